"""The ids by which Gymnasium knows the tasks: `cmrl_jax/window-open-v0` and so on.

Gymnasium from 1.0 on looks for no plugins: who makes an environment imports the package that
registers it, before or after `import gymnasium`, or names it in the id, as in
`gymnasium.make("cmrl_jax:cmrl_jax/window-open-v0")`. Importing ours is to stay light, so that a
command line answers at once; gymnasium is not, as it brings numpy.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import sys
from collections.abc import Sequence
from types import ModuleType

from envs.tasks import TASKS

NAMESPACE, VERSION = "cmrl_jax", 0
_HOME = "envs.adapters.gymnasium_envs"


def env_id(task: str) -> str:
    """Gymnasium's id of a task."""
    return f"{NAMESPACE}/{task}-v{VERSION}"


def register_when_imported() -> None:
    """Makes the ids known to Gymnasium: now if it is imported, else as soon as it is."""
    if "gymnasium" in sys.modules:
        _register()
    elif not any(isinstance(finder, _AfterGymnasium) for finder in sys.meta_path):
        sys.meta_path.insert(0, _AfterGymnasium())


def _register() -> None:
    import gymnasium

    for task in TASKS:
        if env_id(task) not in gymnasium.registry:
            gymnasium.register(
                id=env_id(task),
                entry_point=f"{_HOME}:TaskEnv",
                vector_entry_point=f"{_HOME}:TaskVectorEnv",
                # No `max_episode_steps`: its wrapper would count beside the `horizon` asked for.
                kwargs={"task": task},
            )


class _AfterGymnasium(importlib.abc.MetaPathFinder):
    """Finds gymnasium where others find it, and has the ids registered once it has run."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname != "gymnasium":
            return None
        others = (finder for finder in sys.meta_path if finder is not self)
        found = (finder.find_spec(fullname, path, target) for finder in others)
        spec = next(filter(None, found), None)
        if spec is not None and spec.loader is not None:
            # Who only asks where gymnasium is gets this too: nothing is done before it runs.
            spec.loader = _ThenRegister(spec.loader)
        return spec


class _ThenRegister(importlib.abc.Loader):
    """Runs a module as its own loader does, then registers the ids."""

    def __init__(self, loader: importlib.abc.Loader):
        self._loader = loader

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        # Its data and its source are found through its own loader.
        module.__loader__ = self._loader
        if module.__spec__ is not None:
            module.__spec__.loader = self._loader
        self._loader.exec_module(module)
        _register()
        sys.meta_path[:] = [f for f in sys.meta_path if not isinstance(f, _AfterGymnasium)]
