"""Meta-World's reward v2 of the four ML4 tasks, for one lane, in jnp.

Formulas: Farama-Foundation/Metaworld `metaworld/envs/sawyer_{drawer,window}_{open,close}_v3.py`
(MIT). Each function returns (reward in [0, 10], distance that decides success, is_success). The
distances are written in the slide position, where every target is a constant: in float32 a
difference of world coordinates would blur the thresholds.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

# drawer-open succeeds exactly at its joint limit: 0.19 - 0.16 <= 0.03 holds in float64 but not in
# float32, so its threshold carries this epsilon (metres).
DRAWER_OPEN_EPSILON = 1e-6
_LONG_TAIL_SCALE = 3.0  # sqrt(1 / 0.1 - 1): the value at the margin is 0.1
_GAUSSIAN_SCALE = 2.145966026289347  # sqrt(-2 ln 0.1)


class RewardInputs(NamedTuple):
    """What the rewards read, metres in the world."""

    hand: jax.Array  # (3,) clipped as in the observation
    tcp: jax.Array  # (3,) midpoint of the finger tips
    handle: jax.Array  # (3,) object position of the observation
    slide: jax.Array  # ()
    gripper_effort: jax.Array  # () last action component
    init_tcp: jax.Array  # (3,) tcp after the reset
    init_handle: jax.Array  # (3,) handle at the task's start slide


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


def _norm(vector: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(jnp.square(vector)))


def drawer_open(x: RewardInputs) -> tuple[jax.Array, jax.Array, jax.Array]:
    distance = jnp.abs(x.slide + 0.19)  # the target is 0.2 beyond the closed handle, less 0.01
    opening = long_tail(distance, 0.02, 0.2)
    # Errors across weigh three times the height, so that the hand may drop onto the handle.
    scale = jnp.array([3.0, 3.0, 1.0])
    # Meta-World's initial handle is the target plus 0.2 along y: 0.01 behind the closed handle.
    start = x.init_handle - jnp.array([0.0, -0.01, 0.0])
    margin = _norm((start - x.init_tcp) * scale)
    caging = long_tail(_norm((x.handle - x.hand) * scale), 0.01, margin)
    return 5.0 * (caging + opening), distance, distance <= 0.03 + DRAWER_OPEN_EPSILON


def drawer_close(x: RewardInputs) -> tuple[jax.Array, jax.Array, jax.Array]:
    # The handle point lies 0.05 above the target for ever: the distance never falls below that.
    distance = jnp.sqrt(jnp.square(x.slide - 0.01) + 0.05**2)
    initial = (0.16**2 + 0.05**2) ** 0.5
    in_place = long_tail(distance, 0.05, abs(initial - 0.05))
    reach = gaussian(
        _norm(x.handle - x.tcp), 0.005, jnp.abs(_norm(x.init_handle - x.init_tcp) - 0.005)
    )
    reach = hamacher_product(reach, jnp.clip(x.gripper_effort, 0.0, 1.0))
    is_success = distance <= 0.05 + 0.015
    return (
        jnp.where(is_success, 10.0, 10.0 * hamacher_product(reach, in_place)),
        distance,
        is_success,
    )


def window_open(x: RewardInputs) -> tuple[jax.Array, jax.Array, jax.Array]:
    distance = jnp.abs(x.slide - 0.24)
    in_place = long_tail(distance, 0.05, 0.15)
    margin = jnp.abs(_norm(x.init_handle - x.init_tcp) - 0.02)
    reach = long_tail(_norm(x.handle - x.tcp), 0.02, margin)
    return 10.0 * hamacher_product(reach, in_place), distance, distance <= 0.05


def window_close(x: RewardInputs) -> tuple[jax.Array, jax.Array, jax.Array]:
    distance = jnp.abs(x.slide + 0.01)
    in_place = long_tail(distance, 0.05, 0.16)
    margin = jnp.abs(_norm(x.init_handle - x.init_tcp) - 0.02)
    reach = gaussian(_norm(x.handle - x.tcp), 0.02, margin)
    return 10.0 * hamacher_product(reach, in_place), distance, distance <= 0.05


# In the order of `tasks.TASKS`.
REWARDS = (drawer_open, drawer_close, window_open, window_close)
