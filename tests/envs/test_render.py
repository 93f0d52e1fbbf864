"""Pictures of the scenes: drawn shapes against Meta-World's model and against `contact.py`, both
without GL; what lands on the pixels in a process of its own, where GL can be had."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull, HalfspaceIntersection

from envs.parity.reference import ReferenceEnv
from envs.physics.mjx.contact import BASE_SLOTS, FINGER_SLOTS, find_contacts
from envs.physics.mjx.geometry import load_gripper, load_shapes
from envs.physics.model import (
    ARM_JOINTS,
    LEFT_FINGER,
    RIGHT_FINGER,
    SLIDE,
    load_fixture,
    load_scene,
)
from envs.render import port_scene
from envs.render.frames import camera_of, metaworld_scene
from envs.render.picture import half_way
from envs.tasks import METAWORLD_TASKS as TASKS
from envs.tasks.specs import SPECS

ROOT = Path(__file__).parents[2]
SCENE = {task: spec.scene for task, spec in zip(TASKS, SPECS, strict=True)}
FINGERS = ("rightclaw_it", "rightpad_geom", "leftclaw_it", "leftpad_geom")


@pytest.fixture(scope="module")
def states():
    """Per task: qpos and placement with the hand at the handle, and Meta-World's scene there."""
    found = {}
    for task in TASKS:
        _, qpos, placement = half_way(task)
        model = metaworld_scene(task, placement)
        data = mujoco.MjData(model)
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        shapes = port_scene.port_shapes(SCENE[task], qpos, placement)
        found[task] = (qpos, placement, model, data, shapes)
    return found


def drawn(shapes, *roles):
    return [shape for shape in shapes if shape.role in roles]


@pytest.mark.parametrize("task", TASKS)
def test_metaworld_scene_is_where_a_reset_puts_it(task):
    placement = np.array([0.03, 0.87, 0.15])
    env = ReferenceEnv(task)
    env.reset(placement)
    ours, theirs = metaworld_scene(task, placement), env.env.model
    np.testing.assert_allclose(ours.body_pos, theirs.body_pos, atol=1e-12)
    np.testing.assert_allclose(ours.site("goal").pos, theirs.site("goal").pos, atol=1e-12)


@pytest.mark.parametrize("task", TASKS)
def test_fingers_handle_and_arm_are_drawn_where_metaworld_has_them(states, task):
    _, _, model, data, shapes = states[task]
    fingers = drawn(shapes, port_scene.FINGERS)
    assert len(fingers) == len(FINGERS)
    for shape, name in zip(fingers, FINGERS, strict=True):
        geom = data.geom(name)
        np.testing.assert_allclose(shape.pos, geom.xpos, atol=1e-6)
        # The port's boxes lie along the hand's axes: the same box, however its axes are named.
        extent = lambda rot, size: np.abs(rot) @ size
        theirs = extent(geom.xmat.reshape(3, 3), model.geom(name).size)
        np.testing.assert_allclose(extent(shape.rot, shape.size), theirs, atol=1e-6)
    capsules = [
        g
        for g in range(model.ngeom)
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE and model.geom_contype[g]
    ]
    handle = drawn(shapes, port_scene.HANDLE)
    for shape, geom in zip(handle, capsules, strict=True):
        np.testing.assert_allclose(shape.pos, data.geom_xpos[geom], atol=1e-9)
        np.testing.assert_allclose(shape.size, model.geom_size[geom, :2], atol=1e-9)
        axes = shape.rot[:, 2], data.geom_xmat[geom].reshape(3, 3)[:, 2]
        assert abs(abs(axes[0] @ axes[1]) - 1) < 1e-9
    for i, shape in enumerate(drawn(shapes, port_scene.ARM)):
        names = ["world", *(f"right_l{j}" for j in range(ARM_JOINTS))]
        ends = [data.body(name).xpos for name in names[i : i + 2]]
        np.testing.assert_allclose(shape.pos, np.mean(ends, 0), atol=1e-9)
        tip = shape.pos + shape.rot[:, 2] * shape.size[1]
        np.testing.assert_allclose(tip, ends[1], atol=1e-9)
    assert i == ARM_JOINTS - 1


@pytest.mark.parametrize("task", TASKS)
def test_boxes_are_drawn_where_metaworld_has_them(states, task):
    _, placement, model, data, shapes = states[task]
    moving = {"drawer": "drawer_link", "window": "windowb_a"}[SCENE[task]]
    theirs = {
        (
            *np.round([*data.geom_xpos[g], *model.geom_size[g]], 6),
            model.body(model.geom_bodyid[g]).name == moving,
        )
        for g in range(model.ngeom)
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX
        and model.geom_contype[g] | model.geom_conaffinity[g]
        and model.geom(g).name not in FINGERS
    }
    ours = {
        (*np.round([*shape.pos, *shape.size], 6), shape.role == port_scene.SLIDING)
        for shape in drawn(shapes, port_scene.SLIDING, port_scene.STANDING)
    }
    assert ours <= theirs
    walls = {box for box in theirs - ours if box[1] < 0.9 and not box[-1]}
    assert theirs - ours == walls and len(walls) == 3  # out of the hand's reach: README


