"""Meta-World's own environments and scripted policies: the oracle the port is compared with.

Nothing here is our logic: observation, reward and success come out of the `metaworld` package.
With `metaworld_envs.py` and `goal_sets.py` (its maker) all that imports metaworld's classes.

NOTES (Farama-Foundation/Metaworld: metaworld/sawyer_xyz_env.py, read and measured on 3.0.0)
1. `reset` runs `reset_model` twice with `mj_resetData` in between, so a start depends neither on
   earlier episodes nor on the process. The 50 x 5 substeps that settle the hand run with the
   fixture in place and its slide at 0; nothing touches it there, so qpos, qvel and warm start are
   the same for all goals of a task, and (slide apart) for both tasks of a scene. The hand is not
   at rest then. drawer-close starts with a finger on the opened drawer.
2. A start observation is stale: it is made from the kinematics of the last settling substep, one
   substep (2.5 ms) behind the state, and without the slide position that window-close sets
   afterwards. So are `init_tcp` and `window_handle_pos_init`. `inject` always refreshes the
   kinematics and therefore never reproduces a start observation: use `reset` for that.
3. The previous frame that the next observation will show is kept unclipped; only the returned
   observation is clipped to Meta-World's observation space.
4. A step depends on the solver's warm start too, by up to 1e-7 in qpos, so a state carries it.
"""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from envs.engine import mujoco  # isort: skip, metaworld imports MuJoCo
from metaworld import policies
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from metaworld.sawyer_xyz_env import SawyerXYZEnv

from envs.adapters.metaworld_envs import make_task, metaworld_name
from envs.tasks import METAWORLD_TASKS

_POLICIES = {
    task: getattr(policies, f"Sawyer{task.title().replace('-', '')}V3Policy")
    for task in METAWORLD_TASKS
}


class Policy(Protocol):
    """A policy of metaworld: observation (39,) to action (4,)."""

    def get_action(self, obs: np.ndarray) -> np.ndarray:
        """Returns the action (4,) for one observation; not clipped to the action box."""
        ...


@dataclass(frozen=True)
class Constants:
    """What Meta-World fixes at a reset and the reward refers to. All positions in metres.

    Attributes:
        target_pos: (3,) the goal position.
        obj_init_pos: (3,) fixture position; for drawer-close the handle's start position.
        init_tcp: (3,) middle of the finger tips after the hand has settled.
        handle_init: (3,) `window_handle_pos_init`; None for the drawer tasks.
    """

    target_pos: np.ndarray
    obj_init_pos: np.ndarray
    init_tcp: np.ndarray
    handle_init: np.ndarray | None


