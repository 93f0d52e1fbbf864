"""Pictures of a running episode in Meta-World's scene, for environments that are asked for them."""

from __future__ import annotations

import functools
import weakref

import numpy as np

from envs.engine import load_gl
from envs.render.frames import Renderer, camera_of, choose_gl, metaworld_scene, place

SIZE = 480  # pixels, as Meta-World's own


_choose_gl = functools.cache(choose_gl)  # it asks a process of its own, once for all environments


class LivePictures:
    """Draws states of one task, whatever the goal.

    Raises:
        ValueError: nothing draws on this machine (two lines: cause, cure).
    """

    def __init__(self, task: str):
        # MuJoCo has been imported by now, maybe before anybody asked for pictures.
        _choose_gl()
        load_gl()
        self._task = task
        self._model = metaworld_scene(task, np.zeros(3))
        self._renderer = Renderer(self._model, SIZE, SIZE)
        # Also at the interpreter's end, while what it needs is still there.
        self._finalizer = weakref.finalize(self, self._renderer.close)

    def draw(self, qpos: np.ndarray, placement: np.ndarray) -> np.ndarray:
        """A picture (480, 480, 3) uint8 of a state qpos (10,), the fixture at `placement` (3,)."""
        place(self._model, self._task, placement)
        return self._renderer.draw(qpos, camera_of(self._task, placement))

    def close(self) -> None:
        """Lets go of the GL context."""
        self._finalizer()
