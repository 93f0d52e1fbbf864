"""MJX, without the message it prints when warp is not installed. Import it before brax does."""

import contextlib
import io

import envs.engine  # noqa: F401  # MuJoCo before mjx imports it

with contextlib.redirect_stdout(io.StringIO()):
    import mujoco.mjx as mjx

__all__ = ["mjx"]
