"""Benchmark rows of the physics: our backends beside the naive port and Meta-World's own ways.

Every row counts control steps (five substeps of 2.5 ms) a second with random actions, compile time
apart. All rows of one file were measured one after another by one process on one machine.
"""

from __future__ import annotations

import os
import resource
import tempfile
import time
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.compilation_cache import compilation_cache

from cmrl_jax.jax_runtime import jit_repeated
from envs.engine import mujoco
from envs.physics.model import load_scene
from envs.physics.native import NativePhysics
from envs.physics.workers import processors
from envs.sawyer import Ml4Env
from envs.tasks import TASKS

CONTROL_STEPS, REPEATS, SUBSTEPS = 20, 3, 5
NAIVE_LANES, NAIVE_STEPS = 64, 2
ROLLOUT_LANES = WORKER_LANES = 256
METAWORLD_STEPS, VECTOR_PROCESSES = 1000, 2


class Report(Protocol):
    """Where rows go."""

    def add(self, name: str, value: float, unit: str, **labels: Any) -> None: ...


def best_seconds(run: Callable[[], Any], repeats: int = REPEATS) -> float:
    """The shortest of a few runs: other work on the machine only ever adds time."""
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(run())
        seconds.append(time.perf_counter() - started)
    return min(seconds)


def random_steps(env: Any) -> Callable[[Any, jax.Array], Any]:
    """`CONTROL_STEPS` steps with random actions: (states of all lanes, key) -> states."""

    def steps(state: Any, key: jax.Array) -> Any:
        def step(state: Any, key: jax.Array) -> tuple[Any, None]:
            action = jax.random.uniform(
                key, (len(state.steps), env.action_size), minval=-1, maxval=1
            )
            return jax.vmap(env.step)(state, action), None

        return jax.lax.scan(step, state, jax.random.split(key, CONTROL_STEPS))[0]

    return steps


def bench_backend(physics: str, lane_counts: tuple[int, ...], report: Report) -> None:
    """Our environment, lanes of all four tasks mixed, by number of lanes."""
    env = Ml4Env(physics=physics)
    steps = random_steps(env)

    for lanes in lane_counts:
        task = jnp.arange(lanes) % len(TASKS)
        state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), lanes), task)
        before = peak_memory_mb()
        compiled, cold_s, warm_s = compile_twice(
            lambda: jit_repeated(steps), state, jax.random.key(1)
        )
        seconds = best_seconds(lambda: compiled(state, jax.random.key(1)))
        label = {"lanes": lanes}
        report.add(
            f"{physics}/control_steps_per_s", lanes * CONTROL_STEPS / seconds, "1/s", **label
        )
        report.add(f"{physics}/compile_cold_s", cold_s, "s", **label)
        report.add(f"{physics}/compile_warm_s", warm_s, "s", **label)
        analysis = compiled.memory_analysis()
        if analysis is not None:
            kb = (analysis.temp_size_in_bytes + analysis.output_size_in_bytes) / 1024 / lanes
            report.add(f"{physics}/memory_per_lane_kb", kb, "kB", **label)
        grown = peak_memory_mb() - before
        report.add(f"{physics}/peak_memory_growth_mb", grown, "MB", **label)


def bench_workers(report: Report) -> None:
    """Host physics by the number of processes that simulate, at least up to 4."""
    env = Ml4Env(physics="native")
    task = jnp.arange(WORKER_LANES) % len(TASKS)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), WORKER_LANES), task)
    count, most = 1, max(4, processors())
    while count <= most:
        physics = NativePhysics(count)
        env.physics = physics
        steps = jax.jit(random_steps(env))
        jax.block_until_ready(steps(state, jax.random.key(1)))  # compiled, and the others started
        seconds = best_seconds(lambda: steps(state, jax.random.key(1)))
        physics.close()
        rate = WORKER_LANES * CONTROL_STEPS / seconds
        labels = {"lanes": WORKER_LANES, "workers": count}
        report.add("native_workers/control_steps_per_s", rate, "1/s", **labels)
        count *= 2


def compile_twice(make: Callable[[], Any], *args: Any) -> tuple[Any, float, float]:
    """A program, and the seconds its compile takes with an empty and with a filled cache."""
    old = jax.config.jax_compilation_cache_dir
    seconds, compiled = [], None
    with tempfile.TemporaryDirectory() as folder:
        jax.config.update("jax_compilation_cache_dir", folder)
        compilation_cache.reset_cache()
        try:
            for _ in range(2):
                jax.clear_caches()  # else the second is answered from memory
                lowered = make().lower(*args)
                started = time.perf_counter()
                compiled = lowered.compile()
                seconds.append(time.perf_counter() - started)
        finally:
            jax.config.update("jax_compilation_cache_dir", old)
            compilation_cache.reset_cache()
    return compiled, seconds[0], seconds[1]


