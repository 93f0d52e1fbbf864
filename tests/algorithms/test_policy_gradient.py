"""What policy-gradient methods share, against plain loops and by hand."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cmrl_jax.algorithms.common.policy_gradient import (
    clipped_surrogate,
    gae,
    gradient_step,
    make_optimizer,
    masked_mean,
    normalized,
)
from cmrl_jax.config.schema import PpoConfig
from cmrl_jax.nn.gaussian_policy import Head, entropy, kl, log_prob, pre_tanh

GAMMA, LAMBDA = 0.9, 0.7


def test_advantages_are_the_sum_of_discounted_errors():
    """Of the steps that count, whatever stands between them; each lane by itself."""
    generator = np.random.default_rng(0)
    time, lanes = 9, 3
    reward, value = generator.normal(size=(2, time, lanes))
    last_value = generator.normal(size=lanes)
    mask = generator.random((time, lanes)) < 0.7
    arrays: Any = map(jnp.asarray, (reward, value, last_value, mask))
    found = gae(*arrays, gamma=GAMMA, gae_lambda=LAMBDA)
    wanted = np.zeros((time, lanes))
    for lane in range(lanes):
        steps = np.flatnonzero(mask[:, lane])
        values = [*value[steps, lane], last_value[lane]]
        errors = [reward[t, lane] + GAMMA * values[i + 1] - values[i] for i, t in enumerate(steps)]
        for i, t in enumerate(steps):
            powers = (GAMMA * LAMBDA) ** np.arange(len(errors) - i)
            wanted[t, lane] = np.dot(powers, errors[i:])
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-6)


def test_with_lambda_one_an_advantage_is_the_return_less_the_value():
    reward, value = jnp.array([[1.0], [2.0], [4.0]]), jnp.array([[0.5], [0.25], [0.125]])
    found = gae(reward, value, jnp.zeros(1), jnp.ones((3, 1), bool), 0.5, 1.0)
    np.testing.assert_allclose(found[:, 0], [3.0 - 0.5, 4.0 - 0.25, 4.0 - 0.125])


def test_normalising_leaves_out_what_is_masked():
    advantage = jnp.array([[1.0, 3.0, 100.0], [10.0, 30.0, 20.0]])
    mask = jnp.array([[True, True, False], [True, True, True]])
    found = normalized(advantage, mask, (1,))
    np.testing.assert_allclose(found[0], [-1.0, 1.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(np.std(found[1]), 1.0, atol=1e-5)
    assert masked_mean(advantage, mask) == (1 + 3 + 10 + 30 + 20) / 5


def test_a_ratio_beyond_the_clip_has_no_gradient_where_it_would_gain():
    """Schulman et al. 2017, figure 1: flat above 1 + e for a gain, below 1 - e for a loss."""

    def slope(ratio, advantage):
        surrogate = lambda x: clipped_surrogate(x, jnp.zeros(()), advantage, 0.2)
        return float(jax.grad(surrogate)(jnp.log(ratio)))

    assert slope(1.3, 1.0) == 0 and slope(0.7, -1.0) == 0
    np.testing.assert_allclose(slope(1.3, -1.0), -1.3, rtol=1e-6)
    np.testing.assert_allclose(slope(0.7, 1.0), 0.7, rtol=1e-6)
    np.testing.assert_allclose(slope(1.1, 2.0), 2.2, rtol=1e-6)


def test_a_gradient_that_is_not_finite_changes_nothing_and_is_counted():
    optimizer, params = make_optimizer(PpoConfig()), {"x": jnp.ones(2)}
    state = optimizer.init(params)
    good, bad = {"x": jnp.array([1.0, -1.0])}, {"x": jnp.array([1.0, jnp.nan])}
    same, after, figures = gradient_step(optimizer, bad, state, params)
    np.testing.assert_array_equal(same["x"], params["x"])
    assert figures["skipped"] == 1
    stepped, _, figures = gradient_step(optimizer, good, after, params)
    alone, _, _ = gradient_step(optimizer, good, state, params)
    np.testing.assert_array_equal(stepped["x"], alone["x"])
    assert figures["skipped"] == 0 and (stepped["x"] != params["x"]).all()


def test_densities_are_those_of_a_gaussian():
    head = Head(jnp.array([0.3, -0.2]), jnp.log(jnp.array([0.5, 2.0])))
    u = jax.random.normal(jax.random.key(0), (100_000, 2)) * jnp.exp(head.log_std) + head.mean
    density = log_prob(head, u)
    np.testing.assert_allclose(entropy(head), -jnp.mean(density), rtol=1e-2)
    other = Head(jnp.array([0.0, 0.5]), jnp.log(jnp.array([1.0, 1.5])))
    np.testing.assert_allclose(kl(head, other), jnp.mean(density - log_prob(other, u)), rtol=2e-2)
    np.testing.assert_allclose(pre_tanh(jnp.tanh(u[:100])), u[:100], rtol=1e-2, atol=1e-3)
    assert np.isfinite(pre_tanh(jnp.array([-1.0, 1.0]))).all()
