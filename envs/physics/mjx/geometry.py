"""Collision shapes of the MJX backend: Meta-World's fixture shapes against a simpler gripper.

Everything on the fixture side (boxes and handle capsules) is taken from the scene unchanged; all of
its boxes are aligned with the world. On the gripper side the two fingers keep their four boxes
against the handles and the gripper base mesh becomes a polytope; against boxes both
become spheres. Every deviation and its measured effect is listed in `README.md`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from envs.engine import mujoco
from envs.physics.model import FIXTURE_BODY, FIXTURE_ROOT
from envs.places import DATA

BOXES = 19  # slots a scene; unused ones are parked far below the floor
HAND, RIGHT, LEFT = 0, 1, 2  # gripper parts: which finger slide, if any, moves a shape
_PARKED = (0.0, 0.0, -100.0)

# The gripper base mesh as a convex polytope, one face a row: outward normal and distance from the
# origin, frame of body `right_hand`, metres. Made by scripts/fit_gripper_base.py, which prints its
# error: rms 0.23 mm, 0.15 mm on the sides that push a window handle.
BASE_FILE = DATA / "gripper_base.csv"
# Against boxes the base is three spheres (both ends and the middle) on each of five capsules across
# the hand: x and z of the axis, radius, half width with the caps.
_BASE_CAPSULES = (
    (-0.0061, 0.0430, 0.0183, 0.0536),
    (0.0197, 0.0361, 0.0199, 0.0338),
    (0.0113, 0.0608, 0.0199, 0.0521),
    (0.0143, 0.0493, 0.0199, 0.0525),
    (-0.0040, 0.0597, 0.0199, 0.0535),
)
# Spheres on a finger pad (metres, frame of the pad): tip and middle, both edges.
_PAD_SPHERES = ((0.042, -0.012), (0.042, 0.012), (-0.010, -0.012), (-0.010, 0.012))
_PAD_SPHERE_RADIUS = 0.003
_PAD_ROOT = -0.045  # where a finger leaves the hand
# Contact points of MuJoCo that one of ours stands for. A finger end or side on a box makes eight,
# claw and pad four each; the base mesh makes two on a handle.
_FINGER_COUNT, _BASE_COUNT, BASE_HANDLE_COUNT = 4.0, 2.0, 2.0


class Material(NamedTuple):
    """MuJoCo contact parameters of one geom, or of one mixed contact; leading dims are free."""

    friction: jax.Array | np.ndarray  # (..., 2) sliding, torsional
    solref: jax.Array | np.ndarray  # (..., 2)
    solimp: jax.Array | np.ndarray  # (..., 5)
    margin: jax.Array | np.ndarray  # (...)
    invweight: jax.Array | np.ndarray  # (...) translational body_invweight0


class Gripper(NamedTuple):
    """Shapes of the robot, in the frame of the last arm link with the fingers at slide 0."""

    finger_center: np.ndarray  # (4, 3) boxes: right claw, right pad, left claw, left pad
    finger_half: np.ndarray  # (4, 3) half sizes along the hand's axes
    finger_part: np.ndarray  # (4,)
    finger_material: Material
    base_normal: np.ndarray  # (face, 3) faces of the base polytope, outward
    base_offset: np.ndarray  # (face,) their distance from the frame's origin
    base_material: Material  # of one geom
    sphere_center: np.ndarray  # (23, 3)
    sphere_radius: np.ndarray  # (23,)
    sphere_stem: np.ndarray  # (23, 3) a point of the same part well inside the gripper
    sphere_part: np.ndarray  # (23,)
    sphere_count: np.ndarray  # (23,) MuJoCo's contact points that one of ours stands for
    sphere_material: Material
    hand_rotation: np.ndarray  # (3, 3) axes of body `hand` (and of the finger boxes)
    finger_axis: np.ndarray  # (2, 3) slide directions of right and left finger


class FixtureShapes(NamedTuple):
    """Shapes that the gripper can touch, relative to the fixture's placement at slide 0."""

    capsule_ends: np.ndarray  # (3, 2, 3) handle
    capsule_radius: np.ndarray  # (3,)
    capsule_material: Material
    box_center: np.ndarray  # (BOXES, 3)
    box_half: np.ndarray  # (BOXES, 3)
    box_moves: np.ndarray  # (BOXES,) 1 where the box rides on the slide
    box_placed: np.ndarray  # (BOXES,) 1 where the box follows the fixture's placement
    box_material: Material
    stop: np.ndarray  # (2,) slide positions where the fixture meets a static part
    stop_count: float  # contact points of such a meeting
    stop_solref: np.ndarray  # (2, 2)
    stop_solimp: np.ndarray  # (2, 5)


