"""Context inference q(z | transitions, goal): the same code for the learner and for rollouts.

The learner sees (task, context) batches, a rollout (lane, time); all functions take any leading
dims. A `Belief` holds the three running sums of the product of Gaussians, so that one more
transition costs the same at step 5000 as at step 1. Observations arrive normalised.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from cmrl_jax.config.schema import Config, EncoderConfig
from cmrl_jax.nn.distributions import Gaussian, NaturalSums, natural_sums, product_of_gaussians
from cmrl_jax.nn.networks import Networks


class Transitions(Protocol):
    """What context inference reads: obs, next_obs (..., context, obs), action, reward (...)."""

    @property
    def obs(self) -> jax.Array: ...
    @property
    def action(self) -> jax.Array: ...
    @property
    def reward(self) -> jax.Array: ...
    @property
    def next_obs(self) -> jax.Array: ...


@struct.dataclass
class Belief:
    """What a lane has seen so far; the goal's factor is added only on `posterior_of_belief`.

    Attributes:
        sums: running sums over transitions, leading dims (lane, ...).
    """

    sums: NaturalSums


def init_belief(lead: tuple[int, ...], latent_dim: int) -> Belief:
    """An empty belief for the leading dims `lead`, e.g. (lanes,)."""
    zeros = jnp.zeros((*lead, latent_dim), jnp.float32)
    return Belief(NaturalSums(zeros, zeros, jnp.zeros(lead, jnp.float32)))


@dataclass(frozen=True)
class ContextInference:
    """Pure functions of one configuration; `goal` (..., G) and `goal_mask` (...) may be None
    with `goal_fusion: none`.

    Attributes:
        latent_dim: size of z.
        has_goal_factor: whether q(z | empty, goal) differs from the prior.
        posterior: (encoder_params, transitions (..., context, .), mask (..., context), goal,
            goal_mask) -> Gaussian (..., latent).
        update_belief: (encoder_params, belief, transitions (..., time, .), mask (..., time), goal,
            goal_mask) -> Belief with those transitions added.
        posterior_of_belief: (encoder_params, belief, goal, goal_mask) -> Gaussian (..., latent).
        z_of_noise: (Gaussian, standard normal (..., latent)) -> z (..., latent), reparameterised;
            the mean without information bottleneck.
        sample_z: (key, Gaussian) -> z (..., latent), the same with its own noise.
    """

    latent_dim: int
    has_goal_factor: bool
    posterior: Callable[..., Gaussian]
    update_belief: Callable[..., Belief]
    posterior_of_belief: Callable[..., Gaussian]
    z_of_noise: Callable[[Gaussian, jax.Array], jax.Array]
    sample_z: Callable[[jax.Array, Gaussian], jax.Array]


def make_context_inference(cfg: Config, networks: Networks) -> ContextInference:
    """Context inference with `encoder` options.

    Without information bottleneck every factor has variance 1 and the product is `pearl`'s: its
    mean is then the plain mean of the factors' means.

    Raises:
        ValueError: the configuration has no encoder (`model.conditioning` is not z).
    """
    encoder = cfg.encoder
    factors_of, goal_factor_of = networks.transition_factors, networks.goal_factor
    if factors_of is None:
        raise ValueError(f"conditioning '{cfg.model.conditioning}' has no context encoder")
    form = encoder.poe if encoder.information_bottleneck else "pearl"

    def as_factor(factor: Gaussian) -> Gaussian:
        if encoder.information_bottleneck:
            return factor
        return Gaussian(factor.mean, jnp.ones_like(factor.variance))

    def sums_of(
        encoder_params: Any,
        transitions: Transitions,
        mask: jax.Array,
        goal: jax.Array | None,
        goal_mask: jax.Array | None,
    ) -> NaturalSums:
        reward = transitions.reward[..., None] * encoder.context_reward_scale
        parts = [transitions.obs, transitions.action, reward]
        if encoder.use_next_obs:
            parts.append(transitions.next_obs)
        features = jnp.concatenate(parts, axis=-1)  # (..., context, feature)
        factors = factors_of(encoder_params, features, goal, goal_mask)
        return natural_sums(as_factor(factors), mask.astype(jnp.float32))

    def finalise(
        encoder_params: Any, sums: NaturalSums, goal: jax.Array | None, goal_mask: jax.Array | None
    ) -> Gaussian:
        factor = None
        if goal_factor_of is not None and goal is not None:
            factor = as_factor(goal_factor_of(encoder_params, goal))
        return product_of_gaussians(sums, factor, goal_mask, form, encoder.n_eff)

    def posterior(encoder_params, transitions, mask, goal=None, goal_mask=None) -> Gaussian:
        sums = sums_of(encoder_params, transitions, mask, goal, goal_mask)
        return finalise(encoder_params, sums, goal, goal_mask)

    def update_belief(
        encoder_params, belief, transitions, mask, goal=None, goal_mask=None
    ) -> Belief:
        new = sums_of(encoder_params, transitions, mask, goal, goal_mask)
        return Belief(jax.tree.map(jnp.add, belief.sums, new))

    def posterior_of_belief(encoder_params, belief, goal=None, goal_mask=None) -> Gaussian:
        return finalise(encoder_params, belief.sums, goal, goal_mask)

    def z_of_noise(gaussian: Gaussian, noise: jax.Array) -> jax.Array:
        mean, variance = gaussian
        return mean + jnp.sqrt(variance) * noise if encoder.information_bottleneck else mean

    def sample_z(key: jax.Array, gaussian: Gaussian) -> jax.Array:
        return z_of_noise(gaussian, jax.random.normal(key, gaussian.mean.shape))

    return ContextInference(
        latent_dim=encoder.latent_dim,
        has_goal_factor=goal_factor_of is not None,
        posterior=posterior,
        update_belief=update_belief,
        posterior_of_belief=posterior_of_belief,
        z_of_noise=z_of_noise,
        sample_z=sample_z,
    )


def context_mask(u_length: jax.Array, u_empty: jax.Array, encoder: EncoderConfig) -> jax.Array:
    """Which of the N_max context transitions of every task row an update uses.

    N is log-uniform on 1..N_max (or N_max), and 0 with probability `p_empty` where there is a
    goal factor to train on an empty context.

    Args:
        u_length, u_empty: uniform on [0, 1), (task,).

    Returns:
        (task, context) of 0 and 1, the ones first.
    """
    n_max = encoder.context_max
    length = jnp.full(u_length.shape, n_max)
    if encoder.context_len == "random":
        length = jnp.floor(jnp.exp(u_length * math.log(n_max + 1))).astype(jnp.int32)
        length = jnp.clip(length, 1, n_max)  # rounding of exp at both ends
    if encoder.goal_fusion in ("factor", "both"):
        length = jnp.where(u_empty < encoder.p_empty, 0, length)
    return (jnp.arange(n_max) < length[..., None]).astype(jnp.float32)
