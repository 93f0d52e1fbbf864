"""What an evaluation reports: means with intervals, a table in words, and one row a cell.

Rows hold cells and the settings they were taken with (cells.py), so any statistic can be computed
again.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from cmrl_jax.evaluation.cells import FIGURES, Row, as_text
from cmrl_jax.evaluation.episode import Episode
from cmrl_jax.evaluation.statistics import mean_interval, wilson_interval
from cmrl_jax.formats import format_figure


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
    rates, goals = ("success_any", "success_last"), len(named["return"])
    intervals = {name: list(wilson_interval(means[name], goals)) for name in rates}
    return means | {"interval_95": intervals | {"return": list(mean_interval(named["return"]))}}


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
    fixed = as_text(common)
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
