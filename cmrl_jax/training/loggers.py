"""Where a run's figures and messages go beside metrics.csv: a list of loggers.

One more is a class with the methods of `Logger` that it needs.
"""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from cmrl_jax.config.schema import Config, ConfigError
from cmrl_jax.formats import format_duration
from cmrl_jax.streams import Output
from cmrl_jax.training.metrics import LEADING_COLUMNS, Row


@dataclass(frozen=True)
class RunInfo:
    """What loggers are told of a run when it begins or goes on.

    Attributes:
        run_dir: its directory.
        train_tasks: names of the training tasks.
        rows: those of metrics.csv so far, oldest first.
        begun: clock time (s) from which the rows' `wall_s` counts.
    """

    run_dir: Path
    train_tasks: tuple[str, ...]
    rows: Iterable[Row] = ()
    begun: float = 0.0


@dataclass(frozen=True)
class Progress:
    """How far a run is: share done, 0 to 1, and seconds until it ends (inf: unknown)."""

    share: float
    seconds_left: float


class Logger:
    """What a logger is told, in this order. Yours is a subclass with the methods that it needs."""

    def start(self, run: RunInfo) -> None:
        """The run begins, or goes on."""

    def row(self, row: Row, progress: Progress) -> None:
        """An iteration is done; `row` holds the columns of metrics.csv that were taken."""

    def message(self, text: str) -> None:
        """A line for the user: what takes long, what is wrong, how it ended."""

    def close(self) -> None:
        """Nothing comes any more."""


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
            self._progress.start()

    @property
    def error(self) -> OSError | None:
        """What keeps the stream from being written."""
        return self._stream.error

    def start(self, run: RunInfo) -> None:
        self._tasks = run.train_tasks

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


class TensorBoard(Logger):
    """TensorBoard events over env steps, for `log.tensorboard`: the rows of metrics.csv once more.

    An event file begins with all rows so far and takes the place of the one before, so that it
    holds what metrics.csv holds, whatever a kill or a resume has cut there. Records are written by
    this thread: tensorboardX's own writer queues them, and a killed process loses its queue.
    """

    def __init__(self) -> None:
        """Events go to the run directory's `tensorboard/`.

        Raises:
            ConfigError: tensorboardX is not installed.
        """
        try:
            from tensorboardX import RecordWriter
            from tensorboardX.proto import event_pb2
        except ImportError as error:
            raise ConfigError(
                "log.tensorboard needs the package tensorboardX, which is not installed",
                "pip install tensorboardX, or set log.tensorboard to false",
            ) from error
        self._record_writer, self._writer = RecordWriter, None
        events: Any = event_pb2  # made at run time, so that no type checker knows what is in it
        self._event = events.Event
        self._session_log = events.SessionLog

    def start(self, run: RunInfo) -> None:
        directory = run.run_dir / "tensorboard"
        self._begun = run.begun
        directory.mkdir(parents=True, exist_ok=True)
        before = list(directory.glob("events.*"))
        # TensorBoard reads the files of a directory in the order of their names.
        self._writer = self._record_writer(str(directory / f"events.out.tfevents.{time.time_ns()}"))
        self._add(self._event(file_version="brain.Event:2", wall_time=self._begun))
        # One that looks on drops what it has read of the files before.
        start = self._session_log(status=self._session_log.START)
        self._add(self._event(session_log=start, wall_time=self._begun))
        for row in run.rows:
            self._add_row(row)
        self._flush()
        for path in before:
            os.truncate(path, 0)  # a TensorBoard that looks on would not go past one that is gone

    def row(self, row: Row, progress: Progress) -> None:
        self._add_row(row)
        self._flush()

    def _add_row(self, row: Row) -> None:
        event = self._event(step=int(row["env_steps"]), wall_time=self._begun + row["wall_s"])
        for name, value in row.items():
            if name not in LEADING_COLUMNS and value is not None:
                event.summary.value.add(tag=name, simple_value=float(value))
        self._add(event)

    def _add(self, event: Any) -> None:
        assert self._writer is not None  # started
        self._writer.write(event.SerializeToString())

    def _flush(self) -> None:
        assert self._writer is not None
        self._writer.flush()

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()


def loggers_of(console: Console, config: Config) -> list[Logger]:
    """The console, and TensorBoard where `log.tensorboard` asks for it."""
    return [console, *([TensorBoard()] if config.log.tensorboard else [])]


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
