"""The four ML4 tasks as data: what differs between them, one row a task.

Source: Farama-Foundation/Metaworld `metaworld/envs/sawyer_{drawer,window}_{open,close}_v3.py`.
Lengths in metres. A goal is a placement of the fixture; the target is a fixed offset from it.
"""

from __future__ import annotations

import difflib
from typing import NamedTuple

import numpy as np

from envs.physics.model import SCENES

HAND_LOW, HAND_HIGH = (-0.5, 0.40, 0.05), (0.5, 1.0, 0.5)  # mocap box, and clip of a shown goal
OBS_HAND_LOW, OBS_HAND_HIGH = (-0.525, 0.348, -0.0525), (0.525, 1.025, 0.7)
ACTION_SCALE = 0.01  # metres a unit of action moves the mocap


class Task(NamedTuple):
    name: str
    scene: str
    hand_start: tuple[float, float, float]
    placement_low: tuple[float, float, float]
    placement_high: tuple[float, float, float]
    start_slide: float
    handle: tuple[float, float, float]  # observed point, from the moving body's position
    has_quaternion: bool  # the observation shows the identity quaternion, else zeros
    target: tuple[float, float, float]  # from the placement
    first_obs_slide: float  # slide position that the reset observation shows, see NOTE
    forward_at_reset: bool  # kinematics refreshed before the reset observation


# NOTE: window-close sets its slide to 0.2 without a forward pass, so Meta-World's reset observation
# (and the previous frame of the first step) still shows the handle at slide 0. We reproduce it.
SPECS = (
    Task(
        name="drawer-open",
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
    ),
    Task(
        name="drawer-close",
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
    ),
    Task(
        name="window-open",
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
    ),
    Task(
        name="window-close",
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
    ),
)
TASKS = tuple(spec.name for spec in SPECS)
SCENE_ID = np.array([list(SCENES).index(spec.scene) for spec in SPECS], np.int32)


def task_id(name: str) -> int:
    """Index of a task in `TASKS`.

    Raises:
        ValueError: unknown name; the message lists the valid ones.
    """
    if name not in TASKS:
        close = difflib.get_close_matches(name, TASKS, 1)
        hint = f"did you mean '{close[0]}'? " if close else ""
        raise ValueError(f"unknown task '{name}'\n{hint}valid: {', '.join(TASKS)}")
    return TASKS.index(name)
