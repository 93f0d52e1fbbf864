"""The five measurements of `python -m envs.parity`: our environment against Meta-World's own.

Every function returns one dict per task, in the order of `tasks.METAWORLD_TASKS`. Both sides get
the same states, actions, noise and goals; lanes are ordered task first, goal second. Metres.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.parity.reference import ReferenceEnv, Rollout, record_rollout, scripted_policy
from envs.physics.base import Positions
from envs.physics.mjx.backend import PhysicsState
from envs.physics.model import FIXTURE_BODY, LEFT_FINGER, RIGHT_FINGER, SLIDE
from envs.physics.native import NativePhysics, unpack
from envs.sawyer import OBS_SIZE, Ml4Env, State
from envs.tasks import METAWORLD_TASKS, TASKS
from envs.tasks.specs import SCENE_ID, SPECS

OPEN_LOOP_STEPS = (1, 10, 50, 100, 150)
ROLLOUTS = ("scripted", "perturbed", "random")
ROW_STRIDE = 5  # every fifth state of a rollout is injected
THRESHOLD_BAND = 1e-4
# Distance at which each task succeeds; Meta-World's info calls that distance obj_to_target.
SUCCESS_DISTANCE = {
    "drawer-open": 0.03,
    "drawer-close": 0.065,
    "window-open": 0.05,
    "window-close": 0.05,
}


METAWORLD_IDS = np.array([TASKS.index(task) for task in METAWORLD_TASKS], np.int32)


class Port:
    """Our environment as compiled functions of a fixed number of lanes.

    Args:
        lanes: batch size of the one compiled step; longer batches go through it in pieces.
        physics: backend, one of `physics.backends.BACKENDS`.
    """

    def __init__(self, lanes: int, physics: str = "mjx"):
        env = Ml4Env(physics=physics)
        scene_id = jnp.asarray(SCENE_ID)
        self.lanes = lanes
        self.reset = jax.jit(jax.vmap(env.reset_to))
        self.step = jax.jit(jax.vmap(env.step))

        def observe(state: State, action: jax.Array) -> State:
            positions = env.physics.positions(state.physics, scene_id[state.task_id])
            return env.observe(state, state.physics, positions, action)

        self.env = env
        self.observe = jax.jit(jax.vmap(observe))
        self.observe_positions = jax.jit(
            jax.vmap(lambda state, positions, a: env.observe(state, state.physics, positions, a))
        )

    def states(self, rollout: Rollout, rows: np.ndarray, frames: np.ndarray) -> State:
        """Recorded states of Meta-World in our form, numpy leaves with a leading row axis.

        Args:
            rows: which states of the rollout.
            frames: (row, 18) what the next observation shows as the previous frame.
        """
        count, task = len(rows), TASKS.index(rollout.task)
        exact = (
            rollout.qpos[rows],
            rollout.qvel[rows],
            rollout.warmstart[rows],
            rollout.mocap_pos[rows],
            np.tile(rollout.rand_vec, (count, 1)),
        )
        physics: Any = PhysicsState(*(np.asarray(x, np.float32) for x in exact))  # type: ignore
        if isinstance(self.env.physics, NativePhysics):
            physics = self.env.physics.host_state(np.full(count, SCENE_ID[task]), *exact)

        def zeros(dtype: Any, *tail: int) -> Any:
            return np.zeros((count, *tail), dtype)

        return State(
            physics=physics,
            task_id=zeros(np.int32) + np.int32(task),
            frame=zeros(np.float32, 18) + np.asarray(frames, np.float32),
            obs=zeros(np.float32, OBS_SIZE),
            origin=zeros(np.float32, 3),
            reward=zeros(np.float32),
            success=zeros(bool),
            distance=zeros(np.float32),
            steps=zeros(np.int32),
            faults=zeros(np.int32),
        )

    def qpos(self, state: State) -> np.ndarray:
        """Joint positions (lane, 10) of states, float64."""
        if isinstance(self.env.physics, NativePhysics):
            return unpack(state.physics)["qpos"]
        return np.asarray(state.physics.qpos, np.float64)

    def in_pieces(self, function: Callable[..., State], *trees: Any) -> State:
        """`function` over trees with any number of rows; the result is on the host."""
        rows = jax.tree.leaves(trees)[0].shape[0]
        index = np.arange(-(-rows // self.lanes) * self.lanes) % rows
        pieces = []
        for piece in index.reshape(-1, self.lanes):
            result = function(*jax.tree.map(lambda leaf: leaf[piece], trees))
            pieces.append(jax.tree.map(np.asarray, result))
        return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:rows], *pieces)


def record(goals: np.ndarray, steps: int, seed: int) -> list[Rollout]:
    """Scripted, perturbed and random episodes of Meta-World on goals (task, goal, 3)."""
    return [
        record_rollout(task, goal, kind, steps, seed=seed + number)
        for task, places in zip(METAWORLD_TASKS, goals, strict=True)
        for number, goal in enumerate(places)
        for kind in ROLLOUTS
    ]


def part_errors(
    port: Port, ours: State, qpos: np.ndarray, hand: np.ndarray
) -> dict[str, np.ndarray]:
    """Errors (row,) in metres of our states against joint and hand positions of Meta-World."""
    fingers = slice(RIGHT_FINGER, LEFT_FINGER + 1)
    error = np.abs(port.qpos(ours) - qpos)
    return {
        "hand": np.linalg.norm(np.asarray(ours.frame, np.float64)[:, :3] - hand, axis=-1),
        "fingers": error[:, fingers].max(-1),
        "fixture": error[:, SLIDE],
    }


def quantiles(errors: np.ndarray) -> dict[str, float]:
    """p50, p99 and maximum; NaN where there is nothing to measure."""
    if not errors.size:
        return dict.fromkeys(("p50", "p99", "max"), float("nan"))
    return {
        "p50": float(np.quantile(errors, 0.5)),
        "p99": float(np.quantile(errors, 0.99)),
        "max": float(errors.max()),
    }


def measure_injected(
    port: Port, rollouts: list[Rollout], tasks: Sequence[str] = METAWORLD_TASKS
) -> list[dict[str, Any]]:
    """Parts 1 and 2: observation, reward and success in given states, and one step from them."""
    return [_injected_task(port, task, [r for r in rollouts if r.task == task]) for task in tasks]


def _injected_task(port: Port, task: str, rollouts: list[Rollout]) -> dict[str, Any]:
    reference = ReferenceEnv(task)
    states, actions, exact, before, onward, contact = [], [], [], [], [], []
    reward, success, distance, obs, qpos, hand = [], [], [], [], [], []
    for rollout in rollouts:
        rows = np.arange(1, len(rollout.action), ROW_STRIDE)
        states.append(port.states(rollout, rows, rollout.prev_frame[rows]))
        before.append(port.states(rollout, rows, rollout.prev_frame[rows + 1]))
        actions.append(rollout.action[rows - 1])
        onward.append(rollout.action[rows])
        qpos.append(rollout.qpos[rows + 1])
        for row in rows.tolist():
            verdict = reference.inject(rollout.state(row), rollout.action[row - 1])
            obs.append(verdict[0])
            reward.append(verdict[1])
            success.append(verdict[2])
            distance.append(verdict[3]["obj_to_target"])
            exact.append(positions(reference))
            touching = is_touching(reference)
            reference.inject(rollout.state(row + 1), rollout.action[row])
            contact.append(touching or is_touching(reference))
            hand.append(reference.positions().hand)
    stack = lambda trees: jax.tree.map(lambda *x: np.concatenate(x), *trees)
    exact = jax.tree.map(lambda *x: np.stack(x).astype(np.float32), *exact)
    states, action = stack(states), np.concatenate(actions)
    ours = port.in_pieces(port.observe, states, action)
    logic = port.in_pieces(port.observe_positions, states, exact, action)
    near = np.abs(np.array(distance) - SUCCESS_DISTANCE[task]) <= THRESHOLD_BAND
    wrong = ours.success != np.array(success)
    stepped = port.in_pieces(port.step, stack(before), np.concatenate(onward))
    errors = part_errors(port, stepped, np.concatenate(qpos), np.array(hand))
    touching = np.array(contact)
    worst = np.max(list(errors.values()), 0)
    split = {"contact": touching, "no_contact": ~touching}
    return {
        "injected": {
            "obs_max": float(np.abs(ours.obs - np.array(obs)).max()),
            "reward_max": float(np.abs(ours.reward - np.array(reward)).max()),
            "success_mismatches": int((wrong & ~near).sum()),
            "near_threshold": int(near.sum()),
            "near_threshold_mismatches": int((wrong & near).sum()),
            "states": len(reward),
            # The same with Meta-World's own positions in place of our float32 kinematics.
            "from_positions": {
                "obs_max": float(np.abs(logic.obs - np.array(obs)).max()),
                "reward_max": float(np.abs(logic.reward - np.array(reward)).max()),
            },
        },
        "one_step": quantiles(worst)
        | {
            name: {"states": int(chosen.sum())}
            | {part: quantiles(error[chosen]) for part, error in errors.items()}
            for name, chosen in split.items()
        },
    }


def positions(reference: ReferenceEnv) -> Positions:
    """What our `observe` reads, from Meta-World's simulator as it stands; float64 leaves."""
    exact: Any = reference.positions()
    gap: Any = np.linalg.norm(exact.right_finger - exact.left_finger)
    data: Any = reference.env.data
    body = FIXTURE_BODY[SPECS[TASKS.index(reference.task)].scene]
    return Positions(
        hand=exact.hand,
        right_tip=exact.tcp,
        left_tip=exact.tcp,
        finger_gap=gap,
        fixture=data.body(body).xpos.copy(),
        slide=data.qpos[SLIDE].copy(),
    )


