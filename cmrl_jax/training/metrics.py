"""Where a run's figures go: metrics.csv, the console, TensorBoard.

Every figure is written as the shortest text that is exact in float32, so two equal runs give equal
files byte for byte; what is not a function of config and seed is named `wall_s` or `time/...`.
"""

from __future__ import annotations

import csv
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from cmrl_jax.config.schema import ConfigError
from cmrl_jax.formats import format_duration, format_figure
from cmrl_jax.streams import Output

LEADING_COLUMNS = ("iteration", "env_steps", "gradient_steps", "wall_s", "seed")

Row = Mapping[str, Any]


class MetricsCsv:
    """metrics.csv: one row an iteration, each flushed, empty where a figure was not taken.

    `offset` is the length in bytes after the last row. A checkpoint stores it, and a resumed run
    cuts the file there: rows after the checkpoint, or half a row, will be written again.
    """

    def __init__(self, path: Path, columns: Sequence[str], offset: int | None = None):
        """Start a new file, or go on with one from `offset`.

        Args:
            path: the file.
            columns: all columns of the run; they begin with `LEADING_COLUMNS`.
            offset: where to go on; None starts the file anew.

        Raises:
            ConfigError: the file to go on with is missing, too short, or has other columns.
            ValueError: the columns are not unique or do not begin with the leading ones.
        """
        self.columns = tuple(columns)
        if self.columns[: len(LEADING_COLUMNS)] != LEADING_COLUMNS:
            raise ValueError(f"columns must begin with {', '.join(LEADING_COLUMNS)}")
        if len(set(self.columns)) < len(self.columns):
            raise ValueError("a column stands twice")
        header = (",".join(self.columns) + "\n").encode()
        if offset is None:
            self._file = open(path, "wb")
            self._write(header)
        else:
            _check_resumable(path, header, offset)
            self._file = open(path, "r+b")
            self._file.truncate(offset)
            self._file.seek(offset)
        self.offset = self._file.tell()

    def write(self, row: Row) -> None:
        """Append one row.

        Raises:
            ValueError: a figure has no column, or a leading column has no figure.
        """
        unknown = sorted(set(row) - set(self.columns))
        missing = [name for name in LEADING_COLUMNS if row.get(name) is None]
        if unknown or missing:
            raise ValueError(f"figures without a column: {unknown}; columns to fill: {missing}")
        self._write((",".join(format_figure(row.get(c)) for c in self.columns) + "\n").encode())
        self.offset = self._file.tell()

    def rows(self) -> Iterator[dict[str, float | None]]:
        """The rows so far, oldest first; None where a figure was not taken."""
        with open(self._file.name, encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                yield {name: float(text) if text else None for name, text in row.items()}

    def _write(self, line: bytes) -> None:
        self._file.write(line)
        self._file.flush()  # a killed run keeps every row that it reported

    def close(self) -> None:
        self._file.close()


def _check_resumable(path: Path, header: bytes, offset: int) -> None:
    cure = "restore the file from a copy, or start a new run without --resume"
    if not path.is_file():
        raise ConfigError(f"{path} is missing, a resumed run would lose its rows", cure)
    with open(path, "rb") as file:
        found = file.readline()
        if found != header:
            old, new = (set(h.decode(errors="replace").strip().split(",")) for h in (found, header))
            names = ", ".join(sorted(old ^ new)) or "their order"
            raise ConfigError(
                f"{path} has other columns than this program writes: {names}",
                "resume with the version that wrote it (versions.json), or start a new run",
            )
        file.seek(max(offset - 1, 0))
        if file.read(1) != b"\n":
            cause = f"{path} does not end a row at byte {offset}, where its checkpoint was taken"
            raise ConfigError(cause, cure)


class TensorBoard:
    """TensorBoard events over env steps, for `log.tensorboard`: the rows of metrics.csv once more.

    An event file begins with all rows so far and takes the place of the one before, so that it
    holds what metrics.csv holds, whatever a kill or a resume has cut there. Records are written by
    this thread: tensorboardX's own writer queues them, and a killed process loses its queue.
    """

    def __init__(self, directory: Path, rows: Iterable[Row] = (), begun: float | None = None):
        """Start an event file in `directory`.

        Args:
            rows: those of metrics.csv so far.
            begun: clock time (s) from which the rows' `wall_s` counts; now by default.

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
        events: Any = event_pb2  # made at run time, so that no type checker knows what is in it
        self._event, self._begun = events.Event, time.time() if begun is None else begun
        directory.mkdir(parents=True, exist_ok=True)
        before = list(directory.glob("events.*"))
        # TensorBoard reads the files of a directory in the order of their names.
        self._writer = RecordWriter(str(directory / f"events.out.tfevents.{time.time_ns()}"))
        self._add(self._event(file_version="brain.Event:2", wall_time=self._begun))
        # One that looks on drops what it has read of the files before.
        start = events.SessionLog(status=events.SessionLog.START)
        self._add(self._event(session_log=start, wall_time=self._begun))
        for row in rows:
            self._add_row(row)
        self._writer.flush()
        for path in before:
            os.truncate(path, 0)  # a TensorBoard that looks on would not go past one that is gone

    def write(self, row: Row) -> None:
        """Add every figure of a row, except the leading columns."""
        self._add_row(row)
        self._writer.flush()

    def _add_row(self, row: Row) -> None:
        event = self._event(step=int(row["env_steps"]), wall_time=self._begun + row["wall_s"])
        for name, value in row.items():
            if name not in LEADING_COLUMNS and value is not None:
                event.summary.value.add(tag=name, simple_value=float(value))
        self._add(event)

    def _add(self, event: Any) -> None:
        self._writer.write(event.SerializeToString())

    def close(self) -> None:
        self._writer.close()


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


class Console:
    """Lines on a stream, above a progress bar where the stream is a terminal.

    A stream that can no longer be written raises nothing here: `error` says why, later lines are
    lost, and `on_error` is called once.
    """

    def __init__(
        self,
        progress: bool = True,
        stream: TextIO | None = None,
        on_error: Callable[[], None] = lambda: None,
    ):
        self._stream = Output(stream or sys.stdout, on_error)
        self._progress = None
        if progress and self._stream.isatty():
            from rich.console import Console as RichConsole
            from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

            columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn())
            file: Any = self._stream
            console = RichConsole(file=file, highlight=False, markup=False)
            self._progress = Progress(*columns, console=console, transient=True)
            self._bar = self._progress.add_task("training", total=1.0)
            self._progress.start()

    @property
    def error(self) -> OSError | None:
        """What keeps the stream from being written."""
        return self._stream.error

    def line(self, text: str) -> None:
        """Print one line."""
        if self._progress is None:
            print(text, file=self._stream, flush=True)
        else:
            self._progress.console.print(text, soft_wrap=True)

    def advance(self, share: float) -> None:
        """Show that this share of the run, 0 to 1, is done."""
        if self._progress is not None:
            self._progress.update(self._bar, completed=min(max(share, 0.0), 1.0))

    def close(self) -> None:
        if self._progress is not None:
            self._progress.stop()
