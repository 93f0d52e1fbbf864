"""Policies by gradient: a Gaussian over u, and tanh(u) as the action.

tanh keeps actions in [-1, 1] and can be undone, so what an agent is shown of its own past is
enough for its densities. Its Jacobian does not depend on the parameters: it cancels in every ratio
and gradient, and densities are those of u throughout.
"""

from __future__ import annotations

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

LARGEST = 1.0 - 1e-6  # of |action|: where tanh is undone


class Head(NamedTuple):
    """A Gaussian over u: `mean` (..., act), `log_std` of the same shape or (act,)."""

    mean: jax.Array
    log_std: jax.Array


def pre_tanh(action: jax.Array) -> jax.Array:
    """The u of an action in [-1, 1]."""
    return jnp.arctanh(jnp.clip(action, -LARGEST, LARGEST))


def action_of(head: Head, noise: jax.Array, is_quiet: jax.Array) -> jax.Array:
    """Actions (lane, act) of a Head and normal noise, left out where `is_quiet` (lane, 1)."""
    return jnp.tanh(head.mean + jnp.where(is_quiet, 0.0, jnp.exp(head.log_std)) * noise)


def log_prob(head: Head, u: jax.Array) -> jax.Array:
    """Log density (...) of u (..., act)."""
    z = (u - head.mean) * jnp.exp(-head.log_std)
    return jnp.sum(-0.5 * (jnp.square(z) + jnp.log(2.0 * jnp.pi)) - head.log_std, -1)


def entropy(head: Head) -> jax.Array:
    """Entropy of u in nats."""
    return jnp.sum(head.log_std + 0.5 * (1.0 + jnp.log(2.0 * jnp.pi)), -1)


def kl(old: Head, new: Head) -> jax.Array:
    """KL(old || new) in nats, (...)."""
    variance = jnp.exp(2.0 * (old.log_std - new.log_std))
    distance = jnp.square((old.mean - new.mean) * jnp.exp(-new.log_std))
    return jnp.sum(new.log_std - old.log_std + 0.5 * (variance + distance - 1.0), -1)


class MlpPolicy(nn.Module):
    """tanh MLP for the mean, a parameter for the log standard deviation."""

    hidden: tuple[int, ...]
    action_size: int
    std_init: float

    @nn.compact
    def __call__(self, obs: jax.Array) -> Head:
        """(..., obs) -> Head of (..., act)."""
        y = obs
        for width in self.hidden:
            y = nn.tanh(nn.Dense(width)(y))
        mean = nn.Dense(self.action_size, kernel_init=small())(y)
        init = nn.initializers.constant(jnp.log(self.std_init))
        return Head(mean, self.param("log_std", init, (self.action_size,)))


def small() -> nn.initializers.Initializer:
    """Kernels of a policy's last layer: the first actions are noise alone."""
    return nn.initializers.variance_scaling(1e-4, "fan_in", "truncated_normal")