def is_touching(reference: ReferenceEnv) -> bool:
    """Whether any contact pushes: in free space the gripper touches nothing, not even itself."""
    data: Any = reference.env.data
    return bool((data.contact.efc_address >= 0).any())


def measure_open_loop(
    port: Port, rollouts: list[Rollout], tasks: Sequence[str] = METAWORLD_TASKS
) -> list[dict[str, Any]]:
    """Part 3: their recorded actions replayed from their start state; errors grow over time."""
    chosen = [r for r in rollouts if r.task in tasks]
    steps = min(OPEN_LOOP_STEPS[-1], min(len(r.action) for r in chosen))
    start = np.zeros(1, np.int64)
    states = [port.states(r, start, r.prev_frame[start + 1]) for r in chosen]
    state = jax.tree.map(lambda *x: np.concatenate(x), *states)
    marks = [step for step in OPEN_LOOP_STEPS if step <= steps]
    errors: dict[int, dict[str, np.ndarray]] = {}
    for step in range(1, steps + 1):
        state = port.in_pieces(port.step, state, np.stack([r.action[step - 1] for r in chosen]))
        if step in marks:
            # The hand of row t + 1's previous frame is the hand of row t, unclipped.
            hand = np.stack([_hand(r, step) for r in chosen])
            errors[step] = part_errors(port, state, np.stack([r.qpos[step] for r in chosen]), hand)
    results = []
    for task in tasks:
        lanes = np.array([r.task == task for r in chosen])
        by_step = {step: {n: e[lanes] for n, e in errors[step].items()} for step in marks}
        worst = {step: np.max(list(parts.values()), 0) for step, parts in by_step.items()}
        results.append(
            {
                "open_loop": {str(step): float(worst[step].max()) for step in marks},
                "open_loop_median": {str(step): float(np.median(worst[step])) for step in marks},
                "open_loop_parts": {
                    str(step): {n: float(e.max()) for n, e in parts.items()}
                    for step, parts in by_step.items()
                },
            }
        )
    return results


