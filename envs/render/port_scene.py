"""What the `mjx` backend simulates, as a list of shapes in the world and as a scene to look at.

The shapes are those of `geometry.py`, placed the way `contact.py` places them; the arm, which takes
part in no contact but the gripper's, is thin capsules along the arm model's bodies.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from envs.engine import mujoco
from envs.physics.mjx.geometry import FixtureShapes, Gripper, load_gripper, load_shapes
from envs.physics.model import (
    ARM_JOINTS,
    LEFT_FINGER,
    RIGHT_FINGER,
    ROBOT_JOINTS,
    SLIDE,
    arm_model,
    load_fixture,
    load_scene,
)

# What a shape is there for -> colour (red, green, blue, opacity).
COLORS = {
    "arm, no contacts": (0.55, 0.57, 0.60, 1.0),
    "gripper base, on handles": (0.98, 0.65, 0.10, 0.5),
    "finger boxes, on handles": (0.85, 0.15, 0.25, 0.55),
    "gripper spheres, on boxes": (0.45, 0.15, 0.55, 1.0),
    "handle capsules": (0.10, 0.55, 0.25, 1.0),
    "boxes that slide": (0.20, 0.50, 0.85, 1.0),
    "boxes that stand": (0.80, 0.74, 0.62, 1.0),
}
ARM, BASE, FINGERS, SPHERES, HANDLE, SLIDING, STANDING = COLORS
_ARM_RADIUS = 0.03


class Shape(NamedTuple):
    """One convex shape in the world, metres."""

    role: str  # a key of COLORS
    kind: str  # box, capsule (along its z axis), sphere or hull
    pos: np.ndarray  # (3,)
    rot: np.ndarray  # (3, 3) its axes in columns
    size: tuple[float, ...]  # half sizes; radius, half length; radius; nothing
    corners: np.ndarray | None = None  # (corner, 3) of a hull, along its own axes


def _capsule(role: str, ends: np.ndarray, radius: float) -> Shape:
    """A capsule from its axis' end points (2, 3)."""
    along = ends[1] - ends[0]
    length = np.linalg.norm(along)
    quat = np.zeros(4)
    mujoco.mju_quatZ2Vec(quat, along / length)
    rot = np.zeros(9)
    mujoco.mju_quat2Mat(rot, quat)
    return Shape(role, "capsule", ends.mean(0), rot.reshape(3, 3), (radius, length / 2))


def _arm(data: mujoco.MjData) -> list[Shape]:
    """A capsule from each joint of the arm to the next."""
    joints = data.xpos[: ARM_JOINTS + 1]  # the first is the world: the robot's base stands there
    links = np.stack([joints[:-1], joints[1:]], 1)  # (link, 2, 3)
    return [_capsule(ARM, ends, _ARM_RADIUS) for ends in links]


def _base(gripper: Gripper, pos: np.ndarray, rot: np.ndarray) -> list[Shape]:
    """The gripper base as handles meet it."""
    corners = polytope_corners(gripper.base_normal, gripper.base_offset)
    return [Shape(BASE, "hull", pos, rot, (), corners)]


def polytope_corners(normal: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Corners (corner, 3) of {x: normal x <= offset}: where three faces meet and no other cuts."""
    triples = np.array(list(itertools.combinations(range(len(normal)), 3)))
    triples = triples[np.abs(np.linalg.det(normal[triples])) > 1e-6]
    points = np.linalg.solve(normal[triples], offset[triples][..., None])[..., 0]
    inside = (points @ normal.T <= offset + 1e-9).all(1)
    return points[inside]


def _fingers(gripper: Gripper, pos: np.ndarray, rot: np.ndarray, slides: np.ndarray) -> list[Shape]:
    """Finger boxes, and the spheres that stand for fingers and base against boxes."""
    moved = np.concatenate([np.zeros((1, 3)), gripper.finger_axis * slides[:, None]])
    boxes = pos + (gripper.finger_center + moved[gripper.finger_part]) @ rot.T
    spheres = pos + (gripper.sphere_center + moved[gripper.sphere_part]) @ rot.T
    axes = rot @ gripper.hand_rotation
    return [
        *(
            Shape(FINGERS, "box", center, axes, tuple(half))
            for center, half in zip(boxes, gripper.finger_half, strict=True)
        ),
        *(
            Shape(SPHERES, "sphere", center, np.eye(3), (radius,))
            for center, radius in zip(spheres, gripper.sphere_radius, strict=True)
        ),
    ]


def _fixture(shapes: FixtureShapes, placement: np.ndarray, shift: np.ndarray) -> list[Shape]:
    """Handle, and boxes of fixture, table and wall; `shift` (3,) is what the slide has moved."""
    ends = shapes.capsule_ends + placement + shift
    moves, placed = shapes.box_moves[:, None], shapes.box_placed[:, None]
    centers = shapes.box_center + placed * placement + moves * shift
    return [
        *(_capsule(HANDLE, e, r) for e, r in zip(ends, shapes.capsule_radius, strict=True)),
        *(
            Shape(SLIDING if moving else STANDING, "box", center, np.eye(3), tuple(half))
            for moving, center, half in zip(moves, centers, shapes.box_half, strict=True)
            if center[2] > -10  # unused slots are parked far below
        ),
    ]


def port_shapes(scene: str, qpos: np.ndarray, placement: np.ndarray) -> list[Shape]:
    """Every shape that the backend knows, in a state.

    Args:
        scene: a key of `model.SCENES`.
        qpos: (10,) arm hinges, right and left finger, fixture slide.
        placement: (3,) the fixture's position, metres.
    """
    full = load_scene(scene)
    arm = arm_model(full)
    data = mujoco.MjData(arm)
    data.qpos[:] = qpos[:ROBOT_JOINTS]
    mujoco.mj_kinematics(arm, data)
    pos, rot = data.xpos[ARM_JOINTS], data.xmat[ARM_JOINTS].reshape(3, 3)
    gripper = load_gripper(full)
    shift = load_fixture(scene, full).axis * qpos[SLIDE]
    return [
        *_arm(data),
        *_base(gripper, pos, rot),
        *_fingers(gripper, pos, rot, qpos[RIGHT_FINGER : LEFT_FINGER + 1]),
        *_fixture(load_shapes(scene, full), placement, shift),
    ]


def to_model(shapes: list[Shape]) -> mujoco.MjModel:
    """A scene of those shapes, one geom each in their order, coloured by role, to be drawn."""
    spec = mujoco.MjSpec()
    spec.visual.headlight.ambient = [0.45, 0.45, 0.45]
    spec.visual.headlight.diffuse = [0.35, 0.35, 0.35]
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[1, 1, 1],
        rgb2=[1, 1, 1],
        width=8,
        height=48,
    )
    spec.worldbody.add_light(pos=[0.6, 0.0, 2.0], dir=[-0.3, 0.35, -1.0], diffuse=[0.5, 0.5, 0.5])
    kinds = {
        "box": mujoco.mjtGeom.mjGEOM_BOX,
        "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
        "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
        "hull": mujoco.mjtGeom.mjGEOM_MESH,
    }
    for i, shape in enumerate(shapes):
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, shape.rot.ravel())
        if shape.corners is not None:
            spec.add_mesh(name=str(i), uservert=shape.corners.ravel())
        spec.worldbody.add_geom(
            meshname=str(i) if shape.corners is not None else "",
            type=kinds[shape.kind],
            pos=shape.pos,
            quat=quat,
            size=[*shape.size, 0.0, 0.0][:3],
            rgba=COLORS[shape.role],
        )
    return spec.compile()
