"""The linear baseline of a group's episodes, fitted to their own returns each time.

Features and ridge fit after Duan et al. 2016 (Benchmarking Deep RL, appendix): an observation, its
square, and time to the third power. Nothing is learned across tasks, so what it is at test time is
what it was in training.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

RIDGE = 1e-3  # of a feature's mean square


def returns_to_go(reward: jax.Array, mask: jax.Array, gamma: float) -> jax.Array:
    """Discounted returns of each step on (episode, time)."""

    def step(following: jax.Array, inputs: tuple[jax.Array, jax.Array]):
        reward, counts = inputs
        total = jnp.where(counts, reward + gamma * following, following)
        return total, total

    start = jnp.zeros(reward.shape[0])
    return jax.lax.scan(step, start, (reward.T, mask.T), reverse=True)[1].T


def features(obs: jax.Array) -> jax.Array:
    """(episode, time, obs) -> (episode, time, 2 obs + 4)."""
    episodes, steps = obs.shape[:2]
    time = jnp.broadcast_to(jnp.arange(steps)[None, :, None] / steps, (episodes, steps, 1))
    return jnp.concatenate([obs, jnp.square(obs), time, time**2, time**3, jnp.ones_like(time)], -1)


def baseline(obs: jax.Array, returns: jax.Array, mask: jax.Array) -> jax.Array:
    """The fit's value of every step (episode, time), by the unmasked ones.

    Args:
        obs: normalised (episode, time, obs).
    """
    x = features(obs)
    weight = mask.astype(jnp.float32)
    count = jnp.maximum(jnp.sum(weight), 1.0)
    gram = jnp.einsum("eti,et,etj->ij", x, weight, x) / count
    moment = jnp.einsum("eti,et,et->i", x, weight, returns) / count
    coefficients = jnp.linalg.solve(gram + RIDGE * jnp.eye(len(gram)), moment)
    return x @ coefficients
