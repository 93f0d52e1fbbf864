"""Benchmark rows as a user of Gymnasium meets them: vector environments, stepped from Python.

Ours by backend and number of lanes, one program for all of them, beside Meta-World's own
environments in Gymnasium's SyncVectorEnv. Those in processes of their own are the row
`metaworld_vector`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cmrl_jax.bench.physics import CONTROL_STEPS, Report, best_seconds

TASK, LANES, HORIZON = "drawer-open", (64, 256), 200
METAWORLD_LANES = 8  # it steps them one after another: more are no quicker, and each has its scene


def bench_gymnasium(report: Report) -> None:
    """Control steps a second of both, with random actions that come from the host."""
    import gymnasium

    from envs.adapters.gymnasium_ids import env_id
    from envs.adapters.metaworld_envs import make_vector_env, set_goals
    from envs.goal_sets import load_goal_set

    for physics in ("native", "mjx"):
        for lanes in LANES:
            envs = gymnasium.make_vec(
                env_id(TASK), num_envs=lanes, horizon=HORIZON, physics=physics
            )
            rate = steps_per_s(envs)
            report.add(f"gymnasium/{physics}/control_steps_per_s", rate, "1/s", lanes=lanes)
    goals = load_goal_set("train", (TASK,))[0, :METAWORLD_LANES]
    envs = make_vector_env(TASK, goals, METAWORLD_LANES, HORIZON)
    set_goals(envs, TASK, goals, goal_observable=False)
    rate = steps_per_s(envs)
    report.add("gymnasium/metaworld/control_steps_per_s", rate, "1/s", lanes=METAWORLD_LANES)


def steps_per_s(envs: Any) -> float:
    """Control steps of all lanes a second, without the first, which compiles; closes them."""
    generator = np.random.default_rng(0)
    actions = generator.uniform(-1, 1, (CONTROL_STEPS, envs.num_envs, 4)).astype(np.float32)

    def steps() -> None:
        for action in actions:
            envs.step(action)

    envs.reset(seed=0)
    envs.step(actions[0])
    seconds = best_seconds(steps)
    envs.close()
    return envs.num_envs * CONTROL_STEPS / seconds
