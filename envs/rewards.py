"""The shapes that Meta-World's rewards are made of, in jnp.

Source: dm_control's `tolerance` and Farama-Foundation/Metaworld
`metaworld/utils/reward_utils.py` (MIT).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

_LONG_TAIL_SCALE = 3.0  # sqrt(1 / 0.1 - 1): the value at the margin is 0.1
_GAUSSIAN_SCALE = 2.145966026289347  # sqrt(-2 ln 0.1)


def long_tail(distance: jax.Array, bound: float, margin: jax.Array | float) -> jax.Array:
    """dm_control's `tolerance` on (0, bound) with the long-tail sigmoid."""
    d = jnp.maximum(distance - bound, 0.0) / margin
    return 1.0 / (jnp.square(d * _LONG_TAIL_SCALE) + 1.0)


def gaussian(distance: jax.Array, bound: float, margin: jax.Array | float) -> jax.Array:
    """dm_control's `tolerance` on (0, bound) with the Gaussian sigmoid."""
    d = jnp.maximum(distance - bound, 0.0) / margin
    return jnp.exp(-0.5 * jnp.square(d * _GAUSSIAN_SCALE))


def hamacher_product(a: jax.Array, b: jax.Array) -> jax.Array:
    """a b / (a + b - a b), and 0 at a = b = 0."""
    denominator = a + b - a * b
    return jnp.where(denominator > 0, a * b / jnp.where(denominator > 0, denominator, 1.0), 0.0)


def norm(vector: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(jnp.square(vector)))
