"""Context inference: order, empty context, text, streaming belief, length of the context."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmrl_jax.config.schema import Config, EncoderConfig
from cmrl_jax.nn.context import (
    context_mask,
    init_belief,
    make_context_inference,
)
from cmrl_jax.nn.distributions import Gaussian
from cmrl_jax.nn.networks import make_networks

TASKS, CONTEXT, OBS, ACT, GOAL, LATENT = 2, 6, 3, 2, 5, 4


class Context(NamedTuple):
    obs: jax.Array
    action: jax.Array
    reward: jax.Array
    next_obs: jax.Array


def standard(lead, latent_dim):
    """N(0, I)."""
    return Gaussian(jnp.zeros((*lead, latent_dim)), jnp.ones((*lead, latent_dim)))


def make(**encoder):
    sizes = {"hidden": (8,), "latent_dim": LATENT, "goal_width": 3, "n_eff": 4, "context_max": 64}
    cfg = replace(Config(), encoder=EncoderConfig(**(sizes | encoder)))
    networks = make_networks(cfg, OBS, ACT, GOAL, TASKS)
    inference = make_context_inference(cfg, networks)
    assert networks.init_encoder is not None
    params = networks.init_encoder(jax.random.key(0))
    rng = np.random.default_rng(0)  # the small initial head would hide every dependence
    params = jax.tree.map(
        lambda x: jnp.asarray(rng.normal(scale=0.5, size=x.shape), jnp.float32), params
    )
    posterior = jax.jit(inference.posterior)
    return inference, params, posterior


def some_context(seed=0, n=CONTEXT):
    rng = np.random.default_rng(seed)
    shapes = (OBS,), (ACT,), (), (OBS,)
    draw = [rng.normal(size=(TASKS, n, *s)).astype(np.float32) for s in shapes]
    return Context(*(jnp.asarray(x) for x in draw))


GOALS = jnp.asarray(np.random.default_rng(7).normal(size=(TASKS, GOAL)), jnp.float32)
MASK = jnp.array([[1, 1, 1, 1, 1, 1], [1, 1, 1, 0, 0, 0]], jnp.float32)
KNOWN = jnp.ones((TASKS,))


@pytest.fixture(scope="module")
def both():
    return make(goal_fusion="both")


def test_posterior_ignores_order_and_masked_transitions_but_not_content(both):
    _, params, posterior = both
    context = some_context()
    base = posterior(params, context, MASK, GOALS, KNOWN)
    order = jnp.array([2, 0, 1, 5, 3, 4])  # keeps the valid half of task 1 in front
    shuffled = posterior(params, Context(*(x[:, order] for x in context)), MASK, GOALS, KNOWN)
    np.testing.assert_allclose(base.mean, shuffled.mean, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(base.variance, shuffled.variance, rtol=1e-4)

    changed = context._replace(reward=context.reward.at[1, 4].add(5.0))
    masked = posterior(params, changed, MASK, GOALS, KNOWN)
    np.testing.assert_array_equal(base.mean, masked.mean)
    changed = context._replace(reward=context.reward.at[1, 1].add(5.0))
    moved = posterior(params, changed, MASK, GOALS, KNOWN)
    assert np.all(moved.mean[1] != base.mean[1])
    np.testing.assert_array_equal(moved.mean[0], base.mean[0])


def test_posterior_is_the_product_of_the_factors_of_the_scaled_transitions():
    """By hand from the factor network: order of the input parts, reward scale, plain product."""
    inference, params, posterior = make(goal_fusion="none", poe="pearl", context_reward_scale=0.25)
    context = some_context()
    got = posterior(params, context, MASK)
    del inference
    p = jax.tree.map(np.asarray, params["params"]["transition_net"])
    for i, count in enumerate((6, 3)):
        precision = total = 0.0
        for n in range(count):
            c = np.concatenate(
                [
                    context.obs[i, n],
                    context.action[i, n],
                    [0.25 * context.reward[i, n]],
                    context.next_obs[i, n],
                ]
            )
            y = c @ p["Linear_0"]["kernel"] + p["Linear_0"]["bias"]
            y = (y - y.mean()) / np.sqrt(y.var() + 1e-6)
            y = np.maximum(y * p["LayerNorm_0"]["scale"] + p["LayerNorm_0"]["bias"], 0)
            y = y @ p["Linear_1"]["kernel"] + p["Linear_1"]["bias"]
            variance = np.maximum(np.log1p(np.exp(y[LATENT:])), 1e-7)
            precision = precision + 1.0 / variance
            total = total + y[:LATENT] / variance
        np.testing.assert_allclose(got.mean[i], total / precision, rtol=2e-3, atol=1e-5)
        np.testing.assert_allclose(got.variance[i], 1.0 / precision, rtol=2e-3)


@pytest.mark.parametrize(
    ("fusion", "depends"), [("none", False), ("concat", False), ("factor", True), ("both", True)]
)
def test_empty_context_depends_on_the_goal_iff_there_is_a_goal_factor(fusion, depends):
    inference, params, posterior = make(goal_fusion=fusion)
    assert inference.has_goal_factor == depends
    empty = jnp.zeros((TASKS, CONTEXT))
    first, second = (posterior(params, some_context(), empty, g, KNOWN) for g in (GOALS, -GOALS))
    assert (not np.allclose(first.mean, second.mean)) == depends
    if not depends:
        assert np.all(first.mean == 0.0) and np.all(first.variance == 1.0)
    full, other = (posterior(params, some_context(), MASK, g, KNOWN) for g in (GOALS, -GOALS))
    assert np.allclose(full.mean, other.mean) == (fusion == "none")


@pytest.mark.parametrize("poe", ["pearl", "prior_tempered"])
def test_nothing_known_is_exactly_the_prior_with_finite_gradients(poe):
    inference, params, _ = make(goal_fusion="both", poe=poe)

    @jax.jit
    @jax.value_and_grad
    def loss(p):
        empty = jnp.zeros((TASKS, CONTEXT))
        posterior = inference.posterior(p, some_context(), empty, GOALS, jnp.zeros((TASKS,)))
        noise = jnp.ones((TASKS, LATENT))
        return jnp.sum(inference.z_of_noise(posterior, noise) ** 2 + jnp.log(posterior.variance))

    value, grads = loss(params)
    assert float(value) == TASKS * LATENT
    assert all(np.all(np.isfinite(g)) and np.all(g == 0.0) for g in jax.tree.leaves(grads))


def test_hidden_goal_leaves_no_trace(both):
    _, params, posterior = both
    hidden = jnp.zeros((TASKS,))
    first, second = (posterior(params, some_context(), MASK, g, hidden) for g in (GOALS, -GOALS))
    np.testing.assert_array_equal(first.mean, second.mean)


@pytest.mark.parametrize(
    "options",
    [{"poe": "pearl"}, {"poe": "prior_tempered"}, {"information_bottleneck": False}],
    ids=str,
)
def test_streaming_belief_equals_the_batch_posterior(options):
    """Transition by transition, then a block; tempering starts at n_eff = 4 in between."""
    inference, params, posterior = make(goal_fusion="both", **options)
    context, update = some_context(), jax.jit(inference.update_belief)
    belief = init_belief((TASKS,), LATENT)
    for t in range(2):
        one = Context(*(x[:, t : t + 1] for x in context))
        belief = update(params, belief, one, MASK[:, t : t + 1], GOALS, KNOWN)
    rest = Context(*(x[:, 2:] for x in context))
    belief = update(params, belief, rest, MASK[:, 2:], GOALS, KNOWN)
    np.testing.assert_array_equal(belief.sums.count, [6, 3])
    got = inference.posterior_of_belief(params, belief, GOALS, KNOWN)
    expected = posterior(params, context, MASK, GOALS, KNOWN)
    np.testing.assert_allclose(got.mean, expected.mean, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(got.variance, expected.variance, rtol=1e-4)


def test_without_bottleneck_z_is_the_mean_of_the_factor_means():
    inference, params, posterior = make(goal_fusion="none", information_bottleneck=False)
    context = some_context()
    z = inference.sample_z(jax.random.key(0), posterior(params, context, MASK))
    single = [
        posterior(params, Context(*(x[:, t : t + 1] for x in context)), MASK[:, t : t + 1]).mean
        for t in range(CONTEXT)
    ]
    np.testing.assert_allclose(z[0], np.mean([s[0] for s in single], 0), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(z[1], np.mean([s[1] for s in single[:3]], 0), rtol=1e-4, atol=1e-6)


def test_prior_and_sample():
    inference, _, _ = make(goal_fusion="none")
    z = inference.sample_z(jax.random.key(0), standard((20_000,), LATENT))
    np.testing.assert_allclose(np.mean(z, 0), 0.0, atol=0.03)
    np.testing.assert_allclose(np.std(z, 0), 1.0, atol=0.03)


def test_context_length_is_log_uniform_and_empty_only_with_a_goal_factor():
    encoder = EncoderConfig(context_max=64, p_empty=0.15, goal_fusion="both")
    u = jax.random.uniform(jax.random.key(0), (2, 50_000))
    mask = context_mask(u[0], u[1], encoder)
    assert mask.shape == (50_000, 64) and np.all(np.diff(mask, axis=-1) <= 0)
    length = np.sum(mask, axis=-1)
    np.testing.assert_allclose(np.mean(length == 0), 0.15, atol=0.01)
    for n in (1, 2, 16, 64):
        expected = 0.85 * np.log((n + 1) / n) / np.log(65)
        np.testing.assert_allclose(np.mean(length == n), expected, atol=0.01)
    alone = context_mask(u[0], u[1], replace(encoder, goal_fusion="concat"))
    assert np.min(np.sum(alone, -1)) == 1 and np.max(np.sum(alone, -1)) == 64
    edges = context_mask(jnp.array([0.0, 1 - 2**-24]), jnp.ones(2), encoder)
    np.testing.assert_array_equal(np.sum(edges, -1), [1, 64])
    fixed = context_mask(u[0], u[1], replace(encoder, context_len="fixed", goal_fusion="none"))
    assert np.all(fixed == 1.0)
