"""What the files of a run say: metrics.csv, eval.json, and the JSON of `eval` and `finetune`.

They are kept for years, copied and edited by hand, so every one is checked as it is read, and every
axis sorted: no reader has to ask in which order steps, k or episodes stand.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cmrl_jax.config.schema import ConfigError
from cmrl_jax.storage.documents import is_there, read_csv, read_json

METRICS, EVALUATION = "metrics.csv", "eval.json"
FIGURES = ("success_any", "success_last", "return")  # of an evaluation, in every such file

Row = dict[str, float]
Curve = dict[int, Row]


@dataclass(frozen=True)
class Evaluation:
    """What an evaluation found.

    Attributes:
        tasks: task -> k -> `FIGURES`, k rising.
        facts: the file's other fields: what the figures were taken with, and of which policy.
    """

    tasks: dict[str, Curve]
    facts: dict[str, Any]


@dataclass(frozen=True)
class Adaptation:
    """What fine-tuning to a task brought: way to adapt -> own episodes -> `FIGURES`, rising."""

    task: str
    curves: dict[str, Curve]


def read_metrics(run: Path) -> list[Row]:
    """Rows of a run's metrics.csv, env steps rising; a row lacks what was not taken in it.

    What is not finite, as a run that diverges may write, was not taken.

    Raises:
        ConfigError: there is no such file, it has no row, or it is damaged.
    """
    path = run / METRICS
    if not is_there(path):
        raise ConfigError(f"{path} does not exist", "give --run a directory that holds a run")
    cure = "put it back from a copy, or leave the run out"
    columns, cells = read_csv(path, cure)
    if not cells:
        raise ConfigError(f"{path} has no row yet", "let the run finish an iteration first")
    rows: dict[float, Row] = {}
    for line, texts in cells.items():
        row: Row = {}
        for column, text in zip(columns, texts, strict=True):
            try:
                value = float(text) if text else math.nan
            except ValueError:
                cause = f"{path}:{line} has the text '{text[:40]}' in column {column}"
                raise ConfigError(cause, cure) from None
            if math.isfinite(value):
                row[column] = value
        steps = figure(row, "env_steps", path, line)
        if steps in rows:
            raise ConfigError(f"{path}:{line} has {steps:,.0f} env steps a second time", cure)
        rows[steps] = row
    return [rows[steps] for steps in sorted(rows)]


def figure(row: Row, column: str, path: Path, line: int | None = None) -> float:
    """A figure that every row has.

    Raises:
        ConfigError: this one has it not.
    """
    if column not in row:
        place = f"{path}:{line}" if line else f"{path}"
        cure = "put it back from a copy, or leave the run out"
        raise ConfigError(f"{place} has no number in column '{column}'", cure)
    return row[column]


def read_evaluation(path: Path) -> Evaluation:
    """An evaluation, from a run's eval.json or what `eval --json` wrote.

    Raises:
        ConfigError: the file is damaged, or no evaluation.
    """
    cure = "put it back from a copy, or move it away: a run is drawn without one too"
    facts = read_json(path, cure)
    tasks = _mapping(facts.pop("tasks", None), f"{path} has no evaluation under 'tasks'", cure)
    read = {task: _curve(by_k, f"{path}, {task}", "k", cure) for task, by_k in tasks.items()}
    return Evaluation(read, facts)


def find_evaluation(run: Path) -> Evaluation | None:
    """The final evaluation of a run, None before it.

    Raises:
        ConfigError: the file is damaged.
    """
    path = run / EVALUATION
    return read_evaluation(path) if is_there(path) else None


def read_adaptation(path: Path) -> Adaptation:
    """The curves that `finetune --json` wrote.

    Raises:
        ConfigError: the file is damaged, or no such curves.
    """
    cure = "put it back from a copy, or write it again with finetune --json"
    found = read_json(path, cure)
    task = found.get("task")
    if not isinstance(task, str):
        raise ConfigError(f"{path} names no task that was adapted to", cure)
    curves = _mapping(found.get("curves"), f"{path} has no curves under 'curves'", cure)
    read = {way: _curve(curve, f"{path}, {way}", "episodes", cure) for way, curve in curves.items()}
    return Adaptation(task, read)


def _mapping(value: Any, cause: str, cure: str) -> Mapping[str, Any]:
    if not isinstance(value, dict) or not value:
        raise ConfigError(cause, cure)
    return value


def _curve(value: Any, place: str, axis: str, cure: str) -> Curve:
    """`{"0": {"success_any": .., ..}, ..}` with whole numbers for keys, rising."""
    curve: Curve = {}
    for key, figures in _mapping(value, f"{place} has no figures", cure).items():
        if not re.fullmatch(r"\d{1,9}", key, re.ASCII) or int(key) in curve:
            raise ConfigError(f"{place}: '{key}' is no {axis}, or one that stands twice", cure)
        at = f"{place}, {axis} = {key}"
        _mapping(figures, f"{at} has no figures", cure)
        for name in FIGURES:
            number = figures.get(name)
            # An integer of hundreds of digits is JSON too, and no float.
            if type(number) not in (int, float) or not abs(number) < 1e300:
                raise ConfigError(f"{at}: {name} is no number", cure)
        curve[int(key)] = {name: float(figures[name]) for name in FIGURES}
    return dict(sorted(curve.items()))
