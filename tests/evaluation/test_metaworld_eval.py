"""Our policies in Meta-World's own environments, beside what the environments themselves say."""

import itertools
import json
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from metaworld.evaluation import metalearning_evaluation
from metaworld_fixtures import Recorder
from policy_fixtures import HORIZON, random_policy, save_run, small_config

from cmrl_jax.algorithms.common.replay import Transition
from cmrl_jax.cli.main import main
from cmrl_jax.evaluation import metaworld as evaluate_metaworld
from cmrl_jax.evaluation.evaluator import Evaluator, lane_names
from cmrl_jax.evaluation.metaworld import (
    adaptation_run,
    agent_of,
    format_own,
    k_shot,
    metaworlds_own,
    of_task,
)
from cmrl_jax.evaluation.metaworld_agent import MetaWorldAgent
from cmrl_jax.evaluation.options import EvalOptions
from cmrl_jax.evaluation.session import Policy, Session
from envs.adapters.metaworld_envs import make_vector_env, set_goals
from envs.parity.reference import record_rollout
from envs.sawyer import OBS_SIZE
from envs.tasks import METAWORLD_TASKS as TASKS

LANES = 2


@pytest.fixture(scope="module")
def session():
    return Session(small_config())


@pytest.fixture(scope="module")
def policy(session):
    vectors = dict(zip(session.eval_tasks, session.goals.vectors[:, 0], strict=True))
    return Policy(random_policy(session, 1), vectors, {})


@pytest.fixture(scope="module")
def trial(session):
    return session.trial("heldout", LANES)


@pytest.fixture(scope="module")
def adapted(session, policy, trial):
    """An agent after two episodes at window-open, and the environments' own record of them."""
    one = of_task(trial, session.eval_tasks.index("window-open"))
    envs = make_vector_env("window-open", one.placements[0], LANES, HORIZON)
    envs.call("toggle_terminate_on_success", False)
    set_goals(envs, "window-open", one.placements[0], False)
    recorder = Recorder(envs)
    agent = agent_of(session, policy, one, [np.arange(LANES)], HORIZON, seed=3)
    agent.init()
    scores = adaptation_run(agent, recorder, (0, 1), HORIZON)  # pyright: ignore[reportArgumentType]
    yield agent, recorder.episodes[:2], scores, one
    envs.close()


