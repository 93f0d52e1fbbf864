"""An episode's figures as metrics: means of each training task's lanes."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from cmrl_jax.algorithms.common.rollout import StepStats, episode_figures


def figures_by_task(
    reward: jax.Array, stats: StepStats, terminated: jax.Array | None, tasks: int
) -> dict[str, jax.Array]:
    """Means (task,) of one episode of every lane (time, lane), task after task.

    Args:
        terminated: see `episode_figures`.
    """
    figures = episode_figures(reward, stats, terminated)
    mean = lambda x: jnp.mean(x.reshape(tasks, -1), -1, dtype=jnp.float32)
    return {
        "success_any": mean(figures.success_any),
        "success_last": mean(figures.success_last),
        "return": mean(figures.returns),
        "final_distance": mean(figures.final_distance),
    }
