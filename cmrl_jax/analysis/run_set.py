"""Runs as figures see them: their rows, configurations and final evaluations, by group.

Runs that are seeds of one (run_groups.py) are one group: the interquartile mean of its seeds, and a
band of its 95 % bootstrap interval over them (evaluation/statistics.py).
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from cmrl_jax.config.files import run_config
from cmrl_jax.config.schema import Config, ConfigError
from cmrl_jax.evaluation.statistics import seeds_band
from cmrl_jax.storage.run_files import (
    EVALUATION,
    Curve,
    Evaluation,
    Row,
    find_evaluation,
    read_metrics,
)
from cmrl_jax.storage.run_groups import group_runs, settings_of

Series = list[tuple[float, float]]


def series(rows: Sequence[Row], column: str) -> Series:
    """(env steps, figure) wherever the column was filled."""
    return [(row["env_steps"], row[column]) for row in rows if column in row]


def band(curves: Sequence[Series]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Env steps where all curves have a figure; IQM and 95 % interval over them, (point,) each.

    A curve has one between its first point and its last, read linearly between two. The points are
    those of all curves; none where curves do not overlap.
    """
    points = [np.array(curve) for curve in curves]
    first, last = max(p[0, 0] for p in points), min(p[-1, 0] for p in points)
    steps = np.unique(np.concatenate([p[:, 0] for p in points]))
    steps = steps[(first <= steps) & (steps <= last)]
    values = np.array([np.interp(steps, *p.T) for p in points])
    return steps, *seeds_band(values)


def final_evaluation(run: Path, rows: Sequence[Row]) -> Evaluation | None:
    """A run's evaluation of where its rows end; one from before it went on is left out, and said.

    Raises:
        ConfigError: the file is damaged.
    """
    found = find_evaluation(run)
    taken = found and found.facts.get("iteration")
    if taken is None or "iteration" not in rows[-1] or taken == rows[-1]["iteration"] + 1:
        return found
    ends = f"the run stands at {rows[-1]['iteration'] + 1:.0f}"
    print(f"{run / EVALUATION} is of iteration {taken} and left out: {ends}", file=sys.stderr)
    return None


class Runs:
    """The runs of a figure: their rows, configurations and evaluations, by group.

    Raises:
        ConfigError: a file of theirs is missing or damaged, or evaluations of seeds of one run were
            not taken alike.
    """

    def __init__(self, runs: Sequence[Path]):
        self.rows = {run: read_metrics(run) for run in runs}
        self.configs: dict[Path, Config] = {run: run_config(run, acts=False) for run in runs}
        found = {run: final_evaluation(run, self.rows[run]) for run in runs}
        self.evaluations = {run: e for run, e in found.items() if e is not None}
        self.groups = group_runs({run: settings_of(c) for run, c in self.configs.items()})
        for group in self.groups.values():
            _check_alike({run: self.evaluations[run] for run in group if run in self.evaluations})
        self.tasks: list[str] = []
        for config in self.configs.values():
            for task in config.tasks.train + config.tasks.test:
                if task not in self.tasks:
                    self.tasks.append(task)

    def config(self, group: str) -> Config:
        """The configuration that the runs of a group share, but for their seeds."""
        return self.configs[self.groups[group][0]]

    def holds_out(self, group: str, task: str) -> bool:
        """Whether a group does not train on a task."""
        return task not in self.config(group).tasks.train

    def is_held_out(self, task: str) -> bool:
        """Whether no group of the figure trains on a task."""
        return all(self.holds_out(group, task) for group in self.groups)

    def mark(self, group: str, task: str) -> str:
        """What a label says of a task that the group holds out."""
        return ", held out" if self.holds_out(group, task) else ""

    def curves(self, group: str, column: str) -> list[Series]:
        """A column of every run of a group that has it."""
        found = [series(self.rows[run], column) for run in self.groups[group]]
        return [curve for curve in found if curve]

    def evaluations_of(self, group: str) -> list[Evaluation]:
        """The final evaluations of a group, of every run that has one."""
        return [self.evaluations[run] for run in self.groups[group] if run in self.evaluations]

    def final(self, group: str, task: str) -> list[Curve]:
        """The final evaluation of a task, of every run of a group that has one, at the k of all."""
        found = [e.tasks[task] for e in self.evaluations_of(group) if task in e.tasks]
        shared = [k for k in found[0] if all(k in curve for curve in found)] if found else []
        return [{k: curve[k] for k in shared} for curve in found] if shared else []


def _check_alike(evaluations: Mapping[Path, Evaluation]) -> None:
    """Raises ConfigError where evaluations that a mean is taken of were not taken with one setting.

    Configurations may be equal and these not, since `eval --json` writes such files too.
    """
    for name in ("goals", "draws", "goal_set", "horizon", "seed", "physics", "policy", "z"):
        values = {run: e.facts[name] for run, e in evaluations.items() if name in e.facts}
        different = {str(value): run for run, value in values.items()}
        if len(different) > 1:
            shown = ", ".join(f"{value} in {run}" for value, run in different.items())
            cause = f"the eval.json of seeds of one run were taken with another {name}: {shown}"
            raise ConfigError(cause, "evaluate them alike, or plot each by itself")
