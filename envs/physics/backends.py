"""The physics backends by name; each is imported when it is asked for."""

from __future__ import annotations

from envs.physics.base import Physics

BACKENDS = ("mjx", "native")


def make_physics(name: str) -> Physics:
    """The backend of a name in `BACKENDS`.

    Raises:
        ValueError: unknown name.
    """
    if name == "mjx":
        from envs.physics.mjx.backend import MjxPhysics

        return MjxPhysics()
    if name == "native":
        from envs.physics.native import NativePhysics

        return NativePhysics()
    raise ValueError(f"unknown physics backend '{name}'\nvalid: {', '.join(BACKENDS)}")
