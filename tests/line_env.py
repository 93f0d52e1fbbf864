"""A third environment: a hidden goal on a line, which only the last step's reward tells of.

The goal is at one end or at the other, and nothing that is observed says at which. One episode's
reward does: who remembers it earns 1 from the second on, who does not can do no better than 0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

TASKS = {"line-left": "line-right", "line-right": "line-left"}
STEPS, STRIDE, END, NEAR = 4, 0.5, 1.0, 0.2


class LineState(struct.PyTreeNode):
    """A walker's state; `goal` is hidden."""

    obs: jax.Array
    reward: jax.Array
    success: jax.Array
    distance: jax.Array
    steps: jax.Array
    faults: jax.Array
    goal: jax.Array


class LineEnv:
    """A `MetaEnv` of episodes of `STEPS` steps; a goal is where the walker starts (1,)."""

    observation_size, action_size, goal_size = 2, 1, 1
    tasks = tuple(TASKS)
    can_terminate = False
    symmetries = np.eye(2, dtype=np.float32)[None], np.eye(1, dtype=np.float32)[None]
    reaches = np.eye(2, dtype=np.float32)[None]

    def reset(self, key: jax.Array, task_id: jax.Array) -> LineState:
        return self.reset_to(task_id, jax.random.uniform(key, (1,), minval=-0.1, maxval=0.1))

    def reset_to(self, task_id: jax.Array, goal: jax.Array) -> LineState:
        zero, none = jnp.zeros(()), jnp.zeros((), jnp.int32)
        return LineState(
            obs=jnp.append(jnp.asarray(goal), 0.0),
            reward=zero,
            success=jnp.zeros((), bool),
            distance=zero,
            steps=none,
            faults=none,
            goal=jnp.array([-END, END])[task_id],
        )

    def step(self, state: LineState, action: jax.Array) -> LineState:
        place = jnp.clip(state.obs[0] + STRIDE * jnp.clip(action[0], -1.0, 1.0), -END, END)
        steps = state.steps + 1
        distance = jnp.abs(place - state.goal)
        return state.replace(
            obs=jnp.stack([place, steps / STEPS]),
            reward=jnp.where(steps == STEPS, 1.0 - distance / (2.0 * END), 0.0),
            success=(steps == STEPS) & (distance < NEAR),
            distance=distance,
            steps=steps,
        )

    def goals(self, name: str, tasks: Sequence[str]) -> np.ndarray:
        seed = {"train": 0, "heldout": 1}[name]
        return np.random.default_rng(seed).uniform(-0.1, 0.1, (len(tasks), 50, 1))


def make(options: Any) -> LineEnv:
    """What `env.name: line` builds."""
    del options
    return LineEnv()