def test_the_belief_is_of_the_environments_transitions_but_the_last(session, policy, adapted):
    agent, episodes, _, trial = adapted
    assert [len(episode) for episode in episodes] == [HORIZON, HORIZON]
    inference, params = session.algorithm.parts.inference, policy.params
    kept = [step for episode in episodes for step in episode[:-1]]
    by_lane = lambda x: jnp.asarray(np.stack(x, 1), jnp.float32)
    obs, action, reward, next_obs = map(by_lane, zip(*kept, strict=True))
    normalize = lambda x: session.algorithm.parts.normalize_obs(params.obs_stats, x)
    flag = jnp.zeros(reward.shape, bool)
    transitions = Transition(normalize(obs), action, reward, flag, flag, flag, normalize(next_obs))
    goal, ones = trial.texts[0, 0], jnp.ones(LANES)
    wanted = inference.posterior(
        params.encoder_params, transitions, jnp.ones(reward.shape), goal, ones
    )
    found = inference.posterior_of_belief(params.encoder_params, agent.memory.belief, goal, ones)
    np.testing.assert_array_equal(agent.memory.belief.sums.count, 2 * (HORIZON - 1))
    np.testing.assert_allclose(found.mean, wanted.mean, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(found.variance, wanted.variance, rtol=1e-4)


def test_scores_are_the_environments(adapted):
    _, episodes, scores, _ = adapted
    for steps, found in zip(episodes, scores.values(), strict=True):
        rewards = np.sum([reward for _, _, reward, _ in steps], 0)
        np.testing.assert_allclose(found.returns, rewards)


class Player:
    """Recorded actions (step, 4) in the agent's place, over and over."""

    explores = False

    def __init__(self, actions):
        self._actions = itertools.cycle(actions)

    def adapt_action(self, observations):
        return next(self._actions)[None], {}

    def step(self, timestep):
        pass


def test_successes_are_metaworlds(trial):
    place, steps = trial.placements[1, :1], 80
    reference = record_rollout("drawer-close", place[0], "scripted", steps=steps)
    envs = make_vector_env("drawer-close", place, 1, steps)
    envs.call("toggle_terminate_on_success", False)
    set_goals(envs, "drawer-close", place, False)
    agent: Any = Player(reference.action)
    for found in adaptation_run(agent, envs, (0, 1), steps).values():
        assert found.success_any.item() and found.success_last.item() == reference.success[-1]
        assert found.first_success.item() == np.flatnonzero(reference.success)[0] > 0
        assert found.returns.item() == pytest.approx(reference.reward.sum(), rel=1e-5)
    envs.close()


@pytest.mark.parametrize("z", ["posterior", "prior", "text", "sampled"])
def test_without_a_dropped_transition_metaworld_agrees_with_the_native_backend(
    session, policy, trial, z
):
    """k = 0 needs no belief: the same latent, the same actions, Meta-World's physics to the bit.

    Prior and text never read one, so they agree at every k. Sampled: the text's, sampled actions.
    """
    deterministic = z != "sampled"
    z = z if deterministic else "text"
    trial = replace(trial, z=z, draws=2, deterministic=deterministic)
    ks = (0,) if z == "posterior" else (0, 1)
    evaluator = Evaluator(session.config, session.env, session.agent, lanes=16)
    native = evaluator.run([policy.params], trial, ks, seed=3)
    for row in range(len(TASKS)):
        found = k_shot(session, policy, of_task(trial, row), ks, HORIZON, seed=3)
        for k in ks:
            wanted = jax.tree.map(lambda x: x[0, row : row + 1], native[k])
            np.testing.assert_allclose(found[k].returns, wanted.returns, rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(found[k].final_distance, wanted.final_distance, atol=1e-4)
            np.testing.assert_array_equal(found[k].success_any, wanted.success_any)
            np.testing.assert_array_equal(found[k].first_success, wanted.first_success)


def test_noise_of_sampled_actions_is_the_lanes_episodes_and_steps_own(session, policy, trial):
    """However long the episode before was, and whatever the other lanes do meanwhile."""
    one = replace(of_task(trial, 0), z="text", deterministic=False)
    agent = agent_of(session, policy, one, [np.arange(LANES)], HORIZON, seed=3)
    seen = np.zeros((LANES, OBS_SIZE))

    def second_episode(steps_before, lanes):
        agent.init()
        for _ in range(steps_before):
            agent.eval_action(seen)
        agent.reset(np.array(lanes))
        return np.stack([agent.eval_action(seen) for _ in range(3)], 1)

    wanted = second_episode(1, [True, True])
    np.testing.assert_array_equal(second_episode(3, [True, True]), wanted)
    alone = second_episode(3, [False, True])
    np.testing.assert_array_equal(alone[1], wanted[1])
    assert not np.array_equal(alone[0], wanted[0])
    noise = agent._noise
    assert len(np.unique(noise)) == noise.size == LANES * HORIZON * 4


def test_a_search_tries_its_arms_and_counts_apart(session, policy, trial):
    """k = 0 is the native backend's; what counts is not learned from, and Meta-World's own
    function explores as often as it is told."""
    trial = replace(trial, draws=1)
    evaluator = session.evaluator(8, adapt="search")
    native = evaluator.run([policy.params], trial, (0,), seed=3)[0]
    one = of_task(trial, 1)
    found = k_shot(session, policy, one, (0, 2), HORIZON, seed=3, adapt="search")
    np.testing.assert_allclose(found[0].returns, native.returns[0, 1:2], rtol=1e-4, atol=1e-5)
    agent = agent_of(session, policy, one, [np.arange(LANES)], HORIZON, seed=3, adapt="search")
    agent.init()
    envs = make_vector_env(one.tasks[0], one.placements[0], LANES, HORIZON)
    envs.call("toggle_terminate_on_success", False)
    set_goals(envs, one.tasks[0], one.placements[0], False)
    scores = adaptation_run(agent, envs, (0, 1, 3), HORIZON)
    envs.close()
    assert list(scores) == [0, 1, 3]
    # Three explored, and each has been credited when the next episode began.
    plays = np.asarray(agent.memory.plays)
    assert (plays.sum(-1) == 3).all() and (plays[:, :3] == 1).all()
    own = metaworlds_own(session, policy, one, EvalOptions(adapt="search"), HORIZON)
    assert own["adaptation_episodes"] == 10


def test_a_policy_that_is_told_the_task(trial):
    config = {"model.conditioning": "task_id", "tasks.test": "[]"}
    session = Session(small_config(**config, **{"eval.k": "[0]", "eval.final_k": "[0]"}))
    policy = Policy(random_policy(session, 1), {}, {})
    trial = session.trial("heldout", LANES)
    evaluator = Evaluator(session.config, session.env, session.agent, lanes=6)
    native = evaluator.run([policy.params], trial, (0,), seed=3)[0]
    found = k_shot(session, policy, of_task(trial, 1), (0,), HORIZON, seed=3)[0]
    np.testing.assert_allclose(found.returns[0], native.returns[0, 1], rtol=1e-4, atol=1e-5)


def test_more_goals_than_environments(session, policy, monkeypatch):
    """Batches of two, the last one padded: as with one environment for each goal."""
    trial = of_task(session.trial("heldout", 3), 0)
    wanted = k_shot(session, policy, trial, (0, 1), HORIZON, seed=3)
    made = []
    make = evaluate_metaworld.make_vector_env
    record = lambda *args: made.append(args[2]) or make(*args)
    monkeypatch.setattr(evaluate_metaworld, "make_vector_env", record)
    found = k_shot(session, policy, trial, (0, 1), HORIZON, seed=3, environments=2)
    assert made == [2]
    for k in (0, 1):
        assert found[k].returns.shape == (1, 3, 1)
        np.testing.assert_allclose(found[k].returns, wanted[k].returns, rtol=1e-4)


class Watched(MetaWorldAgent):
    """The agent, with a log of its calls, latents and beliefs."""

    def watch(self):
        self.log = []
        return self

    def count(self):
        """Transitions in the belief of each lane."""
        return np.array(self.memory.belief.sums.count)

    def latents(self):
        return np.array(self.memory.conditioning)

    def init(self):
        super().init()
        self.log.append(("init", None, None))

    def adapt(self):
        super().adapt()
        self.log.append(("adapt", None, self.count()))

    def adapt_action(self, observations):
        result = super().adapt_action(observations)
        self.log.append(("adapt_action", self.latents(), self.count()))
        return result

    def eval_action(self, observations):
        result = super().eval_action(observations)
        self.log.append(("eval_action", self.latents(), self.count()))
        return result


def test_metaworlds_own_function_drives_the_agent_as_it_should(session, policy, trial):
    one = of_task(trial, 1)
    base = agent_of(session, policy, one, [np.array([0]), np.array([1])], HORIZON, seed=3)
    agent = Watched(
        session.config.env, session.agent, policy.params,
        base._texts, base._lane_ids, 1, np.zeros(3), HORIZON, seed=3,
    ).watch()  # fmt: skip
    envs = make_vector_env(one.tasks[0], one.placements[0], 1, HORIZON)
    rewards = []
    step = envs.step
    envs.step = lambda actions: (result := step(actions), rewards.append(result[1].item()))[0]
    rate, mean_return, per_task = metalearning_evaluation(
        agent, envs, num_evals=2, adaptation_steps=1, adaptation_episodes=2, evaluation_episodes=3
    )
    names = [name for name, _, _ in agent.log]
    a_run = ["init"] + 2 * HORIZON * ["adapt_action"] + ["adapt"] + 3 * HORIZON * ["eval_action"]
    assert names == 2 * a_run
    assert per_task == {"drawer-close-v3": rate} and rate == 0
    evaluated = [
        rewards[n] for n, name in enumerate(x for x in names if "_" in x) if name[0] == "e"
    ]
    assert mean_return == pytest.approx(np.sum(evaluated) / 6, rel=1e-6)
    for run in (agent.log[: len(a_run)], agent.log[len(a_run) :]):
        counts = [count.item() for name, _, count in run if name == "adapt_action"]
        # A belief grows at each truncation, by all but the last transition; adapt finds it grown.
        assert counts == HORIZON * [0] + HORIZON * [HORIZON - 1]
        after = [count.item() for name, _, count in run if name in ("adapt", "eval_action")]
        assert set(after) == {2 * (HORIZON - 1)}  # and it stays as it was
        latents = [z for name, z, _ in run if name.endswith("_action")]
        by_episode = [latents[n : n + HORIZON] for n in range(0, len(latents), HORIZON)]
        assert all(np.array_equal(z, episode[0]) for episode in by_episode for z in episode)
        distinct = np.unique([episode[0][0] for episode in by_episode], axis=0)
        assert len(distinct) == 5  # one draw an episode, in evaluation too
    # Frozen is frozen, whatever comes after.
    agent.init()
    agent.adapt()
    envs.call("toggle_terminate_on_success", False)
    adaptation_run(agent, envs, (0,), HORIZON)
    assert agent.count() == 0
    envs.close()


def test_the_first_evaluation_episode_is_the_protocols_k(session, policy, trial):
    """After n adaptation episodes Meta-World's function sees the episode we report at k = n."""
    one = of_task(trial, 2).of_goal(0)
    ours = k_shot(session, policy, one, (0, 2), HORIZON, seed=3)
    for k in (0, 2):
        options = EvalOptions(
            goals=1, seed=3, adaptation_episodes=k, evaluation_episodes=1, physics="metaworld"
        )
        own = metaworlds_own(session, policy, one, options, HORIZON)
        assert own["mean_return"] == pytest.approx(ours[k].returns.item(), rel=1e-5)
        assert own["num_evals"] == 1 and own["adaptation_episodes"] == k


def test_metaworlds_own_function_plays_every_draw_of_every_goal(session, policy, monkeypatch):
    one = replace(of_task(session.trial("heldout", 2), 1), draws=3)
    visited, agents = [], []

    def evaluation(agent, envs, num_evals, **episodes):
        for _ in range(num_evals):
            agent.init()
            envs.call("sample_tasks")
            visited.append(envs.envs[0].unwrapped._last_rand_vec.copy())
            agents.append(agent._lane_id.item())
        return 0.5, 1.0, {}

    monkeypatch.setattr(evaluate_metaworld, "metalearning_evaluation", evaluation)
    options = EvalOptions(goals=2, draws=3, seed=3, physics="metaworld")
    own = metaworlds_own(session, policy, one, options, HORIZON)
    assert (own["num_evals"], own["draws"]) == (6, 3)
    places, counts = np.unique(np.round(visited, 6), axis=0, return_counts=True)
    wanted = np.unique(np.round(one.placements[0], 6), axis=0)
    np.testing.assert_allclose(places, wanted, atol=1e-6)
    assert list(counts) == [3, 3] and len(set(agents)) == 6
    assert "2 goals, 3 runs each" in format_own({"drawer-close": own})


def test_goals_are_those_of_the_set(trial):
    for row, task in enumerate(trial.tasks):
        envs = make_vector_env(task, trial.placements[row], 1, HORIZON)
        seen = []
        for _ in range(LANES):
            envs.call("sample_tasks")
            seen.append(envs.envs[0].unwrapped._last_rand_vec)  # pyright: ignore[reportAttributeAccessIssue]
        assert envs.envs[0].unwrapped._partially_observable  # pyright: ignore[reportAttributeAccessIssue]
        envs.close()
        order = np.lexsort(np.array(seen).T)
        wanted = trial.placements[row]
        np.testing.assert_allclose(np.array(seen)[order], wanted[np.lexsort(wanted.T)])


def test_the_command_writes_both_figures(session, tmp_path, capsys, refused):
    run = save_run(tmp_path / "run", session, seeds=(1,))
    words = ["eval", "--run", str(run), "--physics", "metaworld", "--goals", "2", "--k", "0,1"]
    refusal = refused(*words, "--horizon", "501")
    assert "at most 500" in refusal[0] and "--horizon 500" in refusal[1]
    files = ["--json", str(tmp_path / "f.json"), "--csv", str(tmp_path / "f.csv")]
    own = ["--adaptation-episodes", "1", "--evaluation-episodes", "2"]
    tasks = ["--tasks", "window-close,drawer-open"]
    lanes = ["--lanes", "1"]
    assert main([*words, *tasks, *own, *files, *lanes]) == 0
    result = json.loads((tmp_path / "f.json").read_text())
    assert list(result["tasks"]) == ["window-close", "drawer-open"]
    assert (result["physics"], result["horizon"], result["goals"]) == ("metaworld", HORIZON, 2)
    found = result["metalearning_evaluation"]["tasks"]["window-close"]
    assert found["success_rate_per_task"] == {"window-close-v3": found["mean_success_rate"]}
    assert (found["num_evals"], found["adaptation_episodes"]) == (2, 1)
    assert (found["evaluation_episodes"], found["horizon"]) == (2, HORIZON)
    assert len((tmp_path / "f.csv").read_text().splitlines()) == 1 + 2 * 2 * 2
    assert "metalearning_evaluation: 2 goals" in capsys.readouterr().out


def test_names_of_lanes_do_not_depend_on_their_company(session, trial):
    every = lane_names(replace(trial, draws=2), session.env.tasks).reshape(4, LANES, 2)
    assert len(np.unique(every)) == every.size
    for row in range(4):
        alone = lane_names(of_task(trial, row).of_goal(1), session.env.tasks)
        assert alone.item() == every[row, 1, 0]
