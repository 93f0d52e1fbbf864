"""Scoring one policy: what was measured, as a table, as rows, as JSON."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cmrl_jax.config.schema import Config, call_envs
from cmrl_jax.evaluation.cells import Row
from cmrl_jax.evaluation.options import EvalOptions, evaluated_tasks, ks_of
from cmrl_jax.evaluation.scores import cell_rows, format_scores, of_policy, summarise
from cmrl_jax.evaluation.session import Policy, Session
from cmrl_jax.evaluation.settings import describe, result_fields, row_columns
from cmrl_jax.evaluation.trials import eval_lanes, trial_of
from envs.outputs import write_json


@dataclass(frozen=True)
class Evaluation:
    """What one policy scored.

    Attributes:
        tasks: {task: {k: figures}}, see `scores.summarise`.
        facts: the settings it was taken with, the policy's origin, versions.
        cells: one row of text a task, goal, draw and k, with the columns of a sweep's CSV.
        setting: the settings in words.
    """

    tasks: dict[str, Any]
    facts: dict[str, Any]
    cells: list[Row]
    setting: str

    def table(self) -> str:
        """Success with its 95 % interval, and return, of every task and k."""
        return format_scores(self.tasks)

    def rows(self) -> list[dict[str, Any]]:
        """One flat row a task and k: `task`, `k`, the means over goals, `<figure>_low`, `_high`."""
        rows = []
        for task, by_k in self.tasks.items():
            for k, figures in by_k.items():
                row: dict[str, Any] = {"task": task, "k": int(k)}
                row |= {name: value for name, value in figures.items() if name != "interval_95"}
                for name, (low, high) in figures["interval_95"].items():
                    row |= {f"{name}_low": low, f"{name}_high": high}
                rows.append(row)
        return rows

    def to_json(self, path: str | Path) -> None:
        """Writes what `eval --json` writes, whole or not at all.

        Raises:
            ConfigError: the file cannot be written.
        """
        call_envs(lambda: write_json(Path(path), "eval", self.as_json()))

    def as_json(self) -> dict[str, Any]:
        """Plain data: the figures by task and k, and the facts."""
        return {"tasks": self.tasks} | self.facts


def score(run: Path, session: Session, policy: Policy, options: EvalOptions) -> Evaluation:
    """Scores a policy in one of our own backends.

    Args:
        run: the policy's run directory, which the record names.
        session: of the configuration to evaluate in (`trials.evaluation_config`).

    Raises:
        ConfigError: a sentence that cannot be had, or a goal set that cannot be read.
    """
    config: Config = session.config
    tasks = evaluated_tasks(options, config)
    trial = trial_of([policy], session, options, tasks)
    unit = config.eval.goals * len(session.eval_tasks)
    lanes = eval_lanes(options, len(tasks), unit)
    evaluator = session.evaluator(lanes, options.horizon, adapt=options.adapt)
    k = ks_of(options, config)
    scores = of_policy(evaluator.run([policy.params], trial, k, options.seed), 0)
    return Evaluation(
        tasks=summarise(scores, tasks),
        facts=result_fields(run, policy.meta, options, config),
        cells=cell_rows(scores, tasks, row_columns(run, policy.meta, options, config)),
        setting=describe(options, config),
    )
