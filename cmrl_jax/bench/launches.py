"""Benchmark rows of what XLA makes of our programs for an NVIDIA H100, on a machine without one.

Small steps on a GPU cost what starting their kernels costs, so kernels started a step are the
yardstick. A program is compiled for a described device, in a process of its own; nothing runs.
Needed are jax's two CUDA wheels and none of NVIDIA's libraries (`HOW`).
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import os
import re
import subprocess
import sys
import time
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import topologies

from cmrl_jax.bench.physics import CONTROL_STEPS, Report, random_steps
from cmrl_jax.config.files import load_config
from cmrl_jax.config.schema import ConfigError, require
from cmrl_jax.evaluation.session import Session, prepare_jax
from cmrl_jax.jax_runtime import repeated_options
from cmrl_jax.streams import to_stderr

HOW = (
    "python -m pip install --no-deps jax-cuda13-plugin=={0} jax-cuda13-pjrt=={0}; then, without a "
    "GPU, JAX_PLATFORMS=cpu JAX_SKIP_CUDA_CONSTRAINTS_CHECK=1 python train.py bench --rows launches"
)
# Programs, and the configurations that each is compiled for; any has the same physics.
PROGRAMS = {
    "gradient_step": ("ml4.yaml", "ml4-large.yaml"),
    "vector_step": ("ml4.yaml",),
    "training_iteration": ("ml4.yaml", "ml4-large.yaml"),
}
GRADIENT_STEPS, LANES = 100, 2048

# What XLA asks a device to be; of an "NVIDIA H100 80GB HBM3".
H100 = """
gpu_device_info {
  threads_per_block_limit: 1024 threads_per_warp: 32 shared_memory_per_block: 49152
  shared_memory_per_core: 233472 threads_per_core_limit: 2048 core_count: 132 fpus_per_core: 128
  block_dim_limit_x: 2147483647 block_dim_limit_y: 65535 block_dim_limit_z: 65535
  memory_bandwidth: 3352320000000 l2_cache_size: 52428800 clock_rate_ghz: 1.98
  device_memory_size: 84978434048 shared_memory_per_block_optin: 232448
  registers_per_core_limit: 65536 registers_per_block_limit: 65536
  cuda_compute_capability { major: 9 }
}
platform_name: "CUDA"
dnn_version_info { major: 9 minor: 12 }
device_description_str: "NVIDIA H100 80GB HBM3"
"""

STARTS = "fusion|custom-call|copy|sort|dot|scatter|reduce|while|conditional|call"
LAUNCH = re.compile(rf" = \S.*? ({STARTS})\(")
HEAD = re.compile(r"(ENTRY )?%?([\w.\-]+) \(.*\{$")


@dataclass(frozen=True)
class Launches:
    """Kernels that a program starts, those that only copy among them."""

    kernels: int = 0
    copies: int = 0

    def __add__(self, other: Launches) -> Launches:
        return Launches(self.kernels + other.kernels, self.copies + other.copies)

    def times(self, trips: int) -> Launches:
        return Launches(self.kernels * trips, self.copies * trips)


def count_launches(text: str) -> Launches:
    """What a compiled module starts from beginning to end.

    A loop counts its body as often as it runs; one that may end early, once. Of a conditional's
    branches the costliest counts.

    Args:
        text: `jax.stages.Compiled.as_text()`.
    """
    lines: dict[str, list[str]] = {}
    entry = current = ""
    for line in text.splitlines():
        if head := HEAD.match(line):
            current = head[2]
            lines[current] = []
            entry = current if head[1] else entry
        elif LAUNCH.search(line):
            lines[current].append(line)

    def of_computation(name: str) -> Launches:
        return sum((of_line(line) for line in lines[name]), start=Launches())

    def of_line(line: str) -> Launches:
        found = LAUNCH.search(line)
        assert found is not None
        kind = found[1]
        if kind == "while":
            trips = re.search(r'known_trip_count":\{"n":"(\d+)"', line)
            body = re.search(r"body=%?([\w.\-]+)", line)
            assert body is not None
            return of_computation(body[1]).times(int(trips[1]) if trips else 1)
        if kind == "conditional":
            names = re.findall(r"(?:true|false)_computation=%?([\w.\-]+)", line)
            if branches := re.search(r"branch_computations=\{(.*?)\}", line):
                names = re.findall(r"%?([\w.\-]+)", branches[1])
            costs = [of_computation(name) for name in names]
            return max(costs, key=lambda cost: cost.kernels)
        if kind == "call":
            called = re.search(r"to_apply=%?([\w.\-]+)", line)
            assert called is not None
            return of_computation(called[1])
        return Launches(1, int(kind == "copy"))

    return of_computation(entry)


def check_wheels() -> None:
    """Raises ConfigError where the wheels are not installed."""
    cause = "rows 'launches' need jax's CUDA wheels"
    cure = HOW.format(importlib.metadata.version("jaxlib"))
    require(importlib.util.find_spec("jax_cuda13_plugin") is not None, cause, cure)


def bench_launches(report: Report) -> None:
    """Rows `launches/` of every program; skipped without the wheels.

    Raises:
        ConfigError: a program does not compile.
    """
    try:
        check_wheels()
    except ConfigError as error:
        to_stderr(f"skipped: {error.cause} ({error.cure})")
        return
    for name, config_files in PROGRAMS.items():
        for config_file in config_files:
            row = compile_apart(name, config_file)
            labels = {"device": "H100, described", "config": config_file}
            if name == "vector_step":
                labels["lanes"] = LANES
            report.add(f"launches/{name}", row["kernels"], "1", **labels)
            report.add(f"launches/{name}_copies", row["copies"], "1", **labels)
            report.add(f"launches/{name}_compile_s", row["compile_s"], "s", **labels)
            report.add(f"launches/{name}_spilled_bytes", row["spilled_bytes"], "1", **labels)


def compile_apart(name: str, config_file: str) -> dict[str, float]:
    """What `compile_for_gpu` finds, in a process of its own, and bytes of registers spilled.

    Of each thread, by all kernels together: one that spills thousands is a kernel that XLA made too
    large, slow to compile and to run.

    Raises:
        ConfigError: the program does not compile.
    """
    command = [sys.executable, "-m", "cmrl_jax.bench.launches", name, config_file]
    # jax finds the plugin, and is not to look for a GPU; XLA tells what the assembler warns of.
    told = {
        "JAX_PLATFORMS": "cpu",
        "JAX_SKIP_CUDA_CONSTRAINTS_CHECK": "1",
        "TF_CPP_MIN_LOG_LEVEL": "0",
    }
    run = subprocess.run(command, env=os.environ | told, capture_output=True, text=True)
    if run.returncode:
        to_stderr(run.stderr)
        cause = f"program '{name}' does not compile for the described GPU, as shown above"
        cure = HOW.format(importlib.metadata.version("jaxlib"))
        raise ConfigError(cause, f"take the wheels of jaxlib's own version: {cure}")
    return json.loads(run.stdout.splitlines()[-1]) | {"spilled_bytes": spilled_bytes(run.stderr)}


def spilled_bytes(log: str) -> int:
    """Bytes that the assembler says were stored for want of registers."""
    return sum(int(number) for number in re.findall(r"(\d+) bytes spill stores", log))


def program(name: str, config_file: str) -> tuple[Any, tuple[Any, ...], int]:
    """A function, the shapes it is called with, and how many steps it makes."""
    config = load_config(config_file)
    prepare_jax(config)
    session = Session(config)
    env, learner = session.env, session.algorithm.parts
    key = jax.eval_shape(lambda: jax.random.key(0))

    def gradient_steps(run: Any, key: Any) -> Any:
        keys = jax.random.split(key, GRADIENT_STEPS)
        return learner.updates(run.learner, run.replay, run.context, keys)[0]

    if name == "gradient_step":
        return gradient_steps, (jax.eval_shape(session.algorithm.init, key), key), GRADIENT_STEPS
    if name == "training_iteration":
        iteration = session.algorithm.make_iteration(session.train_placements())
        return iteration, (jax.eval_shape(session.algorithm.init, key),), 1
    if name != "vector_step":
        raise ValueError(f"unknown program '{name}'")
    reset = lambda key: jax.vmap(env.reset)(jax.random.split(key, LANES), jnp.zeros(LANES, int))
    return random_steps(env), (jax.eval_shape(reset, key), key), CONTROL_STEPS


def compile_for_gpu(name: str, config_file: str) -> dict[str, float]:
    """Kernels and copies a step, and the seconds that compiling took."""
    function, shapes, steps = program(name, config_file)
    jax.config.update("jax_enable_compilation_cache", False)
    target = topologies.get_topology_desc(
        platform="cuda", topology_name="h100", topology="1x1x1", target_config=H100
    )
    place = jax.sharding.SingleDeviceSharding(target.devices[0])
    placed = lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=place)
    jitted = jax.jit(function, compiler_options=repeated_options("gpu"))
    traced = jitted.trace(*jax.tree.map(placed, shapes))
    lowered = traced.lower(lowering_platforms=("cuda",))
    started = time.perf_counter()
    compiled = lowered.compile()
    seconds = time.perf_counter() - started
    found = count_launches(compiled.as_text() or "")
    return {
        "kernels": found.kernels / steps,
        "copies": found.copies / steps,
        "compile_s": seconds,
    }


if __name__ == "__main__":
    print(json.dumps(compile_for_gpu(*sys.argv[1:])))
