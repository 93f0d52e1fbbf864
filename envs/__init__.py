"""Meta-World's ML4 tasks on MJX.

`make("drawer-open")` is one task behind brax's interface, `Ml4Env` all four for vmapped lanes.
Names are imported on first use, so that light modules (goal sets, command lines) stay light.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from envs.adapters.brax_view import SingleTaskEnv
    from envs.sawyer import Ml4Env, State
    from envs.tasks import TASKS

__all__ = ["TASKS", "Ml4Env", "State", "make"]

_HOME = {"TASKS": "envs.tasks", "Ml4Env": "envs.sawyer", "State": "envs.sawyer"}


def make(
    task: str, horizon: int = 200, goal_observable: bool = False, auto_reset: bool = True
) -> SingleTaskEnv:
    """One task as a brax environment; see `SingleTaskEnv` for the arguments.

    Raises:
        ValueError: unknown task, or a horizon below one step.
    """
    from envs.adapters.brax_view import SingleTaskEnv

    return SingleTaskEnv(task, horizon, goal_observable, auto_reset)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'envs' has no attribute '{name}'")
    return getattr(importlib.import_module(_HOME[name]), name)
