"""The `native` backend: MuJoCo C on the host, with Meta-World's own model, contacts and solver.

A control step of the whole batch is one host callback. A lane's state crosses it as float64, bit
cast to pairs of uint32, so that nothing is rounded between steps; only what observation and reward
read is float32. The callback is pure: placements are arguments, and a lane's result depends on its
arguments alone, whatever the number of processes that simulate and the order of lanes.

`mujoco.rollout` would need no processes, but it does not return the warm start, without which the
next step is not Meta-World's to the last bit, its sensors are one substep old, and it needs a model
for every lane (18 MB) where this needs one for every process.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs.engine import mujoco
from envs.physics.base import MOCAP_QUAT, Positions, settled_starts
from envs.physics.model import (
    FIXTURE_BODY,
    FIXTURE_ROOT,
    SCENES,
    SLIDE,
    Fixture,
    load_fixture,
    load_scene,
)
from envs.physics.simulator import CARRIED_PARTS, CARRIED_SIZE, Batch, Simulator
from envs.physics.workers import Scenes, Workers
from envs.tasks.base import ACTION_SCALE, HAND_HIGH, HAND_LOW
from envs.tasks.specs import SCENE_ID

_WORDS = 2 * CARRIED_SIZE


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
    parts = np.split(numbers, CARRIED_PARTS, axis=-1)
    return dict(zip(("qpos", "qvel", "warm_start", "mocap"), parts, strict=True))


class NativePhysics:
    """Static data of the backend.

    Args:
        workers: processes that simulate, this one among them; None: one for every processor.
    """

    def __init__(self, workers: int | None = None) -> None:
        self._models = _models()
        self._workers = Workers(scenes(), workers) if workers else _workers()
        fixtures = [load_fixture(scene, model) for scene, model in self._models.items()]
        stack = lambda *leaves: jnp.asarray(np.stack(leaves), jnp.float32)
        self._fixtures: Fixture = jax.tree.map(stack, *fixtures)
        begin = settled_starts()
        nowhere = np.zeros_like(begin.mocap)
        start = self.host_state(
            SCENE_ID, begin.qpos, begin.qvel, begin.warm_start, begin.mocap, nowhere
        )
        self._start: NativeState = jax.tree.map(jnp.asarray, start)

    def close(self) -> None:
        """Ends the other processes; the next control step starts new ones."""
        self._workers.close()

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
        given = step_inputs(carried, np.zeros((len(carried), 4)))
        bodies, sites = np.empty((len(carried), 4, 3)), np.empty((len(carried), 2, 3))
        simulators = [Simulator(*scene) for scene in scenes()]
        for i, scene in enumerate(scene_id.tolist()):
            simulator = simulators[scene]
            simulator.load(given[i], placement[i])
            simulator.read(bodies[i], sites[i])
        positions = Positions(*_positions(carried, bodies, sites))
        leaves: tuple = (carried.view(np.uint32), np.asarray(placement, np.float32), positions)
        return NativeState(*leaves)

    def _simulate(self, words, placement, action, scene_id):
        """The callback: numpy and MuJoCo only, since jax in here could block the CPU client."""
        lead = np.shape(scene_id)
        carried = np.array(words).reshape(-1, _WORDS).view(np.float64)
        given = step_inputs(carried, np.array(action, np.float64).reshape(-1, 4))
        placement = np.array(placement, np.float64).reshape(-1, 3)
        batch = Batch(
            given=given,
            placement=placement,
            scene=np.array(scene_id, np.int64).ravel(),
            carried=carried,
            bodies=np.zeros((len(given), 4, 3)),
            sites=np.zeros((len(given), 2, 3)),
            is_sound=np.isfinite(given).all(1) & np.isfinite(placement).all(1),
        )
        # By scene, so that a processor's cache holds one model at a time; and without what is not
        # finite: MuJoCo would find it out, too, and write a log file.
        order = np.argsort(batch.scene, kind="stable")
        self._workers.simulate(batch, order[batch.is_sound[order]])
        positions = _positions(carried, batch.bodies, batch.sites)
        results = (carried.view(np.uint32), *positions, batch.is_sound)
        return tuple(result.reshape(lead + result.shape[1:]) for result in results)


@functools.cache
def _models() -> dict[str, mujoco.MjModel]:
    return {scene: load_scene(scene) for scene in SCENES}


def scenes() -> Scenes:
    return [(model, FIXTURE_ROOT[name], FIXTURE_BODY[name]) for name, model in _models().items()]


@functools.cache
def _workers() -> Workers:
    """The pool of this process, whatever number of environments it has."""
    return Workers(scenes())


def step_inputs(carried: np.ndarray, action: np.ndarray) -> np.ndarray:
    """What a control step starts from, (lane, 39): `carried` with mocap moved, ctrl and quaternion.

    The arithmetic of SawyerXYZEnv.set_xyz_action, in float64.
    """
    mocap = carried[:, CARRIED_PARTS[-1] :] + action[:, :3] * ACTION_SCALE
    ctrl = np.stack([action[:, 3], -action[:, 3]], 1)
    quat = np.broadcast_to(MOCAP_QUAT, (len(carried), 4))
    mocap = np.clip(mocap, HAND_LOW, HAND_HIGH)
    return np.concatenate([carried[:, : CARRIED_PARTS[-1]], ctrl, mocap, quat], 1)


def _positions(carried: np.ndarray, bodies: np.ndarray, sites: np.ndarray) -> list[Any]:
    """The fields of `Positions` of lanes, numpy float32, from what `Simulator.read` wrote."""
    gap = np.linalg.norm(bodies[:, 1] - bodies[:, 2], axis=-1)
    exact = (bodies[:, 0], sites[:, 0], sites[:, 1], gap, bodies[:, 3], carried[:, SLIDE])
    return [np.asarray(field, np.float32) for field in exact]
