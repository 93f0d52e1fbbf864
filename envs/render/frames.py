"""Meta-World's scenes as pictures: MuJoCo's own renderer on states of either backend, headless too.

MuJoCo chooses its GL library when it is first imported, from the environment variable MUJOCO_GL.
So a command calls `choose_gl` before anything imports mujoco; a variable the user has set wins.
What draws nothing does without: `engine.py`.
"""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from envs.engine import mujoco

# Draws one picture. A context alone would not do: a display that cannot be opened has one too.
_PROBE = """
import mujoco
scene = "<mujoco><worldbody><light pos='0 0 9'/><geom size='1'/></worldbody></mujoco>"
model = mujoco.MjModel.from_xml_string(scene)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 32, 32) as renderer:
    renderer.update_scene(data)
    raise SystemExit(not renderer.render().any())
"""
_PROBE_SECONDS = 60  # a display may belong to a machine that does not answer


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
    from envs.physics.model import load_scene
    from envs.tasks import task_id
    from envs.tasks.specs import SPECS

    model = load_scene(SPECS[task_id(task)].scene)
    place(model, task, placement)
    return model


def place(model: mujoco.MjModel, task: str, placement: np.ndarray) -> None:
    """Moves fixture and goal mark of a task's scene to a `placement` (3,), metres."""
    from envs.physics.model import FIXTURE_ROOT
    from envs.tasks import task_id
    from envs.tasks.specs import SPECS

    spec = SPECS[task_id(task)]
    model.body(FIXTURE_ROOT[spec.scene]).pos = placement
    model.site("goal").pos = placement + np.array(spec.target)


def choose_gl() -> None:
    """Makes sure that MuJoCo can draw in this process; to be called before it is imported.

    Without MUJOCO_GL it is set, for this process and those it starts, to the first of egl and
    osmesa that draws, unless there is a display that does.

    Raises:
        ValueError: none draws. The message is two lines: cause, cure.
    """
    wished = os.environ.get("MUJOCO_GL", "").strip()
    names = [wished]
    if not wished and sys.platform == "linux":
        has_display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        names = ["", "egl", "osmesa"] if has_display else ["egl", "osmesa"]
    for name in names:
        if _draws(name):
            if name:
                os.environ["MUJOCO_GL"] = name
            return
    tried = f"MUJOCO_GL={wished} does not work here" if wished else "no GL library works here"
    raise _cannot_draw(tried)


def _draws(gl: str) -> bool:
    """Whether MuJoCo draws with a value of MUJOCO_GL, in a process of its own: a failure inside
    `import mujoco` or GL could not be undone."""
    command = [sys.executable, "-c", _PROBE]
    environment = os.environ | {"MUJOCO_GL": gl}
    try:
        probe = subprocess.run(
            command, env=environment, capture_output=True, check=False, timeout=_PROBE_SECONDS
        )
    except subprocess.TimeoutExpired:
        return False
    return probe.returncode == 0


def _cannot_draw(reason: str) -> ValueError:
    return ValueError(
        f"pictures need OpenGL, and {reason}\n"
        "on Debian or Ubuntu: apt-get install libegl1 libosmesa6; MUJOCO_GL=egl or "
        "MUJOCO_GL=osmesa takes one of them for certain"
    )


class Renderer:
    """Draws states of a compiled scene; a context manager, to let go of its GL context.

    Args:
        model: any MuJoCo model; its off-screen buffer is enlarged where it is too small.
        width, height: of a picture, pixels.

    Raises:
        ValueError: MuJoCo was imported without GL (two lines: cause, cure).
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int):
        from envs.engine import mujoco

        if not hasattr(mujoco, "GLContext"):
            raise _cannot_draw("MuJoCo could not load it in this process")
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
        from envs.engine import mujoco

        self._data.qpos[:] = qpos
        mujoco.mj_forward(self._model, self._data)  # pyright: ignore[reportAttributeAccessIssue]
        self._camera.lookat[:] = camera.lookat
        self._camera.distance = camera.distance
        self._camera.azimuth, self._camera.elevation = camera.azimuth, camera.elevation
        self._renderer.update_scene(self._data, self._camera)
        return self._renderer.render()