def _hand(rollout: Rollout, row: int) -> np.ndarray:
    if row + 1 < len(rollout.prev_frame):
        return rollout.prev_frame[row + 1, :3]
    return rollout.obs[row, :3]


def measure_resets(port: Port, goals: np.ndarray) -> list[dict[str, Any]]:
    """Part 5: start observations over goals (task, goal, 3)."""
    count = goals.shape[1]
    task_ids = np.repeat(METAWORLD_IDS, count)
    ours = np.asarray(port.reset(task_ids, goals.reshape(-1, 3).astype(np.float32)).obs)
    results = []
    for task, places, obs in zip(
        METAWORLD_TASKS, goals, np.split(ours, len(METAWORLD_TASKS)), strict=True
    ):
        reference = ReferenceEnv(task)
        theirs = np.stack([reference.reset(place) for place in places])
        results.append({"reset_obs_max": float(np.abs(obs - theirs).max())})
    return results


def draw_noise(goals: np.ndarray, horizon: int, scale: float, seed: int) -> np.ndarray:
    """Gaussian action noise (task, goal, step, 4) that both sides add."""
    shape = (*goals.shape[:2], horizon, 4)
    return scale * np.random.default_rng(seed).standard_normal(shape)


def _action(policy: Any, obs: np.ndarray, noise: np.ndarray) -> np.ndarray:
    action = np.clip(policy.get_action(obs), -1, 1) + noise
    return np.clip(action, -1, 1).astype(np.float32)


