"""The ML4 environment: one lane of any task, written once over a physics backend.

`reset(key, task_id)` and `step(state, action)` are pure functions of one lane; callers vmap them.
Tasks are data, so lanes of different tasks share one compiled program. Reward, observation and
success follow Meta-World V3; they are computed from a small struct of positions that any backend
can fill in.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs.goal_sets import load_goal_set
from envs.physics.backends import make_physics
from envs.physics.base import Physics, Positions, settled_starts
from envs.tasks import TASKS
from envs.tasks.base import HAND_HIGH, HAND_LOW, OBS_HAND_HIGH, OBS_HAND_LOW, RewardInputs
from envs.tasks.specs import SCENE_ID, SPECS

OBS_SIZE, ACTION_SIZE, FRAME = 39, 4, 18
HAND, OBJECT, QUATERNION = slice(0, 3), slice(4, 7), slice(7, 11)  # of a frame
PLANE_SYMMETRIES = np.array(
    [
        [[1, 0], [0, 1]],
        [[-1, 0], [0, 1]],
        [[1, 0], [0, -1]],
        [[-1, 0], [0, -1]],
        [[0, 1], [-1, 0]],
        [[0, -1], [1, 0]],
        [[0, 1], [1, 0]],
        [[0, -1], [-1, 0]],
    ],
    np.float32,
)
REACHES = (1.0, 0.7)  # parts of an object's way at which it is shown; drawer and window have stops
OBS_MODES = ("metaworld", "canonical")


class State(struct.PyTreeNode):
    """One lane's environment state."""

    physics: Any  # of the backend, with `placement` (3,)
    task_id: jax.Array  # () int32, index into `tasks.TASKS`
    frame: jax.Array  # (18,) last frame, the second half of the next observation
    obs: jax.Array  # (39,) frame, previous frame, goal (zeros when hidden), in the mode chosen
    origin: jax.Array  # (3,) where the object stands after the reset, metres in the world
    reward: jax.Array  # () in [0, 10]
    success: jax.Array  # () bool, at this very step
    distance: jax.Array  # () metres between object and target, the quantity success is judged by
    steps: jax.Array  # () int32, control steps since the reset
    faults: jax.Array  # () int32, times the physics became non-finite and was put back to the start


class _TaskData:
    """`SPECS` as arrays with a leading task axis, and what each task shows at its start."""

    def __init__(self) -> None:
        column = lambda field: jnp.asarray(
            np.array([getattr(spec, field) for spec in SPECS], np.float32)
        )
        self.placement_low = column("placement_low")
        self.placement_high = column("placement_high")
        self.start_slide = column("start_slide")
        self.first_obs_slide = column("first_obs_slide")
        self.handle = column("handle")
        self.has_quaternion = column("has_quaternion")
        self.target = column("target")
        starts = settled_starts()
        self.hand, self.opening, self.init_tcp = (
            jnp.asarray(leaf, jnp.float32)
            for leaf in (starts.hand, starts.opening, starts.init_tcp)
        )


