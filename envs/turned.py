"""An environment as it is seen by an arm of a search: mirrored, turned, its object held back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import MetaEnv


class TurnedEnv:
    """A `MetaEnv` whose observations and actions are those of a view; all else is the original's.

    Args:
        env: the original.
        of_obs: an invertible matrix, one of `MetaEnv.symmetries` and `MetaEnv.reaches`.
        of_action: an orthogonal one, of the same symmetry.
    """

    def __init__(self, env: MetaEnv, of_obs: np.ndarray, of_action: np.ndarray):
        self._env = env
        self._of_obs, self._of_action = jnp.asarray(of_obs), jnp.asarray(of_action)
        self._to_obs = jnp.asarray(np.linalg.inv(of_obs))
        self.observation_size, self.action_size = env.observation_size, env.action_size
        self.goal_size, self.tasks = env.goal_size, env.tasks
        self.can_terminate = env.can_terminate

    @property
    def symmetries(self) -> tuple[np.ndarray, np.ndarray]:
        """The identity: the view is chosen."""
        identity = lambda size: np.eye(size, dtype=np.float32)[None]
        return identity(self.observation_size), identity(self.action_size)

    @property
    def reaches(self) -> np.ndarray:
        """The identity: it is chosen, too."""
        return np.eye(self.observation_size, dtype=np.float32)[None]

    def reset(self, key: jax.Array, task_id: jax.Array) -> Any:
        """As the original's."""
        return self._seen(self._env.reset(key, task_id))

    def reset_to(self, task_id: jax.Array, goal: jax.Array) -> Any:
        """As the original's."""
        return self._seen(self._env.reset_to(task_id, goal))

    def step(self, state: Any, action: jax.Array) -> Any:
        """As the original's, after an action of the view."""
        original = state.replace(obs=self._to_obs @ state.obs)
        return self._seen(self._env.step(original, self._of_action.T @ action))

    def goals(self, name: str, tasks: Sequence[str]) -> np.ndarray:
        """The original's."""
        return self._env.goals(name, tasks)

    def _seen(self, state: Any) -> Any:
        return state.replace(obs=self._of_obs @ state.obs)
