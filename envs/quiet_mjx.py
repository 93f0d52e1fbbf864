"""MJX, without the message it prints when warp is not installed. Import it before brax does."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    import mujoco.mjx as mjx

__all__ = ["mjx"]
