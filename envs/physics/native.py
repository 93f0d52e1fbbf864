"""The `native` backend: MuJoCo C on the host, with Meta-World's own model, contacts and solver.

A control step of the whole batch is one host callback. A lane's state crosses it as float64, bit
cast to pairs of uint32, so that nothing is rounded between steps; only what observation and reward
read is float32. The callback is pure: placements are arguments, and a lane's result depends on its
arguments alone, whatever the number of threads and the order of lanes.

NOTES
1. Lanes run `mj_step` on a pool of Python threads; it lets go of the interpreter lock while it
   simulates. `mujoco.rollout` would hold the lock less, but it does not return the warm start,
   without which the next step is not Meta-World's to the last bit, its sensors are one substep
   old, and it needs a model for every lane (18 MB) where this needs one for every thread.
2. Meta-World ends a control step with `mj_forward`. That changes no part of the state, so only its
   kinematics are computed here, which is what observation and reward are made of.
3. MuJoCo starts afresh from its zero pose when a number becomes non-finite or exceeds 1e10, and
   counts a warning. The warning is what tells such a lane.
"""

from __future__ import annotations

import collections
import copy
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs.engine import mujoco
from envs.physics.base import FRAME_SKIP, MOCAP_QUAT, Positions, settled_starts
from envs.physics.model import (
    FIXTURE_BODY,
    FIXTURE_ROOT,
    SCENES,
    SLIDE,
    Fixture,
    load_fixture,
    load_scene,
)
from envs.tasks.base import ACTION_SCALE, HAND_HIGH, HAND_LOW
from envs.tasks.specs import SCENE_ID

_BITS: Any = mujoco.mjtState
# MuJoCo lays the parts of a state vector out in the order of their bits.
_CARRIED_BITS = (
    _BITS.mjSTATE_QPOS,
    _BITS.mjSTATE_QVEL,
    _BITS.mjSTATE_WARMSTART,
    _BITS.mjSTATE_MOCAP_POS,
)
_CARRIED = sum(map(int, _CARRIED_BITS))
_CARRIED_PARTS = (10, 20, 30)  # where qvel, warm start and mocap position begin
_CARRIED_SIZE = 33
_GIVEN = _CARRIED + int(_BITS.mjSTATE_CTRL) + int(_BITS.mjSTATE_MOCAP_QUAT)
_WORDS = 2 * _CARRIED_SIZE


class NativeState(struct.PyTreeNode):
    """What a lane carries between control steps."""

    words: jax.Array  # (66,) uint32, the bits of 33 float64 numbers, see `unpack`
    placement: jax.Array  # (3,) the fixture's position, metres
    positions: Positions  # of this very state


def unpack(state: NativeState) -> dict[str, np.ndarray]:
    """The float64 numbers of states on the host.

    Returns:
        qpos (..., 10), qvel (..., 10), warm_start (..., 10) and mocap (..., 3).
    """
    numbers = np.ascontiguousarray(state.words).view(np.float64)
    parts = np.split(numbers, _CARRIED_PARTS, axis=-1)
    return dict(zip(("qpos", "qvel", "warm_start", "mocap"), parts, strict=True))


class _Simulator:
    """One thread's model and data of a scene, through which it takes its lanes one by one."""

    def __init__(self, scene: str, model: mujoco.MjModel):
        # A copy of its own: the placement of the lane at hand is written into it.
        self._model = copy.copy(model)
        self._data = mujoco.MjData(self._model)
        self._placement = self._model.body_pos[model.body(FIXTURE_ROOT[scene]).id]
        self._warnings = self._data.warning.number
        bodies = ("hand", "rightclaw", "leftclaw", FIXTURE_BODY[scene])
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
        if self._warnings.any():  # NOTE 3
            self._warnings[:] = 0
            return False
        return True

    def read(self, bodies: np.ndarray, sites: np.ndarray) -> None:
        """Writes world positions: hand, claws and fixture (4, 3), right and left tip (2, 3)."""
        mujoco.mj_kinematics(self._model, self._data)
        self._data.xpos.take(self._bodies, axis=0, out=bodies, mode="clip")
        self._data.site_xpos.take(self._sites, axis=0, out=sites, mode="clip")


