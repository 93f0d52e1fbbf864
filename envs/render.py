"""Meta-World's scenes as pictures: MuJoCo's own renderer on states of either backend, headless too.

MuJoCo chooses its GL library when it is first imported, from the environment variable MUJOCO_GL.
So a command calls `choose_gl` before anything imports mujoco; a variable the user has set wins.
"""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import mujoco

_PROBE = "import mujoco; c = mujoco.GLContext(8, 8); c.make_current(); c.free()"


class Camera(NamedTuple):
    """A free camera: what it looks at (metres, world), from how far, and from where (degrees)."""

    lookat: tuple[float, float, float]
    distance: float
    azimuth: float
    elevation: float


# Fixture, hand and forearm in sight, the handle not behind them. `lookat` is from the placement.
_CAMERAS = {
    "drawer-open": Camera((-0.05, -0.31, 0.16), 0.92, 140.0, -22.0),
    "drawer-close": Camera((-0.05, -0.31, 0.16), 0.92, 140.0, -22.0),
    "window-open": Camera((-0.03, -0.2, 0.06), 0.92, 145.0, -20.0),
    "window-close": Camera((0.03, -0.2, 0.06), 0.92, 20.0, -16.0),
}


def camera_of(task: str, placement: np.ndarray) -> Camera:
    """The camera for a task with its fixture at `placement` (3,), metres."""
    camera = _CAMERAS[task]
    x, y, z = (float(a + b) for a, b in zip(camera.lookat, placement, strict=True))
    return camera._replace(lookat=(x, y, z))


def metaworld_scene(task: str, placement: np.ndarray) -> mujoco.MjModel:
    """Meta-World's scene of a task with fixture and goal mark where its reset puts them."""
    from envs.model import FIXTURE_ROOT, load_scene
    from envs.tasks import SPECS, task_id

    spec = SPECS[task_id(task)]
    model = load_scene(spec.scene)
    model.body(FIXTURE_ROOT[spec.scene]).pos = placement
    model.site("goal").pos = placement + np.array(spec.target)
    return model


def choose_gl() -> None:
    """Makes sure that MuJoCo can draw in this process; to be called before it is imported.

    Without MUJOCO_GL and without a display it is set to the first of egl and osmesa that works,
    for this process and those it starts. Each is tried in a process of its own, since a failure
    inside `import mujoco` could not be undone.

    Raises:
        ValueError: none works. The message is two lines: cause, cure.
    """
    wished = os.environ.get("MUJOCO_GL", "")
    names = [wished]
    if not wished and sys.platform == "linux":
        has_display = "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
        names = [""] * has_display + ["egl", "osmesa"]
    for name in names:
        environment = os.environ | {"MUJOCO_GL": name} if name else None
        probe = subprocess.run(
            [sys.executable, "-c", _PROBE], env=environment, capture_output=True, check=False
        )
        if probe.returncode == 0:
            if name:
                os.environ["MUJOCO_GL"] = name
            return
    tried = f"MUJOCO_GL={wished} does not work here" if wished else "no GL library works here"
    raise ValueError(
        f"pictures need OpenGL, and {tried}\n"
        "on Debian or Ubuntu: apt-get install libegl1 libosmesa6; MUJOCO_GL=egl or "
        "MUJOCO_GL=osmesa takes one of them for certain"
    )


class Renderer:
    """Draws states of a compiled scene; a context manager, to let go of its GL context.

    Args:
        model: any MuJoCo model; its off-screen buffer is enlarged where it is too small.
        width, height: of a picture, pixels.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int):
        import mujoco

        buffer = model.vis.global_
        buffer.offwidth, buffer.offheight = (
            max(buffer.offwidth, width),
            max(buffer.offheight, height),
        )
        self._model, self._data = model, mujoco.MjData(model)
        self._renderer = mujoco.Renderer(model, height, width)
        self._camera = mujoco.MjvCamera()

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Lets go of the GL context."""
        self._renderer.close()

    def draw(self, qpos: np.ndarray, camera: Camera) -> np.ndarray:
        """A picture (height, width, 3) uint8 of a state qpos (nq,) as the camera sees it."""
        import mujoco

        self._data.qpos[:] = qpos
        mujoco.mj_forward(self._model, self._data)  # pyright: ignore[reportAttributeAccessIssue]
        self._camera.lookat[:] = camera.lookat
        self._camera.distance = camera.distance
        self._camera.azimuth, self._camera.elevation = camera.azimuth, camera.elevation
        self._renderer.update_scene(self._data, self._camera)
        return self._renderer.render()
