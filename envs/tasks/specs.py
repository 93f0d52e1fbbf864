"""The registered tasks, read: `SPECS[i]` is the `Task` of `TASKS[i]`."""

from __future__ import annotations

import importlib

import numpy as np

from envs.physics.model import SCENES
from envs.tasks import REGISTRY
from envs.tasks.base import Task

SPECS: tuple[Task, ...] = tuple(
    importlib.import_module(entry.module).TASKS[name] for name, entry in REGISTRY.items()
)
SCENE_ID = np.array([list(SCENES).index(spec.scene) for spec in SPECS], np.int32)
