"""The `mjx` backend: one control step of one lane, MJX for the arm and our own contacts around it.

MJX computes the arm's mass matrix and bias forces. The fixture is one joint whose only coupling is
contact, so it stays outside the MJX model as a few numbers per lane. Unused MJX stages (cameras,
tendons, sensors, its collision driver) are skipped.
"""

from __future__ import annotations

import contextlib
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs.physics.base import Positions, settled_starts
from envs.physics.mjx import rotations
from envs.physics.mjx.contact import Contacts, find_contacts
from envs.physics.mjx.geometry import (
    LEFT,
    RIGHT,
    FixtureShapes,
    load_gripper,
    load_shapes,
)
from envs.physics.mjx.kinematics import Kinematics
from envs.physics.mjx.quiet import mjx
from envs.physics.mjx.solver import (
    Cones,
    RowGeometry,
    Rows,
    make_cones,
    make_rows,
    solve,
    solve_positive,
)
from envs.physics.model import (
    ARM_JOINTS,
    FRAME_SKIP,
    JOINTS,
    LEFT_FINGER,
    RIGHT_FINGER,
    ROBOT_JOINTS,
    SCENES,
    SLIDE,
    Fixture,
    arm_model,
    load_fixture,
    load_scene,
)
from envs.tasks.base import ACTION_SCALE, HAND_HIGH, HAND_LOW

SUBSTEPS = FRAME_SKIP
SOLVER_ITERATIONS, LINE_SEARCH_ITERATIONS = 4, 6
LIMIT_SOLREF, LIMIT_SOLIMP = (0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0)  # MuJoCo defaults
WELD_ROWS = 6
WELD_TORQUE_SCALE = 5.0  # SawyerMocapBase.reset_mocap_welds


class PhysicsState(struct.PyTreeNode):
    """What a lane carries between control steps."""

    qpos: jax.Array  # (10,) 7 arm hinges, right finger, left finger, fixture slide
    qvel: jax.Array  # (10,)
    warm_start: jax.Array  # (10,) last joint acceleration
    mocap: jax.Array  # (3,) commanded hand position, metres
    placement: jax.Array  # (3,) the fixture's position, metres


class SceneData(NamedTuple):
    """Numbers of one scene; stacked over scenes with a leading axis and gathered per lane."""

    fixture: Fixture
    shapes: FixtureShapes


