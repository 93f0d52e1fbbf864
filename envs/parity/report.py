"""Plain text tables of a parity measurement, and its JSON form."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A titled table with aligned columns; floats are shown with three or four digits."""
    cells = [list(columns), *([_shown(value) for value in row] for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(columns))]
    lines = [
        "  ".join(
            c.ljust(w) if i == 0 else c.rjust(w)
            for i, (c, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in cells
    ]
    return "\n".join([title, *(f"  {line}".rstrip() for line in lines)])


def _shown(value: Any) -> str:
    if not isinstance(value, float):
        return str(value)
    if math.isnan(value):
        return "-"
    if value != 0 and abs(value) < 1e-2:
        return f"{value:.1e}"
    return f"{value:.3f}" if abs(value) < 10 else f"{value:.1f}"


def report(result: dict[str, Any]) -> str:
    """The measurement as text; parts that were not measured are left out."""
    tasks = result["tasks"]
    head = (
        f"physics {result['physics']}, {result['goals']} goals a task of '{result['goal_set']}', "
        f"horizon {result['horizon']}, seed {result['seed']}; "
        + ", ".join(f"{name} {version}" for name, version in result["versions"].items())
    )
    parts = [head, *_injected(tasks), *_open_loop(tasks), *_closed_loop(tasks), *_resets(tasks)]
    return "\n\n".join(parts)


def _injected(tasks: dict[str, Any]) -> list[str]:
    rows = [
        [
            name,
            task["injected"]["states"],
            task["injected"]["obs_max"],
            task["injected"]["reward_max"],
            task["injected"]["success_mismatches"],
            task["injected"]["near_threshold"],
            task["injected"]["near_threshold_mismatches"],
        ]
        for name, task in tasks.items()
        if "injected" in task
    ]
    if not rows:
        return []
    columns = ("task", "states", "obs max", "reward max", "success wrong", "at edge", "wrong there")
    steps = [
        [f"{name} {kind.replace('_', ' ')}", task["one_step"][kind]["states"]]
        + [task["one_step"][kind][p][q] for p in _PARTS for q in ("p50", "p99", "max")]
        for name, task in tasks.items()
        for kind in ("contact", "no_contact")
    ]
    step_columns = ["task", "states", *(f"{p} {q}" for p in _PARTS for q in ("p50", "p99", "max"))]
    return [
        table("1. Observation, reward and success in states of Meta-World", columns, rows),
        table("2. One control step from states of Meta-World: error (m)", step_columns, steps),
    ]


_PARTS = ("hand", "fingers", "fixture")


def _open_loop(tasks: dict[str, Any]) -> list[str]:
    measured = {name: task for name, task in tasks.items() if "open_loop" in task}
    if not measured:
        return []
    steps = list(next(iter(measured.values()))["open_loop"])
    rows = [
        [f"{name} {label}", *(float(task[key][step]) for step in steps)]
        for name, task in measured.items()
        for label, key in (("median", "open_loop_median"), ("max", "open_loop"))
    ]
    title = "3. Their actions replayed: largest error of hand, fingers, fixture (m) after n steps"
    return [table(title, ["task", *steps], rows)]


def _closed_loop(tasks: dict[str, Any]) -> list[str]:
    columns = ("task", "any", "last", "return", "ratio", "first step")
    columns += ("theirs: any", "last", "return", "first step")
    keys = ("success_any", "success_last", "return", "return_ratio", "first_success_step")
    keys += tuple(f"reference_{key}" for key in keys if key != "return_ratio")
    tables = []
    for condition in next(iter(tasks.values()))["closed_loop"]:
        runs = {name: task["closed_loop"][condition] for name, task in tasks.items()}
        rows = [[name, *(run[key] for key in keys)] for name, run in runs.items()]
        title = f"4. Scripted policies, action noise {condition}: success, return, first success"
        tables.append(table(title, columns, rows))
    return tables


def _resets(tasks: dict[str, Any]) -> list[str]:
    rows = [[n, t["reset_obs_max"]] for n, t in tasks.items() if "reset_obs_max" in t]
    return [table("5. Start observations", ("task", "obs max"), rows)] if rows else []


def finite(value: Any) -> Any:
    """A result for strict JSON: what could not be measured (NaN) is null."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
