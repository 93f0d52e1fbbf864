"""A run's figures as lines on a stream."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TextIO

import numpy as np

from cmrl_jax.formats import format_duration
from cmrl_jax.streams import Output
from cmrl_jax.training.logger import Logger, Progress, RunInfo
from cmrl_jax.training.metrics import Row


class Console(Logger):
    """Lines on a stream, above a progress bar where the stream is a terminal.

    A stream that can no longer be written raises nothing here: `error` says why, later lines are
    lost, and `on_error` is called once.

    Args:
        label: what the lines of iterations begin with.
    """

    def __init__(
        self,
        progress: bool = True,
        stream: TextIO | None = None,
        on_error: Callable[[], None] = lambda: None,
        label: str = "",
    ):
        self._label = label
        self._stream = Output(stream or sys.stdout, on_error)
        self._tasks: tuple[str, ...] = ()
        self._progress = None
        if progress and self._stream.isatty():
            from rich.console import Console as RichConsole
            from rich.progress import BarColumn, TaskProgressColumn, TextColumn
            from rich.progress import Progress as Bar

            columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn())
            file: Any = self._stream
            console = RichConsole(file=file, highlight=False, markup=False)
            self._progress = Bar(*columns, console=console, transient=True)
            self._bar = self._progress.add_task("training", total=1.0)

    @property
    def error(self) -> OSError | None:
        """What keeps the stream from being written."""
        return self._stream.error

    def start(self, run: RunInfo) -> None:
        self._tasks = run.config.tasks.train
        if self._progress is not None:
            self._progress.start()

    def row(self, row: Row, progress: Progress) -> None:
        self.message(self._label + format_iteration(row, self._tasks, progress.seconds_left))
        if evaluation := format_evaluation(row):
            self.message(self._label + evaluation)
        self._advance(progress.share)

    def message(self, text: str) -> None:
        if self._progress is None:
            print(text, file=self._stream, flush=True)
        else:
            self._progress.console.print(text, soft_wrap=True)

    def _advance(self, share: float) -> None:
        if self._progress is not None:
            self._progress.update(self._bar, completed=min(max(share, 0.0), 1.0))

    def close(self) -> None:
        if self._progress is not None:
            self._progress.stop()


def figure_of(row: Row, name: str, tasks: Iterable[str]) -> float | None:
    """`train/<name>`, or else the mean of `train/<task>/<name>` over the tasks that have it."""
    if row.get(f"train/{name}") is not None:
        return float(row[f"train/{name}"])
    values = [row.get(f"train/{task}/{name}") for task in tasks]
    taken = [float(value) for value in values if value is not None]
    return float(np.mean(taken)) if taken else None


def format_iteration(row: Row, tasks: Sequence[str], eta_s: float) -> str:
    """The console line of an iteration; figures that the row lacks are left out.

    Args:
        row: columns of metrics.csv. Read are `train/<task>/success_any`, `train/<task>/return`,
            `train/critic_loss`, `actor_loss`, `kl`, `routing_entropy` (or each per task) and
            `time/env_steps_per_s`.
        tasks: training tasks.
        eta_s: seconds until the run ends.
    """
    parts = [f"iter {int(row['iteration']):>4}  {int(row['env_steps']):>10,} steps"]
    for label, name, style in (("success", "success_any", ".2f"), ("return", "return", ".0f")):
        values = ((task, row.get(f"train/{task}/{name}")) for task in tasks)
        shown = [f"{task} {float(value):{style}}" for task, value in values if value is not None]
        if shown:
            parts.append(f"{label} {' '.join(shown)}")
    figures = (
        ("critic {:.3g}", "critic_loss"),
        ("actor {:.3g}", "actor_loss"),
        ("KL {:.2f} nats", "kl"),
        ("routing {:.2f}", "routing_entropy"),
    )
    values = ((text, figure_of(row, name, tasks)) for text, name in figures)
    shown = [text.format(value) for text, value in values if value is not None]
    if shown:
        parts.append("  ".join(shown))
    if row.get("time/env_steps_per_s") is not None:
        parts.append(f"{float(row['time/env_steps_per_s']):,.0f} steps/s")
    parts.append(f"ETA {format_duration(eta_s)}")
    return " | ".join(parts)


def format_evaluation(row: Row) -> str | None:
    """The success at any step of each `eval/<task>/k<k>` in the row; None if it has none."""
    tasks: dict[str, list[str]] = {}
    for name, value in row.items():
        match = re.fullmatch(r"eval/([^/]+)/(k\d+)/success_any", name)
        if match and value is not None:
            tasks.setdefault(match[1], []).append(f"{match[2]} {float(value):.2f}")
    if not tasks:
        return None
    return "evaluation | " + " | ".join(f"{t} {' '.join(shown)}" for t, shown in tasks.items())
