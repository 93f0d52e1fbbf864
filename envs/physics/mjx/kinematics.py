"""Where the arm's links are: a chain of one-joint bodies, followed number by number.

MJX's own `kinematics` goes through the bodies with a dozen small kernels each on a GPU; written out
in numbers the whole chain is one. What comes out is what MJX's later stages read of its data.

NOTE: joints have their anchor in the body's origin and are zero at rest, as all of the arm's are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.engine import mujoco
from envs.physics.mjx import rotations
from envs.physics.mjx.rotations import Parts

Joint = mujoco.mjtJoint


class Kinematics:
    """The chain of a model, as `arm_model` makes it: hinges and slides, one a body."""

    def __init__(self, model: mujoco.MjModel):
        if not np.isin(model.jnt_type, (Joint.mjJNT_HINGE, Joint.mjJNT_SLIDE)).all():
            raise ValueError("every joint must be a hinge or a slide")
        one_each = (model.body_jntnum[1:] == 1).all()
        if not one_each or model.jnt_pos.any() or model.qpos0.any():
            raise ValueError("every body needs one joint, in its origin and zero at rest")
        self._model = model
        self._com_pos = jnp.asarray(model.body_ipos, jnp.float32)
        self._com_quat = jnp.asarray(model.body_iquat, jnp.float32)
        self._axis = jnp.asarray(model.jnt_axis, jnp.float32)

    def __call__(self, data: Any) -> Any:
        """MJX data with the poses of all bodies at its `qpos` (joint,)."""
        model, qpos = self._model, data.qpos
        pos: list[Parts] = [(0.0, 0.0, 0.0)]  # of the world
        quat: list[Parts] = [(1.0, 0.0, 0.0, 0.0)]
        anchors: list[Parts] = []
        for body in range(1, model.nbody):
            parent, joint = model.body_parentid[body], body - 1
            axis = model.jnt_axis[joint].tolist()
            offset = _turned(quat[parent], model.body_pos[body].tolist())
            origin = [a + b for a, b in zip(pos[parent], offset, strict=True)]
            turned = rotations.product(quat[parent], model.body_quat[body].tolist())
            anchors.append(origin)
            if model.jnt_type[joint] == Joint.mjJNT_HINGE:
                half = 0.5 * qpos[joint]
                sine = jnp.sin(half)
                turned = rotations.product(turned, [jnp.cos(half), *(a * sine for a in axis)])
            else:
                way = _turned(turned, axis)
                origin = [a + b * qpos[joint] for a, b in zip(origin, way, strict=True)]
            pos.append(origin)
            quat.append(turned)
        xquat, xpos = _table(quat), _table(pos)
        xmat = _matrix(xquat)
        com_quat = jnp.stack(rotations.product(xquat.T, self._com_quat.T), -1)
        return data.replace(
            xpos=xpos,
            xquat=xquat,
            xmat=xmat,
            xanchor=_table(anchors),
            xaxis=rotations.dot(xmat[1:], self._axis[:, None]),
            xipos=xpos + rotations.dot(xmat, self._com_pos[:, None]),
            ximat=_matrix(com_quat),
        )


def _table(rows: Sequence[Parts]) -> jax.Array:
    """Rows of numbers as an array (row, number)."""
    numbers = [jnp.asarray(x, jnp.float32) for row in rows for x in row]
    return jnp.stack(numbers).reshape(len(rows), -1)


def _turned(q: Parts, v: Parts) -> Parts:
    """A vector turned by a unit quaternion."""
    w, *axis = q
    half = _cross(axis, v)
    return [x + 2 * (w * h + c) for x, h, c in zip(v, half, _cross(axis, half), strict=True)]


def _cross(a: Parts, b: Parts) -> Parts:
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]


def _matrix(q: jax.Array) -> jax.Array:
    """Rotation matrices (body, 3, 3) of unit quaternions (body, 4)."""
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)