class NativePhysics:
    """Static data of the backend.

    Args:
        threads: simulating threads; None for the processors that this process may use.
    """

    def __init__(self, threads: int | None = None) -> None:
        self._threads = threads or _processors()
        self._pool = ThreadPoolExecutor(self._threads, thread_name_prefix="native-physics")
        self._models = {scene: load_scene(scene) for scene in SCENES}
        self._local = threading.local()
        fixtures = [load_fixture(scene, model) for scene, model in self._models.items()]
        stack = lambda *leaves: jnp.asarray(np.stack(leaves), jnp.float32)
        self._fixtures: Fixture = jax.tree.map(stack, *fixtures)
        begin = settled_starts()
        nowhere = np.zeros_like(begin.mocap)
        start = self.host_state(
            SCENE_ID, begin.qpos, begin.qvel, begin.warm_start, begin.mocap, nowhere
        )
        self._start: NativeState = jax.tree.map(jnp.asarray, start)

    @property
    def timestep(self) -> float:
        """Seconds of a substep."""
        return float(self._models["drawer"].opt.timestep)

    def fixture(self, scene_id: jax.Array) -> Fixture:
        """The fixture's numbers of one scene, float32."""
        return jax.tree.map(lambda leaf: leaf[scene_id], self._fixtures)

    def start(self, task_id: jax.Array, placement: jax.Array) -> NativeState:
        """The settled state of a task with the fixture at `placement` (3,)."""
        placement = jnp.asarray(placement, jnp.float32)
        start = jax.tree.map(lambda leaf: leaf[task_id], self._start)
        positions = start.positions.replace(fixture=start.positions.fixture + placement)
        return start.replace(placement=placement, positions=positions)

    def positions(self, state: NativeState, scene_id: jax.Array) -> Positions:
        """Positions of a state: the step that made it has read them already."""
        del scene_id
        return state.positions

    def advance(
        self, state: NativeState, action: jax.Array, scene_id: jax.Array
    ) -> tuple[NativeState, jax.Array]:
        """Moves the mocap target by an action (4,) in [-1, 1] and simulates one control step.

        Returns:
            The new state, and () bool: False where MuJoCo gave up on the lane.
        """
        shape = jax.ShapeDtypeStruct
        point, number = shape((3,), jnp.float32), shape((), jnp.float32)
        words, *fields, is_sound = jax.pure_callback(
            self._simulate,
            (
                shape((_WORDS,), jnp.uint32),
                *(point, point, point, number, point, number),  # the fields of `Positions`
                shape((), jnp.bool_),
            ),
            state.words,
            state.placement,
            action,
            scene_id,
            vmap_method="broadcast_all",
        )
        return state.replace(words=words, positions=Positions(*fields)), is_sound

    def host_state(
        self,
        scene_id: np.ndarray,
        qpos: np.ndarray,
        qvel: np.ndarray,
        warm_start: np.ndarray,
        mocap: np.ndarray,
        placement: np.ndarray,
    ) -> NativeState:
        """States from float64 arrays on the host, with a leading lane axis; numpy leaves."""
        carried = np.concatenate([qpos, qvel, warm_start, mocap], -1, dtype=np.float64)
        given = _given(carried, np.zeros((len(carried), 4)))
        bodies, sites = np.empty((len(carried), 4, 3)), np.empty((len(carried), 2, 3))
        for i, scene in enumerate(scene_id.tolist()):
            simulator = self._simulator(scene)
            simulator.load(given[i], placement[i])
            simulator.read(bodies[i], sites[i])
        positions = Positions(*_positions(carried, bodies, sites))
        leaves: tuple = (carried.view(np.uint32), np.asarray(placement, np.float32), positions)
        return NativeState(*leaves)

    def _simulator(self, scene: int) -> _Simulator:
        """The calling thread's own simulator of a scene."""
        simulators = self._local.__dict__.setdefault("simulators", {})
        if scene not in simulators:
            name = list(SCENES)[scene]
            simulators[scene] = _Simulator(name, self._models[name])
        return simulators[scene]

    def _simulate(self, words, placement, action, scene_id):
        """The callback: numpy and MuJoCo only, since jax in here could block the CPU client."""
        lead = np.shape(scene_id)
        carried = np.array(words).reshape(-1, _WORDS).view(np.float64)
        placement = np.array(placement, np.float64).reshape(-1, 3)
        scenes = np.array(scene_id).ravel()
        given = _given(carried, np.array(action, np.float64).reshape(-1, 4))
        is_sound = np.isfinite(given).all(1) & np.isfinite(placement).all(1)
        bodies, sites = np.zeros((len(given), 4, 3)), np.zeros((len(given), 2, 3))
        # By scene, so that a processor's cache holds one model at a time.
        todo = collections.deque(np.argsort(scenes, kind="stable").tolist())

        def work() -> None:
            while True:
                try:
                    i = todo.popleft()
                except IndexError:
                    return
                if is_sound[i]:  # MuJoCo would find it out, too, and write a log file
                    simulator = self._simulator(int(scenes[i]))
                    simulator.load(given[i], placement[i])
                    is_sound[i] = simulator.advance(carried[i])
                    simulator.read(bodies[i], sites[i])

        jobs = [self._pool.submit(work) for _ in range(min(self._threads, len(given)))]
        for job in jobs:
            job.result()
        results = (carried.view(np.uint32), *_positions(carried, bodies, sites), is_sound)
        return tuple(result.reshape(lead + result.shape[1:]) for result in results)


def _given(carried: np.ndarray, action: np.ndarray) -> np.ndarray:
    """What a control step starts from, (lane, 39): `carried` with mocap moved, ctrl and quaternion.

    The arithmetic of SawyerXYZEnv.set_xyz_action, in float64.
    """
    mocap = carried[:, _CARRIED_PARTS[-1] :] + action[:, :3] * ACTION_SCALE
    ctrl = np.stack([action[:, 3], -action[:, 3]], 1)
    quat = np.broadcast_to(MOCAP_QUAT, (len(carried), 4))
    mocap = np.clip(mocap, HAND_LOW, HAND_HIGH)
    return np.concatenate([carried[:, : _CARRIED_PARTS[-1]], ctrl, mocap, quat], 1)


def _positions(carried: np.ndarray, bodies: np.ndarray, sites: np.ndarray) -> list[Any]:
    """The fields of `Positions` of lanes, numpy float32, from what `_Simulator.read` wrote."""
    gap = np.linalg.norm(bodies[:, 1] - bodies[:, 2], axis=-1)
    exact = (bodies[:, 0], sites[:, 0], sites[:, 1], gap, bodies[:, 3], carried[:, SLIDE])
    return [np.asarray(field, np.float32) for field in exact]


def _processors() -> int:
    """Processors this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
