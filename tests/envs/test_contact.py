"""Collision geometry against MuJoCo's: distances of the scene's own geoms, mixed parameters."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from env_fixtures import GOALS

from envs.parity.reference import ReferenceEnv
from envs.physics.mjx.contact import (
    base_handle_contacts,
    finger_capsule_contacts,
    mix,
    point_box,
    segment_polytope,
    sphere_box_contacts,
    stem_box,
)
from envs.physics.mjx.geometry import Material, load_gripper, load_shapes
from envs.physics.model import (
    FIXTURE_BODY,
    LEFT_FINGER,
    RIGHT_FINGER,
    SLIDE,
    load_fixture,
    load_scene,
)
from envs.tasks import METAWORLD_TASKS as TASKS
from envs.tasks.specs import SPECS

SCENE = {task: spec.scene for task, spec in zip(TASKS, SPECS, strict=True)}
FINGERS = ("rightclaw_it", "rightpad_geom", "leftclaw_it", "leftpad_geom")


def test_point_box_equals_mujocos_distance():
    half = np.array([0.3, 0.2, 0.1])
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom type='box' size='.3 .2 .1'/>"
        "<body><freejoint/><inertial pos='0 0 0' mass='1' diaginertia='1 1 1'/>"
        "<geom type='sphere' size='1e-6'/></body></worldbody></mujoco>"
    )
    data, segment = mujoco.MjData(model), np.zeros(6)
    points = np.random.default_rng(0).uniform(-1.7, 1.7, (400, 3)) * half
    dist, normal = jax.jit(point_box)(points, half)
    for point, d, n in zip(points, dist, np.asarray(normal), strict=True):
        data.qpos[:3] = point
        mujoco.mj_kinematics(model, data)
        expected = mujoco.mj_geomDistance(model, data, 0, 1, 10.0, segment)
        assert abs(d - expected) < 5e-6
        assert abs(np.linalg.norm(n) - 1) < 1e-5
        # Stepping back along the normal lands on the surface.
        assert abs(np.max(np.abs(point - n * d) - half)) < 1e-5
    assert (np.asarray(dist) < 0).mean() > 0.1


@pytest.mark.parametrize(
    ("point", "dist", "normal"),
    [
        ((0.0, 0.0, 0.03), 0.02, (0, 0, 1)),  # above the plate
        ((0.0, 0.0, 0.008), -0.002, (0, 0, 1)),  # in its upper half
        ((0.0, 0.0, -0.009), -0.019, (0, 0, 1)),  # in its lower half: not out at the bottom
        ((0.0, 0.0, -0.03), -0.04, (0, 0, 1)),  # through it
        ((0.198, 0.0, -0.009), -0.002, (1, 0, 0)),  # a nearer way out, at the side
        ((0.23, 0.0, -0.03), np.hypot(0.03, 0.02), None),  # beside it
    ],
)
def test_a_stick_is_pushed_back_the_way_it_came(point, dist, normal):
    half, point = jnp.array([0.2, 0.2, 0.01]), jnp.array(point)
    stem = point.at[2].set(0.1)
    got, out = stem_box(stem, point, half)
    np.testing.assert_allclose(got, dist, atol=1e-6)
    assert normal is None or (np.asarray(out) == normal).all()
    # Seen from below everything is mirrored.
    mirror = jnp.array([1.0, 1.0, -1.0])
    got, mirrored = stem_box(stem * mirror, point * mirror, half)
    np.testing.assert_allclose(got, dist, atol=1e-6)
    np.testing.assert_allclose(mirrored * mirror, out, atol=1e-6)


@pytest.fixture(scope="module")
def near_states(rollouts):
    """Per task: data of Meta-World's simulator in states near contact, as a list of MjData."""
    found = {}
    for task in TASKS:
        env, states = ReferenceEnv(task), []
        for rollout in (r for r in rollouts if r.task == task and r.action.std() > 0):
            for row in range(40, 160, 3):
                env.inject(rollout.state(row), rollout.action[row - 1])
                data = mujoco.MjData(env.env.model)
                mujoco.mj_copyData(data, env.env.model, env.env.data)
                states.append((data, rollout.rand_vec))
        found[task] = (env, states)
    return found


