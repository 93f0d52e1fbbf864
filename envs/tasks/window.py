"""The window: sliding it open, sliding it shut.

Source of numbers and rewards: Farama-Foundation/Metaworld (MIT),
`metaworld/envs/sawyer_window_{open,close}_v3.py`, reward v2. Distances are written in the slide
position, where every target is a constant: in float32 a difference of world coordinates would blur
the thresholds.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from envs.rewards import gaussian, hamacher_product, long_tail, norm
from envs.tasks.base import RewardInputs, Task


def window_open(x: RewardInputs) -> tuple[jax.Array, jax.Array, jax.Array]:
    distance = jnp.abs(x.slide - 0.24)
    in_place = long_tail(distance, 0.05, 0.15)
    margin = jnp.abs(norm(x.init_handle - x.init_tcp) - 0.02)
    reach = long_tail(norm(x.handle - x.tcp), 0.02, margin)
    return 10.0 * hamacher_product(reach, in_place), distance, distance <= 0.05


def window_close(x: RewardInputs) -> tuple[jax.Array, jax.Array, jax.Array]:
    distance = jnp.abs(x.slide + 0.01)
    in_place = long_tail(distance, 0.05, 0.16)
    margin = jnp.abs(norm(x.init_handle - x.init_tcp) - 0.02)
    reach = gaussian(norm(x.handle - x.tcp), 0.02, margin)
    return 10.0 * hamacher_product(reach, in_place), distance, distance <= 0.05


# NOTE: window-close sets its slide to 0.2 without a forward pass, so Meta-World's reset observation
# (and the previous frame of the first step) still shows the handle at slide 0. We reproduce it.
TASKS = {
    "window-open": Task(
        scene="window",
        hand_start=(0.0, 0.4, 0.2),
        placement_low=(-0.1, 0.7, 0.16),
        placement_high=(0.1, 0.9, 0.16),
        start_slide=0.0,
        handle=(-0.04, -0.095, 0.0),
        has_quaternion=False,
        target=(0.2, 0.0, 0.0),
        first_obs_slide=0.0,
        forward_at_reset=False,
        reward=window_open,
    ),
    "window-close": Task(
        scene="window",
        hand_start=(0.0, 0.4, 0.2),
        placement_low=(0.0, 0.75, 0.2),
        placement_high=(0.0, 0.9, 0.2),
        start_slide=0.2,
        handle=(0.01, -0.095, 0.0),
        has_quaternion=False,
        target=(0.0, 0.0, 0.0),
        first_obs_slide=0.0,
        forward_at_reset=False,
        reward=window_close,
    ),
}
