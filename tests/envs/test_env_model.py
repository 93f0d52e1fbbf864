"""The arm and fixture models against MuJoCo's full scenes, in float64."""

import mujoco
import numpy as np
import pytest

from envs.physics import model as env_model
from envs.physics.model import FIXTURE_BODY, FIXTURE_ROOT, ROBOT_JOINTS, SCENES, SLIDE


@pytest.fixture(scope="module", params=SCENES)
def scene(request):
    full = env_model.load_scene(request.param)
    return request.param, full, env_model.arm_model(full)


def random_state(model, rng):
    data = mujoco.MjData(model)
    low, high = model.jnt_range.T
    data.qpos[:] = low + (high - low) * rng.random(model.nq)
    data.qvel[:] = rng.standard_normal(model.nv)
    data.ctrl[:] = rng.uniform(-1, 1, model.nu)
    return data


def test_arm_dynamics_equal_the_full_scenes(scene):
    _, full, arm = scene
    assert (arm.nq, arm.ngeom) == (ROBOT_JOINTS, 0)
    robot, rng = slice(0, ROBOT_JOINTS), np.random.default_rng(0)
    for _ in range(20):
        data, part = random_state(full, rng), mujoco.MjData(arm)
        part.qpos[:], part.qvel[:] = data.qpos[robot], data.qvel[robot]
        part.ctrl[:] = data.ctrl
        mujoco.mj_forward(full, data)
        mujoco.mj_forward(arm, part)
        whole = np.zeros((full.nv, full.nv))
        own = np.zeros((arm.nv, arm.nv))
        mujoco.mj_fullM(full, data, whole)
        mujoco.mj_fullM(arm, part, own)
        np.testing.assert_allclose(own, whole[robot, robot], atol=1e-12)
        np.testing.assert_array_equal(whole[robot, SLIDE], 0)
        for name in ("qfrc_bias", "qfrc_passive", "qfrc_actuator", "qfrc_smooth"):
            ours, theirs = getattr(part, name), getattr(data, name)[robot]
            np.testing.assert_allclose(ours, theirs, atol=1e-11, err_msg=name)
            assert name == "qfrc_passive" or np.abs(theirs).max() > 0
        np.testing.assert_allclose(part.qacc_smooth, data.qacc_smooth[robot], rtol=1e-9, atol=1e-8)


def test_fixture_is_one_joint_without_gravity(scene):
    name, full, _ = scene
    fixture, rng = env_model.load_fixture(name, full), np.random.default_rng(1)
    for _ in range(10):
        data = random_state(full, rng)
        mujoco.mj_forward(full, data)
        whole = np.zeros((full.nv, full.nv))
        mujoco.mj_fullM(full, data, whole)
        np.testing.assert_allclose(fixture.inertia, whole[SLIDE, SLIDE], rtol=1e-12)
        assert abs(data.qfrc_bias[SLIDE]) < 1e-12
        np.testing.assert_allclose(
            data.qfrc_passive[SLIDE], -fixture.damping * data.qvel[SLIDE], atol=1e-12
        )
        placement = data.body(FIXTURE_ROOT[name]).xpos
        body = placement + fixture.offset + fixture.axis * data.qpos[SLIDE]
        np.testing.assert_allclose(body, data.body(FIXTURE_BODY[name]).xpos, atol=1e-12)


def test_both_scenes_have_the_same_robot():
    drawer, window = (env_model.arm_model(env_model.load_scene(scene)) for scene in SCENES)
    for name in ("body_mass", "body_inertia", "body_ipos", "jnt_range", "dof_invweight0"):
        np.testing.assert_allclose(getattr(drawer, name), getattr(window, name), atol=1e-12)


@pytest.mark.parametrize(
    "versions", [("3.16.0", "3.15.0"), ("3.17.0", "3.17.0"), ("4.0.0", "4.0.0")]
)
def test_an_unmatched_or_too_new_mujoco_is_refused(monkeypatch, versions):
    found = dict(zip(("mujoco", "mujoco-mjx"), versions, strict=True))
    monkeypatch.setattr(env_model.importlib.metadata, "version", found.__getitem__)
    with pytest.raises(ValueError, match="matched pair") as error:
        env_model.check_versions()
    assert len(str(error.value).splitlines()) == 2 and versions[0] in str(error.value)


def test_a_missing_metaworld_is_named(monkeypatch):
    monkeypatch.setattr(env_model.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match="metaworld is not installed\npip|metaworld==3.0.0"):
        env_model.asset_dir()
