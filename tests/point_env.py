"""A second environment: a point on a plate, with edges that it may fall over.

Nothing of it is Meta-World's: three observations, two actions, goals of two numbers, terminals.
The point earns by being on its task's side, and most in a fall over the edge there: who is not told
that a fall ends the episode goes over the edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

TASKS = {"point-left": "point-right", "point-right": "point-left"}
STEP, EDGE, NEAR, FALL = 0.15, 1.0, 0.5, 2.0


class PointState(struct.PyTreeNode):
    """A point's state; `sign` says which side is the task's."""

    obs: jax.Array
    reward: jax.Array
    success: jax.Array
    distance: jax.Array
    steps: jax.Array
    faults: jax.Array
    terminated: jax.Array
    sign: jax.Array


class PointEnv:
    """A `MetaEnv`; a goal is where the point starts (2,)."""

    observation_size, action_size, goal_size = 3, 2, 2
    tasks = tuple(TASKS)
    can_terminate = True
    symmetries = np.eye(3, dtype=np.float32)[None], np.eye(2, dtype=np.float32)[None]
    reaches = np.eye(3, dtype=np.float32)[None]

    def reset(self, key: jax.Array, task_id: jax.Array) -> PointState:
        return self.reset_to(task_id, jax.random.uniform(key, (2,), minval=-0.2, maxval=0.2))

    def reset_to(self, task_id: jax.Array, goal: jax.Array) -> PointState:
        zero = jnp.zeros(())
        return PointState(
            obs=_shown(jnp.asarray(goal)),
            reward=zero,
            success=jnp.zeros((), bool),
            distance=zero,
            steps=jnp.zeros((), jnp.int32),
            faults=jnp.zeros((), jnp.int32),
            terminated=jnp.zeros((), bool),
            sign=jnp.array([-1.0, 1.0])[task_id],
        )

    def step(self, state: PointState, action: jax.Array) -> PointState:
        place = state.obs[:2] + STEP * jnp.clip(action, -1.0, 1.0)
        out = state.sign * place[0]
        fell = jnp.abs(place[0]) > EDGE
        return state.replace(
            obs=_shown(place),
            reward=jnp.where(out > EDGE, FALL, jnp.minimum(out, NEAR)),
            success=(out > NEAR) & ~fell,
            distance=jnp.abs(out - EDGE),
            steps=state.steps + 1,
            terminated=fell,
        )

    def goals(self, name: str, tasks: Sequence[str]) -> np.ndarray:
        seed = {"train": 0, "heldout": 1}[name]
        return np.random.default_rng(seed).uniform(-0.2, 0.2, (len(tasks), 50, 2))


def _shown(place: jax.Array) -> jax.Array:
    """The point's place and its distance from the nearer edge (3,)."""
    return jnp.append(place, EDGE - jnp.abs(place[0]))


def make(options: Any) -> PointEnv:
    """What `env.name: point` builds."""
    del options
    return PointEnv()
