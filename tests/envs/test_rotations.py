"""Quaternions and contact frames against MuJoCo's own C functions."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from envs.physics.mjx import rotations

RANDOM = np.random.default_rng(0)


def unit(size):
    vector = RANDOM.normal(size=size)
    return vector / np.linalg.norm(vector)


def mju(function, size, *arguments):
    out = np.zeros(size)
    getattr(mujoco, function)(out, *arguments)
    return out


def test_products_and_inverse_are_mujocos():
    for _ in range(20):
        u, v, axis = unit(4), unit(4), RANDOM.normal(size=3)
        np.testing.assert_allclose(rotations.multiply(u, v), mju("mju_mulQuat", 4, u, v), atol=1e-6)
        np.testing.assert_allclose(
            rotations.multiply_vector(jnp.asarray(u), jnp.asarray(axis)),
            mju("mju_mulQuatAxis", 4, u, axis),
            atol=1e-6,
        )
        np.testing.assert_allclose(rotations.conjugate(u), mju("mju_negQuat", 4, u), atol=1e-6)


def mujocos_frame(normal):
    """The frame of the contact that MuJoCo finds between two spheres, (3, 3)."""
    sphere = '<geom type="sphere" size="1"/>'
    pos = " ".join(map(str, 1.9 * normal))
    bodies = f'<body>{sphere}<freejoint/></body><body pos="{pos}">{sphere}<freejoint/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data.contact[0].frame.reshape(3, 3)


NORMALS = [unit(3) for _ in range(20)] + [np.eye(3)[1], -np.eye(3)[1], np.eye(3)[2]]


@pytest.mark.parametrize("normal", NORMALS)
def test_contact_frames_are_mujocos(normal):
    ours = np.asarray(rotations.contact_frame(3.0 * normal))
    np.testing.assert_allclose(ours, mujocos_frame(normal), atol=1e-6)


def test_a_frame_of_no_normal_is_zero():
    assert not np.asarray(rotations.contact_frame(jnp.zeros(3))).any()