class Ml4Env:
    """The environment, a `MetaEnv`; a goal is the fixture's placement (3,), metres.

    Args:
        goal_observable: show the target in the last three observation numbers.
        physics: backend, one of `physics.backends.BACKENDS`.
        obs_mode: `metaworld`, or `canonical`, see `canonical_obs`.

    Raises:
        ValueError: unknown backend or observation mode.
    """

    observation_size = OBS_SIZE
    action_size = ACTION_SIZE
    goal_size = 3
    tasks = TASKS
    can_terminate = False  # Meta-World has no terminal states

    def __init__(
        self, goal_observable: bool = False, physics: str = "mjx", obs_mode: str = "metaworld"
    ):
        if obs_mode not in OBS_MODES:
            raise ValueError(
                f"unknown observation mode '{obs_mode}'\nvalid: {', '.join(OBS_MODES)}"
            )
        self.obs_mode = obs_mode
        self.physics: Physics = make_physics(physics)
        self.goal_observable = goal_observable
        self._data = _TaskData()
        self._scene_id = jnp.asarray(SCENE_ID)

    def reset(self, key: jax.Array, task_id: jax.Array) -> State:
        """A fresh episode with a random placement of the fixture (Meta-World's reset box)."""
        low, high = self._data.placement_low[task_id], self._data.placement_high[task_id]
        return self.reset_to(task_id, low + (high - low) * jax.random.uniform(key, (3,)))

    def reset_to(self, task_id: jax.Array, placement: jax.Array) -> State:
        """A fresh episode with the fixture at `placement` (3,), a goal of a named goal set."""
        tasks = self._data
        task_id = jnp.asarray(task_id, jnp.int32)
        physics = self.physics.start(task_id, placement)
        fixture = self.physics.fixture(self._scene_id[task_id])
        shown = physics.placement + fixture.offset + fixture.axis * tasks.first_obs_slide[task_id]
        frame = self._frame(tasks.hand[task_id], tasks.opening[task_id], shown, task_id)
        goal = self._target(physics, task_id) * float(self.goal_observable)
        obs = jnp.concatenate([frame, frame, goal])
        origin = frame[OBJECT] + self.reset_lag(task_id)
        zero = jnp.zeros(())
        return State(
            physics=physics,
            task_id=task_id,
            frame=frame,
            obs=self._in_mode(obs, origin),
            origin=origin,
            reward=zero,
            success=jnp.zeros((), bool),
            distance=zero,
            steps=jnp.zeros((), jnp.int32),
            faults=jnp.zeros((), jnp.int32),
        )

    def reset_lag(self, task_id: jax.Array) -> jax.Array:
        """From where the reset observation shows a task's object to where it stands (3,), metres.

        Zero but for window-close, see the NOTE in `tasks/window.py`.
        """
        axis = self.physics.fixture(self._scene_id[task_id]).axis
        return (self._data.start_slide - self._data.first_obs_slide)[task_id] * axis

    def step(self, state: State, action: jax.Array) -> State:
        """One control step; `action` (4,) in [-1, 1]: hand displacement / 0.01 m, finger effort."""
        action = jnp.clip(action, -1.0, 1.0)
        scene = self._scene_id[state.task_id]
        physics, is_finite = self.physics.advance(state.physics, action, scene)
        start = self.physics.start(state.task_id, physics.placement)
        physics = jax.tree.map(lambda new, old: jnp.where(is_finite, new, old), physics, start)
        state = state.replace(faults=state.faults + 1 - is_finite.astype(jnp.int32))
        positions = self.physics.positions(physics, scene)
        return self.observe(state, physics, positions, action)

    def observe(self, state: State, physics: Any, positions: Positions, action: jax.Array) -> State:
        """The state after a control step, from the new physics state and its positions."""
        task_id = state.task_id
        opening = jnp.clip(positions.finger_gap / 0.1, 0.0, 1.0)
        frame = self._frame(positions.hand, opening, positions.fixture, task_id)
        goal = jnp.zeros(3)
        if self.goal_observable:
            goal = jnp.clip(
                self._target(physics, task_id), jnp.array(HAND_LOW), jnp.array(HAND_HIGH)
            )
        obs = jnp.concatenate([_clip_hand(frame), _clip_hand(state.frame), goal])
        fixture = self.physics.fixture(self._scene_id[task_id])
        start = physics.placement + fixture.offset + self._data.handle[task_id]
        inputs = RewardInputs(
            hand=obs[:3],
            tcp=0.5 * (positions.right_tip + positions.left_tip),
            handle=positions.fixture + self._data.handle[task_id],
            slide=positions.slide,
            gripper_effort=action[3],
            init_tcp=self._data.init_tcp[task_id],
            init_handle=start + fixture.axis * self._data.start_slide[task_id],
        )
        values = [spec.reward(inputs) for spec in SPECS]
        pick = lambda i: jnp.stack([value[i] for value in values])[task_id]
        return state.replace(
            physics=physics,
            frame=frame,
            obs=self._in_mode(obs, state.origin),
            reward=pick(0),
            distance=pick(1),
            success=pick(2),
            steps=state.steps + 1,
        )

    @property
    def symmetries(self) -> tuple[np.ndarray, np.ndarray]:
        """The eight of a square, in the plane about the object's place: mirrors, then turns.

        Only canonical observations have their origin there; others have the identity alone. The
        gripper itself does not turn: its fingers open along one axis.
        """
        count = len(PLANE_SYMMETRIES) if self.obs_mode == "canonical" else 1
        of_obs = np.tile(np.eye(OBS_SIZE, dtype=np.float32), (count, 1, 1))
        of_action = np.tile(np.eye(ACTION_SIZE, dtype=np.float32), (count, 1, 1))
        places = [start + part.start for start in (0, FRAME) for part in (HAND, OBJECT)]
        for row, matrix in enumerate(PLANE_SYMMETRIES[:count]):
            for place in (*places, 2 * FRAME):
                of_obs[row, place : place + 2, place : place + 2] = matrix
            of_action[row, :2, :2] = matrix
        return of_obs, of_action

    @property
    def reaches(self) -> np.ndarray:
        """As it is, then with the object shown at `REACHES` of its way.

        The hand is shown moved by as much, so that what it does at the object looks the same. Only
        canonical observations show how far an object has moved; others have the identity alone.
        """
        seen = REACHES if self.obs_mode == "canonical" else REACHES[:1]
        matrices = np.tile(np.eye(OBS_SIZE, dtype=np.float32), (len(seen), 1, 1))
        for start in (0, FRAME):
            for axis in range(3):
                hand, moved = start + HAND.start + axis, start + OBJECT.start + axis
                matrices[:, moved, moved] = seen
                matrices[:, hand, moved] = np.asarray(seen) - 1.0
        return matrices

    def goals(self, name: str, tasks: Sequence[str] = TASKS) -> np.ndarray:
        """Placements of a named goal set, see `goal_sets.load_goal_set`."""
        return load_goal_set(name, tasks)

    def _in_mode(self, obs: jax.Array, origin: jax.Array) -> jax.Array:
        if self.obs_mode == "metaworld":
            return obs
        return canonical_obs(obs, origin, self.goal_observable)

    def _target(self, physics: Any, task_id: jax.Array) -> jax.Array:
        return physics.placement + self._data.target[task_id]

    def _frame(
        self, hand: jax.Array, opening: jax.Array, fixture: jax.Array, task_id: jax.Array
    ) -> jax.Array:
        """Hand (3), gripper opening, object position (3), quaternion (4), zeros (7)."""
        quaternion = jnp.array([1.0, 0.0, 0.0, 0.0]) * self._data.has_quaternion[task_id]
        handle = fixture + self._data.handle[task_id]
        return jnp.concatenate([hand, opening[None], handle, quaternion, jnp.zeros(7)])