def ours(task, states, family):
    """Our contacts of one family in MuJoCo's states, leaves with a leading state axis."""
    model = load_scene(SCENE[task])
    gripper, shapes = load_gripper(model), load_shapes(SCENE[task], model)
    axis = load_fixture(SCENE[task], model).axis
    single = lambda tree: jax.tree.map(
        lambda x: jnp.asarray(x, jnp.float32 if np.asarray(x).dtype.kind == "f" else jnp.int32),
        tree,
    )
    rows = [
        (
            data.body("right_l6").xpos,
            data.body("right_l6").xmat.reshape(3, 3),
            data.qpos[RIGHT_FINGER : LEFT_FINGER + 1],
            place,
            place + axis * data.qpos[SLIDE],
        )
        for data, place in states
    ]
    pos, rot, fingers, place, shift = single(tuple(np.stack(x) for x in zip(*rows, strict=True)))
    arguments = {
        finger_capsule_contacts: (pos, rot, fingers, shift),
        base_handle_contacts: (pos, rot, shift),
        sphere_box_contacts: (pos, rot, fingers, place, shift),
    }[family]
    gripper, shapes = single(gripper), single(shapes)
    return jax.jit(jax.vmap(lambda *x: family(gripper, shapes, *x)))(*arguments)


def handle_capsules(task, model):
    body = model.body(FIXTURE_BODY[SCENE[task]]).id
    capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
    geoms = np.flatnonzero((model.geom_bodyid == body) & (model.geom_type == capsule))
    return [g for g in geoms if model.geom_contype[g] | model.geom_conaffinity[g]]


@pytest.mark.parametrize("task", TASKS)
def test_finger_boxes_touch_handles_where_mujocos_do(near_states, task):
    env, states = near_states[task]
    model = env.env.model
    contacts = ours(task, states, finger_capsule_contacts)
    dist = np.asarray(contacts.dist).reshape(len(states), 4, 3, 2).min(-1)
    handles, near = handle_capsules(task, model), 0
    for i, (data, _) in enumerate(states):
        for j, finger in enumerate(FINGERS):
            for k, handle in enumerate(handles):
                box = model.geom(finger).id
                expected = mujoco.mj_geomDistance(model, data, box, handle, 0.02, np.zeros(6))
                if -0.004 < expected < 0.01:  # deeper, MuJoCo's own answer is approximate
                    near += 1
                    assert abs(dist[i, j, k] - expected) < 2e-4, (i, finger, k)
    assert near > 10


@pytest.mark.parametrize("task", ["window-open", "window-close"])
def test_the_base_polytope_follows_the_mesh(near_states, task):
    """It stands for the mesh within 0.7 mm (median) near a handle, 2 mm at far corners."""
    env, states = near_states[task]
    model, mesh = env.env.model, None
    body = model.body("right_hand").id
    for geom in range(model.ngeom):
        if model.geom_bodyid[geom] == body and model.geom_contype[geom]:
            mesh = geom
    contacts = ours(task, states, base_handle_contacts)
    errors, turns = [], []
    for i, (data, _) in enumerate(states):
        for k, handle in enumerate(handle_capsules(task, model)):
            segment = np.zeros(6)
            expected = mujoco.mj_geomDistance(model, data, mesh, handle, 0.02, segment)
            if -0.002 < expected < 0.005:
                errors.append(contacts.dist[i, k] - expected)
                way = (segment[3:] - segment[:3]) / expected
                turns.append(way @ np.asarray(contacts.normal[i, k]))
    assert len(errors) > 20
    assert np.abs(np.median(errors)) < 7e-4 and np.abs(errors).max() < 2e-3
    assert np.median(turns) > 0.99 and min(turns) > 0.85


def test_segments_meet_a_polytope_where_they_are_deepest():
    """A box given by its six faces, against a fine search along each segment."""
    half = np.array([0.03, 0.02, 0.01])
    rng = np.random.default_rng(3)
    start = rng.uniform(-2, 2, (300, 3)) * half
    along = rng.uniform(-3, 3, (300, 3)) * half
    normal = np.concatenate([np.eye(3), -np.eye(3)])
    t, dist, out = jax.jit(segment_polytope)(start, along, normal, np.tile(half, 2))
    steps = np.linspace(0, 1, 2001)[:, None, None]
    excess = np.abs(start + steps * along) - half  # (step, segment, axis)
    deepest = excess.max(-1).min(0)
    assert 50 < (deepest < 0).sum() < 250
    np.testing.assert_allclose(dist, deepest, atol=3e-5)
    at = start + np.asarray(t)[:, None] * along
    np.testing.assert_allclose((np.abs(at) - half).max(-1), deepest, atol=3e-5)
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1, atol=1e-5)
    # Perpendicular to the segment, but where it leaves through opposite faces or ends there.
    inner = (np.asarray(t) > 0.01) & (np.asarray(t) < 0.99)
    skew = np.abs((np.asarray(out) * along).sum(1)) / np.linalg.norm(along, axis=1)
    pierced = np.abs(out).max(1) > 1 - 1e-6
    assert (inner & ~pierced).sum() > 50 and skew[inner & ~pierced].max() < 1e-4


