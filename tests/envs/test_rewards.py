"""Observation, reward and success against Meta-World's own, in the same states."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env_fixtures import GOALS, LANE_GOALS, LANE_TASKS

from envs.parity import parts as parity_parts
from envs.parity.parts import SUCCESS_DISTANCE, THRESHOLD_BAND
from envs.parity.reference import ReferenceEnv
from envs.rewards import gaussian, hamacher_product, long_tail
from envs.sawyer import Ml4Env
from envs.tasks import METAWORLD_TASKS as TASKS
from envs.tasks import task_id

SLIDE = 9
SLIDES = {"drawer-open": (-0.17, 0.0), "drawer-close": (-0.17, 0.0)}
SLIDES |= {"window-open": (0.0, 0.21), "window-close": (0.0, 0.21)}
# Slide positions where success begins (m).
THRESHOLD = {
    "drawer-open": -0.16,
    "drawer-close": 0.01 - np.sqrt(0.065**2 - 0.05**2),
    "window-open": 0.19,
    "window-close": 0.04,
}


def verdicts(port, rollout, slides, row=100):
    """Ours and Meta-World's verdicts on one state of a rollout with other slide positions."""
    reference, theirs = ReferenceEnv(rollout.task), []
    rows = np.full(len(slides), row)
    states = port.states(rollout, rows, rollout.prev_frame[rows])
    states.physics.qpos[:, SLIDE] = slides
    for slide in states.physics.qpos[:, SLIDE].astype(np.float64):
        state = rollout.state(row)
        qpos = state.qpos.copy()
        qpos[SLIDE] = slide
        state = dataclasses.replace(state, qpos=qpos)
        theirs.append(reference.inject(state, rollout.action[row - 1])[:3])
    action = np.tile(rollout.action[row - 1], (len(slides), 1))
    return port.in_pieces(port.observe, states, action), [
        np.array(x) for x in zip(*theirs, strict=True)
    ]


@pytest.mark.parametrize("task", TASKS)
def test_slides_across_the_success_threshold(port, rollouts, task):
    edge = THRESHOLD[task] + np.array([-2e-3, -3e-4, -2e-4, 2e-4, 3e-4, 2e-3])
    slides = np.concatenate([np.linspace(*SLIDES[task], 20), edge])
    for rollout in (r for r in rollouts if r.task == task):
        ours, (obs, reward, success) = verdicts(port, rollout, slides)
        np.testing.assert_allclose(ours.obs, obs, atol=3e-6)
        np.testing.assert_allclose(ours.reward, reward, atol=1e-4)
        far = np.abs(ours.distance - SUCCESS_DISTANCE[task]) > THRESHOLD_BAND
        np.testing.assert_array_equal(ours.success[far], success[far])
        assert far.sum() >= 22 and 0 < success[-6:].sum() < 6


def test_drawer_open_succeeds_exactly_at_its_joint_limit(port, rollouts):
    """0.19 - 0.16 <= 0.03 holds in float64 and would not in float32."""
    rollout = next(r for r in rollouts if r.task == "drawer-open")
    states = port.states(rollout, np.array([100]), rollout.prev_frame[[100]])
    states.physics.qpos[:, SLIDE] = -0.16
    assert port.in_pieces(port.observe, states, rollout.action[[99]]).success.all()
    reference, state = ReferenceEnv("drawer-open"), rollout.state(100)
    state.qpos[SLIDE] = -0.16
    assert reference.inject(state, rollout.action[99])[2]


@pytest.mark.parametrize("task", TASKS)
def test_states_of_whole_episodes(port, rollouts, task):
    own = [r for r in rollouts if r.task == task]
    result = parity_parts.measure_injected(port, own, (task,))[0]["injected"]
    assert result["states"] > 90
    assert result["obs_max"] < 3e-6 and result["reward_max"] < 1e-4
    assert result["from_positions"]["reward_max"] < 1e-4
    assert result["success_mismatches"] == 0


def test_a_shown_goal_is_the_clipped_target_and_a_hidden_one_zeros(port, rollouts):
    env = Ml4Env(goal_observable=True)
    observe = jax.jit(jax.vmap(lambda s, p, a: env.observe(s, s.physics, p, a)))
    shown_start = np.asarray(
        jax.vmap(env.reset_to)(*map(jnp.asarray, (LANE_TASKS, LANE_GOALS))).obs
    )
    hidden_start = np.asarray(port.reset(LANE_TASKS, LANE_GOALS).obs)
    np.testing.assert_array_equal(hidden_start[:, :36], shown_start[:, :36])
    assert not hidden_start[:, 36:].any()
    for i, task in enumerate(TASKS):
        reference = ReferenceEnv(task, goal_observable=True)
        rollout = next(r for r in rollouts if r.task == task)
        start = reference.reset(rollout.rand_vec)
        lane = np.flatnonzero((LANE_GOALS == rollout.rand_vec.astype(np.float32)).all(1))
        lane = [j for j in lane if LANE_TASKS[j] == i][0]
        np.testing.assert_allclose(shown_start[lane], start, atol=1e-6)
        # Far aside, where the target leaves the box that Meta-World clips it to.
        far = rollout.rand_vec + (0.7, 0.0, 0.0)
        constants = rollout.constants
        target = constants.target_pos + (0.7, 0.0, 0.0)
        constants = dataclasses.replace(constants, target_pos=target)
        state = dataclasses.replace(rollout.state(50), fixture_pos=far, constants=constants)
        obs = reference.inject(state, rollout.action[49])[0]
        rows = np.array([50])
        moved = dataclasses.replace(rollout, rand_vec=far)
        states = port.states(moved, rows, rollout.prev_frame[rows])
        positions = jax.tree.map(lambda x: np.float32(x)[None], parity_parts.positions(reference))
        ours = observe(states, positions, rollout.action[[49]])
        np.testing.assert_allclose(ours.obs[0], obs, atol=1e-6)
        assert obs[36] == 0.5 < target[0]


def test_reward_parts_at_their_definition():
    """dm_control's tolerance is 1 inside the bound and 0.1 at bound + margin."""
    for shape in (long_tail, gaussian):
        np.testing.assert_allclose(shape(jnp.float32(0.05), 0.05, 0.2), 1.0)
        np.testing.assert_allclose(shape(jnp.float32(0.25), 0.05, 0.2), 0.1, rtol=1e-5)
    for a, b in [(0.0, 0.0), (0.0, 0.7), (1.0, 1.0), (0.2, 0.9)]:
        expected = a * b / (a + b - a * b) if a or b else 0.0
        np.testing.assert_allclose(
            hamacher_product(jnp.float32(a), jnp.float32(b)), expected, rtol=1e-6
        )


def test_an_unknown_task_gets_a_suggestion():
    with pytest.raises(ValueError, match="did you mean 'drawer-open'"):
        task_id("drawer-opne")
    assert [task_id(name) for name in TASKS] == list(range(len(TASKS)))
    assert GOALS.shape[0] == len(TASKS)
