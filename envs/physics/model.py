"""From Meta-World's installed MJCF to the two things the MJX backend steps: an arm and a fixture.

The scene XML is read from the `metaworld` package (found without importing it) and compiled by
MuJoCo; nothing is vendored. In both ML4 scenes the fixture (drawer, window pane) slides on one
joint and touches the robot only through contacts, and the robot is the same. So the robot becomes
one MJX model shared by every lane of every task, and a fixture is a handful of numbers per lane.
Fixed bodies are fused into the nearest moving one with their exact inertia.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
from pathlib import Path
from typing import NamedTuple

import numpy as np

from envs.engine import mujoco

SCENES = {"drawer": "sawyer_drawer.xml", "window": "sawyer_window_horizontal.xml"}
FIXTURE_BODY = {"drawer": "drawer_link", "window": "windowb_a"}
FIXTURE_ROOT = {"drawer": "drawer", "window": "window"}
FRAME_SKIP = 5  # substeps of a control step
ARM_JOINTS, ROBOT_JOINTS, JOINTS = 7, 9, 10  # arm hinges; + two finger slides; + the fixture slide
RIGHT_FINGER, LEFT_FINGER, SLIDE = 7, 8, 9


class Fixture(NamedTuple):
    """A fixture's one-joint dynamics: what the arm model does not know. Float64, SI units."""

    axis: np.ndarray  # (3,) slide direction in the world
    offset: np.ndarray  # (3,) moving body's position at slide 0, from the fixture's placement
    inertia: float  # mass + armature, the mass matrix entry of the slide
    damping: float
    joint_range: np.ndarray  # (2,) metres
    dof_invweight: float  # MuJoCo's dof_invweight0 of the slide
    body_invweight: float  # MuJoCo's translational body_invweight0 of the moving body


def check_versions() -> None:
    """Raises ValueError unless mujoco and mujoco-mjx are the same release below 3.17."""
    versions = {p: importlib.metadata.version(p) for p in ("mujoco", "mujoco-mjx")}
    release = tuple(int(part) for part in versions["mujoco"].split(".")[:2])
    if versions["mujoco"] != versions["mujoco-mjx"] or release >= (3, 17):
        raise ValueError(
            f"mujoco {versions['mujoco']} with mujoco-mjx {versions['mujoco-mjx']}: the scenes "
            "need one matched pair below 3.17\n"
            "run: pip install mujoco==3.16.0 mujoco-mjx==3.16.0"
        )


def asset_dir() -> Path:
    """Folder of Meta-World's scene files; raises ValueError when metaworld is not installed."""
    spec = importlib.util.find_spec("metaworld")
    if spec is None or not spec.submodule_search_locations:
        raise ValueError("metaworld is not installed\nrun: pip install metaworld==3.0.0")
    return Path(spec.submodule_search_locations[0]) / "assets" / "sawyer_xyz"


def load_scene(scene: str) -> mujoco.MjModel:
    """Meta-World's scene, compiled as it is but for the weld data its Python code writes."""
    check_versions()
    model = mujoco.MjModel.from_xml_path(str(asset_dir() / SCENES[scene]))
    # SawyerMocapBase.reset_mocap_welds: no offset, identity rotation (sign -1), torque scale 5.
    model.eq_data[0] = [0, 0, 0, 0, 0, 0, -1, 0, 0, 0, 5]
    return model


def load_fixture(scene: str, model: mujoco.MjModel) -> Fixture:
    """The fixture of a compiled scene."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    body = model.body(FIXTURE_BODY[scene]).id
    joint = model.body_jntadr[body]
    dof = model.jnt_dofadr[joint]
    inertia = np.zeros(model.nv)
    mujoco.mj_mulM(model, data, inertia, np.eye(model.nv)[dof])
    return Fixture(
        axis=data.xaxis[joint].copy(),
        offset=data.xpos[body] - data.body(FIXTURE_ROOT[scene]).xpos,
        inertia=float(inertia[dof]),
        damping=float(model.dof_damping[dof]),
        joint_range=model.jnt_range[joint].copy(),
        dof_invweight=float(model.dof_invweight0[dof]),
        body_invweight=float(model.body_invweight0[body, 0]),
    )


def _moving_ancestor(model: mujoco.MjModel, body: int) -> int:
    """The nearest body at or above `body` that has a joint; 0 (the world) if none has."""
    while body and model.body_jntnum[body] == 0:
        body = model.body_parentid[body]
    return int(body)


def _fused_inertia(data: mujoco.MjData, bodies: list[int], frame: int):
    """Mass, centre of mass (3,), inertia (3, 3) about it of rigidly joined bodies, in `frame`."""
    model = data.model
    mass = model.body_mass[bodies]
    com = np.average(data.xipos[bodies], axis=0, weights=mass)
    inertia = np.zeros((3, 3))
    for m, b in zip(mass, bodies, strict=True):
        rot = data.ximat[b].reshape(3, 3)
        offset = data.xipos[b] - com
        inertia += rot @ np.diag(model.body_inertia[b]) @ rot.T
        inertia += m * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    rot = data.xmat[frame].reshape(3, 3)
    return mass.sum(), rot.T @ (com - data.xpos[frame]), rot.T @ inertia @ rot


def arm_model(full: mujoco.MjModel) -> mujoco.MjModel:
    """The robot alone: nine one-joint bodies, two actuators, no geoms.

    Mass matrix, bias forces, damping, armature, limits and actuators equal the scene's (tested);
    the inverse weights that scale MuJoCo's constraints are copied from it.
    """
    data = mujoco.MjData(full)
    mujoco.mj_forward(full, data)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    spec.option.timestep = full.opt.timestep
    spec_body = {0: spec.worldbody}
    for body in [int(full.jnt_bodyid[j]) for j in range(ROBOT_JOINTS)]:
        parent = _moving_ancestor(full, full.body_parentid[body])
        fused = [b for b in range(1, full.nbody) if _moving_ancestor(full, b) == body]
        mass, com, inertia = _fused_inertia(data, fused, body)
        rot = data.xmat[parent].reshape(3, 3)
        quat, parent_inverse = np.zeros(4), np.zeros(4)
        mujoco.mju_negQuat(parent_inverse, data.xquat[parent])
        mujoco.mju_mulQuat(quat, parent_inverse, data.xquat[body])
        spec_body[body] = spec_body[parent].add_body(
            name=full.body(body).name,
            pos=rot.T @ (data.xpos[body] - data.xpos[parent]),
            quat=quat,
            mass=mass,
            ipos=com,
            fullinertia=[*inertia.diagonal(), inertia[0, 1], inertia[0, 2], inertia[1, 2]],
            explicitinertial=True,
        )
        joint = full.joint(full.body_jntadr[body])
        spec_body[body].add_joint(
            name=joint.name,
            type=int(full.jnt_type[joint.id]),
            axis=joint.axis,
            range=joint.range,
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            damping=[joint.damping[0], 0, 0],
            armature=joint.armature[0],
        )
    for actuator in range(full.nu):
        spec.add_actuator(
            target=full.joint(full.actuator_trnid[actuator, 0]).name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gainprm=full.actuator_gainprm[actuator],
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            biasprm=full.actuator_biasprm[actuator],
            ctrllimited=mujoco.mjtLimited.mjLIMITED_TRUE,
            ctrlrange=full.actuator_ctrlrange[actuator],
        )
    model = spec.compile()
    model.dof_invweight0[:] = full.dof_invweight0[:ROBOT_JOINTS]
    return model
