"""Canonical observations in Meta-World's own environments: their origin is our environment's.

An agent sees observations alone there, and window-close's first one shows the pane elsewhere.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from policy_fixtures import HORIZON, random_policy, small_config

from cmrl_jax.evaluation.evaluator import Evaluator
from cmrl_jax.evaluation.metaworld import agent_of, k_shot, of_task
from cmrl_jax.evaluation.session import Policy, Session
from envs.adapters.metaworld_envs import make_vector_env, set_goals
from envs.sawyer import OBJECT
from envs.tasks import METAWORLD_TASKS as TASKS
from envs.tasks import task_id

LANES = 2


@pytest.fixture(scope="module")
def session():
    return Session(small_config(**{"env.obs_mode": "canonical"}))


@pytest.fixture(scope="module")
def policy(session):
    vectors = dict(zip(session.eval_tasks, session.goals.vectors[:, 0], strict=True))
    return Policy(random_policy(session, 1), vectors, {})


@pytest.fixture(scope="module")
def trial(session):
    return session.trial("heldout", LANES)


def test_returns_are_those_of_the_native_backend(session, policy, trial):
    """On every task, and where an episode's first observation came with the last of another."""
    trial = replace(trial, z="text")
    evaluator = Evaluator(session.config, session.env, session.agent, lanes=8)
    native = evaluator.run([policy.params], trial, (0, 1), seed=3)
    for row in range(len(TASKS)):
        found = k_shot(session, policy, of_task(trial, row), (0, 1), HORIZON, seed=3)
        for k in (0, 1):
            wanted = native[k].returns[0, row]
            np.testing.assert_allclose(found[k].returns[0], wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("task", ["window-close", "drawer-open"])
def test_the_agent_is_shown_what_our_environment_shows(session, policy, trial, task):
    """What the agent is shown, step by step over two episodes, is what our environment shows."""
    one = of_task(trial, session.eval_tasks.index(task))
    envs = make_vector_env(task, one.placements[0], LANES, HORIZON)
    envs.call("toggle_terminate_on_success", False)
    set_goals(envs, task, one.placements[0], False)
    agent = agent_of(session, policy, one, [np.arange(LANES)], HORIZON, seed=3)
    agent.init()
    start = jax.vmap(session.env.reset_to, (None, 0))(task_id(task), jnp.float32(one.placements[0]))
    state, (seen, _) = start, envs.reset()
    for step in range(2 * HORIZON):
        state = start if step % HORIZON == 0 else state
        action = agent.eval_action(seen)
        np.testing.assert_allclose(agent._shown, state.obs, atol=1e-5)
        if step % HORIZON == 1:
            np.testing.assert_allclose(agent._shown[:, OBJECT], 0, atol=1e-3)
        seen, _, _, truncated, _ = envs.step(action)
        agent.reset(truncated)
        state = jax.vmap(session.env.step)(state, action)
    envs.close()
