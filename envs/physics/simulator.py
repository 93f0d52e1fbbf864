"""MuJoCo C on one lane after another: numpy and mujoco alone, since worker processes start with it.

NOTES
1. Meta-World ends a control step with `mj_forward`. That changes no part of the state, so only its
   kinematics are computed here, which is what observation and reward are made of.
2. MuJoCo starts afresh from its zero pose when a number becomes non-finite or exceeds 1e10, and
   counts a warning. The warning is what tells such a lane.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from envs.engine import mujoco
from envs.physics.model import FRAME_SKIP

_BITS: Any = mujoco.mjtState
# MuJoCo lays the parts of a state vector out in the order of their bits.
_CARRIED_BITS = (
    _BITS.mjSTATE_QPOS,
    _BITS.mjSTATE_QVEL,
    _BITS.mjSTATE_WARMSTART,
    _BITS.mjSTATE_MOCAP_POS,
)
_CARRIED = sum(map(int, _CARRIED_BITS))
_GIVEN = _CARRIED + int(_BITS.mjSTATE_CTRL) + int(_BITS.mjSTATE_MOCAP_QUAT)
CARRIED_PARTS = (10, 20, 30)  # where qvel, warm start and mocap position begin
CARRIED_SIZE = 33


class Batch(NamedTuple):
    """Control steps of lanes, what goes in and what comes out; leading axis lane.

    Attributes:
        given: (lane, 39) `carried` with mocap moved, ctrl (2) and mocap quaternion (4) between.
        placement: (lane, 3) the fixture's position, metres.
        scene: (lane,) index of the scene.
        carried: (lane, 33) what a lane carries to the next step: qpos, qvel, warm start, mocap.
        bodies: (lane, 4, 3) world positions of hand, right claw, left claw and fixture.
        sites: (lane, 2, 3) right and left finger tip.
        is_sound: (lane,) bool; False where MuJoCo gave up.
    """

    given: np.ndarray
    placement: np.ndarray
    scene: np.ndarray
    carried: np.ndarray
    bodies: np.ndarray
    sites: np.ndarray
    is_sound: np.ndarray


INPUTS = ("given", "placement", "scene")
OUTPUTS = ("carried", "bodies", "sites", "is_sound")
# In an order that keeps every array aligned when they lie one after another.
_LAYOUT = tuple(
    np.dtype((kind, shape))
    for kind, shape in (
        (np.float64, (39,)),
        (np.float64, (3,)),
        (np.int64, ()),
        (np.float64, (CARRIED_SIZE,)),
        (np.float64, (4, 3)),
        (np.float64, (2, 3)),
        (np.bool_, ()),
    )
)
LANE_BYTES = sum(field.itemsize for field in _LAYOUT)


def batch_in(memory: Any, lanes: int) -> Batch:
    """The arrays of `lanes` lanes in a buffer of `lanes * LANE_BYTES` bytes."""
    arrays, offset = [], 0
    for field in _LAYOUT:
        arrays.append(np.frombuffer(memory, field.base, lanes * int(np.prod(field.shape)), offset))
        arrays[-1] = arrays[-1].reshape(lanes, *field.shape)
        offset += lanes * field.itemsize
    return Batch(*arrays)


class Simulator:
    """A model and its data, through which lanes of a scene are taken one by one.

    Args:
        model: compiled scene; copied.
        fixture_root: name of the body whose position is the fixture's placement.
        fixture_body: name of the fixture's moving body.
    """

    def __init__(self, model: mujoco.MjModel, fixture_root: str, fixture_body: str):
        # A copy of its own: the placement of the lane at hand is written into it.
        self._model = copy.copy(model)
        self._data = mujoco.MjData(self._model)
        self._placement = self._model.body_pos[model.body(fixture_root).id]
        self._warnings = self._data.warning.number
        bodies = ("hand", "rightclaw", "leftclaw", fixture_body)
        self._bodies = np.array([model.body(name).id for name in bodies])
        sites = ("rightEndEffector", "leftEndEffector")
        self._sites = np.array([model.site(name).id for name in sites])

    def load(self, given: np.ndarray, placement: np.ndarray) -> None:
        """Takes on a lane's state; all that it leaves out is the same for every lane."""
        self._placement[:] = placement
        mujoco.mj_setState(self._model, self._data, given, _GIVEN)

    def advance(self, carried: np.ndarray) -> bool:
        """Simulates a control step and writes the new state; False where MuJoCo gave up."""
        mujoco.mj_step(self._model, self._data, nstep=FRAME_SKIP)
        mujoco.mj_getState(self._model, self._data, carried, _CARRIED)
        if self._warnings.any():  # NOTE 2
            self._warnings[:] = 0
            return False
        return True

    def read(self, bodies: np.ndarray, sites: np.ndarray) -> None:
        """Writes world positions: hand, claws and fixture (4, 3), right and left tip (2, 3)."""
        mujoco.mj_kinematics(self._model, self._data)  # NOTE 1
        self._data.xpos.take(self._bodies, axis=0, out=bodies, mode="clip")
        self._data.site_xpos.take(self._sites, axis=0, out=sites, mode="clip")


def simulate(simulators: list[Simulator], batch: Batch, lanes: Iterable[int]) -> None:
    """One control step of the given lanes of a batch; outputs are written into it."""
    for i in lanes:
        simulator = simulators[batch.scene[i]]
        simulator.load(batch.given[i], batch.placement[i])
        batch.is_sound[i] = simulator.advance(batch.carried[i])
        simulator.read(batch.bodies[i], batch.sites[i])
