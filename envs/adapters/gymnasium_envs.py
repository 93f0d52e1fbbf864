"""The tasks as Gymnasium environments, one at a time or as many lanes in one compiled program.

`gymnasium.make("cmrl_jax/window-open-v0")` and `gymnasium.make_vec(..., num_envs=64)`; the ids are
registered by `gymnasium_ids.py`. Both say the same of the same seeds: lane i of the vector
environment, reset with seed s, is the single environment reset with seed s + i, as in Gymnasium's
own SyncVectorEnv. Goals are drawn from NumPy's generators, as Gymnasium asks, not from keys of jax.

A goal is the fixture's placement (3,) in metres. `reset` tells it as `info["goal"]`, and takes one
in `options={"goal": ...}`. A step's info has `success` (at this very step), `distance` (metres,
what success is judged by) and `faults` (times the episode's simulation failed and was put back to
its start). No episode terminates; it is truncated after `horizon` control steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from envs.adapters.lanes import TaskLanes
from envs.command_line import suggest
from envs.render.live import LivePictures
from envs.sawyer import ACTION_SIZE, OBS_SIZE

RENDER_MODES = ("rgb_array",)
REACH = 2.0
"""Bound of an observation's numbers: no two things of the scene are as far apart, in metres."""


class TaskEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One task: observation (39,) float32, action (4,) in [-1, 1], reward in [0, 10].

    Args:
        task: one of `TASKS`; the id's.
        horizon: control steps (12.5 ms) of an episode.
        goal_observable: show the target in the last three observation numbers.
        physics: `native`, MuJoCo C with Meta-World's own scenes, or `mjx`, on the device.
        obs_mode: `metaworld`, or `canonical`, see `envs.sawyer.canonical_obs`.
        goals: the goal set to draw from, `train`, `heldout` or `fresh:<seed>`; None: Meta-World's
            reset box.
        render_mode: `rgb_array`, for pictures (480, 480, 3) of Meta-World's scene, or None.

    Raises:
        ValueError: a value that there is not (two lines: cause, cure).
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 80}

    def __init__(
        self,
        task: str,
        horizon: int = 200,
        goal_observable: bool = False,
        physics: str = "native",
        obs_mode: str = "metaworld",
        goals: str | None = None,
        render_mode: str | None = None,
    ):
        _check(horizon, render_mode)
        self.observation_space, self.action_space = _spaces()
        self.horizon, self.render_mode = horizon, render_mode
        self._lanes = TaskLanes(task, goal_observable, physics, obs_mode, goals)
        self._goal: np.ndarray | None = None  # until the first reset
        self._pictures = LivePictures(task) if render_mode else None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A fresh episode; without a seed, the next one of the last seed.

        Args:
            options: `goal`, a placement (3,) to begin on instead of a drawn one.

        Raises:
            ValueError: another option, or a goal that is none (two lines: cause, cure).
        """
        super().reset(seed=seed)
        goal = _given_goals(_checked(options, "goal"), (3,))
        self._goal = self._lanes.draw_goal(self.np_random) if goal is None else goal
        moment = self._lanes.begin(self._goal[None], np.ones(1, bool))
        return moment.obs[0], {"goal": self._goal.copy()}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control step; `action` (4,): hand displacement / 0.01 m, finger effort.

        Raises:
            gymnasium.error.ResetNeeded: there is no episode yet.
            ValueError: an action of another shape, or not finite (two lines: cause, cure).
        """
        if self._goal is None:
            raise _reset_needed()
        actions = _as_actions(action, (ACTION_SIZE,))[None]
        moment = self._lanes.step(actions, np.zeros(1, bool), self._goal[None])
        info = {
            "success": bool(moment.success[0]),
            "distance": float(moment.distance[0]),
            "faults": int(moment.faults[0]),
        }
        is_over = bool(moment.steps[0] >= self.horizon)
        return moment.obs[0], float(moment.reward[0]), False, is_over, info

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The state as a picture (480, 480, 3) uint8; None without a render mode."""
        if self._pictures is None:
            return None
        if self._goal is None:
            raise _reset_needed()
        return self._pictures.draw(self._lanes.qpos()[0], self._goal)

    def close(self) -> None:
        """Lets go of what draws."""
        if self._pictures is not None:
            self._pictures.close()


class TaskVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Lanes of one task, stepped by one compiled program.

    Autoreset is Gymnasium's usual one, NEXT_STEP: the step after a lane's last ignores its action
    and returns the first observation of its next episode, with reward 0. Infos are SyncVectorEnv's:
    `goal` of lanes that were reset, `success` and `distance` of those that were not, each with a
    mask of the lanes that have it (`_goal` ...).

    Args:
        task, horizon, goal_observable, physics, obs_mode, goals, render_mode: see `TaskEnv`.
        num_envs: lanes.
        max_episode_steps: what `gymnasium.make` calls a time limit: the shorter of both ends an
            episode.

    Raises:
        ValueError: a value that there is not (two lines: cause, cure).
    """

    metadata = TaskEnv.metadata | {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        horizon: int = 200,
        goal_observable: bool = False,
        physics: str = "native",
        obs_mode: str = "metaworld",
        goals: str | None = None,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
    ):
        horizon = horizon if max_episode_steps is None else min(horizon, max_episode_steps)
        _check(horizon, render_mode)
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}\nask for 1 lane or more")
        self.single_observation_space, self.single_action_space = _spaces()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.num_envs, self.horizon, self.render_mode = num_envs, horizon, render_mode
        self._lanes = TaskLanes(task, goal_observable, physics, obs_mode, goals)
        self._goals: np.ndarray | None = None  # (lane, 3) once there are episodes
        self._is_due = np.zeros(num_envs, bool)  # lanes that the next step resets
        self._streams: list[tuple[np.random.Generator, int] | None] = [None] * num_envs
        self._pictures = LivePictures(task) if render_mode else None

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The generator of every lane."""
        return tuple(self._stream(lane)[0] for lane in range(self.num_envs))

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed of every lane."""
        return tuple(self._stream(lane)[1] for lane in range(self.num_envs))

    def reset(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Fresh episodes.

        Args:
            seed: lane i is given seed + i, or the i-th of a sequence; None goes on.
            options: `goal`, placements (lane, 3) to begin on instead of drawn ones; `reset_mask`,
                (lane,) bool, the lanes that are reset, by default all.

        Raises:
            gymnasium.error.ResetNeeded: a mask where there are no episodes yet.
            ValueError: another number of seeds, another option, or one that is none of its kind
                (two lines: cause, cure).
        """
        options = _checked(options, "goal", "reset_mask")
        given = _given_goals(options, (self.num_envs, 3))
        is_fresh = _given_mask(options, self.num_envs)
        if self._goals is None and not is_fresh.all():
            raise _reset_needed()
        for lane, one in enumerate(_lane_seeds(seed, self.num_envs)):
            if one is not None and is_fresh[lane]:
                self._streams[lane] = seeding.np_random(one)
        goals = np.zeros((self.num_envs, 3), np.float32) if self._goals is None else self._goals
        if given is None:
            self._goals = self._drawn(goals, is_fresh)
        else:
            self._goals = np.where(is_fresh[:, None], given, goals)
        moment = self._lanes.begin(self._goals, is_fresh)
        self._is_due = self._is_due & ~is_fresh
        return moment.obs, _masked({"goal": self._goals}, is_fresh)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control step of every lane, or its first observation where its episode had ended.

        Args:
            actions: (lane, 4) in [-1, 1].

        Raises:
            gymnasium.error.ResetNeeded: there are no episodes yet.
            ValueError: actions of another shape, or not finite (two lines: cause, cure).
        """
        if self._goals is None:
            raise _reset_needed()
        actions = _as_actions(actions, (self.num_envs, ACTION_SIZE))
        is_fresh = self._is_due
        self._goals = self._drawn(self._goals, is_fresh)
        moment = self._lanes.step(actions, is_fresh, self._goals)
        infos = _masked({"goal": self._goals}, is_fresh)
        found = {
            "success": moment.success,
            "distance": moment.distance,
            "faults": moment.faults,
        }
        infos |= _masked(found, ~is_fresh)
        self._is_due = moment.steps >= self.horizon
        is_terminated = np.zeros(self.num_envs, bool)
        return moment.obs, moment.reward, is_terminated, self._is_due.copy(), infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture (480, 480, 3) uint8 of every lane; None without a render mode."""
        if self._pictures is None:
            return None
        if self._goals is None:
            raise _reset_needed()
        lanes = zip(self._lanes.qpos(), self._goals, strict=True)
        return tuple(self._pictures.draw(qpos, goal) for qpos, goal in lanes)

    def close_extras(self, **kwargs: Any) -> None:
        """Lets go of what draws."""
        if self._pictures is not None:
            self._pictures.close()

    def _stream(self, lane: int) -> tuple[np.random.Generator, int]:
        stream = self._streams[lane] or seeding.np_random()
        self._streams[lane] = stream
        return stream

    def _drawn(self, goals: np.ndarray, is_fresh: np.ndarray) -> np.ndarray:
        """A copy of `goals` (lane, 3) with new ones for the lanes that begin an episode."""
        goals = goals.copy()
        for lane in np.flatnonzero(is_fresh).tolist():
            goals[lane] = self._lanes.draw_goal(self._stream(lane)[0])
        return goals


def _masked(values: dict[str, np.ndarray], mask: np.ndarray) -> dict[str, np.ndarray]:
    """Infos as Gymnasium gives them: only if a lane has them, each with the mask of which do."""
    infos = {}
    for name, value in values.items() if mask.any() else ():
        infos[name], infos[f"_{name}"] = value.copy(), mask.copy()
        infos[name][~mask] = 0
    return infos


def _spaces() -> tuple[Box, Box]:
    return (
        Box(-REACH, REACH, (OBS_SIZE,), np.float32),
        Box(-1.0, 1.0, (ACTION_SIZE,), np.float32),
    )


def _check(horizon: int, render_mode: str | None) -> None:
    if horizon < 1:
        raise ValueError(f"an episode of {horizon} steps has no end\nuse a horizon of 1 or more")
    if render_mode is not None and render_mode not in RENDER_MODES:
        valid = f"{suggest(render_mode, RENDER_MODES)}valid: {', '.join(RENDER_MODES)}, None"
        raise ValueError(f"unknown render mode '{render_mode}'\n{valid}")


def _checked(options: dict[str, Any] | None, *valid: str) -> dict[str, Any]:
    """The options of a reset, none of which is unknown."""
    for name in options or {}:
        if name not in valid:
            cure = f"{suggest(name, valid)}valid: {', '.join(valid)}"
            raise ValueError(f"unknown option '{name}' of a reset\n{cure}")
    return options or {}


def _given_goals(options: dict[str, Any], shape: tuple[int, ...]) -> np.ndarray | None:
    """Goals that the options of a reset name, float32 of a shape; None where they name none."""
    if "goal" not in options:
        return None
    goals = np.array(options["goal"], np.float32)
    if goals.shape != shape or not (np.abs(goals) <= REACH / 2).all():
        cure = (
            f"give placements of shape {shape}, at most {REACH / 2:g} m from the robot on each axis"
        )
        raise ValueError(f"options['goal'] of shape {goals.shape} is no goal\n{cure}")
    return goals


def _given_mask(options: dict[str, Any], lanes: int) -> np.ndarray:
    mask = np.array(options.get("reset_mask", np.ones(lanes, bool)))
    if mask.shape != (lanes,) or mask.dtype != bool or not mask.any():
        cause = f"options['reset_mask'], {mask.dtype} {mask.shape}, names no lanes"
        raise ValueError(f"{cause}\ngive ({lanes},) booleans, one of them True")
    return mask


def _lane_seeds(seed: int | Sequence[int | None] | None, lanes: int) -> list[int | None]:
    if seed is None:
        return [None] * lanes
    if isinstance(seed, int | np.integer):
        return [int(seed) + lane for lane in range(lanes)]
    if len(seed) != lanes:
        raise ValueError(f"{len(seed)} seeds for {lanes} lanes\ngive one number, or one a lane")
    return list(seed)


def _as_actions(actions: Any, shape: tuple[int, ...]) -> np.ndarray:
    actions = np.asarray(actions, np.float32)
    if actions.shape != shape:
        raise ValueError(f"an action of shape {actions.shape}\ngive one of shape {shape}")
    if not np.isfinite(actions).all():
        raise ValueError("an action is NaN or infinite\ngive numbers, of which [-1, 1] counts")
    return actions


def _reset_needed() -> gymnasium.error.ResetNeeded:
    return gymnasium.error.ResetNeeded("there is no episode yet\ncall reset() first")