def _material(model: mujoco.MjModel, geoms: list[int]) -> Material:
    # What solver.py takes for granted, as it holds for all of Meta-World's scenes.
    if (model.geom_solimp[geoms][:, 4] != 2).any() or (model.geom_solref[geoms] <= 0).any():
        raise ValueError("every geom needs power 2 in solimp, and a positive solref")
    return Material(
        friction=model.geom_friction[geoms][:, :2].copy(),
        solref=model.geom_solref[geoms].copy(),
        solimp=model.geom_solimp[geoms].copy(),
        margin=model.geom_margin[geoms].copy(),
        invweight=model.body_invweight0[model.geom_bodyid[geoms], 0].copy(),
    )


def _repeat(material: Material, index: list[int]) -> Material:
    return Material(*(leaf[index] for leaf in material))


def load_gripper(model: mujoco.MjModel) -> Gripper:
    """Gripper shapes of a compiled scene (both scenes have the same robot)."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    link = data.body("right_l6")
    link_rot = link.xmat.reshape(3, 3)

    def in_link(points: np.ndarray) -> np.ndarray:
        return (np.asarray(points) - link.xpos) @ link_rot

    def on_body(name: str, points: np.ndarray) -> np.ndarray:
        body = data.body(name)
        return in_link(body.xpos + np.asarray(points) @ body.xmat.reshape(3, 3).T)

    names = ("rightclaw_it", "rightpad_geom", "leftclaw_it", "leftpad_geom")
    fingers = [model.geom(name).id for name in names]
    mesh = [g for g in range(model.ngeom) if model.geom_bodyid[g] == model.body("right_hand").id]
    mesh = [g for g in mesh if model.geom_contype[g]]
    planes = np.loadtxt(BASE_FILE, delimiter=",")
    hand = data.body("right_hand")
    base_normal = planes[:, :3] @ (link_rot.T @ hand.xmat.reshape(3, 3)).T
    base_normal /= np.linalg.norm(base_normal, axis=1, keepdims=True)
    base_offset = planes[:, 3] + base_normal @ in_link(hand.xpos)
    base_spheres = on_body(
        "right_hand",
        np.array([(x, y, z) for x, z, r, half in _BASE_CAPSULES for y in (r - half, 0, half - r)]),
    )
    base_radius = np.array([r for _, _, r, _ in _BASE_CAPSULES])
    pads = {
        side: on_body(f"{side}pad", np.array([(x, 0.0, z) for x, z in _PAD_SPHERES]))
        for side in ("right", "left")
    }
    roots = [on_body(f"{side}pad", np.array([(_PAD_ROOT, 0.0, 0.0)])) for side in ("right", "left")]
    material = _material(model, [*mesh, *fingers])  # 0: base; 1..4: finger boxes
    # A finger is a claw and a pad, 3 mm apart: half of its spheres stand for either, crosswise, so
    # that neither edge of a finger is the rougher one.
    centers = in_link(data.geom_xpos[fingers])
    sphere_index = [1, 2, 2, 1, 4, 3, 3, 4] + [0] * len(base_spheres)
    for side, (claw, pad) in {"right": (0, 1), "left": (2, 3)}.items():
        pads[side][[0, 3]] += centers[claw] - centers[pad]
    rotation = link_rot.T @ data.body("hand").xmat.reshape(3, 3)
    axes = [link_rot.T @ data.xaxis[model.joint(name).id] for name in ("r_close", "l_close")]
    return Gripper(
        finger_center=centers,
        finger_half=model.geom_size[fingers].copy(),
        finger_part=np.array([RIGHT, RIGHT, LEFT, LEFT]),
        finger_material=_repeat(material, [1, 2, 3, 4]),
        base_normal=base_normal,
        base_offset=base_offset,
        base_material=Material(*(leaf[0] for leaf in material)),
        sphere_center=np.concatenate([pads["right"], pads["left"], base_spheres]),
        sphere_radius=np.concatenate([np.full(8, _PAD_SPHERE_RADIUS), np.repeat(base_radius, 3)]),
        sphere_stem=np.concatenate(
            [
                *(np.repeat(root, 4, 0) for root in roots),
                np.tile(base_spheres.mean(0), (len(base_spheres), 1)),
            ]
        ),
        sphere_part=np.array([RIGHT] * 4 + [LEFT] * 4 + [HAND] * len(base_spheres)),
        sphere_count=np.array([_FINGER_COUNT] * 8 + [_BASE_COUNT] * len(base_spheres)),
        sphere_material=_repeat(material, sphere_index),
        hand_rotation=rotation,
        finger_axis=np.array(axes),
    )


def load_shapes(scene: str, model: mujoco.MjModel) -> FixtureShapes:
    """Fixture, table and wall shapes of a compiled scene."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    placement = data.body(FIXTURE_ROOT[scene]).xpos
    moving = model.body(FIXTURE_BODY[scene]).id
    root = model.body(FIXTURE_ROOT[scene]).id
    capsules, boxes, placed, moves = [], [], [], []
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        if not (model.geom_contype[geom] | model.geom_conaffinity[geom]):
            continue
        kind, on_fixture = model.geom_type[geom], body == moving
        under_root = _is_under(model, body, root)
        if on_fixture and kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            capsules.append(geom)
        elif kind == mujoco.mjtGeom.mjGEOM_BOX and (under_root or _reachable(model, data, geom)):
            boxes.append(geom)
            placed.append(float(under_root))
            moves.append(float(on_fixture))
    half_axis = data.geom_xmat[capsules].reshape(-1, 3, 3)[:, :, 2] * model.geom_size[capsules, 1:2]
    center = data.geom_xpos[capsules] - placement
    spare = BOXES - len(boxes)
    stop, count, stop_geoms = _stops(scene, model)
    mixed = [_material(model, list(pair)) for pair in stop_geoms]
    return FixtureShapes(
        capsule_ends=np.stack([center - half_axis, center + half_axis], 1),
        capsule_radius=model.geom_size[capsules, 0].copy(),
        capsule_material=_material(model, capsules),
        box_center=np.concatenate(
            [
                data.geom_xpos[boxes] - placement * np.array(placed)[:, None],
                np.tile(_PARKED, (spare, 1)),
            ]
        ),
        box_half=np.concatenate([model.geom_size[boxes], np.full((spare, 3), 0.01)]),
        box_moves=np.array(moves + [0.0] * spare),
        box_placed=np.array(placed + [0.0] * spare),
        box_material=_material(model, boxes + boxes[:1] * spare),
        stop=stop,
        stop_count=count,
        stop_solref=np.array([m.solref.mean(0) for m in mixed]),
        stop_solimp=np.array([m.solimp.mean(0) for m in mixed]),
    )