def ml4(options: Any) -> Ml4Env:
    """The environment of a configuration's `env` section."""
    return Ml4Env(options.goal_observable, options.physics, options.obs_mode)


def canonical_obs(obs: jax.Array, origin: jax.Array, goal_observable: bool = False) -> jax.Array:
    """An observation that tells less of which task it is: seen from where the object began.

    Hand and object of both frames (and the goal, where it is shown) are relative to where the
    object stands after the reset, which is not where every reset observation shows it; the
    quaternion, which drawer-open alone shows, is zero.

    Args:
        obs: (..., 39) as Meta-World's; origin: (..., 3).
    """
    for start in (0, FRAME):
        for part in (HAND, OBJECT):
            place = slice(start + part.start, start + part.stop)
            obs = obs.at[..., place].add(-origin)
        obs = obs.at[..., start + QUATERNION.start : start + QUATERNION.stop].set(0.0)
    return obs.at[..., 2 * FRAME :].add(-origin) if goal_observable else obs


def _clip_hand(frame: jax.Array) -> jax.Array:
    """Meta-World clips a step's observation to its space; only the hand can leave it."""
    hand = jnp.clip(frame[:3], jnp.array(OBS_HAND_LOW), jnp.array(OBS_HAND_HIGH))
    return jnp.concatenate([hand, frame[3:]])