def test_drawn_shapes_are_as_far_apart_as_contacts_say(states):
    """Distances in the drawn scene against those of `find_contacts` in the same state."""
    single = lambda x: jnp.asarray(x, jnp.float32 if np.asarray(x).dtype.kind == "f" else jnp.int32)
    contacts = jax.jit(find_contacts)
    compared = 0
    for task, (qpos, placement, _, data, shapes) in states.items():
        full, link = load_scene(SCENE[task]), data.body("right_l6")
        arguments = (
            load_gripper(full),
            load_shapes(SCENE[task], full),
            link.xpos,
            link.xmat.reshape(3, 3),
            qpos[RIGHT_FINGER : LEFT_FINGER + 1],
            placement,
            placement + load_fixture(SCENE[task], full).axis * qpos[SLIDE],
        )
        kept = contacts(*jax.tree.map(single, arguments)).dist
        fingers, base, boxes = np.split(kept, (FINGER_SLOTS, FINGER_SLOTS + BASE_SLOTS))
        assert abs(base.min() - base_to_handle(shapes)) < 1e-5, task
        model = port_scene.to_model(shapes)
        scene = mujoco.MjData(model)
        mujoco.mj_forward(model, scene)
        for got, one, other in (
            (fingers, port_scene.FINGERS, (port_scene.HANDLE,)),
            (boxes, port_scene.SPHERES, (port_scene.SLIDING, port_scene.STANDING)),
        ):
            least = min(
                mujoco.mj_geomDistance(model, scene, i, j, 0.5, np.zeros(6))
                for i, a in enumerate(shapes)
                for j, b in enumerate(shapes)
                if a.role == one and b.role in other
            )
            if least > -0.002:  # deeper, MuJoCo's own answer is approximate
                compared += 1
                assert abs(got.min() - least) < 2e-4, (task, one)
    assert compared >= 6


def base_to_handle(shapes):
    """Least distance of the handle to the farthest face of the drawn base, along the handle."""
    [base] = drawn(shapes, port_scene.BASE)
    faces = ConvexHull(base.pos + base.corners @ base.rot.T).equations
    along = np.linspace(-1, 1, 4001)[:, None]
    return min(
        ((handle.pos + along * handle.size[1] * handle.rot[:, 2]) @ faces[:, :3].T + faces[:, 3])
        .max(1)
        .min()
        - handle.size[0]
        for handle in drawn(shapes, port_scene.HANDLE)
    )


def test_corners_of_the_gripper_base_are_those_of_its_half_spaces():
    gripper = load_gripper(load_scene("drawer"))
    normal, offset = gripper.base_normal, gripper.base_offset
    ours = port_scene.polytope_corners(normal, offset)
    inside = ours.mean(0)  # qhull wants a point within
    theirs = HalfspaceIntersection(np.column_stack([normal, -offset]), inside).intersections
    apart = np.linalg.norm(ours[:, None] - theirs, axis=2)
    assert apart.min(0).max() < 1e-6 and apart.min(1).max() < 1e-6


# From here on, pictures: each in a process of its own (see the fixture `gl`).


def python(code, **environment):
    return subprocess.run(
        [sys.executable, *code],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
    )


@pytest.mark.parametrize("gl", ["off", "no-such-library"])
def test_missing_gl_is_two_lines(gl, tmp_path):
    done = python(["-m", "envs.render.picture", "--out", str(tmp_path / "new")], MUJOCO_GL=gl)
    cause, cure = done.stderr.splitlines()
    assert (done.returncode, done.stdout) == (2, "") and not (tmp_path / "new").exists()
    assert cause.startswith("error: ") and f"MUJOCO_GL={gl} does not work" in cause
    assert cure.startswith("fix: ") and "libegl1 libosmesa6" in cure


@pytest.fixture(scope="module")
def pictures(gl, tmp_path_factory):
    """Meta-World's and the port's picture of three tasks, (2, height, width, 3)."""
    out = tmp_path_factory.mktemp("pictures") / "pictures.npz"
    done = python(
        [
            "-c",
            "import sys, numpy as np; from envs.render.picture import draw_task\n"
            "tasks = 'drawer-open', 'window-open', 'window-close'\n"
            "np.savez(sys.argv[1], **{t: np.stack(draw_task(t)[1:3]) for t in tasks})",
            str(out),
        ],
        MUJOCO_GL=gl,
    )
    assert done.returncode == 0, done.stderr
    return dict(np.load(out))


def pixel(point, camera, height, width):
    """Row and column where a pinhole camera, vertical field of view 45 degrees, sees a point."""
    azimuth, elevation = np.radians([camera.azimuth, camera.elevation])
    forward = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    seen = np.asarray(point) - (np.array(camera.lookat) - camera.distance * forward)
    scale = height / 2 / np.tan(np.radians(45 / 2)) / (seen @ forward)
    up = np.cross(right, forward)
    return int(height / 2 - scale * (seen @ up)), int(width / 2 + scale * (seen @ right))


@pytest.mark.parametrize("task", ["drawer-open", "window-open", "window-close"])
def test_both_pictures_show_the_handle_where_it_is(states, pictures, task):
    _, placement, _, _, shapes = states[task]
    metaworld, port = pictures[task].astype(int)
    capsule = drawn(shapes, port_scene.HANDLE)[2]  # not behind the hand in these states
    row, column = pixel(capsule.pos, camera_of(task, placement), *port.shape[:2])
    red, green, blue = port[row, column]
    assert green > red + 30 and green > blue + 30, port[row, column]
    # Meta-World's handles are light grey.
    color = metaworld[row, column]
    assert color.min() > 110 and np.ptp(color) < 25, color


def test_committed_pictures_are_small():
    for scene in ("drawer", "window"):
        assert 50_000 < (ROOT / "envs" / "pictures" / f"{scene}.png").stat().st_size < 300_000
