"""Meta-World's own Gymnasium environments, placed at goals of our named sets.

They are made the way Meta-World makes the test environments of its benchmarks, from a benchmark
whose test set is one class: classes of one call would share a random stream.
"""

from __future__ import annotations

import pickle
from collections import OrderedDict
from typing import Any

import envs.engine  # noqa: F401  # isort: skip, metaworld imports MuJoCo
import metaworld
import numpy as np
from gymnasium.vector import SyncVectorEnv
from metaworld.env_dict import ALL_V3_ENVIRONMENTS, ML1_args_kwargs
from metaworld.types import Task

MAX_HORIZON = 500
"""Control steps after which Meta-World itself ends an episode."""


def metaworld_name(task: str) -> str:
    """Meta-World's name of one of `envs.tasks.TASKS`."""
    return f"{task}-v3"


def make_task(task: str, placement: np.ndarray, goal_observable: bool = False) -> Task:
    """Meta-World's record of a task with the fixture at `placement` (3,), metres."""
    name = metaworld_name(task)
    data: dict[str, Any] = dict(ML1_args_kwargs[name]["kwargs"])
    del data["task_id"]
    data["rand_vec"] = np.array(placement, np.float64)
    data["env_cls"] = ALL_V3_ENVIRONMENTS[name]
    data["partially_observable"] = not goal_observable
    return Task(env_name=name, data=pickle.dumps(data))


class OneClass(metaworld.Benchmark):
    """A benchmark whose test set is one task, at goals of our choice."""

    def __init__(self, task: str, placements: np.ndarray, goal_observable: bool):
        super().__init__()
        name = metaworld_name(task)
        self._train_classes, self._train_tasks = OrderedDict(), []
        self._test_classes = OrderedDict({name: ALL_V3_ENVIRONMENTS[name]})
        self._test_tasks = [make_task(task, place, goal_observable) for place in placements]


def make_vector_env(
    task: str,
    placements: np.ndarray,
    environments: int,
    horizon: int,
    goal_observable: bool = False,
    seed: int = 0,
    with_last_step: bool = False,
) -> SyncVectorEnv:
    """Environments that share a task's goals evenly, with Meta-World's wrappers of a test set.

    An episode that ends is started anew within the same step; `sample_tasks` moves each environment
    to the next of its goals, in shuffled order.

    Args:
        placements: goals (goal, 3), as many as a multiple of `environments`.
        horizon: control steps of an episode, at most `MAX_HORIZON`.
        with_last_step: whether observations go on with the last action (4,), the last reward and
            whether it ended an episode, as Meta-World shows them to recurrent agents.
    """
    return metaworld._make_ml_envs_inner(  # pyright: ignore[reportReturnType]
        OneClass(task, placements, goal_observable),
        meta_batch_size=environments,
        seed=seed,
        split="test",
        task_select="pseudorandom",
        terminate_on_success=True,
        max_episode_steps=horizon,
        recurrent_info_in_obs=with_last_step,
        normalize_reward_in_recurrent_info=False,
    )


def set_goals(
    envs: SyncVectorEnv, task: str, placements: np.ndarray, goal_observable: bool
) -> None:
    """Gives each environment one goal of `placements` (environment, 3) and moves it there."""
    envs.set_attr("tasks", [[make_task(task, place, goal_observable)] for place in placements])
    envs.call("sample_tasks")
