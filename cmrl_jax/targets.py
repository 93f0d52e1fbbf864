"""What a sweep scores: checkpoints, the program each needs, and the cells that are missing."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from cmrl_jax.checkpoint import policy_store
from cmrl_jax.config import TASKS, Config, ConfigError
from cmrl_jax.evaluate_flags import DONATED, EvalOptions, evaluated_tasks
from cmrl_jax.scores import ScoreCsv
from cmrl_jax.session import Policy, Session, load_policy
from cmrl_jax.settings import cell_columns, settings
from cmrl_jax.trials import evaluation_config


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
    k = options.k if options.k is not None else config.eval.final_k
    tasks = sorted(evaluated_tasks(options, config), key=TASKS.index)
    return [Target(run, step, config, k, tuple(tasks)) for step in steps]


def program_key(target: Target) -> str:
    """Targets of one key are scored by one compiled program, and adapt equally often."""
    config = target.config
    told = config.tasks.train if config.model.conditioning == "task_id" else ()
    env = (config.env.physics, config.env.impl, config.env.horizon, config.env.goal_observable)
    parts = (env, config.env.obs_mode, config.model, config.encoder, config.goals, told)
    return repr((*parts, config.sac.normalize_obs, config.collect.chunk, target.k))


def cells_per_task(target: Target, options: EvalOptions) -> int:
    return options.goals * options.draws * len(target.k)


def pending_tasks(target: Target, options: EvalOptions, table: ScoreCsv) -> tuple[str, ...]:
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
