"""MuJoCo, whatever MUJOCO_GL says: a GL library that is not here stops only what draws.

Every module of ours takes `mujoco` from here, and imports this one before metaworld, mjx or brax,
which import MuJoCo too. It loads the library that MUJOCO_GL names as part of its import, and dies
there of a name it does not know or of a library that is missing.
"""

from __future__ import annotations

import importlib
import os
import sys

WITHOUT_GL = "disable"  # a value of MUJOCO_GL


def _import_mujoco() -> None:
    wished = os.environ.get("MUJOCO_GL")
    if not wished or "mujoco" in sys.modules:
        return  # nothing to die of, or too late
    os.environ["MUJOCO_GL"] = WITHOUT_GL
    try:
        importlib.import_module("mujoco")
    finally:
        os.environ["MUJOCO_GL"] = wished  # for processes that this one starts
    load_gl()


def load_gl() -> None:
    """Gives the imported MuJoCo the library that MUJOCO_GL names, if it can be had."""
    platform = os.environ.get("PYOPENGL_PLATFORM")
    try:
        context = importlib.reload(sys.modules["mujoco.rendering.classic.gl_context"])
        vars(sys.modules["mujoco"])["GLContext"] = context.GLContext
    except Exception:  # of any kind: it comes out of PyOpenGL and of ctypes
        # Set by MuJoCo on its way to the library; it would mislead a process started with another.
        os.environ.pop("PYOPENGL_PLATFORM", None)
        if platform is not None:
            os.environ["PYOPENGL_PLATFORM"] = platform


_import_mujoco()
import mujoco  # noqa: E402

__all__ = ["load_gl", "mujoco"]