@pytest.mark.parametrize("task", TASKS)
def test_boxes_are_met_where_they_are(near_states, task):
    """Every sphere's distance is that of the nearest box of the scene, wherever it has moved."""
    env, states = near_states[task]
    model = env.env.model
    gripper = load_gripper(load_scene(SCENE[task]))
    contacts = ours(task, states, sphere_box_contacts)
    boxes = [
        g
        for g in range(model.ngeom)
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX
        and (model.geom_contype[g] | model.geom_conaffinity[g])
        and model.geom(g).name not in FINGERS
    ]
    checked = 0
    for i, (data, _) in enumerate(states[::4]):
        link = data.body("right_l6")
        slide = np.array([0.0, *data.qpos[RIGHT_FINGER : LEFT_FINGER + 1]])[gripper.sphere_part]
        axis = np.concatenate([np.zeros((1, 3)), gripper.finger_axis])[gripper.sphere_part]
        center = gripper.sphere_center + axis * slide[:, None]
        center = link.xpos + center @ link.xmat.reshape(3, 3).T
        outside = [
            np.linalg.norm(np.maximum(np.abs(local) - model.geom_size[g], 0), axis=1)
            for g in boxes
            for local in [(center - data.geom_xpos[g]) @ data.geom_xmat[g].reshape(3, 3)]
        ]
        expected = np.min(outside, 0) - gripper.sphere_radius
        apart = expected > 1e-4 - gripper.sphere_radius  # centres outside all boxes
        near = apart & (expected < 0.1)  # the three walls left out are farther than that
        checked += near.sum()
        np.testing.assert_allclose(contacts.dist[4 * i][near], expected[near], atol=5e-6)
    assert checked > 50


def test_mixed_parameters_equal_mujocos(near_states):
    seen = set()
    for task in TASKS:
        env, states = near_states[task]
        model = env.env.model
        for data, _ in states:
            for contact in data.contact:
                pair = (int(contact.geom1), int(contact.geom2))
                if contact.efc_address < 0 or (task, pair) in seen:
                    continue
                seen.add((task, pair))
                sides = [
                    Material(
                        friction=model.geom_friction[g, :2],
                        solref=model.geom_solref[g],
                        solimp=model.geom_solimp[g],
                        margin=model.geom_margin[g],
                        invweight=model.body_invweight0[model.geom_bodyid[g], 0],
                    )
                    for g in pair
                ]
                mixed = mix(*sides)
                np.testing.assert_allclose(mixed.friction, contact.friction[[0, 2]], rtol=1e-6)
                np.testing.assert_allclose(mixed.solref, contact.solref, rtol=1e-6)
                np.testing.assert_allclose(mixed.solimp, contact.solimp, rtol=1e-6)
                np.testing.assert_allclose(mixed.margin, contact.includemargin, rtol=1e-6)
    assert len(seen) >= 6


def test_goals_lie_where_the_shapes_are_placed():
    """A placement moves the handle of our shapes as it moves Meta-World's."""
    for i, task in enumerate(TASKS):
        env = ReferenceEnv(task)
        env.reset(GOALS[i, 0])
        model, data = env.env.model, env.env.data
        mujoco.mj_forward(model, data)
        scene = load_scene(SCENE[task])
        shapes, fixture = load_shapes(SCENE[task], scene), load_fixture(SCENE[task], scene)
        moved = shapes.capsule_ends.mean(1) + GOALS[i, 0] + fixture.axis * data.qpos[SLIDE]
        np.testing.assert_allclose(moved, data.geom_xpos[handle_capsules(task, model)], atol=1e-9)
