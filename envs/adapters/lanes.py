"""Lanes of one task that a host steps: what both Gymnasium environments are made of.

A control step of all lanes is one compiled program, in which a lane whose turn it is begins a fresh
episode instead. Tasks are data: one program serves all tasks, and all environments of a process
that have the same number of lanes.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.goal_sets import load_goal_set
from envs.physics.native import NativeState, unpack
from envs.sawyer import Ml4Env
from envs.tasks import task_id
from envs.tasks.specs import SPECS


class Moment(NamedTuple):
    """What a host reads of its lanes after a reset or a step: arrays of its own."""

    obs: np.ndarray  # (lane, 39) float32
    reward: np.ndarray  # (lane,) float64, of the step that led here
    success: np.ndarray  # (lane,) bool, at this very step
    distance: np.ndarray  # (lane,) float64, metres between object and target
    steps: np.ndarray  # (lane,) int32, control steps since the reset
    faults: np.ndarray  # (lane,) int64, times the simulation failed and was put back to the start


class TaskLanes:
    """Lanes of one task and where they are.

    Args:
        task: one of `TASKS`.
        goal_observable, physics, obs_mode: of `Ml4Env`.
        goals: the named goal set that goals are drawn from (`train`, `heldout`, `fresh:<seed>`);
            None: Meta-World's reset box.

    Raises:
        ValueError: unknown task, backend, observation mode or goal set (two lines: cause, cure).
    """

    def __init__(
        self, task: str, goal_observable: bool, physics: str, obs_mode: str, goals: str | None
    ):
        index = task_id(task)
        self._task_id = jnp.asarray(index, jnp.int32)
        self._box = SPECS[index].placement_low, SPECS[index].placement_high
        self._goal_set = None if goals is None else load_goal_set(goals, (task,))[0]
        self._begin, self._advance = _programs(bool(goal_observable), physics, obs_mode)
        self._states: Any = None

    def draw_goal(self, generator: np.random.Generator) -> np.ndarray:
        """A goal (3,), the fixture's placement in metres, float32."""
        if self._goal_set is None:
            return generator.uniform(*self._box).astype(np.float32)
        return self._goal_set[generator.integers(len(self._goal_set))].astype(np.float32)

    def begin(self, goals: np.ndarray, is_due: np.ndarray) -> Moment:
        """Begins an episode on `goals` (lane, 3) in the lanes that are due, at first in all."""
        fresh = self._begin(self._task_id, goals)
        self._states = fresh if is_due.all() else _merge(is_due, fresh, self._states)
        return _read(self._states)

    def step(self, actions: np.ndarray, is_due: np.ndarray, goals: np.ndarray) -> Moment:
        """One control step of the lanes that are begun.

        Args:
            actions: (lane, 4) in [-1, 1].
            is_due: (lane,) bool, lanes that begin an episode instead, on their goal.
            goals: (lane, 3).
        """
        self._states = self._advance(self._states, actions, is_due, self._task_id, goals)
        return _read(self._states)

    def qpos(self) -> np.ndarray:
        """Joint positions (lane, 10): seven arm hinges, two finger slides, the fixture's slide."""
        physics = self._states.physics
        if isinstance(physics, NativeState):
            return unpack(physics.replace(words=np.asarray(physics.words)))["qpos"]
        return np.asarray(physics.qpos)


@functools.cache
def _programs(
    goal_observable: bool, physics: str, obs_mode: str
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """`begin` and `advance` of all lanes, compiled once a process and number of lanes."""
    env = Ml4Env(goal_observable, physics, obs_mode)
    begin = jax.vmap(env.reset_to, in_axes=(None, 0))

    def advance(states, actions, is_due, task, goals):
        after = jax.vmap(env.step)(states, actions)
        return _merge(is_due, begin(task, goals), after)

    return jax.jit(begin), jax.jit(advance)


@jax.jit
def _merge(is_new: jax.Array, new: Any, old: Any) -> Any:
    """States of all lanes: the new ones where `is_new` (lane,), else the old ones."""
    one = lambda is_new, new, old: jax.tree.map(lambda n, o: jnp.where(is_new, n, o), new, old)
    return jax.vmap(one)(is_new, new, old)


def _read(states: Any) -> Moment:
    read = states.obs, states.reward, states.success, states.distance, states.steps, states.faults
    obs, reward, success, distance, steps, faults = jax.device_get(read)
    # Copies: what jax hands out may be its own memory, and not to be written to.
    return Moment(
        obs=np.array(obs),
        reward=reward.astype(np.float64),
        success=np.array(success),
        distance=distance.astype(np.float64),
        steps=np.array(steps),
        faults=faults.astype(np.int64),
    )
