"""The oracle itself: exact injection, starts that depend on the goal alone, solved tasks."""

import dataclasses
import warnings

import numpy as np
import pytest

from envs.goal_sets import load_goal_set
from envs.parity import reference
from envs.parity.reference import ReferenceEnv, record_rollout, scripted_policy
from envs.tasks import METAWORLD_TASKS as TASKS

GOALS = dict(zip(TASKS, load_goal_set("heldout", TASKS), strict=True))


def drive(env: ReferenceEnv, steps: int, seed: int = 0) -> None:
    """Steps with a perturbed scripted policy, so that hand and fixture touch and move."""
    policy, rng = scripted_policy(env.task), np.random.default_rng(seed)
    obs = env.step(np.zeros(4))[0]
    for _ in range(steps - 1):
        action = np.clip(policy.get_action(obs), -1, 1) + 0.2 * rng.standard_normal(4)
        obs = env.step(np.clip(action, -1, 1))[0]


@pytest.mark.parametrize("task", TASKS)
def test_scripted_policy_solves_the_task(task):
    for goal in GOALS[task][:3]:
        rollout = record_rollout(task, goal, steps=200)
        assert rollout.success.any()
        assert 60 < np.argmax(rollout.success) < 120  # 77-95 measured: not solved at the start
        assert 0 <= rollout.reward.min() and rollout.reward.max() <= 10


@pytest.mark.parametrize("task", TASKS)
def test_random_actions_do_not_solve_it(task):
    rollout = record_rollout(task, GOALS[task][0], "random", steps=60, seed=1)
    assert not rollout.success.any()


@pytest.mark.parametrize("goal_observable", [False, True])
@pytest.mark.parametrize("task", TASKS)
def test_inject_reproduces_observation_reward_and_the_next_step(task, goal_observable):
    env, other = (ReferenceEnv(task, goal_observable) for _ in range(2))
    env.reset(GOALS[task][0])
    other.reset(GOALS[task][1])
    drive(other, 30)  # a simulator whose own state is elsewhere, with another fixture position
    drive(env, 70)
    action = np.array([0.3, -0.2, 0.1, 0.6], np.float32)
    for _ in range(10):
        obs, reward, success, info = env.step(action)
        injected = other.inject(env.get_state(), action)
        np.testing.assert_array_equal(injected[0], obs)
        assert injected[1:3] == (reward, success)
        assert injected[3] == info
        positions, injected_positions = env.positions(), other.positions()
        for name, value in vars(positions).items():
            np.testing.assert_array_equal(vars(injected_positions)[name], value)

    onward, injected_onward = env.step(-action), other.step(-action)
    np.testing.assert_array_equal(injected_onward[0], onward[0])
    assert injected_onward[1] == onward[1]
    np.testing.assert_array_equal(other.get_state().qvel, env.get_state().qvel)


@pytest.mark.parametrize("field", ["qpos", "mocap_pos", "warmstart", "fixture_pos", "prev_frame"])
def test_inject_uses_every_part_of_the_state(field):
    """The warm start too, though it moves a step by less than 1e-6 m."""
    rollout = record_rollout("drawer-open", GOALS["drawer-open"][0], "perturbed", 90)
    env = ReferenceEnv("drawer-open")

    def onward(state, action):
        return np.concatenate([env.inject(state, action)[0], env.step(action)[0]])

    differs = []
    for step in range(60, 90, 5):  # gripper and handle touch
        state, action = rollout.state(step + 1), rollout.action[step]
        changed = dataclasses.replace(state, **{field: getattr(state, field) + 0.01})
        differs.append(not np.array_equal(onward(state, action), onward(changed, action)))
    assert any(differs) if field == "warmstart" else all(differs)


