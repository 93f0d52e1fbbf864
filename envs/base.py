"""What an environment offers the learner: a family of tasks, one lane at a time, in pure functions.

`Ml4Env` (sawyer.py) is one; others are registered with `cmrl_jax.register_environment`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import jax
import numpy as np


class MetaState(Protocol):
    """One lane's state, a pytree; further leaves are the environment's own.

    Attributes:
        obs: (observation_size,) float32.
        reward: () float32, of the step that led here.
        success: () bool, at this very step.
        distance: () float32, the quantity success is judged by, for the figures.
        steps: () int32, control steps since the reset.
        faults: () int32, times the simulation failed and was put back to the start; 0 where it
            cannot.
        terminated: () bool, whether the episode has ended in a true terminal: no later reward
            counts. Read only where the environment `can_terminate`.
    """

    @property
    def obs(self) -> jax.Array: ...
    @property
    def reward(self) -> jax.Array: ...
    @property
    def success(self) -> jax.Array: ...
    @property
    def distance(self) -> jax.Array: ...
    @property
    def steps(self) -> jax.Array: ...
    @property
    def faults(self) -> jax.Array: ...


class MetaEnv(Protocol):
    """Jittable functions of one lane; callers vmap them, lanes of different tasks together.

    Time limits are no matter of the environment's: episodes are cut after `env.horizon` steps.

    Attributes:
        observation_size, action_size: numbers of an observation and of an action in [-1, 1].
        goal_size: numbers of a goal (where the target is, say), which an episode is reset to.
        tasks: names; a task's place is its id.
        can_terminate: whether a step may end an episode for good.
        symmetries: orthogonal matrices that observations (symmetry, observation_size,
            observation_size) and actions (symmetry, action_size, action_size) are multiplied by
            where the scene is seen mirrored or turned, the identity first.
        reaches: matrices that observations (reach, observation_size, observation_size) are
            multiplied by to show an object at another part of the way that it has moved, the
            identity first: a policy that stops where it was taught to then pushes on, or stops
            earlier.
    """

    observation_size: int
    action_size: int
    goal_size: int
    tasks: tuple[str, ...]
    can_terminate: bool

    @property
    def symmetries(self) -> tuple[np.ndarray, np.ndarray]: ...

    @property
    def reaches(self) -> np.ndarray: ...

    def reset(self, key: jax.Array, task_id: jax.Array, /) -> Any:
        """A fresh episode of a task on a random goal: MetaState."""
        ...

    def reset_to(self, task_id: jax.Array, goal: jax.Array, /) -> Any:
        """A fresh episode on a goal (goal_size,): MetaState."""
        ...

    def step(self, state: Any, action: jax.Array, /) -> Any:
        """The MetaState after an action (action_size,), one control step later."""
        ...

    def goals(self, name: str, tasks: Sequence[str]) -> np.ndarray:
        """Goals of a named set, (task, 50, goal_size): the same for every call.

        Args:
            name: `train`, `heldout` or `fresh:<seed>`.

        Raises:
            ValueError: they cannot be had (two lines: cause, cure).
        """
        ...