@dataclass(frozen=True)
class ReferenceState:
    """Everything Meta-World's next step, observation and reward depend on.

    Attributes:
        qpos: (10,) seven arm hinges (rad), right and left finger slide (m), fixture slide (m).
        qvel: (10,) their velocities.
        mocap_pos: (3,) commanded hand position (m).
        warmstart: (10,) the solver's `qacc_warmstart`.
        fixture_pos: (3,) position of the fixture body in the model (m).
        prev_frame: (18,) the frame which this state's observation shows as the previous one.
        constants: what the reset fixed.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    mocap_pos: np.ndarray
    warmstart: np.ndarray
    fixture_pos: np.ndarray
    prev_frame: np.ndarray
    constants: Constants


@dataclass(frozen=True)
class Positions:
    """World positions (m) that observation and reward are made of, each (3,); see `positions`."""

    hand: np.ndarray
    right_finger: np.ndarray
    left_finger: np.ndarray
    right_pad: np.ndarray
    left_pad: np.ndarray
    tcp: np.ndarray
    handle: np.ndarray
    handle_quat: np.ndarray


@dataclass(frozen=True)
class Rollout:
    """One recorded episode of T control steps. Row 0 of the state arrays is the start state, row
    t + 1 the state after `action[t]`.

    Attributes:
        task, rand_vec: task name and goal (3,).
        constants: what the reset fixed.
        qpos, qvel, warmstart: (T + 1, 10).
        mocap_pos: (T + 1, 3).
        prev_frame: (T + 1, 18) the previous frame in each state's observation, unclipped.
        obs: (T + 1, 39); row 0 is the stale start observation (module NOTE 2).
        action: (T, 4) inside the action box, float32.
        reward, success: (T,) of the step that `action[t]` made.
    """

    task: str
    rand_vec: np.ndarray
    constants: Constants
    qpos: np.ndarray
    qvel: np.ndarray
    mocap_pos: np.ndarray
    warmstart: np.ndarray
    prev_frame: np.ndarray
    obs: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    success: np.ndarray

    def state(self, row: int) -> ReferenceState:
        """Returns row `row` of the state arrays in the form `ReferenceEnv.inject` takes."""
        return ReferenceState(
            qpos=self.qpos[row],
            qvel=self.qvel[row],
            mocap_pos=self.mocap_pos[row],
            warmstart=self.warmstart[row],
            fixture_pos=self.rand_vec,
            prev_frame=self.prev_frame[row],
            constants=self.constants,
        )


class ReferenceEnv:
    """Meta-World's V3 environment object of one task, with access to its exact state.

    Episodes are counted by the caller; Meta-World itself refuses to go beyond 500 steps.
    """

    def __init__(self, task: str, goal_observable: bool = False):
        """Loads the task's scene.

        Args:
            task: one of `METAWORLD_TASKS`.
            goal_observable: show the target in the observation (Meta-World's MT mode; ML hides it).

        Raises:
            ValueError: unknown task.
        """
        _check_task(task)
        self.task = task
        self.goal_observable = goal_observable
        # Any: the attributes a task sets in its reset are not declared on metaworld's base class.
        self._env: Any = ALL_V3_ENVIRONMENTS[metaworld_name(task)]()
        self._fixture = task.split("-")[0]  # the scenes name the body so
        self._prev_frame = np.zeros(18)

    @property
    def env(self) -> SawyerXYZEnv:
        """The wrapped environment, for what this class does not offer (rendering, model edits)."""
        return self._env

    @property
    def step_limit(self) -> int:
        """Meta-World's own time limit in control steps (500)."""
        return self._env.max_path_length

    def reset(self, rand_vec: np.ndarray) -> np.ndarray:
        """Starts an episode with the fixture at `rand_vec` (3,), as metaworld's benchmarks do.

        Returns:
            The start observation (39,), float64; stale by one substep, see module NOTE 2.
        """
        self._set_task(rand_vec)
        obs, _ = self._env.reset()
        self._prev_frame = self._env._prev_obs.copy()
        return obs

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, dict[str, Any]]:
        """Advances one control step (12.5 ms): Meta-World's own `step`.

        Args:
            action: (4,) hand displacement in units of 1/100 m, and gripper effort.

        Returns:
            observation (39,) float64, reward in [0, 10], success of this step, metaworld's info.
        """
        prev_frame = self._env._prev_obs.copy()
        obs, reward, _, _, info = self._env.step(action)
        self._prev_frame = prev_frame
        return obs, float(reward), bool(info["success"]), info

    def get_state(self) -> ReferenceState:
        """Returns a copy of the state after the last `reset`, `step` or `inject`."""
        data, env = self._env.data, self._env
        handle_init = getattr(env, "window_handle_pos_init", None)
        return ReferenceState(
            qpos=data.qpos.copy(),
            qvel=data.qvel.copy(),
            mocap_pos=data.mocap_pos[0].copy(),
            warmstart=data.qacc_warmstart.copy(),
            fixture_pos=env.model.body(self._fixture).pos.copy(),
            prev_frame=self._prev_frame.copy(),
            constants=Constants(
                target_pos=np.array(env._target_pos, np.float64),
                obj_init_pos=np.array(env.obj_init_pos, np.float64),
                init_tcp=np.array(env.init_tcp, np.float64),
                handle_init=None if handle_init is None else np.array(handle_init, np.float64),
            ),
        )

    def inject(
        self, state: ReferenceState, action: np.ndarray
    ) -> tuple[np.ndarray, float, bool, dict[str, Any]]:
        """Puts the simulator into `state` and asks Meta-World for its verdict on it.

        The tail of Meta-World's `step` after the simulation: `mj_forward`, observation, clipping,
        reward. Stepping on from here continues the episode exactly.

        Args:
            state: the state after a step; start one from a `get_state` and `dataclasses.replace`.
            action: (4,) the action of that step; some rewards look at the gripper effort.

        Returns:
            observation (39,), reward, success, info, as from `step`.
        """
        env = self._env
        self._set_task(state.fixture_pos)
        constants = state.constants
        env._target_pos = constants.target_pos.copy()
        env.obj_init_pos = constants.obj_init_pos.copy()
        env.init_tcp = constants.init_tcp.copy()
        if constants.handle_init is not None:
            env.window_handle_pos_init = constants.handle_init.copy()
        env.model.body(self._fixture).pos = state.fixture_pos
        env.model.site("goal").pos = constants.target_pos

        data = env.data
        data.qpos[:] = state.qpos
        data.qvel[:] = state.qvel
        data.mocap_pos[0] = state.mocap_pos
        data.mocap_quat[0] = (1, 0, 1, 0)
        data.ctrl[:] = (action[-1], -action[-1])
        mujoco.mj_forward(env.model, data)  # pyright: ignore[reportAttributeAccessIssue]
        data.qacc_warmstart[:] = state.warmstart

        env.curr_path_length = 0
        self._prev_frame = state.prev_frame.copy()
        env._prev_obs = state.prev_frame.copy()
        space = env.sawyer_observation_space
        obs = np.clip(env._get_obs(), space.low, space.high)
        env._last_stable_obs = obs
        reward, info = env.evaluate_state(obs, action)
        return obs.copy(), float(reward), bool(info["success"]), info

    def _set_task(self, rand_vec: np.ndarray) -> None:
        self._env.set_task(make_task(self.task, rand_vec, self.goal_observable))

    def positions(self) -> Positions:
        """Returns the raw positions of the simulator's current kinematics.

        Fingers are the `rightclaw` / `leftclaw` bodies (gripper opening), pads the bodies of the
        caging reward, tcp the middle of the finger tip sites, handle and its quaternion (4,) what
        the observation shows as the object.
        """
        env, data = self._env, self._env.data
        return Positions(
            hand=data.body("hand").xpos.copy(),
            right_finger=data.body("rightclaw").xpos.copy(),
            left_finger=data.body("leftclaw").xpos.copy(),
            right_pad=data.body("rightpad").xpos.copy(),
            left_pad=data.body("leftpad").xpos.copy(),
            tcp=env.tcp_center,
            handle=np.array(env._get_pos_objects(), np.float64),
            handle_quat=np.array(env._get_quat_objects(), np.float64),
        )


