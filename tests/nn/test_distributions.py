"""Product of Gaussians, KL and tanh-Gaussian against plain numpy and numeric integration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmrl_jax.nn.distributions import (
    Gaussian,
    kl_to_standard_normal,
    natural_sums,
    product_of_gaussians,
    sample_tanh_gaussian,
)

N_EFF = 3


def product_by_loop(means, variances, mask, goal, goal_mask, form):
    """One dim of one task, factor by factor in float64."""
    n = int(sum(mask))
    weight = min(1.0, N_EFF / max(n, 1)) if form == "prior_tempered" else 1.0
    precision = 1.0 if form == "prior_tempered" else 0.0
    total = 0.0
    for mean, variance, valid in zip(means, variances, mask, strict=True):
        if valid:
            precision += weight / variance
            total += weight * mean / variance
    if goal_mask:
        precision += 1.0 / goal[1]
        total += goal[0] / goal[1]
    return (total / precision, 1.0 / precision) if precision > 0 else (0.0, 1.0)


@pytest.mark.parametrize("form", ["pearl", "prior_tempered"])
def test_product_matches_a_loop_over_factors(form):
    rng = np.random.default_rng(0)
    tasks, context, latent = 4, 5, 2
    mean = rng.normal(size=(tasks, context, latent)).astype(np.float32)
    variance = rng.uniform(0.1, 2.0, size=mean.shape).astype(np.float32)
    mask = np.array([[1, 1, 1, 1, 1], [1, 0, 1, 0, 0], [0] * 5, [0] * 5], np.float32)
    goal_mean = rng.normal(size=(tasks, latent)).astype(np.float32)
    goal_variance = rng.uniform(0.1, 2.0, size=goal_mean.shape).astype(np.float32)
    goal_mask = np.array([1, 0, 1, 0], np.float32)
    got = product_of_gaussians(
        natural_sums(Gaussian(jnp.asarray(mean), jnp.asarray(variance)), jnp.asarray(mask)),
        Gaussian(jnp.asarray(goal_mean), jnp.asarray(goal_variance)),
        jnp.asarray(goal_mask),
        form,
        N_EFF,
    )
    for i in range(tasks):
        for d in range(latent):
            goal = (goal_mean[i, d], goal_variance[i, d])
            expected = product_by_loop(
                mean[i, :, d], variance[i, :, d], mask[i], goal, goal_mask[i], form
            )
            found = (got.mean[i, d], got.variance[i, d])
            np.testing.assert_allclose(found, expected, rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize("form", ["pearl", "prior_tempered"])
def test_empty_product_is_exactly_the_prior_with_finite_gradients(form):
    def total(raw):
        factors = Gaussian(raw, jnp.exp(raw))
        goal = Gaussian(raw[:, 0], jnp.exp(raw[:, 0]))
        sums = natural_sums(factors, jnp.zeros((2, 3)))
        posterior = product_of_gaussians(sums, goal, jnp.zeros((2,)), form, N_EFF)
        return jnp.sum(posterior.mean + jnp.sqrt(posterior.variance)), posterior

    raw = jnp.array(np.random.default_rng(1).normal(size=(2, 3, 2)), jnp.float32)
    grads, posterior = jax.grad(total, has_aux=True)(raw)
    assert np.all(posterior.mean == 0.0) and np.all(posterior.variance == 1.0)
    assert np.all(np.isfinite(grads)) and np.all(grads == 0.0)


def test_kl_matches_numeric_integration():
    for mean, variance in [(0.0, 1.0), (0.7, 0.3), (-2.0, 1.8)]:
        x = np.linspace(-15, 15, 200_001)
        density = np.exp(-0.5 * (x - mean) ** 2 / variance) / np.sqrt(2 * np.pi * variance)
        ratio = -0.5 * (x - mean) ** 2 / variance - 0.5 * np.log(variance) + 0.5 * x**2
        expected = np.sum(density * ratio) * (x[1] - x[0])
        got = kl_to_standard_normal(Gaussian(jnp.array([mean]), jnp.array([variance])))
        np.testing.assert_allclose(got, [expected], atol=1e-5)


def test_tanh_log_prob_is_the_density_of_the_action():
    """Change of variables in float64, and a total mass of 1 over the action's interval."""
    mean, log_std = np.array([0.3, -1.0]), np.array([-0.5, 0.2])
    noise = np.random.default_rng(2).normal(size=(64, 2))
    action, log_prob = sample_tanh_gaussian(*(jnp.asarray(x) for x in (mean, log_std, noise)))
    u = mean + np.exp(log_std) * noise
    normal = -0.5 * noise**2 - log_std - 0.5 * np.log(2 * np.pi)
    expected = np.sum(normal - np.log(1 - np.tanh(u) ** 2), axis=-1)
    np.testing.assert_allclose(action, np.tanh(u), atol=1e-6)
    np.testing.assert_allclose(log_prob, expected, rtol=1e-3, atol=1e-4)

    grid = jnp.linspace(-6, 6, 20_001)[:, None]
    action, log_prob = sample_tanh_gaussian(jnp.array([0.3]), jnp.array([-0.5]), grid)
    mass = np.trapezoid(np.exp(np.asarray(log_prob)), np.asarray(action[:, 0]))
    np.testing.assert_allclose(mass, 1.0, atol=1e-3)


def test_tanh_log_prob_stays_exact_at_the_smallest_std():
    """(u - mean) / std would be 0 / 0 in float32 here; the noise is known exactly."""
    noise = jnp.array([[1.5]])
    _, log_prob = sample_tanh_gaussian(jnp.array([[0.4]]), jnp.array([[-20.0]]), noise)
    expected = -0.5 * 1.5**2 + 20.0 - 0.5 * np.log(2 * np.pi) - np.log(1 - np.tanh(0.4) ** 2)
    np.testing.assert_allclose(log_prob, [expected], rtol=1e-6)