class MjxPhysics:
    """Static data of the backend: the shared arm model and the stacked scenes."""

    def __init__(self) -> None:
        full = {scene: load_scene(scene) for scene in SCENES}
        drawer = full["drawer"]
        arm = arm_model(drawer)
        self.model = mjx.put_model(arm)
        self._kinematics = Kinematics(arm)
        self.timestep = float(drawer.opt.timestep)
        self._data = mjx.make_data(self.model)
        self._gripper = jax.tree.map(_float32, load_gripper(drawer))
        scenes = [SceneData(load_fixture(s, m), load_shapes(s, m)) for s, m in full.items()]
        self.scenes: SceneData = jax.tree.map(lambda *x: _float32(np.stack(x)), *scenes)
        self._read_constants(drawer)
        starts = settled_starts()
        self._start_qpos, self._start_qvel, self._start_warm, self._start_mocap = (
            _float32(leaf) for leaf in (starts.qpos, starts.qvel, starts.warm_start, starts.mocap)
        )

    def _read_constants(self, model: Any) -> None:
        from envs.engine import mujoco

        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        link = data.body("right_l6")
        rot = link.xmat.reshape(3, 3)
        quat, inverse = np.zeros(4), np.zeros(4)
        mujoco.mju_negQuat(inverse, link.xquat)
        mujoco.mju_mulQuat(quat, inverse, data.body("hand").xquat)
        self._hand_pos = _float32(rot.T @ (data.body("hand").xpos - link.xpos))
        self._hand_quat = _float32(quat)
        self._hand_invweight = model.body_invweight0[model.body("hand").id].copy()
        claws = ("rightclaw", "leftclaw")
        tips = ("rightEndEffector", "leftEndEffector")
        self._claw = [_float32(rot.T @ (data.body(n).xpos - link.xpos)) for n in claws]
        self._tip = [_float32(rot.T @ (data.site(n).xpos - link.xpos)) for n in tips]
        self._dof_invweight = model.dof_invweight0[:ROBOT_JOINTS].copy()
        self._joint_range = model.jnt_range[:ROBOT_JOINTS].copy()
        self._servo_gain = _float32(model.actuator_gainprm[:, 0])
        self._servo_bias = _float32(model.actuator_biasprm[:, 1])

    def scene(self, scene_id: jax.Array) -> SceneData:
        """The numbers of one scene, by index into `SCENES`."""
        return jax.tree.map(lambda leaf: leaf[scene_id], self.scenes)

    def fixture(self, scene_id: jax.Array) -> Fixture:
        """The fixture's numbers of one scene."""
        return self.scene(scene_id).fixture

    def start(self, task_id: jax.Array, placement: jax.Array) -> PhysicsState:
        """The settled state of a task with the fixture at `placement` (3,)."""
        return PhysicsState(
            qpos=self._start_qpos[task_id],
            qvel=self._start_qvel[task_id],
            warm_start=self._start_warm[task_id],
            mocap=self._start_mocap[task_id],
            placement=jnp.asarray(placement, jnp.float32),
        )

    def advance(
        self, state: PhysicsState, action: jax.Array, scene_id: jax.Array
    ) -> tuple[PhysicsState, jax.Array]:
        """Moves the mocap target by an action (4,) in [-1, 1] and simulates one control step.

        Returns:
            The new state and whether it is finite, () bool.
        """
        mocap = state.mocap + action[:3] * ACTION_SCALE
        mocap = jnp.clip(mocap, jnp.array(HAND_LOW), jnp.array(HAND_HIGH))
        ctrl = jnp.stack([action[3], -action[3]])
        state = self.step(state.replace(mocap=mocap), ctrl, scene_id)
        return state, jnp.isfinite(state.qpos).all() & jnp.isfinite(state.qvel).all()

    def step(self, state: PhysicsState, ctrl: jax.Array, scene_id: jax.Array) -> PhysicsState:
        """One control step (five substeps of 2.5 ms) with the mocap target already moved.

        Args:
            ctrl: finger commands (2,), right and left, in [-1, 1].
        """
        scene = self.scene(scene_id)
        body = lambda s, _: (self._substep(s, ctrl, scene), None)
        with exact_products():
            return jax.lax.scan(body, state, None, length=SUBSTEPS)[0]

    def positions(self, state: PhysicsState, scene_id: jax.Array) -> Positions:
        """Positions after kinematics, as Meta-World reads them after `mj_forward`."""
        with exact_products():
            return self._positions(state, scene_id)

    def _positions(self, state: PhysicsState, scene_id: jax.Array) -> Positions:
        scene = self.scene(scene_id)
        data = self._data.replace(qpos=state.qpos[:ROBOT_JOINTS])
        data = self._kinematics(data)
        pos, rot = data.xpos[ARM_JOINTS], data.xmat[ARM_JOINTS]
        fingers, axes = state.qpos[RIGHT_FINGER : LEFT_FINGER + 1], self._gripper.finger_axis
        moved = [
            [pos + rot @ (p + a * q) for p, a, q in zip(points, axes, fingers, strict=True)]
            for points in (self._claw, self._tip)
        ]
        return Positions(
            hand=pos + rot @ self._hand_pos,
            right_tip=moved[1][0],
            left_tip=moved[1][1],
            finger_gap=jnp.linalg.norm(moved[0][0] - moved[0][1]),
            fixture=state.placement + scene.fixture.offset + scene.fixture.axis * state.qpos[SLIDE],
            slide=state.qpos[SLIDE],
        )

    def _substep(self, state: PhysicsState, ctrl: jax.Array, scene: SceneData) -> PhysicsState:
        data = self._data.replace(
            qpos=state.qpos[:ROBOT_JOINTS], qvel=state.qvel[:ROBOT_JOINTS], ctrl=ctrl
        )
        data = _fence(self._smooth_dynamics(data))
        fixture = scene.fixture
        mass = (
            jnp.zeros((JOINTS, JOINTS))
            .at[:ROBOT_JOINTS, :ROBOT_JOINTS]
            .set(mjx.full_m(self.model, data))
        )
        mass = mass.at[SLIDE, SLIDE].set(fixture.inertia)
        # The slides are horizontal: gravity does no work on a fixture, damping is all it has.
        slide_force = -fixture.damping * state.qvel[SLIDE]
        force = jnp.append(data.qfrc_smooth, slide_force)
        smooth = solve_positive(mass, force)
        rows, cones = _fence(self._constraints(state, data, scene))
        acceleration, constraint_force = solve(
            mass,
            force,
            smooth,
            state.warm_start,
            rows,
            cones,
            WELD_ROWS,
            SOLVER_ITERATIONS,
            LINE_SEARCH_ITERATIONS,
        )
        # Euler with implicit joint damping, as mj_Euler: (M + h D) a = forces.
        damping = jnp.append(self.model.dof_damping, fixture.damping)
        implicit = mass + jnp.diag(self.timestep * damping)
        step = solve_positive(implicit, force + constraint_force)
        qvel = state.qvel + self.timestep * step
        return state.replace(
            qpos=state.qpos + self.timestep * qvel, qvel=qvel, warm_start=acceleration
        )

    def _smooth_dynamics(self, data: mjx.Data) -> mjx.Data:
        """The arm without constraints: poses, then MJX's own stages up to its forces."""
        model = self.model
        data = self._kinematics(data)
        data = mjx.com_pos(model, data)
        data = mjx.crb(model, data)
        data = mjx.fwd_velocity(model, data)
        # Of all that MJX adds up here only the fingers' servos are not zero.
        fingers = slice(ARM_JOINTS, ROBOT_JOINTS)
        servo = self._servo_gain * data.ctrl + self._servo_bias * data.qpos[fingers]
        force = (data.qfrc_passive - data.qfrc_bias).at[fingers].add(servo)
        return data.replace(qfrc_smooth=force)

    def _constraints(
        self, state: PhysicsState, data: mjx.Data, scene: SceneData
    ) -> tuple[Rows, Cones]:
        """The weld of the hand and the limits as rows, and the contacts."""
        pos, rot = data.xpos[ARM_JOINTS], data.xmat[ARM_JOINTS]
        contacts = find_contacts(
            self._gripper,
            scene.shapes,
            pos,
            rot,
            state.qpos[RIGHT_FINGER : LEFT_FINGER + 1],
            state.placement,
            state.placement + scene.fixture.axis * state.qpos[SLIDE],
        )
        weld, drift = self._weld(state, data, pos, rot)
        parts = zip(weld, self._limits(state, scene), strict=True)
        geometry = RowGeometry(*map(jnp.concatenate, parts))
        rows = make_rows(geometry, state.qvel, self.timestep)
        rows = rows._replace(reference=rows.reference.at[:WELD_ROWS].add(-drift))
        return rows, self._contact_cones(state, data, scene, _fence(contacts))

    def _weld(
        self, state: PhysicsState, data: mjx.Data, pos: jax.Array, rot: jax.Array
    ) -> tuple[RowGeometry, jax.Array]:
        """The weld of the hand to the mocap body: three translations, three rotations.

        MuJoCo takes the change of the Jacobian into account for equalities, and only there: how
        much it takes off the reference acceleration is returned too, (6,).
        """
        hand = pos + rot @ self._hand_pos
        translate, rotate = self._robot_jacobian(data, hand)  # (joint, 3) each
        error = state.mocap - hand
        hand_inverse = rotations.conjugate(
            rotations.multiply(data.xquat[ARM_JOINTS], self._hand_quat)
        )
        # Mocap orientation (1, 0, 1, 0) times the weld's relative pose (-1, 0, 0, 0).
        target = jnp.array([-1.0, 0.0, -1.0, 0.0]) / jnp.sqrt(2.0)
        twist = rotations.multiply(hand_inverse, target)[1:] * WELD_TORQUE_SCALE
        turn = lambda j: rotations.multiply(rotations.multiply_vector(hand_inverse, j), target)[1:]
        turned = 0.5 * jax.vmap(turn)(-rotate * WELD_TORQUE_SCALE)
        jacobian = jnp.concatenate([-translate.T, turned.T])
        error = jnp.concatenate([error, twist])
        speed, linear, angular = self._velocity_product(state, data, hand)
        turning = 0.5 * turn(-angular * WELD_TORQUE_SCALE) - 0.25 * (speed @ speed) * twist
        drift = jnp.concatenate([-linear, turning])
        ones = jnp.ones(WELD_ROWS)
        rows = RowGeometry(
            jacobian=jnp.pad(jacobian, ((0, 0), (0, 1))),
            pos=error,
            impedance_pos=jnp.linalg.norm(error) * ones,
            invweight=jnp.repeat(jnp.asarray(self._hand_invweight, jnp.float32), 3),
            solref=jnp.tile(jnp.array(LIMIT_SOLREF), (WELD_ROWS, 1)),
            solimp=jnp.tile(jnp.array(LIMIT_SOLIMP), (WELD_ROWS, 1)),
            active=ones,
        )
        return rows, drift

    def _limits(self, state: PhysicsState, scene: SceneData) -> RowGeometry:
        """Ten joint limits, and the two slide positions where the fixture meets a static part."""
        ranges = jnp.concatenate(
            [jnp.asarray(self._joint_range, jnp.float32), scene.fixture.joint_range[None]]
        )
        below, above = state.qpos - ranges[:, 0], ranges[:, 1] - state.qpos
        slide, stop = state.qpos[SLIDE], scene.shapes.stop
        pos = jnp.append(jnp.minimum(below, above), jnp.stack([slide - stop[0], stop[1] - slide]))
        sign = jnp.append(jnp.where(below < above, 1.0, -1.0), jnp.array([1.0, -1.0]))
        joint = np.array([*range(JOINTS), SLIDE, SLIDE])
        stop_invweight = jnp.full(2, scene.fixture.body_invweight / scene.shapes.stop_count)
        invweight = jnp.concatenate(
            [
                jnp.asarray(self._dof_invweight, jnp.float32),
                jnp.asarray(scene.fixture.dof_invweight)[None],
                stop_invweight,
            ]
        )
        tile = lambda value: jnp.tile(jnp.array(value), (JOINTS, 1))
        return RowGeometry(
            jacobian=jnp.eye(JOINTS)[joint] * sign[:, None],
            pos=pos,
            impedance_pos=pos,
            invweight=invweight,
            solref=jnp.concatenate([tile(LIMIT_SOLREF), scene.shapes.stop_solref]),
            solimp=jnp.concatenate([tile(LIMIT_SOLIMP), scene.shapes.stop_solimp]),
            active=(pos < 0).astype(jnp.float32),
        )

    def _contact_cones(
        self, state: PhysicsState, data: mjx.Data, scene: SceneData, contacts: Contacts
    ) -> Cones:
        count = contacts.dist.shape[0]
        translate, rotate = jax.vmap(lambda p: self._robot_jacobian(data, p))(contacts.pos)
        fingers = jnp.stack([contacts.part == RIGHT, contacts.part == LEFT], 1)  # (contact, 2)
        mask = jnp.concatenate([jnp.ones((count, ARM_JOINTS)), fingers], 1)
        axes = data.xaxis[ARM_JOINTS:]  # finger slides move a finger's points, but do not turn them
        translate = translate.at[:, ARM_JOINTS:].set(axes) * mask[..., None]
        fixture = contacts.moves[:, None] * scene.fixture.axis  # (contact, 3)
        relative = jnp.concatenate([-translate, fixture[:, None]], 1)  # (contact, joint, 3)
        frame = jax.vmap(rotations.contact_frame)(contacts.normal)  # (contact, 3, 3), normal first
        motion = jnp.einsum("cfx,cjx->cfj", frame, relative)
        spin = -jnp.einsum("cx,cjx->cj", contacts.normal, rotate * mask[..., None])
        spin = jnp.pad(spin, ((0, 0), (0, 1)))[:, None]
        pos = contacts.dist - contacts.material.margin
        return make_cones(
            jacobian=jnp.concatenate([motion, spin], 1),
            friction=contacts.material.friction,
            pos=pos,
            invweight=contacts.material.invweight,
            solref=contacts.material.solref,
            solimp=contacts.material.solimp,
            qvel=state.qvel,
            timestep=self.timestep,
            active=(pos < 0).astype(jnp.float32),
        )

    def _velocity_product(self, state: PhysicsState, data: mjx.Data, point: jax.Array):
        """What a point on the last arm link does when no joint accelerates.

        Returns:
            The link's angular velocity, the point's acceleration and the link's angular
            acceleration, (3,) each: the Jacobians' time derivatives times the joint velocity.
        """
        anchor = data.xanchor[:ARM_JOINTS]
        spin = data.xaxis[:ARM_JOINTS] * state.qvel[:ARM_JOINTS, None]
        # Link j moves a point x at omega_j cross x - moment_j.
        omega = jnp.cumsum(spin, 0)
        moment = jnp.cumsum(jnp.cross(spin, anchor), 0)
        turn = jnp.cross(omega, spin)
        relative = (jnp.cross(omega[-1], point) - moment[-1]) - (jnp.cross(omega, anchor) - moment)
        linear = jnp.cross(turn, point - anchor) + jnp.cross(spin, relative)
        return omega[-1], linear.sum(0), turn.sum(0)

    def _robot_jacobian(self, data: mjx.Data, point: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Jacobians (robot joint, 3) of a world point riding on the last arm link."""
        arm = slice(0, ARM_JOINTS)
        rotate = jnp.zeros((ROBOT_JOINTS, 3)).at[arm].set(data.xaxis[arm])
        translate = jnp.cross(rotate, point - data.xanchor)
        return translate, rotate


def exact_products() -> contextlib.AbstractContextManager[Any]:
    """Products in float32, whoever calls: TF32, an accelerator's default, harms contacts."""
    return jax.default_matmul_precision("highest")


def _fence(tree: Any) -> Any:
    """Keeps XLA from fusing across a stage: it would recompute the stage for every consumer."""
    return jax.lax.optimization_barrier(tree)


def _float32(value: Any) -> jax.Array:
    array = np.asarray(value)
    return jnp.asarray(array, jnp.float32 if array.dtype.kind == "f" else jnp.int32)