class _QuietPolicy:
    """A policy of metaworld without its warning that far targets saturate the action box."""

    def __init__(self, policy: Any):
        self._policy = policy

    def get_action(self, obs: np.ndarray) -> np.ndarray:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=r"Constant\(s\) may be too high")
            return self._policy.get_action(obs)


def scripted_policy(task: str) -> Policy:
    """Returns Meta-World's scripted policy of `task`. Its actions exceed the box: clip them.

    Raises:
        ValueError: unknown task.
    """
    _check_task(task)
    return _QuietPolicy(_POLICIES[task]())


def record_rollout(
    task: str,
    rand_vec: np.ndarray,
    policy: Literal["scripted", "random", "perturbed"] = "scripted",
    steps: int = 200,
    seed: int = 0,
    noise: float = 0.3,
    goal_observable: bool = False,
) -> Rollout:
    """Records one episode of Meta-World's environment.

    Args:
        task: one of `METAWORLD_TASKS`.
        rand_vec: (3,) fixture position (m).
        policy: the scripted policy, uniform random actions, or the scripted policy's action,
            clipped to the box, plus Gaussian noise of standard deviation `noise`, clipped again.
        steps: control steps, at most Meta-World's 500.
        seed: of the random and perturbed actions.
        noise: standard deviation, in action units.
        goal_observable: as for `ReferenceEnv`.

    Raises:
        ValueError: unknown task or policy, or more steps than Meta-World allows.
    """
    if policy not in ("scripted", "random", "perturbed"):
        raise ValueError(
            f"unknown policy {policy!r} for a recorded rollout\nuse scripted, random or perturbed"
        )
    env = ReferenceEnv(task, goal_observable)
    if steps > env.step_limit:
        raise ValueError(
            f"a rollout of {steps} steps exceeds Meta-World's limit\n"
            f"ask for at most {env.step_limit}"
        )
    expert = scripted_policy(task)
    rng = np.random.default_rng(seed)
    obs = [env.reset(rand_vec)]
    states = [env.get_state()]
    actions, rewards, successes = [], [], []
    for _ in range(steps):
        if policy == "random":
            action = rng.uniform(-1, 1, 4)
        else:
            action = np.clip(expert.get_action(obs[-1]), -1, 1)
            if policy == "perturbed":
                action = np.clip(action + noise * rng.standard_normal(4), -1, 1)
        actions.append(action.astype(np.float32))
        next_obs, reward, success, _ = env.step(actions[-1])
        obs.append(next_obs)
        states.append(env.get_state())
        rewards.append(reward)
        successes.append(success)
    rows = {
        field.name: np.stack([getattr(state, field.name) for state in states])
        for field in dataclasses.fields(ReferenceState)
        if field.name not in ("fixture_pos", "constants")
    }
    return Rollout(
        task=task,
        rand_vec=np.array(rand_vec, np.float64),
        constants=states[0].constants,
        obs=np.stack(obs),
        action=np.stack(actions),
        reward=np.array(rewards),
        success=np.array(successes),
        **rows,
    )


def _check_task(task: str) -> None:
    if task not in _POLICIES:
        raise ValueError(f"unknown task {task!r}\nvalid tasks: {', '.join(METAWORLD_TASKS)}")
