"""MAML's baseline, gradients and agent; that it learns is in test_meta_rl.py."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmrl_jax.algorithms.base import Told
from cmrl_jax.algorithms.common.policy_gradient import PolicyParams
from cmrl_jax.algorithms.common.replay import Transition
from cmrl_jax.algorithms.maml.agent import MamlAgent
from cmrl_jax.algorithms.maml.baseline import RIDGE, baseline, features, returns_to_go
from cmrl_jax.algorithms.maml.inner import Episodes, InnerStep
from cmrl_jax.algorithms.maml.learner import Learner
from cmrl_jax.config.schema import Config, EnvConfig, MamlConfig, PpoConfig
from cmrl_jax.nn.gaussian_policy import Head, MlpPolicy
from cmrl_jax.nn.normalizers import init_obs_stats

OBS, ACT, EPISODES, STEPS, GROUPS = 3, 2, 2, 5, 2
CONFIG = replace(
    Config(),
    env=EnvConfig(horizon=STEPS),
    maml=MamlConfig(episodes=EPISODES, inner_steps=2, inner_lr=0.3, hidden=(4,), kl=0.2),
    ppo=PpoConfig(entropy=0.05, clip=10.0),
)
POLICY = MlpPolicy((4,), ACT, 0.5)
INNER = InnerStep(CONFIG, POLICY)


@pytest.fixture(scope="module")
def params():
    start = POLICY.init(jax.random.key(0), jnp.zeros((1, OBS)))
    noise = lambda i, x: 0.3 * jax.random.normal(jax.random.key(i), x.shape)
    return jax.tree.map(lambda x: x + noise(x.size, x), start)


def episodes(seed, *lead):
    """Random episodes (*lead, episode, time, ...) of some other policy."""
    keys = jax.random.split(jax.random.key(seed), 5)
    shape = *lead, EPISODES, STEPS
    mean = 0.1 * jax.random.normal(keys[3], (*shape, ACT))
    return Episodes(
        obs=jax.random.normal(keys[0], (*shape, OBS)),
        u=mean + 0.5 * jax.random.normal(keys[1], (*shape, ACT)),
        reward=jax.random.normal(keys[2], shape),
        mask=jax.random.uniform(keys[4], shape) < 0.9,
        head=Head(mean, jnp.full((*shape, ACT), jnp.log(0.5))),
    )


def test_the_baseline_is_the_ridge_fit_of_what_counts():
    found = episodes(1)
    returns = np.asarray(returns_to_go(found.reward, found.mask, 0.9))
    mask, reward = np.asarray(found.mask), np.asarray(found.reward)
    for episode in range(EPISODES):
        steps = np.flatnonzero(mask[episode])
        for i, t in enumerate(steps):
            later = reward[episode, steps[i:]]
            wanted = np.dot(0.9 ** np.arange(len(later)), later)
            np.testing.assert_allclose(returns[episode, t], wanted, rtol=1e-5)
    x, y = np.asarray(features(found.obs))[mask].astype(float), returns[mask].astype(float)
    assert x.shape[1] == 2 * OBS + 4
    penalty = np.sqrt(RIDGE * len(x)) * np.eye(x.shape[1])
    coefficients, *_ = np.linalg.lstsq(
        np.concatenate([x, penalty]), np.concatenate([y, np.zeros(x.shape[1])]), rcond=None
    )
    predicted = baseline(found.obs, jnp.asarray(returns), found.mask)
    np.testing.assert_allclose(np.asarray(predicted)[mask], x @ coefficients, rtol=1e-3, atol=1e-3)


def test_an_inner_step_is_the_policy_gradient(params):
    """On what the policy did itself the ratio is 1: the gradient is of log-likelihood times
    advantage."""
    found = episodes(2)
    head = INNER.head(params, found.obs)
    log_std = jnp.broadcast_to(head.log_std, head.mean.shape)
    found = found._replace(head=Head(head.mean, log_std))
    advantage = INNER.advantages(found)

    def likelihood(params):
        mean, log_std = INNER.head(params, found.obs)
        z = (found.u - mean) / jnp.exp(log_std)
        log_prob = jnp.sum(-0.5 * z**2 - log_std, -1)
        return jnp.sum(log_prob * advantage * found.mask) / jnp.sum(found.mask)

    wanted = jax.tree.map(
        lambda x, g: x + CONFIG.maml.inner_lr * g, params, jax.grad(likelihood)(params)
    )
    for new, x in zip(*map(jax.tree.leaves, (INNER(params, found), wanted)), strict=True):
        np.testing.assert_allclose(new, x, rtol=1e-5, atol=1e-6)


def test_the_outer_gradient_goes_through_the_inner_steps(params):
    """Against central differences of the whole loss, in double precision, along ten directions."""
    learner = Learner(INNER)
    with jax.enable_x64(True):
        double = lambda tree: jax.tree.map(
            lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x, tree
        )
        start = double(params)
        inner, outer = double(episodes(3, GROUPS, 2)), double(episodes(4, GROUPS))
        advantage = jax.vmap(INNER.advantages)(outer)
        loss = jax.jit(lambda p: learner.loss(p, inner, outer, advantage)[0])
        grads = jax.grad(loss)(start)
        leaves, tree = jax.tree.flatten(start)
        for seed in range(10):
            generator = np.random.default_rng(seed)
            way = [generator.normal(size=leaf.shape) for leaf in leaves]
            at = lambda e, way=way: loss(
                jax.tree.unflatten(tree, [x + e * d for x, d in zip(leaves, way, strict=True)])
            )
            slope = (at(1e-5) - at(-1e-5)) / 2e-5
            along = sum(jnp.sum(g * d) for g, d in zip(jax.tree.leaves(grads), way, strict=True))
            np.testing.assert_allclose(along, slope, rtol=1e-5, atol=1e-8)


NO_KEYS: Any = None  # nothing is drawn


@pytest.fixture(scope="module")
def agent(params) -> Any:
    return MamlAgent(INNER, jax.tree.map(jnp.zeros_like, params), OBS, ACT)


def shown(found, episode):
    """An episode as an agent is shown it (1, time, ...)."""
    obs, u, reward = (x[None, episode] for x in (found.obs, found.u, found.reward))
    flag = jnp.zeros(reward.shape, bool)
    return Transition(obs, jnp.tanh(u), reward, flag, flag, flag, obs)


def test_the_agent_takes_the_inner_steps_of_training(agent, params):
    """After all episodes of a step: that step; of the next ones: from there."""
    saved = PolicyParams(params, init_obs_stats(OBS))
    found = jax.tree.map(lambda x: x[0], episodes(5, 2))._replace(
        mask=jnp.ones((EPISODES, STEPS), bool)
    )
    memory = agent.init(Told(jnp.zeros((1, 1)), jnp.ones(1), jnp.zeros(1, jnp.int32)))
    learns, counts = np.bool_(False), np.bool_(True)

    def taken(start):
        head = INNER.head(start, found.obs)
        log_std = jnp.broadcast_to(head.log_std, head.mean.shape)
        return INNER(start, found._replace(head=Head(head.mean, log_std)))

    def acts_on(memory, wanted):
        for moved, x, y in zip(*map(jax.tree.leaves, (memory.acting, params, wanted)), strict=True):
            np.testing.assert_allclose(moved[0] + x, y, rtol=1e-4, atol=1e-5)

    wanted = params
    for _ in range(2):
        for episode in range(EPISODES):
            memory = agent.begin_episode(saved, memory, memory, NO_KEYS, learns)
            acts_on(memory, wanted)  # what is learned from is acted on the last whole step
            half = STEPS // 2
            for part in (slice(0, half), slice(half, STEPS)):
                cut = jax.tree.map(lambda x, p=part: x[:, p], shown(found, episode))
                memory = agent.observe(saved, memory, cut, jnp.ones((1, cut.reward.shape[1])))
        wanted = taken(wanted)
        acts_on(agent.begin_episode(saved, memory, memory, NO_KEYS, counts), wanted)
    blank = agent.init(Told(jnp.zeros((1, 1)), jnp.ones(1), jnp.zeros(1, jnp.int32)))
    acts_on(agent.begin_episode(saved, memory, blank, NO_KEYS, counts), params)


def test_an_episode_that_ends_early_ends_there(agent, params):
    saved, found = PolicyParams(params, init_obs_stats(OBS)), episodes(6)
    memory = agent.init(Told(jnp.zeros((1, 1)), jnp.ones(1), jnp.zeros(1, jnp.int32)))
    memory = agent.begin_episode(saved, memory, memory, NO_KEYS, np.bool_(False))
    mask = (jnp.arange(STEPS) < 3)[None].astype(jnp.float32)
    memory = agent.observe(saved, memory, shown(found, 0), mask)
    assert memory.steps[0].tolist() == [3, 0]
    wanted = np.append(found.reward[0, :3], [0, 0])
    np.testing.assert_allclose(memory.reward[0, 0], wanted, rtol=1e-6)
    longer = jax.tree.map(lambda x: jnp.tile(x, (1, 2) + (1,) * (x.ndim - 2)), shown(found, 1))
    after = agent.observe(saved, memory, longer, jnp.ones((1, 2 * STEPS)))
    assert np.isfinite(after.reward).all()  # an episode longer than those of the run