@pytest.mark.parametrize("task", TASKS)
def test_start_state_depends_on_the_goal_alone(task):
    used, fresh = ReferenceEnv(task), ReferenceEnv(task)
    used.reset(GOALS[task][5])
    drive(used, 120)
    obs, fresh_obs = used.reset(GOALS[task][2]), fresh.reset(GOALS[task][2])
    np.testing.assert_array_equal(obs, fresh_obs)
    state, fresh_state = used.get_state(), fresh.get_state()
    for name in ("qpos", "qvel", "mocap_pos", "warmstart", "fixture_pos"):
        np.testing.assert_array_equal(getattr(state, name), getattr(fresh_state, name))
    for name, value in vars(state.constants).items():
        np.testing.assert_array_equal(value, vars(fresh_state.constants)[name])


@pytest.mark.parametrize("task", TASKS)
def test_start_observation_is_stale_by_one_substep(task):
    """Documented behaviour the port must decide about: module NOTE 2."""
    env = ReferenceEnv(task)
    goal = GOALS[task][0]
    obs = env.reset(goal)
    np.testing.assert_array_equal(obs[:18], obs[18:36])
    np.testing.assert_array_equal(obs[36:], np.zeros(3))
    refreshed, _, success, _ = env.inject(env.get_state(), np.zeros(4))
    assert not success
    handle = {"drawer-open": (0, -0.17, 0.09), "drawer-close": (0, -0.32, 0.14)}
    handle |= {"window-open": (-0.04, -0.095, 0), "window-close": (0.21, -0.095, 0)}
    np.testing.assert_allclose(refreshed[4:7] - goal, handle[task], atol=1e-9)
    hand_gap = np.abs(refreshed[:3] - obs[:3]).max()
    if task == "drawer-close":  # the only task that calls mj_forward at the end of its reset
        assert hand_gap == 0
    else:
        assert 1e-5 < hand_gap < 1e-4
    stale_handle = 0.2 if task == "window-close" else 0.0
    np.testing.assert_allclose(refreshed[4] - obs[4], stale_handle, atol=1e-9)


def test_rollout_rows_are_states_that_inject_takes():
    rollout = record_rollout("window-close", GOALS["window-close"][3], "perturbed", 90, seed=4)
    assert rollout.obs.shape == (91, 39) and rollout.action.shape == (90, 4)
    assert np.abs(rollout.action).max() <= 1
    env = ReferenceEnv("window-close")
    for step in (0, 1, 45, 89):
        obs, reward, success, _ = env.inject(rollout.state(step + 1), rollout.action[step])
        np.testing.assert_array_equal(obs, rollout.obs[step + 1])
        assert (reward, success) == (rollout.reward[step], rollout.success[step])
    again = record_rollout("window-close", GOALS["window-close"][3], "perturbed", 90, seed=4)
    np.testing.assert_array_equal(again.obs, rollout.obs)
    other = record_rollout("window-close", GOALS["window-close"][3], "perturbed", 90, seed=5)
    assert not np.array_equal(other.action, rollout.action)


def test_only_the_saturation_warning_is_silenced():
    policy = scripted_policy("drawer-open")
    far = np.zeros(39)
    far[4:7] = (0.1, 0.73, 0.09)
    assert np.abs(policy.get_action(far)).max() > 1  # would raise: warnings are errors here

    class Warns:
        def get_action(self, obs):
            warnings.warn("something else", UserWarning, stacklevel=2)

    with pytest.warns(UserWarning, match="something else"):
        reference._QuietPolicy(Warns()).get_action(far)


@pytest.mark.parametrize(
    "call",
    [
        lambda: ReferenceEnv("drawer-opne"),
        lambda: scripted_policy("door-open"),
        lambda: record_rollout("drawer-open", np.zeros(3), "expert"),  # type: ignore[arg-type]
        lambda: record_rollout("drawer-open", np.zeros(3), steps=501),
    ],
)
def test_mistakes_name_cause_and_cure(call):
    with pytest.raises(ValueError) as error:
        call()
    assert len(str(error.value).splitlines()) == 2
