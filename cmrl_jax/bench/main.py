"""`train.py bench`: figures of this machine, as JSON rows that are flushed one by one.

Kinds of rows (`--rows`) are the keys of `KINDS`. Physics rows stand in `bench/physics.py`,
`bench/stages.py` and `bench/vector_envs.py`; here are the learner (gradient steps) and the start
(seconds from the command to the end of the first iteration, with an empty and a filled compilation
cache, and peak memory), both of the main job. `bench/launches.py` counts the kernels that a step
starts on a GPU, and times how long its programs compile.
"""

from __future__ import annotations

import datetime
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from cmrl_jax.algorithms.common.replay import Transition, add
from cmrl_jax.bench import physics as bench_physics
from cmrl_jax.bench import stages as bench_stages
from cmrl_jax.bench.launches import bench_launches, check_wheels
from cmrl_jax.bench.physics import best_seconds
from cmrl_jax.bench.vector_envs import bench_gymnasium
from cmrl_jax.commands import CHILD
from cmrl_jax.config.files import load_config
from cmrl_jax.config.schema import Config, ConfigError, call_envs
from cmrl_jax.evaluation.session import Session, prepare_jax
from cmrl_jax.jax_runtime import jit_once, jit_repeated
from cmrl_jax.places import ROOT
from cmrl_jax.storage.versions import package_versions
from envs.outputs import write_json

CONFIG = "ml4.yaml"
LANES = (32, 256, 512, 2048)
GRADIENT_STEPS = 100


class Report:
    """The JSON file, rewritten after every row, so that a stopped run keeps its rows."""

    def __init__(self, path: Path, device: str, command: str = "bench"):
        self._path, self._command = path, command
        self._document: dict[str, Any] = {
            "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "device": device,
            "cpu_count": os.cpu_count(),
            "versions": package_versions(),
            "rows": [],
        }

    @property
    def device(self) -> str:
        """What the rows were measured on."""
        return self._document["device"]

    @device.setter
    def device(self, name: str) -> None:
        self._document["device"] = name

    def add(self, name: str, value: float, unit: str, **labels: Any) -> None:
        self._document["rows"].append({"name": name, "value": value, "unit": unit} | labels)
        call_envs(lambda: write_json(self._path, self._command, self._document))
        shown = " ".join(f"{key}={label}" for key, label in labels.items())
        print(f"{name:<30} {value:>10.1f} {unit:<8} {shown}", flush=True)


def bench_learner(config: Config, report: bench_physics.Report) -> None:
    """Gradient steps a second on rings full of random transitions, and what compiling them took.

    That is short where the cache of compiled programs has them.
    """
    session = Session(config)
    learner, env = session.algorithm.parts, session.env
    run = jit_once(session.algorithm.init)(jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), 4)
    lead = (config.env.horizon, len(config.tasks.train), run.replay.lanes_per_task)
    flag = jnp.zeros(lead, bool)
    data = Transition(
        obs=jax.random.normal(keys[0], (*lead, env.observation_size)),
        action=jax.random.uniform(keys[1], (*lead, env.action_size), minval=-1, maxval=1),
        reward=jax.random.uniform(keys[2], lead),
        terminated=flag,
        truncated=flag,
        first=flag,
        next_obs=jax.random.normal(keys[3], (*lead, env.observation_size)),
    )
    replay = jax.jit(add)(run.replay, data)
    writers = run.context.lanes_per_task
    context = jax.jit(add)(run.context, jax.tree.map(lambda x: x[:, :, :writers], data))

    def updates(state, key):
        keys = jax.random.split(key, GRADIENT_STEPS)
        return learner.updates(state, replay, context, keys)[0]

    lowered = jit_repeated(updates).lower(run.learner, jax.random.key(2))
    started = time.perf_counter()
    compiled = lowered.compile()
    compile_s = time.perf_counter() - started
    seconds = best_seconds(lambda: compiled(run.learner, jax.random.key(2)))
    shape = f"{len(config.tasks.train)}x{config.sac.batch}"
    report.add("learner/gradient_steps_per_s", GRADIENT_STEPS / seconds, "1/s", batch=shape)
    report.add("learner/compile_s", compile_s, "s", batch=shape)


def bench_start(config: Config, report: Report) -> None:
    """Two processes of the main job: the first compiles, the second finds everything compiled."""
    with tempfile.TemporaryDirectory() as folder:
        for name in ("cold", "warm"):
            seconds, peak = time_to_iterations(Path(folder), name)
            report.add(f"start/{name}_s", seconds, "s")
        report.add("memory/peak_mb", peak, "MB")


def time_to_iterations(folder: Path, name: str) -> tuple[float, float]:
    """Seconds to the end of iteration 0, and peak memory in MB by the end of iteration 1."""
    script = ROOT / "train.py"
    launch = [str(script)] if script.is_file() else ["-c", CHILD]
    command = [sys.executable, *launch, "--config", CONFIG, "--run", str(folder / name)]
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(folder / "cache")}
    started = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    assert process.stdout is not None
    seconds = None
    try:
        for line in process.stdout:
            if line.startswith("iter ") and seconds is None:
                seconds = time.perf_counter() - started
            elif line.startswith("iter "):
                return seconds or 0.0, peak_memory_mb(process.pid)
    finally:
        process.kill()
        process.wait()
    raise RuntimeError(f"{' '.join(command)} ended before its second iteration")


def peak_memory_mb(pid: int) -> float:
    """Peak resident memory of a running process, from the kernel (Linux)."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024
    raise RuntimeError("the kernel reports no peak memory")


KINDS = {
    "mjx": lambda config, report: bench_physics.bench_backend("mjx", LANES, report),
    "stages": lambda config, report: bench_stages.bench_stages(LANES, report),
    "native": lambda config, report: bench_physics.bench_backend("native", LANES, report),
    "native_workers": lambda config, report: bench_physics.bench_workers(report),
    "rollout": lambda config, report: bench_physics.bench_rollout(report),
    "metaworld": lambda config, report: bench_physics.bench_metaworld(report),
    "metaworld_vector": lambda config, report: bench_physics.bench_metaworld_vector(report),
    "gymnasium": lambda config, report: bench_gymnasium(report),
    "learner": bench_learner,
    "start": bench_start,
    "launches": lambda config, report: bench_launches(report),
    "naive": lambda config, report: bench_physics.bench_naive(report),
}


def main(json_path: Path, rows: tuple[str, ...]) -> int:
    """Measures the chosen kinds of rows (all by default); returns the exit code.

    Raises:
        ConfigError: an unknown kind, or one that needs what is not installed.
    """
    for row in rows:
        if row not in KINDS:
            raise ConfigError(f"unknown rows '{row}'", f"choose from: {', '.join(KINDS)}")
    if "launches" in rows:
        check_wheels()
    config = load_config(CONFIG)
    report = Report(json_path, prepare_jax(config))
    for kind, measure in KINDS.items():
        if kind in (rows or KINDS):
            measure(config, report)
    return 0
