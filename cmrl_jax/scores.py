"""What an evaluation reports: means with intervals, a table, and one CSV row a cell.

A cell is one number of adaptation episodes of one lane: (run, checkpoint, task, goal, draw, k). The
CSV holds cells and the settings they were taken with, so any statistic can be computed again, and a
sweep can see what it has done already.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cmrl_jax.config import ConfigError
from cmrl_jax.episode import Episode
from cmrl_jax.metrics import format_figure

FIGURES = {
    "success_any": "success_any",
    "success_last": "success_last",
    "return": "returns",
    "first_success": "first_success",
    "final_distance": "final_distance",
    "faults": "faults",
}
"""Column -> field of `Episode`."""
SETTINGS = (
    "physics",
    "horizon",
    "goal_set",
    "policy",
    "z",
    "donors",
    "paraphrases",
    "text_control",
    "text",
    "eval_seed",
)
CELL = ("run", "checkpoint", "policy_sha256", "task", "goal", "draw", "k")
FACTS = ("config", "train_seed", "env_steps")  # of the checkpoint, for whoever reads the file
COLUMNS = (*CELL, *FACTS, *SETTINGS, *FIGURES)

RESAMPLES = 2000

Row = dict[str, str]


def bootstrap_interval(values: np.ndarray) -> list[float]:
    """95 % percentile bootstrap interval of the mean over goals; values (goal,)."""
    generator = np.random.default_rng(0)
    index = generator.integers(0, len(values), (RESAMPLES, len(values)))
    return [float(x) for x in np.quantile(values[index].mean(1), (0.025, 0.975))]


def of_policy(scores: Mapping[int, Episode], policy: int) -> dict[int, Episode]:
    """One policy's scores, k -> Episode of (task, goal, draw)."""
    return {k: jax.tree.map(lambda x: x[policy], episode) for k, episode in scores.items()}


def summarise(scores: Mapping[int, Episode], tasks: Sequence[str]) -> dict[str, Any]:
    """Means over goals and draws, with the interval over goals.

    Args:
        scores: k -> Episode of (task, goal, draw).

    Returns:
        {task: {k: {"success_any": .., "success_last": .., "return": .., "first_success_step": ..,
        "final_distance": .., "faults": .., "interval_95": {"success_any": [low, high], ..}}}}.
    """
    return {
        task: {
            str(k): _summary({f: getattr(e, field)[row].mean(-1) for f, field in FIGURES.items()})
            for k, e in scores.items()
        }
        for row, task in enumerate(tasks)
    }


