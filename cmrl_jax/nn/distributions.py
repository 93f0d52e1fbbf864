"""The two distributions of the method: a tanh-Gaussian policy and a product of diagonal Gaussians.

The product is written over three running sums (`natural_sums`), so that a whole batch of context
and a belief that grows by one transition a step go through the same finalisation.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

LOG_STD_MIN = -20.0
LOG_STD_MAX = 2.0

ProductForm = Literal["pearl", "prior_tempered"]


class NaturalSums(NamedTuple):
    """Sums over factors of a product of Gaussians; the leading dims are tasks or lanes.

    Attributes:
        precision: sum of 1 / variance, (..., latent).
        weighted_mean: sum of mean / variance, (..., latent).
        count: number of factors, (...).
    """

    precision: jax.Array
    weighted_mean: jax.Array
    count: jax.Array


class Gaussian(NamedTuple):
    """Diagonal Gaussians: `mean` and `variance`, both (..., latent)."""

    mean: jax.Array
    variance: jax.Array


def sample_tanh_gaussian(
    mean: jax.Array, log_std: jax.Array, noise: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Reparameterised action tanh(u), u = mean + exp(log_std) noise, and its log density.

    The density is written in the noise: (u - mean) / std would cancel at a small std.

    Args:
        mean, log_std: (..., act), log_std already clipped to [LOG_STD_MIN, LOG_STD_MAX].
        noise: standard normal, (..., act).

    Returns:
        The action (..., act) in (-1, 1) and log pi(action), (...).
    """
    pre_tanh = mean + jnp.exp(log_std) * noise
    normal = -0.5 * (jnp.square(noise) + jnp.log(2.0 * jnp.pi)) - log_std
    log_det = 2.0 * (jnp.log(2.0) - pre_tanh - jax.nn.softplus(-2.0 * pre_tanh))
    return jnp.tanh(pre_tanh), jnp.sum(normal - log_det, axis=-1)


def natural_sums(factors: Gaussian, mask: jax.Array) -> NaturalSums:
    """Sums over the second last axis of the factors that the mask keeps.

    Args:
        factors: mean and variance (..., context, latent); variances must be positive everywhere.
        mask: 1 for a valid factor, else 0, (..., context).
    """
    precision = mask[..., None] / factors.variance
    return NaturalSums(
        precision=jnp.sum(precision, axis=-2),
        weighted_mean=jnp.sum(precision * factors.mean, axis=-2),
        count=jnp.sum(mask, axis=-1),
    )


def product_of_gaussians(
    sums: NaturalSums,
    goal: Gaussian | None,
    goal_mask: jax.Array | None,
    form: ProductForm,
    n_eff: int,
) -> Gaussian:
    """The posterior from the transitions' sums and, where its mask is 1, the goal's factor.

    `pearl` multiplies the factors alone (katerakelly/oyster: rlkit/torch/sac/agent.py) and needs
    the empty product to be defined: it is exactly N(0, I). `prior_tempered` multiplies N(0, I) in
    and tempers the transitions once there are more than `n_eff`: precision adds linearly, so a
    posterior from a test episode would else be far tighter than any seen in training.

    Args:
        sums: of the transitions, leading dims (...).
        goal: the goal's factor (..., latent), or None.
        goal_mask: 1 where the goal is known, else 0, (...); used only with `goal`.
        form, n_eff: `encoder.poe` and `encoder.n_eff`.

    Returns:
        Posterior mean and variance, (..., latent).
    """
    precision, weighted_mean, count = sums
    if form == "prior_tempered":
        tempering = jnp.minimum(1.0, n_eff / jnp.maximum(count, 1.0))[..., None]
        precision = 1.0 + tempering * precision
        weighted_mean = tempering * weighted_mean
    if goal is not None and goal_mask is not None:
        goal_precision = goal_mask[..., None] / goal.variance
        precision = precision + goal_precision
        weighted_mean = weighted_mean + goal_precision * goal.mean
        count = count + goal_mask
    if form == "prior_tempered":
        return Gaussian(weighted_mean / precision, 1.0 / precision)
    empty = jnp.broadcast_to(count[..., None] == 0, precision.shape)
    safe_precision = jnp.where(empty, 1.0, precision)  # before the division: finite gradients
    return Gaussian(
        mean=jnp.where(empty, 0.0, weighted_mean / safe_precision),
        variance=jnp.where(empty, 1.0, 1.0 / safe_precision),
    )


def kl_to_standard_normal(posterior: Gaussian) -> jax.Array:
    """KL(N(mean, variance) || N(0, 1)) in nats for each leading index and dim, (..., latent)."""
    mean, variance = posterior
    return 0.5 * (jnp.square(mean) + variance - 1.0 - jnp.log(variance))
