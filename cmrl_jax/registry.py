"""The environments and the algorithms that a configuration can name, without importing any.

An entry says where to find what builds it, so that a typo is reported before jax is imported.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from envs.command_line import suggest
from envs.tasks import REGISTRY


@dataclass(frozen=True)
class Environment:
    """An entry of `env.name`.

    Attributes:
        tasks: task names in the order of their ids, each with the task whose sentence
            `--text-control shuffled` gives in its place.
        make: the `env` section of a configuration -> `envs.base.MetaEnv`; a function, or where to
            find it as "module:function".
    """

    tasks: Mapping[str, str]
    make: str | Callable[[Any], Any]


@dataclass(frozen=True)
class AlgorithmEntry:
    """An entry of `algorithm`.

    Attributes:
        make: (Config, MetaEnv, text vectors (training task, paraphrase, G)) ->
            `algorithms.base.Algorithm`; a function, or where to find it as "module:function".
        rules: its `algorithms.rules.AlgorithmRules`, a class, or where to find it.
    """

    make: str | Callable[..., Any]
    rules: Any


ENVIRONMENTS: dict[str, Environment] = {
    "ml4": Environment({name: task.other for name, task in REGISTRY.items()}, "envs.sawyer:ml4"),
}
ALGORITHMS: dict[str, AlgorithmEntry] = {
    "cmrl": AlgorithmEntry(
        "cmrl_jax.algorithms.cmrl.algorithm:make", "cmrl_jax.algorithms.cmrl.rules:Rules"
    ),
    "rl2": AlgorithmEntry(
        "cmrl_jax.algorithms.rl2.algorithm:make", "cmrl_jax.algorithms.rl2.rules:Rules"
    ),
    "maml": AlgorithmEntry(
        "cmrl_jax.algorithms.maml.algorithm:make", "cmrl_jax.algorithms.maml.rules:Rules"
    ),
}


ENVIRONMENT_PARTS = (
    "observation_size",
    "action_size",
    "goal_size",
    "tasks",
    "can_terminate",
    "symmetries",
    "reaches",
    "reset",
    "reset_to",
    "step",
    "goals",
)
"""The attributes of `envs.base.MetaEnv`, which this module does not import."""


def register_environment(
    name: str, tasks: Mapping[str, str], make: str | Callable[[Any], Any]
) -> None:
    """Makes `env.name: NAME` known to this process.

    Args:
        tasks: see `Environment`.
        make: see `Environment`.

    Raises:
        ValueError: the name is taken, or one of its tasks is another environment's.
    """
    if name in ENVIRONMENTS:
        raise ValueError(f"environment '{name}' is registered\ngive yours another name")
    for task, other in tasks.items():
        if task in task_names():
            owner = environment_of(task)
            raise ValueError(f"task '{task}' is one of '{owner}'\ngive yours another name")
        if other not in tasks:
            raise ValueError(f"'{other}' is no task of '{name}'\nname one of {', '.join(tasks)}")
    ENVIRONMENTS[name] = Environment(dict(tasks), make)


def register_algorithm(name: str, make: str | Callable[..., Any], rules: Any) -> None:
    """Makes `algorithm: NAME` known to this process.

    Args:
        make: see `AlgorithmEntry`.
        rules: see `AlgorithmEntry`.

    Raises:
        ValueError: the name is taken.
    """
    if name in ALGORITHMS:
        raise ValueError(f"algorithm '{name}' is registered\ngive yours another name")
    ALGORITHMS[name] = AlgorithmEntry(make, rules)


def environment(name: str) -> Environment:
    """The entry of an environment.

    Raises:
        ValueError: unknown (two lines: cause, cure).
    """
    return _found(ENVIRONMENTS, name, "environment")


def algorithm(name: str) -> AlgorithmEntry:
    """The entry of an algorithm.

    Raises:
        ValueError: unknown (two lines: cause, cure).
    """
    return _found(ALGORITHMS, name, "algorithm")


def make_environment(options: Any) -> Any:
    """Builds what the `env` section of a configuration names: a `MetaEnv`.

    Raises:
        ValueError: what was built lacks a part of one (two lines: cause, cure).
    """
    env = _loaded(environment(options.name).make)(options)
    if missing := [part for part in ENVIRONMENT_PARTS if not hasattr(env, part)]:
        cause = f"environment '{options.name}' ({type(env).__name__}) has no {missing[0]}"
        raise ValueError(f"{cause}\ngive it all that envs.base.MetaEnv lists")
    return env


def make_algorithm(config: Any, env: Any, goal_vectors: Any) -> Any:
    """Builds what a configuration names: an `Algorithm`."""
    return _loaded(algorithm(config.algorithm).make)(config, env, goal_vectors)


def rules_of(config: Any) -> Any:
    """The `AlgorithmRules` of a configuration.

    Raises:
        ValueError: unknown algorithm (two lines: cause, cure).
    """
    return _loaded(algorithm(config.algorithm).rules)(config)


def task_names() -> tuple[str, ...]:
    """Every task of every environment."""
    return tuple(task for entry in ENVIRONMENTS.values() for task in entry.tasks)


def environment_of(task: str) -> str:
    """The name of the environment that a task belongs to.

    Raises:
        ValueError: unknown task (two lines: cause, cure).
    """
    _found(dict.fromkeys(task_names()), task, "task")
    [name] = [name for name, entry in ENVIRONMENTS.items() if task in entry.tasks]
    return name


def tasks_beside(task: str) -> tuple[str, ...]:
    """All tasks of the environment that a task belongs to, itself among them."""
    return tuple(ENVIRONMENTS[environment_of(task)].tasks)


def other_task(task: str) -> str:
    """The task whose sentence `--text-control shuffled` gives in place of this one's."""
    return ENVIRONMENTS[environment_of(task)].tasks[task]


def _found(entries: Mapping[str, Any], name: str, kind: str) -> Any:
    if name not in entries:
        valid = f"valid: {', '.join(entries)}"
        if kind != "task":
            valid += "; one of your own is known once it is registered in this process"
        raise ValueError(f"unknown {kind} '{name}'\n{suggest(name, entries)}{valid}")
    return entries[name]


def _loaded(place: Any) -> Any:
    if not isinstance(place, str):
        return place
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)
