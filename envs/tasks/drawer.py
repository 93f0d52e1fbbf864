"""The drawer: pulling it open, pushing it shut.

Source of numbers and rewards: Farama-Foundation/Metaworld (MIT),
`metaworld/envs/sawyer_drawer_{open,close}_v3.py`, reward v2. Distances are written in the slide
position, where every target is a constant: in float32 a difference of world coordinates would blur
the thresholds.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from envs.rewards import gaussian, hamacher_product, long_tail, norm
from envs.tasks.base import RewardInputs, Task

# drawer-open succeeds exactly at its joint limit: 0.19 - 0.16 <= 0.03 holds in float64 but not in
# float32, so its threshold carries this epsilon (metres).
DRAWER_OPEN_EPSILON = 1e-6


def drawer_open(x: RewardInputs) -> tuple[jax.Array, jax.Array, jax.Array]:
    distance = jnp.abs(x.slide + 0.19)  # the target is 0.2 beyond the closed handle, less 0.01
    opening = long_tail(distance, 0.02, 0.2)
    # Errors across weigh three times the height, so that the hand may drop onto the handle.
    scale = jnp.array([3.0, 3.0, 1.0])
    # Meta-World's initial handle is the target plus 0.2 along y: 0.01 behind the closed handle.
    start = x.init_handle - jnp.array([0.0, -0.01, 0.0])
    margin = norm((start - x.init_tcp) * scale)
    caging = long_tail(norm((x.handle - x.hand) * scale), 0.01, margin)
    return 5.0 * (caging + opening), distance, distance <= 0.03 + DRAWER_OPEN_EPSILON


def drawer_close(x: RewardInputs) -> tuple[jax.Array, jax.Array, jax.Array]:
    # The handle point lies 0.05 above the target for ever: the distance never falls below that.
    distance = jnp.sqrt(jnp.square(x.slide - 0.01) + 0.05**2)
    initial = (0.16**2 + 0.05**2) ** 0.5
    in_place = long_tail(distance, 0.05, abs(initial - 0.05))
    reach = gaussian(
        norm(x.handle - x.tcp), 0.005, jnp.abs(norm(x.init_handle - x.init_tcp) - 0.005)
    )
    reach = hamacher_product(reach, jnp.clip(x.gripper_effort, 0.0, 1.0))
    is_success = distance <= 0.05 + 0.015
    return (
        jnp.where(is_success, 10.0, 10.0 * hamacher_product(reach, in_place)),
        distance,
        is_success,
    )


TASKS = {
    "drawer-open": Task(
        scene="drawer",
        hand_start=(0.0, 0.6, 0.2),
        placement_low=(-0.1, 0.9, 0.0),
        placement_high=(0.1, 0.9, 0.0),
        start_slide=0.0,
        handle=(0.0, -0.16, 0.0),
        has_quaternion=True,
        target=(0.0, -0.36, 0.09),
        first_obs_slide=0.0,
        forward_at_reset=False,
        reward=drawer_open,
    ),
    "drawer-close": Task(
        scene="drawer",
        hand_start=(0.0, 0.6, 0.2),
        placement_low=(-0.1, 0.9, 0.0),
        placement_high=(0.1, 0.9, 0.0),
        start_slide=-0.15,
        handle=(0.0, -0.16, 0.05),
        has_quaternion=False,
        target=(0.0, -0.16, 0.09),
        first_obs_slide=-0.15,
        forward_at_reset=True,
        reward=drawer_close,
    ),
}
