"""Which tasks there are: the registry, light enough for a configuration to read.

A task is one line here, and its numbers and reward in the file of its object (`drawer.py`,
`window.py`). Its place in the registry is its id, by which lanes' noise is named: new tasks go to
the end.
"""

from __future__ import annotations

from typing import NamedTuple

from envs.command_line import suggest


class Entry(NamedTuple):
    """Where a task is described.

    Attributes:
        module: its `TASKS` has the task's `Task` under the task's name.
        other: the task whose sentence `--text-control shuffled` gives in place of this one's.
        is_metaworlds: whether Meta-World has a task of this name, whose task maker then draws the
            goals; else they are drawn from the reset box.
    """

    module: str
    other: str
    is_metaworlds: bool = True


REGISTRY = {
    "drawer-open": Entry("envs.tasks.drawer", other="drawer-close"),
    "drawer-close": Entry("envs.tasks.drawer", other="window-open"),
    "window-open": Entry("envs.tasks.window", other="window-close"),
    "window-close": Entry("envs.tasks.window", other="drawer-open"),
}
TASKS = tuple(REGISTRY)
METAWORLD_TASKS = tuple(name for name, entry in REGISTRY.items() if entry.is_metaworlds)


def task_id(name: str) -> int:
    """Index of a task in `TASKS`.

    Raises:
        ValueError: unknown name; the message lists the valid ones.
    """
    if name not in TASKS:
        valid = f"valid: {', '.join(TASKS)}"
        raise ValueError(f"unknown task '{name}'\n{suggest(name, TASKS)}{valid}")
    return TASKS.index(name)
