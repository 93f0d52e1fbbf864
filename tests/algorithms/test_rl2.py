"""RL2's network, trials and agent; that it learns is in test_meta_rl.py."""

from typing import Any

import jax
import jax.numpy as jnp
import line_env
import numpy as np
import pytest

from cmrl_jax.algorithms.base import Told
from cmrl_jax.algorithms.common.policy_gradient import PolicyParams
from cmrl_jax.algorithms.common.replay import Transition
from cmrl_jax.algorithms.rl2.agent import Rl2Agent
from cmrl_jax.algorithms.rl2.algorithm import Iteration, make
from cmrl_jax.algorithms.rl2.learner import unroll
from cmrl_jax.config.files import resolve
from cmrl_jax.nn.normalizers import init_obs_stats
from cmrl_jax.nn.recurrent import RecurrentActorCritic

LANES, EPISODES = 4, 3
NET = RecurrentActorCritic(width=6, hidden=5, action_size=1, std_init=0.5)
AGENT: Any = Rl2Agent(NET, reward_scale=0.5)


@pytest.fixture(scope="module")
def params():
    shown = jnp.zeros((1, line_env.LineEnv.observation_size + 3))
    return PolicyParams(NET.init(jax.random.key(0), jnp.zeros((1, 6)), shown), init_obs_stats(2))


@pytest.fixture(scope="module")
def iteration(registered):
    config = resolve(
        {
            "algorithm": "rl2",
            "env": {"name": "line", "horizon": line_env.STEPS, "obs_mode": "metaworld"},
            "tasks": {"train": ["line-left", "line-right"], "test": []},
            "goals": {"table": "one-hot"},
            "collect": {"lanes": LANES},
            "rl2": {"episodes": EPISODES, "width": 6, "hidden": 5, "minibatches": 2},
        }
    )
    algorithm = make(config, line_env.LineEnv(), jnp.zeros((2, 1, 2)))
    made = algorithm.make_iteration(None)
    assert isinstance(made, Iteration)
    return made, algorithm.init(jax.random.key(1))


@pytest.fixture(scope="module")
def registered():
    from cmrl_jax import registry

    registry.register_environment("line", line_env.TASKS, line_env.make)
    yield
    del registry.ENVIRONMENTS["line"]


def test_a_whole_trial_gives_what_its_steps_give(params):
    """And a step that does not count leaves no trace."""
    inputs = jax.random.normal(jax.random.key(2), (7, LANES, 5))
    mask = jnp.ones((7, LANES), bool).at[2, 1].set(False)
    head, value = unroll(NET, params.params, inputs, mask)
    state = jnp.zeros((LANES, 6))
    for time in range(7):
        done: Any = NET.apply(params.params, state, inputs[time])
        new, found = done
        np.testing.assert_allclose(found.head.mean, head.mean[time], atol=1e-6)
        np.testing.assert_allclose(found.value, value[time], atol=1e-6)
        state = jnp.where(mask[time][:, None], new, state)
    changed, _ = unroll(NET, params.params, inputs.at[2, 1].add(1.0), mask)
    np.testing.assert_array_equal(changed.mean[3:], head.mean[3:])
    changed, _ = unroll(NET, params.params, inputs.at[2, 0].add(1.0), mask)
    assert (changed.mean[3:, 0] != head.mean[3:, 0]).all()


def test_the_agent_is_the_policy_that_was_trained(iteration):
    """Shown a trial step by step, it knows what training knew, and says of each step the same."""
    made, run = iteration
    params = PolicyParams(run.learner.params, run.learner.obs_stats)
    after, steps = made.trial(params, jax.random.key(3))
    agent: Any = made.agent
    memory = agent.blank((LANES,))
    for episode in range(EPISODES):
        memory = agent.begin_episode(params, memory, memory, None, np.bool_(False))
        for time in range(line_env.STEPS):
            step = jax.tree.map(lambda x, e=episode, t=time: x[e, t], steps)
            wanted = np.tanh(step.u)
            noise = (step.u - agent.step(params, memory, step.obs)[1].head.mean) / 0.8
            action = agent.act(params, memory, step.obs, noise, False)
            np.testing.assert_allclose(action, wanted, atol=1e-5)
            flag = jnp.zeros((LANES, 1), bool)
            obs, action, reward = (x[:, None] for x in (step.obs, wanted, step.reward))
            shown = Transition(obs, action, reward, flag, flag, flag, obs)
            memory = agent.observe(params, memory, shown, jnp.ones((LANES, 1)))
    np.testing.assert_allclose(memory.hidden, after.hidden, atol=1e-5)


def test_episodes_of_a_trial_have_one_goal_and_a_start_that_is_told(iteration):
    made, run = iteration
    params = PolicyParams(run.learner.params, run.learner.obs_stats)
    _, steps = made.trial(params, jax.random.key(4))
    first = steps.obs[:, 0]
    np.testing.assert_array_equal(first, np.broadcast_to(first[:1], first.shape))
    assert len(np.unique(first[0, :, 0])) == LANES
    starts = np.asarray(steps.inputs[..., -1])
    assert (starts[:, 0] == 1).all() and (starts[:, 1:] == 0).all()
    # The first input of a later episode has the last reward of the one before.
    np.testing.assert_allclose(steps.inputs[1:, 0, :, -2], 0.1 * steps.reward[:-1, -1], rtol=1e-6)


def test_what_is_learned_from_has_noise_and_what_counts_none(params):
    blank = AGENT.init(Told(jnp.zeros((2, 1)), jnp.ones(2), jnp.zeros(2, jnp.int32)))
    obs = jnp.ones((2, 2))

    def difference(exploit, deterministic):
        memory = AGENT.begin_episode(params, blank, blank, None, np.bool_(exploit))
        act = lambda noise: AGENT.act(params, memory, obs, noise, np.bool_(deterministic))
        return np.abs(act(jnp.ones((2, 1))) - act(jnp.zeros((2, 1)))).min()

    assert difference(True, True) == 0
    assert min(difference(True, False), difference(False, True)) > 0.1
