"""What a sweep scores: checkpoints, the program each needs, and the cells that are missing."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from cmrl_jax.config.schema import Config, ConfigError, leaves
from cmrl_jax.evaluation.cells import CellTable
from cmrl_jax.evaluation.options import DONATED, EvalOptions, evaluated_tasks, ks_of
from cmrl_jax.evaluation.session import Policy, Session, load_policy
from cmrl_jax.evaluation.settings import cell_columns, settings
from cmrl_jax.evaluation.trials import evaluation_config
from cmrl_jax.registry import rules_of, task_names
from cmrl_jax.storage.checkpoint import policy_store


@dataclass(frozen=True)
class Target:
    """One checkpoint to score."""

    run: Path
    checkpoint: int
    config: Config
    k: tuple[int, ...]
    tasks: tuple[str, ...]


def targets_of(
    run: Path, checkpoints: tuple[int, ...] | Literal["all", "last"], options: EvalOptions
) -> list[Target]:
    """The chosen checkpoints of a run.

    Raises:
        ConfigError: it has none, or not those.
    """
    if options.physics == "metaworld":
        raise ValueError("a sweep runs on mjx or native")
    config = evaluation_config(run, options.physics)
    with policy_store(run, read_only=True) as store:
        steps = store.steps()
    if not steps:
        raise ConfigError(f"no policy checkpoint in {run}", "leave the run out of --runs")
    if isinstance(checkpoints, tuple):
        if missing := [step for step in checkpoints if step not in steps]:
            there = ", ".join(map(str, steps))
            raise ConfigError(f"{run} has no checkpoint {missing[0]}", f"there are: {there}")
        steps = list(checkpoints)
    elif checkpoints == "last":
        steps = steps[-1:]
    k = ks_of(options, config)
    tasks = sorted(evaluated_tasks(options, config), key=task_names().index)
    return [Target(run, step, config, k, tuple(tasks)) for step in steps]


def program_key(target: Target, adapt: str = "posterior") -> str:
    """Targets of one key are scored by one compiled program, and adapt equally often.

    The key is the whole configuration less what is known not to act, so that a key of the schema
    which nobody thought of here costs a compile, and never scores a policy as another's.
    """
    config = target.config
    rules = rules_of(config)
    idle = (*IDLE, *rules.IDLE)
    acting = [(name, value) for name, _, value in leaves(config) if not _is_idle(name, idle)]
    if rules.is_told_the_task:
        told = config.tasks.train
    else:  # a search has arms for each training task
        told = 0 if adapt == "posterior" else len(config.tasks.train)
    return repr((acting, told, target.k))


IDLE = (
    "name",
    "seed",
    "tasks.",  # told to a policy by `program_key`, where it is told them at all
    "env.variation",  # an evaluation names its placements
    "train.",
    "eval.",  # an evaluation has options of its own; k is part of the key
    "checkpoint.",
    "log.",
    "runtime.compile_cache",
)
"""Keys, and with a dot whole sections, that training reads and a policy that acts does not; an
algorithm's own are in its rules."""


def _is_idle(name: str, idle: tuple[str, ...]) -> bool:
    return name in idle or any(name.startswith(x) for x in idle if x.endswith("."))


def cells_per_task(target: Target, options: EvalOptions) -> int:
    return options.goals * options.draws * len(target.k)


def pending_tasks(target: Target, options: EvalOptions, table: CellTable) -> tuple[str, ...]:
    """The tasks of a target with a cell that is not in the table.

    Where a lane's z is another lane's, an evaluation is whole or it is another evaluation.
    """
    common = columns_of(target, options)

    def is_done(task: str) -> bool:
        cells = itertools.product(range(options.goals), range(options.draws), target.k)
        return all(
            table.holds(common | {"task": task, "goal": goal, "draw": draw, "k": k})
            for goal, draw, k in cells
        )

    pending = tuple(task for task in target.tasks if not is_done(task))
    return target.tasks if pending and options.z in DONATED else pending


def columns_of(target: Target, options: EvalOptions) -> dict[str, Any]:
    """The columns that name a target's cells."""
    cell = cell_columns(target.run, target.checkpoint)
    return cell | settings(options, target.config)


def load_target(target: Target, session: Session) -> Policy:
    """The policy of a target, read with the session of its program."""
    tasks = target.config.tasks.train + target.config.tasks.test
    return load_policy(target.run, session, target.checkpoint, tasks)