def _is_under(model: mujoco.MjModel, body: int, root: int) -> bool:
    while body and body != root:
        body = int(model.body_parentid[body])
    return body == root


def _reachable(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> bool:
    """Static boxes the hand can come near: the table and the wall behind the fixture.

    The mocap box keeps the hand at |x| <= 0.5 and y >= 0.4, so the other three walls stay apart.
    """
    name = model.body(model.geom_bodyid[geom]).name
    return name == "tablelink" or (name == "RetainingWall" and data.geom_xpos[geom, 1] > 0.9)


def _stops(scene: str, model: mujoco.MjModel):
    """Where the fixture itself runs into static parts: slide positions, contact points, geoms.

    In Meta-World these contacts, not the joint limit, carry the load when a policy keeps pushing:
    the window pane meets the frame's posts, the drawer meets the wall behind it. Each such meeting
    is flat box on flat box, which on a one-joint fixture is a one-sided spring on the slide.
    """
    body = model.body(FIXTURE_BODY[scene]).id
    by_body = {
        b: [
            g
            for g in range(model.ngeom)
            if model.geom_bodyid[g] == b
            and model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX
            and model.geom_contype[g] | model.geom_conaffinity[g]
        ]
        for b in range(model.nbody)
    }
    if scene == "window":
        frame = by_body[int(model.body_parentid[body])]
        left = min(frame, key=lambda g: model.geom_pos[g, 0])
        right = max(frame, key=lambda g: model.geom_pos[g, 0])
        panes = by_body[body]
        low = min(panes, key=lambda g: model.geom_pos[g, 0] - model.geom_size[g, 0])
        high = max(panes, key=lambda g: model.geom_pos[g, 0] + model.geom_size[g, 0])

        def edge(geom: int, sign: int) -> float:
            return float(model.geom_pos[geom, 0] + sign * model.geom_size[geom, 0])

        stop = np.array([edge(left, 1) - edge(low, -1), edge(right, -1) - edge(high, 1)])
        return stop, 4.0, ((left, low), (right, high))
    # The drawer at y 0.9: its back and its floor end where the wall begins, at slide 0.
    wall = max(by_body[model.body("RetainingWall").id], key=lambda g: model.geom_pos[g, 1])
    back = max(by_body[body], key=lambda g: model.geom_pos[g, 1])
    return np.array([-10.0, 0.0]), 8.0, ((wall, back), (wall, back))
