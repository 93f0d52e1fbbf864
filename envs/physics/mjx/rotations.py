"""Quaternions (w, x, y, z) and contact frames: the little of rotations that the solver's rows need.

MJX has the same functions, but none of them is public.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

Parts = Sequence[Any] | jax.Array
"""The parts of a vector or a quaternion: numbers of one lane, arrays, or constants."""


def product(u: Parts, v: Parts) -> list[Any]:
    """The product of two quaternions by their four parts, numbers or arrays."""
    return [
        u[0] * v[0] - u[1] * v[1] - u[2] * v[2] - u[3] * v[3],
        u[0] * v[1] + u[1] * v[0] + u[2] * v[3] - u[3] * v[2],
        u[0] * v[2] - u[1] * v[3] + u[2] * v[0] + u[3] * v[1],
        u[0] * v[3] + u[1] * v[2] - u[2] * v[1] + u[3] * v[0],
    ]


def multiply(u: jax.Array, v: jax.Array) -> jax.Array:
    """The product of two quaternions, (4,) each -> (4,)."""
    return jnp.stack(product(u, v))


def multiply_vector(q: jax.Array, v: jax.Array) -> jax.Array:
    """The product of a quaternion (4,) and a vector (3,), taken as (0, x, y, z) -> (4,)."""
    return jnp.stack(
        [
            -q[1] * v[0] - q[2] * v[1] - q[3] * v[2],
            q[0] * v[0] + q[2] * v[2] - q[3] * v[1],
            q[0] * v[1] + q[3] * v[0] - q[1] * v[2],
            q[0] * v[2] + q[1] * v[1] - q[2] * v[0],
        ]
    )


def conjugate(q: jax.Array) -> jax.Array:
    """The inverse rotation of a unit quaternion, (4,) -> (4,)."""
    return q * jnp.array([1.0, -1.0, -1.0, -1.0])


def dot(a: jax.Array, b: jax.Array) -> jax.Array:
    """Sum over the last axis of a * b, written out: three or four terms need no kernel."""
    first, *others = (a[..., i] * b[..., i] for i in range(a.shape[-1]))
    return sum(others, start=first)


def contact_frame(normal: jax.Array) -> jax.Array:
    """A right-handed frame whose rows are the unit normal and two tangents, (3,) -> (3, 3).

    The tangents are MuJoCo's (mju_makeFrame): the first lies in the plane of the normal and the
    y axis, or the z axis where the normal is near y. A zero normal gives zero tangents.
    """
    normal = _unit(normal)
    is_near_y = jnp.abs(normal[1]) >= 0.5
    axis = jnp.where(is_near_y, jnp.array([0.0, 0.0, 1.0]), jnp.array([0.0, 1.0, 0.0]))
    tangent = _unit(axis - normal * normal.dot(axis)) * jnp.any(normal)
    return jnp.stack([normal, tangent, jnp.cross(normal, tangent)])


def _unit(vector: jax.Array) -> jax.Array:
    """The vector (3,) at length 1; zero stays zero."""
    length = jnp.linalg.norm(vector)
    return vector / jnp.where(length == 0.0, 1.0, length)
