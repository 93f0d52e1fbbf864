"""What an evaluation was taken with: as CSV columns, as JSON fields, in words."""

from __future__ import annotations

from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from cmrl_jax.config.schema import Config
from cmrl_jax.evaluation.cells import RENAMED, UNNAMED
from cmrl_jax.evaluation.options import DONATED, EvalOptions, evaluated_tasks
from cmrl_jax.registry import other_task, task_names
from cmrl_jax.storage.checkpoint import policy_digest
from cmrl_jax.storage.versions import package_versions
from cmrl_jax.text.goals import load_goals


def horizon_of(options: EvalOptions, config: Config) -> int:
    """Control steps of an episode."""
    return options.horizon or config.env.horizon


def donors_of(options: EvalOptions, config: Config) -> str | None:
    """What decides from which lane another's z comes, None where no lane has another's."""
    if options.z not in DONATED:
        return None
    tasks = sorted(evaluated_tasks(options, config), key=task_names().index)
    return f"{'+'.join(tasks)} x {options.goals} goals x {options.draws} draws"


def sentences_of(options: EvalOptions, config: Config) -> str | None:
    """What decides which vectors sentences have: the encoder of `text`, or a table by its digest.

    None where no sentence comes from either: they are those in the checkpoint, or zero.
    """
    if options.text is not None:
        return config.goals.table  # `embed` refuses another encoder's weights
    tasks = evaluated_tasks(options, config)
    if options.text_control == "shuffled":
        tasks = tuple(other_task(task) for task in tasks)
    known = set(tasks) <= set(config.tasks.train + config.tasks.test)
    if options.text_control == "zero" or (known and options.paraphrases == "train"):
        return None
    return load_goals(config.goals.table, tasks).sha256[:12]


def settings(options: EvalOptions, config: Config) -> dict[str, Any]:
    """The columns `cells.SETTINGS`: what a figure was taken with, the checkpoint apart."""
    given = {
        RENAMED.get(f.name, f.name): getattr(options, f.name)
        for f in fields(options)
        if f.name not in UNNAMED
    }
    return given | {
        "physics": options.physics or config.env.physics,
        "horizon": horizon_of(options, config),
        "donors": donors_of(options, config),
        "sentences": sentences_of(options, config),
    }


def cell_columns(run: Path, checkpoint: int) -> dict[str, Any]:
    """The columns that name a checkpoint: another one in its place is not it."""
    digest = policy_digest(run, checkpoint)
    return {"run": run.as_posix(), "checkpoint": checkpoint, "policy_sha256": digest}


def row_columns(
    run: Path, meta: dict[str, Any], options: EvalOptions, config: Config
) -> dict[str, Any]:
    """The columns that all CSV rows of a checkpoint share."""
    facts = {"config": config.name, "train_seed": config.seed, "env_steps": meta["env_steps"]}
    return cell_columns(run, meta["iteration"]) | facts | settings(options, config)


def result_fields(
    run: Path, meta: dict[str, Any], options: EvalOptions, config: Config
) -> dict[str, Any]:
    """What stands beside the figures in an evaluation's JSON."""
    fields = settings(options, config)
    return {
        "goals": options.goals,
        "draws": options.draws,
        "seed": fields.pop("eval_seed"),
        **fields,
        "run": run.as_posix(),
        "iteration": meta["iteration"],
        "env_steps": meta["env_steps"],
        "train_tasks": list(config.tasks.train),
        "test_tasks": list(config.tasks.test),
        "config": config.name,
        "train_seed": config.seed,
        "versions": package_versions(),
    }


def describe(options: EvalOptions, config: Config) -> str:
    """The settings of an evaluation in words; those that are the protocol's are left out."""
    where = f"{options.goals} goals of '{options.goal_set}', horizon {horizon_of(options, config)}"
    words = [where, f"seed {options.seed}", options.physics or config.env.physics]
    usual = asdict(EvalOptions())
    for name in (
        "draws",
        "policy",
        "adapt",
        "protocol",
        "z",
        "paraphrases",
        "text_control",
        "text",
    ):
        if (value := getattr(options, name)) != usual[name]:
            words.append(f"{name.replace('_', ' ')} {value}")
    return ", ".join(words)