def port_episodes(port: Port, goals: np.ndarray, noise: np.ndarray) -> tuple[Any, Any, Any]:
    """Scripted policies in our environment: reward and success, (task, goal, step) each, faults.

    Faults (task, goal) count how often the physics of an episode became non-finite.
    """
    tasks, count = goals.shape[:2]
    task_ids = np.repeat(METAWORLD_IDS, count)
    policies = [scripted_policy(TASKS[i]) for i in task_ids]
    noise = noise.reshape(tasks * count, -1, 4)
    state = port.reset(task_ids, goals.reshape(-1, 3).astype(np.float32))
    rewards, successes = [], []
    for step in range(noise.shape[1]):
        obs = np.asarray(state.obs, np.float64)
        actions = [_action(p, o, n) for p, o, n in zip(policies, obs, noise[:, step], strict=True)]
        state = port.step(state, np.stack(actions))
        rewards.append(np.asarray(state.reward))
        successes.append(np.asarray(state.success))
    shape = (tasks, count, -1)
    reward, success = (np.stack(x, 1).reshape(shape) for x in (rewards, successes))
    return reward, success, np.asarray(state.faults).reshape(tasks, count)


def reference_episodes(goals: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same in Meta-World: reward and success, (task, goal, step) each."""
    rewards, successes = np.zeros(noise.shape[:3]), np.zeros(noise.shape[:3], bool)
    for i, task in enumerate(METAWORLD_TASKS):
        env, policy = ReferenceEnv(task), scripted_policy(task)
        for j, place in enumerate(goals[i]):
            obs = env.reset(place)
            for step, disturbance in enumerate(noise[i, j]):
                obs, reward, success, _ = env.step(_action(policy, obs, disturbance))
                rewards[i, j, step], successes[i, j, step] = reward, success
    return rewards, successes


def measure_closed_loop(port: Port, goals: np.ndarray, noise: np.ndarray) -> list[dict[str, Any]]:
    """Part 4: scripted policies on both sides, under the same noise (task, goal, step, 4)."""
    *ours, faults = port_episodes(port, goals, noise)
    theirs = reference_episodes(goals, noise)
    return [
        _compare(*(x[i] for x in (*ours, *theirs))) | {"faults": int(faults[i].sum())}
        for i in range(len(METAWORLD_TASKS))
    ]


def _compare(
    reward: np.ndarray, success: np.ndarray, their_reward: np.ndarray, their_success: np.ndarray
) -> dict[str, Any]:
    """Figures of one task from reward and success (goal, step) of both sides."""
    ours, theirs = _summary(reward, success), _summary(their_reward, their_success)
    return ours | {
        "return_ratio": ours["return"] / theirs["return"],
        **{f"reference_{name}": value for name, value in theirs.items()},
    }


def _summary(reward: np.ndarray, success: np.ndarray) -> dict[str, float]:
    solved = success.any(-1)
    first = 1 + success.argmax(-1)[solved]  # in control steps after the reset
    return {
        "success_any": float(solved.mean()),
        "success_last": float(success[:, -1].mean()),
        "return": float(reward.sum(-1).mean()),
        "first_success_step": float(first.mean()) if solved.any() else float("nan"),
    }
