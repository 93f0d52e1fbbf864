"""RL2 and MAML in Meta-World's own environments: what they know there is what they were shown."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from metaworld_fixtures import Recorder
from policy_fixtures import HORIZON

from cmrl_jax.algorithms.base import Told
from cmrl_jax.algorithms.common.replay import Transition
from cmrl_jax.config.files import load_config
from cmrl_jax.evaluation.metaworld import adaptation_run, agent_of, metaworlds_own, of_task
from cmrl_jax.evaluation.options import EvalOptions
from cmrl_jax.evaluation.session import Policy, Session
from envs.adapters.metaworld_envs import make_vector_env, set_goals

LANES, TASK = 2, "window-open"
SMALL = {
    "env.horizon": HORIZON,
    "env.obs_mode": "metaworld",
    "collect.lanes": 6,
    "rl2.width": 8,
    "rl2.hidden": 8,
    "rl2.minibatches": 1,
    "maml.episodes": 2,
    "maml.hidden": [8],
    "maml.inner_lr": 5.0,
}


def setting(name):
    """Session, a policy whose every weight matters, and a trial of one task."""
    session = Session(load_config(name, SMALL))
    params = jax.eval_shape(
        lambda key: session.algorithm.policy_params(session.algorithm.init(key)), jax.random.key(0)
    )
    generator = np.random.default_rng(1)
    weights = jax.tree.map(
        lambda x: generator.normal(0, 0.5, x.shape).astype(np.float32), params.params
    )
    run = jax.jit(session.algorithm.init)(jax.random.key(0))
    saved: Any = session.algorithm.policy_params(run)._replace(params=weights)
    vectors = dict(zip(session.eval_tasks, session.goals.vectors[:, 0], strict=True))
    trial = of_task(session.trial("heldout", LANES), session.eval_tasks.index(TASK))
    return session, Policy(saved, vectors, {}), trial


@pytest.fixture(scope="module", params=["rl2", "maml"])
def adapted(request):
    """An agent after three episodes that count at k = 0, 1, 2 and two learned from; and all of
    them as they were."""
    session, policy, trial = setting(request.param)
    recurrent = request.param == "rl2"
    envs = make_vector_env(TASK, trial.placements[0], LANES, HORIZON, False, 0, recurrent)
    envs.call("toggle_terminate_on_success", False)
    set_goals(envs, TASK, trial.placements[0], False)
    recorder: Any = Recorder(envs)
    agent = agent_of(session, policy, trial, [np.arange(LANES)], HORIZON, seed=3)
    agent.init()
    scores = adaptation_run(agent, recorder, (0, 1, 2), HORIZON)
    yield session, policy, trial, agent, recorder.episodes[:5], scores
    envs.close()


def replayed(session, policy, episodes):
    """The agent's memory, shown the episodes that are learned from, less their last steps."""
    agent, params = session.agent, policy.params
    memory = agent.init(Told(jnp.zeros((LANES, 1)), jnp.ones(LANES), jnp.zeros(LANES, jnp.int32)))
    no_keys: Any = None
    for episode in episodes:
        memory = agent.begin_episode(params, memory, memory, no_keys, np.bool_(False))
        by_lane = lambda x: jnp.asarray(np.stack(x, 1), jnp.float32)
        obs, action, reward, next_obs = map(by_lane, zip(*episode[:-1], strict=True))
        flag = jnp.zeros(reward.shape, bool)
        obs, next_obs = obs[..., :39], next_obs[..., :39]
        shown = Transition(obs, action, reward, flag, flag, flag, next_obs)
        memory = agent.observe(params, memory, shown, jnp.ones(reward.shape))
    return memory


def test_it_knows_the_episodes_that_are_learned_from(adapted):
    """And nothing of those that count, which come before each."""
    session, policy, _, agent, episodes, _ = adapted
    wanted = replayed(session, policy, [episodes[1], episodes[3]])
    if hasattr(wanted, "hidden"):
        np.testing.assert_allclose(agent.memory.hidden, wanted.hidden, atol=1e-5)
        assert np.abs(np.asarray(wanted.hidden)).max() > 0.1
        return
    # MAML's group of two is full: the last episode that counts has taken the step.
    begun = session.agent.begin_episode(
        policy.params, wanted, wanted, jnp.zeros(()), np.bool_(True)
    )
    for ours, theirs in zip(
        *map(jax.tree.leaves, (agent.memory.acting, begun.acting)), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-4)
    assert max(float(np.abs(leaf).max()) for leaf in jax.tree.leaves(begun.acting)) > 0.05


def test_what_counts_is_acted_without_noise_and_what_is_learned_from_with(adapted):
    """The first episode that counts is the next one's, but for the noise of its actions."""
    *_, episodes, _ = adapted
    assert [len(episode) for episode in episodes] == 5 * [HORIZON]
    first = [np.asarray(episode[0][1]) for episode in episodes]
    assert (first[0] != first[1]).all()


def test_metaworlds_own_function_drives_it(adapted):
    session, policy, trial, *_ = adapted
    options = EvalOptions(goals=LANES, adaptation_episodes=2, evaluation_episodes=2)
    own = metaworlds_own(session, policy, trial, options, HORIZON)
    assert own["num_evals"] == LANES and np.isfinite(own["mean_return"])