def peak_memory_mb() -> float:
    """Peak resident memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def bench_naive(report: Report) -> None:
    """The port one gets for nothing: Meta-World's drawer scene through `mjx.step` as it is.

    Only what MJX cannot load is taken out of collision (cylinders).
    """
    from envs.physics.mjx.quiet import mjx

    model = load_scene("drawer")
    cylinders = model.geom_type == mujoco.mjtGeom.mjGEOM_CYLINDER
    model.geom_contype[cylinders] = model.geom_conaffinity[cylinders] = 0
    device_model = mjx.put_model(model)
    data = mujoco.MjData(model)
    data.mocap_pos[0], data.mocap_quat[0] = (0.0, 0.6, 0.2), (1.0, 0.0, 1.0, 0.0)
    lane = mjx.put_data(model, data)
    lanes = jax.tree.map(lambda x: jnp.stack([x] * NAIVE_LANES), lane)

    def control_step(data):
        substep = lambda data, _: (mjx.step(device_model, data), None)
        return jax.lax.scan(substep, data, None, length=SUBSTEPS)[0]

    def steps(data):
        body = lambda data, _: (jax.vmap(control_step)(data), None)
        return jax.lax.scan(body, data, None, length=NAIVE_STEPS)[0]

    started = time.perf_counter()
    compiled = jax.jit(steps).lower(lanes).compile()
    compile_s = time.perf_counter() - started
    seconds = best_seconds(lambda: compiled(lanes), repeats=1)
    rate = NAIVE_LANES * NAIVE_STEPS / seconds
    report.add("naive/control_steps_per_s", rate, "1/s", lanes=NAIVE_LANES)
    report.add("naive/compile_s", compile_s, "s", lanes=NAIVE_LANES)


def bench_rollout(report: Report) -> None:
    """Bare `mujoco.rollout`: one call a control step, nothing read or written but the state."""
    from mujoco import rollout

    model = load_scene("drawer")
    threads = os.cpu_count() or 1
    data = [mujoco.MjData(model) for _ in range(threads)]
    for _ in range(50):
        data[0].mocap_pos[0], data[0].mocap_quat[0] = (0.0, 0.6, 0.2), (1.0, 0.0, 1.0, 0.0)
        mujoco.mj_step(model, data[0], nstep=SUBSTEPS)
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    start = np.zeros(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data[0], start, kind)
    spec = int(mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_MOCAP_POS)
    spec |= int(mujoco.mjtState.mjSTATE_MOCAP_QUAT)
    generator = np.random.default_rng(0)

    with rollout.Rollout(nthread=threads) as pool:

        def steps():
            state, mocap = (
                np.tile(start, (ROLLOUT_LANES, 1)),
                np.tile((0, 0.6, 0.2), (ROLLOUT_LANES, 1)),
            )
            for _ in range(CONTROL_STEPS):
                action = generator.uniform(-1, 1, (ROLLOUT_LANES, 4))
                mocap = mocap + 0.01 * action[:, :3]
                effort = np.stack([action[:, 3], -action[:, 3]], 1)
                turned = np.tile((1.0, 0.0, 1.0, 0.0), (ROLLOUT_LANES, 1))
                control = np.concatenate([effort, mocap, turned], 1)[:, None]
                control = np.repeat(control, SUBSTEPS, 1)
                states, _ = pool.rollout(model, data, state, control, control_spec=spec)
                state = states[:, -1]

        seconds = best_seconds(steps)
    rate = ROLLOUT_LANES * CONTROL_STEPS / seconds
    report.add("rollout/control_steps_per_s", rate, "1/s", lanes=ROLLOUT_LANES, threads=threads)


def _metaworld_env():
    """Meta-World's own drawer-open environment with a goal set, as Gymnasium users step it."""
    from envs.goal_sets import load_goal_set
    from envs.parity.reference import ReferenceEnv

    reference = ReferenceEnv("drawer-open")
    reference.reset(load_goal_set("train", ("drawer-open",))[0, 0])
    return reference.env


def bench_metaworld(report: Report) -> None:
    """Meta-World's own environment, stepped in Python."""
    env = _metaworld_env()
    generator = np.random.default_rng(0)

    def steps():
        for step in range(METAWORLD_STEPS):
            if step % 200 == 0:
                env.reset()
            env.step(generator.uniform(-1, 1, 4).astype(np.float32))

    seconds = best_seconds(steps)
    report.add("metaworld/control_steps_per_s", METAWORLD_STEPS / seconds, "1/s", processes=1)


def bench_metaworld_vector(report: Report) -> None:
    """Gymnasium's asynchronous vector environment of it, one process an environment."""
    import gymnasium

    # Spawned, not forked: a fork of a process with jax's threads may deadlock.
    with_processes = gymnasium.vector.AsyncVectorEnv(
        [_metaworld_env] * VECTOR_PROCESSES, context="spawn"
    )
    generator = np.random.default_rng(0)
    try:
        with_processes.reset()

        def steps():
            for step in range(METAWORLD_STEPS // VECTOR_PROCESSES):
                if step % 200 == 0:
                    with_processes.reset()
                actions = generator.uniform(-1, 1, (VECTOR_PROCESSES, 4)).astype(np.float32)
                with_processes.step(actions)

        seconds = best_seconds(steps)
    finally:
        with_processes.close()
    rate = METAWORLD_STEPS / seconds
    report.add("metaworld_vector/control_steps_per_s", rate, "1/s", processes=VECTOR_PROCESSES)
