"""What a task is made of: its numbers, and its reward as a function of a few positions.

Lengths in metres. A goal is a placement of the fixture; the target is a fixed offset from it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax

HAND_LOW, HAND_HIGH = (-0.5, 0.40, 0.05), (0.5, 1.0, 0.5)  # mocap box, and clip of a shown goal
OBS_HAND_LOW, OBS_HAND_HIGH = (-0.525, 0.348, -0.0525), (0.525, 1.025, 0.7)
ACTION_SCALE = 0.01  # metres a unit of action moves the mocap


class RewardInputs(NamedTuple):
    """What a reward reads, metres in the world."""

    hand: jax.Array  # (3,) clipped as in the observation
    tcp: jax.Array  # (3,) midpoint of the finger tips
    handle: jax.Array  # (3,) object position of the observation
    slide: jax.Array  # ()
    gripper_effort: jax.Array  # () last action component
    init_tcp: jax.Array  # (3,) tcp after the reset
    init_handle: jax.Array  # (3,) handle at the task's start slide


Reward = Callable[[RewardInputs], tuple[jax.Array, jax.Array, jax.Array]]
"""Inputs of one lane -> reward in [0, 10], distance that decides success, whether it succeeds."""


class Task(NamedTuple):
    """A task as data.

    Attributes:
        scene: one of `physics.model.SCENES`.
        hand_start: where the hand is pulled to at a reset.
        placement_low, placement_high: Meta-World's reset box of the fixture.
        start_slide: slide position after a reset.
        handle: the observed point, from the moving body's position.
        has_quaternion: whether the observation shows the identity quaternion, else zeros.
        target: from the placement.
        first_obs_slide: slide position that the reset observation shows.
        forward_at_reset: whether kinematics are refreshed before the reset observation.
        reward: of one lane, in jnp.
    """

    scene: str
    hand_start: tuple[float, float, float]
    placement_low: tuple[float, float, float]
    placement_high: tuple[float, float, float]
    start_slide: float
    handle: tuple[float, float, float]
    has_quaternion: bool
    target: tuple[float, float, float]
    first_obs_slide: float
    forward_at_reset: bool
    reward: Reward
