"""Benchmark rows of one MJX control step, stage by stage: where the time goes.

Each stage is jitted by itself over the five substeps of a control step, from the same states, so
the stages need not add up to the whole: fused together they share work.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from cmrl_jax.bench.physics import Report, best_seconds
from cmrl_jax.jax_runtime import jit_repeated
from envs.physics.mjx.backend import (
    LINE_SEARCH_ITERATIONS,
    ROBOT_JOINTS,
    SOLVER_ITERATIONS,
    SUBSTEPS,
    WELD_ROWS,
    MjxPhysics,
)
from envs.physics.mjx.quiet import mjx
from envs.physics.mjx.solver import solve, solve_positive
from envs.physics.model import JOINTS
from envs.tasks import TASKS
from envs.tasks.specs import SCENE_ID


def bench_stages(lane_counts: tuple[int, ...], report: Report) -> None:
    """Rows `mjx/stage_ms` by stage and number of lanes, lanes of all four tasks mixed."""
    physics = MjxPhysics()
    scene_ids = jnp.asarray(SCENE_ID)

    def start(task: jax.Array) -> Any:
        low = jnp.array([0.0, 0.9, 0.16])
        return physics.start(task, low)

    def arm(state: Any, scene: Any) -> Any:
        data = physics._data.replace(qpos=state.qpos[:ROBOT_JOINTS], qvel=state.qvel[:ROBOT_JOINTS])
        return physics._smooth_dynamics(data)

    def constraints(state: Any, scene: Any) -> Any:
        data = arm(state, scene)
        return data, physics._constraints(state, data, scene)

    def with_solver(state: Any, scene: Any) -> jax.Array:
        data, (rows, cones) = constraints(state, scene)
        mass = jnp.eye(JOINTS).at[:ROBOT_JOINTS, :ROBOT_JOINTS].set(mjx.full_m(physics.model, data))
        force = jnp.append(data.qfrc_smooth, 0.0)
        smooth = solve_positive(mass, force)
        budget = (WELD_ROWS, SOLVER_ITERATIONS, LINE_SEARCH_ITERATIONS)
        return solve(mass, force, smooth, state.warm_start, rows, cones, *budget)[0]

    # Each adds one stage to those before it, and returns something that all of it leads to.
    stages: dict[str, Callable[[Any, Any], jax.Array]] = {
        "arm": lambda state, scene: total(arm(state, scene).qfrc_smooth),
        "arm+contacts+rows": lambda state, scene: total(constraints(state, scene)[1]),
        "arm+contacts+rows+solver": lambda state, scene: total(with_solver(state, scene)),
    }

    def repeated(stage: Callable[[Any, Any], jax.Array]) -> Callable[[Any, jax.Array], Any]:
        def lane(state: Any, scene_id: jax.Array) -> jax.Array:
            scene = physics.scene(scene_id)

            def substep(state: Any, _: None) -> tuple[Any, None]:
                nudge = 1e-9 * stage(state, scene)  # what follows depends on it
                return state.replace(qpos=state.qpos + nudge), None

            return jax.lax.scan(substep, state, None, length=SUBSTEPS)[0].qpos

        return jit_repeated(jax.vmap(lane))

    for lanes in lane_counts:
        task = jnp.arange(lanes) % len(TASKS)
        state = jax.jit(jax.vmap(start))(task)
        scene_id = scene_ids[task]
        ctrl = jnp.zeros((lanes, 2))
        whole = jit_repeated(jax.vmap(physics.step))
        jax.block_until_ready(whole(state, ctrl, scene_id))
        seconds = {"whole": best_seconds(lambda: whole(state, ctrl, scene_id), repeats=10)}
        for name, stage in stages.items():
            run = repeated(stage)
            jax.block_until_ready(run(state, scene_id))
            seconds[name] = best_seconds(lambda run=run: run(state, scene_id), repeats=10)
        for name, value in seconds.items():
            report.add("mjx/stage_ms", 1e3 * value, "ms", stage=name, lanes=lanes)


def total(tree: Any) -> jax.Array:
    """Sum of all numbers of a tree, ()."""
    return sum((jnp.sum(leaf) for leaf in jax.tree.leaves(tree)), start=jnp.zeros(()))
