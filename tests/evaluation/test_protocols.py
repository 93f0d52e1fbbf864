"""Which episodes are learned from and which count, by protocol, with agents that keep a tally."""

import jax.numpy as jnp
import numpy as np
import pytest
from point_env import PointEnv

from cmrl_jax.config.files import load_config
from cmrl_jax.evaluation.evaluator import Evaluator, Trial

HORIZON, GOALS, DRAWS, EPISODES = 5, 3, 2, 4
TASKS = PointEnv.tasks


class Tally:
    """Stays where it is; remembers where its learning episodes began, and how many there were."""

    adapts, chunk = True, HORIZON

    def __init__(self, explores):
        self.explores = explores

    def init(self, told):
        zero = jnp.zeros(told.task_row.shape)
        return {"episodes": zero, "places": zero, "learns": zero, "text": told.text}

    def begin_episode(self, params, memory, source, keys, exploit):
        return memory | {"learns": jnp.ones_like(memory["learns"]) * (1.0 - exploit)}

    def act(self, params, memory, obs, noise, deterministic):
        return jnp.zeros((len(obs), 2))

    def observe(self, params, memory, transitions, mask):
        place = transitions.obs[:, 0, 0] * memory["learns"]
        return memory | {
            "episodes": memory["episodes"] + memory["learns"],
            "places": memory["places"] + place,
        }


def played(explores, adaptation=None, **options):
    """(k, memories before, scores) of each counted episode of one policy, and the goals."""
    found, goals = every_episode(explores, adaptation, **options)
    return [(e.number, e.before, e.score) for e in found if e.is_counted], goals


def every_episode(explores, adaptation=None, **options):
    goals = np.random.default_rng(0).uniform(-0.5, 0.5, (2, GOALS, 2)).astype(np.float32)
    texts = np.zeros((1, 2, GOALS, 1), np.float32)
    trial = Trial(TASKS, goals, texts, draws=DRAWS, adaptation=adaptation)
    config = load_config("smoke.yaml")
    evaluator = Evaluator(config, PointEnv(), Tally(explores), 5, HORIZON)  # in uneven batches
    policy = {"weight": np.zeros(1, np.float32)}
    return list(evaluator.episodes([policy], trial, EPISODES, 0, **options)), goals


def places(memory):
    return np.asarray(memory["places"]).reshape(2, -1, DRAWS)


@pytest.mark.parametrize("explores", [False, True])
def test_by_goal_a_lane_learns_on_its_own_goal(explores):
    found, goals = played(explores)
    for k, (number, memory, scores) in enumerate(found):
        assert number == k and (memory["episodes"] == k).all()
        np.testing.assert_allclose(places(memory), np.repeat(k * goals[..., :1], DRAWS, -1), 1e-5)
        assert scores.returns.shape == (1, 2, GOALS, DRAWS)
        sign = np.array([-1, 1])[:, None]
        reward = HORIZON * np.minimum(sign * goals[..., 0], 0.5)
        np.testing.assert_allclose(scores.returns[0, :, :, 0], reward, rtol=1e-4)


def test_by_task_a_draw_learns_once_for_all_goals():
    """On goals of its own, in their order; what counts is scored on the others and not learned."""
    adaptation = np.random.default_rng(1).uniform(-0.5, 0.5, (2, DRAWS, EPISODES, 2))
    for explores in (False, True):
        found, goals = played(explores, adaptation)
        for k, (number, memory, scores) in enumerate(found):
            assert number == k and (memory["episodes"] == k).all()
            learned = adaptation[:, :, :k, 0].sum(-1)  # (task, draw)
            wanted = np.repeat(learned[:, None], GOALS, 1)
            np.testing.assert_allclose(places(memory), wanted, rtol=1e-4, atol=1e-6)
            reward = HORIZON * np.minimum(np.array([-1, 1])[:, None] * goals[..., 0], 0.5)
            np.testing.assert_allclose(scores.returns[0, :, :, 1], reward, rtol=1e-4)


def test_every_episode_is_told_of_in_turn():
    """One that is learned from comes after the one that counts in its place, and scores its own."""
    found, _ = every_episode(False, counted=(1,))
    assert [(e.number, e.is_counted) for e in found] == [(k, k == 1) for k in range(EPISODES)]
    adaptation = np.random.default_rng(1).uniform(-0.5, 0.5, (2, DRAWS, EPISODES, 2))
    found, _ = every_episode(True, adaptation, counted=(0, EPISODES - 1))
    order = [(0, True), *((k, False) for k in range(EPISODES - 1)), (EPISODES - 1, True)]
    assert [(e.number, e.is_counted) for e in found] == order
    for e in found:
        np.testing.assert_array_equal(e.after["learns"], not e.is_counted)
        if not e.is_counted:
            learned = adaptation[:, :, e.number, 0]
            reward = HORIZON * np.minimum(np.array([[-1], [1]]) * learned, 0.5)
            np.testing.assert_allclose(e.score.returns[0, :, 0], reward, rtol=1e-4)
            after = np.asarray(e.after["places"] - e.before["places"]).reshape(2, DRAWS)
            np.testing.assert_allclose(after, learned, rtol=1e-4, atol=1e-6)


def test_only_what_is_asked_for_is_scored():
    every, _ = played(True)
    some, _ = played(True, counted=(1, 3))
    assert [number for number, _, _ in some] == [1, 3]
    for number, memory, scores in some:
        np.testing.assert_array_equal(scores.returns, every[number][2].returns)
        np.testing.assert_array_equal(memory["places"], every[number][1]["places"])


def test_faults_of_learning_and_of_the_episode_that_counts_add_up(monkeypatch):
    step = PointEnv.step
    faulty = lambda self, state, action: step(self, state, action).replace(faults=state.faults + 1)
    monkeypatch.setattr(PointEnv, "step", faulty)
    adaptation = np.zeros((2, DRAWS, EPISODES, 2))
    for explores, goals in ((False, None), (True, None), (False, adaptation), (True, adaptation)):
        found, _ = played(explores, goals)
        for number, _, scores in found:
            assert (scores.faults == HORIZON * (number + 1)).all()