def _summary(figures: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Figures of one task and k, each (goal,)."""
    named = {{"first_success": "first_success_step"}.get(n, n): v for n, v in figures.items()}
    means: dict[str, Any] = {name: float(values.mean()) for name, values in named.items()}
    with_interval = ("success_any", "success_last", "return")
    return means | {
        "interval_95": {name: bootstrap_interval(named[name]) for name in with_interval}
    }


def format_scores(summary: Mapping[str, Any]) -> str:
    """A table of an evaluation: success at any and last step and return, per task and k.

    Below it a line of warning where physics failed.
    """
    lines = [f"{'task':<14} {'k':>3} {'any step':>9} {'95 %':>11} {'last step':>9} {'return':>8}"]
    for task, by_k in summary.items():
        for k, f in by_k.items():
            low, high = f["interval_95"]["success_any"]
            success = f"{f['success_any']:>9.2f} {low:>6.2f}-{high:.2f} {f['success_last']:>9.2f}"
            lines.append(f"{task:<14} {k:>3} {success} {f['return']:>8.0f}")
    return "\n".join(lines + fault_warning(summary))


def fault_warning(summary: Mapping[str, Any]) -> list[str]:
    """One line that names the tasks in which lanes were put back to their start, or none."""
    worst = {task: max(f["faults"] for f in by_k.values()) for task, by_k in summary.items()}
    shown = [f"{task} {faults:.2g} times a lane" for task, faults in worst.items() if faults]
    if not shown:
        return []
    return [f"warning: physics became non-finite and was put back: {', '.join(shown)}"]


def cell_rows(
    scores: Mapping[int, Episode], tasks: Sequence[str], common: Mapping[str, Any]
) -> list[Row]:
    """CSV rows of one policy's scores (task, goal, draw), all text.

    Args:
        common: the columns that do not differ between these rows: the run, its facts, settings.
    """
    fixed = _as_text(common)
    return [
        fixed
        | {"task": tasks[task], "goal": str(goal), "draw": str(draw), "k": str(k)}
        | {c: format_figure(getattr(episode, f)[task, goal, draw]) for c, f in FIGURES.items()}
        for k, episode in scores.items()
        for task, goal, draw in np.ndindex(episode.returns.shape)
    ]


def summarise_rows(rows: Iterable[Row]) -> dict[str, Any]:
    """`summarise` from CSV rows of one checkpoint under one setting."""
    cells: dict[tuple[str, str], dict[str, list[Row]]] = {}
    for row in rows:
        cells.setdefault((row["task"], row["k"]), {}).setdefault(row["goal"], []).append(row)
    summary: dict[str, Any] = {}
    for (task, k), by_goal in sorted(cells.items(), key=lambda item: int(item[0][1])):
        figures = {
            name: np.array([np.mean([float(r[name]) for r in draws]) for draws in by_goal.values()])
            for name in FIGURES
        }
        summary.setdefault(task, {})[k] = _summary(figures)
    return summary


class ScoreCsv:
    """A CSV of cells that grows by whole batches and knows which cells it holds; close it.

    Args:
        path: the file; None keeps the rows in memory only.
        resume: go on with the file that is there, less half a row that a kill left; else anew.

    Raises:
        ConfigError: the file to go on with is no such CSV.
    """

    def __init__(self, path: Path | None, resume: bool):
        self._path = path
        self._rows: dict[tuple[str, ...], Row] = {}
        header = _line(COLUMNS)
        content = path.read_bytes() if path is not None and resume and path.is_file() else b""
        whole = content[: content.rfind(b"\n") + 1].decode("utf-8", errors="replace")
        if content and not whole.startswith(header):
            cure = "give --csv another file, or move this one away"
            raise ConfigError(f"{path} does not hold the columns of a sweep", cure)
        for row in csv.DictReader(io.StringIO(whole)):
            self._rows[_key(row)] = row
        self._file = None
        if path is not None:
            self._file = open(path, "r+b" if content else "wb")
            self._file.truncate(len(whole.encode()))
            self._file.seek(0, io.SEEK_END)
            if not whole:
                self._write(header)

    def holds(self, cell: Mapping[str, Any]) -> bool:
        """Whether the cell (columns CELL and SETTINGS) was taken already."""
        return _key(_as_text(cell)) in self._rows

    def find(self, cell: Mapping[str, Any]) -> Row:
        """The row of a cell that it holds."""
        return self._rows[_key(_as_text(cell))]

    def add(self, rows: Iterable[Row]) -> None:
        """Writes the rows of cells that are not there yet, and flushes them."""
        new = {_key(row): row for row in rows}
        new = {key: row for key, row in new.items() if key not in self._rows}
        self._rows |= new
        self._write("".join(_line([row[c] for c in COLUMNS]) for row in new.values()))

    def rows(self, common: Mapping[str, Any]) -> list[Row]:
        """The rows whose columns have the values of `common`."""
        wanted = _as_text(common)
        return [r for r in self._rows.values() if all(r[n] == v for n, v in wanted.items())]

    def close(self) -> None:
        if self._file is not None:
            self._file.close()

    def __enter__(self) -> ScoreCsv:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _write(self, text: str) -> None:
        if self._file is not None:
            self._file.write(text.encode())
            self._file.flush()


def _as_text(columns: Mapping[str, Any]) -> dict[str, str]:
    return {name: "" if value is None else str(value) for name, value in columns.items()}


def _key(row: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(row[name] for name in (*CELL, *SETTINGS))


def _line(values: Sequence[str]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerow(values)
    return out.getvalue()
