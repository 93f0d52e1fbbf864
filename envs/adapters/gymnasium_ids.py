"""The ids by which Gymnasium knows the tasks: `cmrl_jax/window-open-v0` and so on.

Gymnasium from 1.0 on looks for no plugins: who makes an environment imports the package that
registers it, or names it in the id, as in `gymnasium.make("cmrl_jax:cmrl_jax/window-open-v0")`.
"""

from __future__ import annotations

import gymnasium

from envs.tasks import TASKS

NAMESPACE, VERSION = "cmrl_jax", 0
_HOME = "envs.adapters.gymnasium_envs"  # imported when an environment is made


def env_id(task: str) -> str:
    """Gymnasium's id of a task."""
    return f"{NAMESPACE}/{task}-v{VERSION}"


def register() -> None:
    """Makes the ids known to Gymnasium."""
    for task in TASKS:
        if env_id(task) not in gymnasium.registry:
            gymnasium.register(
                id=env_id(task),
                entry_point=f"{_HOME}:TaskEnv",
                vector_entry_point=f"{_HOME}:TaskVectorEnv",
                # No `max_episode_steps`: its wrapper would count beside the `horizon` asked for.
                kwargs={"task": task},
            )
