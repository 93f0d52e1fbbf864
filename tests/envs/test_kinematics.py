"""The arm against MuJoCo: poses, mass matrix and forces, and what the chain must be like."""

import re
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from envs.physics.mjx.backend import MjxPhysics
from envs.physics.mjx.kinematics import Kinematics
from envs.physics.mjx.quiet import mjx
from envs.physics.model import arm_model, load_scene

POSES = ("xpos", "xquat", "xmat", "xanchor", "xaxis", "xipos", "ximat")


@pytest.fixture(scope="module")
def arm():
    return arm_model(load_scene("drawer"))


def test_poses_are_mujocos(arm):
    data, found = mujoco.MjData(arm), mjx.make_data(mjx.put_model(arm))
    poses = jax.jit(lambda qpos: Kinematics(arm)(found.replace(qpos=qpos)))
    rng = np.random.default_rng(0)
    for _ in range(20):
        data.qpos[:] = rng.uniform(*arm.jnt_range.T)
        mujoco.mj_kinematics(arm, data)
        ours = poses(np.asarray(data.qpos, np.float32))
        for name in POSES:
            mine, theirs = np.asarray(getattr(ours, name)), getattr(data, name)
            np.testing.assert_allclose(mine, theirs.reshape(mine.shape), atol=2e-6, err_msg=name)


def test_another_kind_of_chain_is_refused():
    one, geom = '<joint axis="1 0 0"/>', '<geom size="1"/>'
    two = f'{one}<joint axis="0 1 0"/>{geom}'
    for body, cause in (
        (two, "one joint"),
        (f"{two}<body>{geom}</body>", "one joint"),  # as many joints as bodies
        (f'<joint type="ball"/>{geom}', "a hinge or a slide"),
    ):
        xml = f"<mujoco><worldbody><body>{body}</body></worldbody></mujoco>"
        with pytest.raises(ValueError, match=cause):
            Kinematics(mujoco.MjModel.from_xml_string(xml))


def test_products_are_exact_whoever_calls():
    """TF32, an accelerator's default, harms contacts: no product is left to a caller's setting."""
    physics = MjxPhysics()
    task: Any = jnp.asarray(0)
    with jax.default_matmul_precision("default"):
        state = physics.start(task, jnp.zeros(3))
        traced = jax.make_jaxpr(lambda s: physics.advance(s, jnp.zeros(4), task))(state)
        read = jax.make_jaxpr(lambda s: physics.positions(s, task))(state)
    found = re.findall(r"dot_general\[.*?precision=(\S+)", f"{traced}{read}", re.DOTALL)
    assert len(found) > 10 and all("HIGHEST" in precision for precision in found)


def test_forces_and_mass_are_mujocos(arm):
    """Bias, damping and the fingers' servos add up to all that acts on the arm."""
    physics, data = MjxPhysics(), mujoco.MjData(arm)

    @jax.jit
    def ours(qpos, qvel, ctrl):
        found = physics._data.replace(qpos=qpos, qvel=qvel, ctrl=ctrl)
        found = physics._smooth_dynamics(found)
        return found.qfrc_smooth, mjx.full_m(physics.model, found)

    rng = np.random.default_rng(1)
    for _ in range(20):
        data.qpos[:] = rng.uniform(*arm.jnt_range.T)
        data.qvel[:] = rng.normal(size=arm.nv)
        data.ctrl[:] = rng.uniform(-1, 1, arm.nu)
        mujoco.mj_forward(arm, data)
        force, mass = ours(*(np.float32(x) for x in (data.qpos, data.qvel, data.ctrl)))
        np.testing.assert_allclose(force, data.qfrc_smooth, rtol=1e-5, atol=1e-4)
        theirs = np.zeros((arm.nv, arm.nv))
        mujoco.mj_fullM(arm, data, theirs)
        np.testing.assert_allclose(mass, theirs, rtol=1e-5, atol=2e-6)
