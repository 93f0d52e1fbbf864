"""metrics.csv: the record of a run's figures, which a resumed run goes on with.

Every figure is written as the shortest text that is exact in float32, so two equal runs give equal
files byte for byte; what is not a function of config and seed is named `wall_s` or `time/...`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cmrl_jax.config.schema import ConfigError
from cmrl_jax.formats import format_figure
from cmrl_jax.storage.documents import read_csv

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
        return read_rows(Path(self._file.name))

    def _write(self, line: bytes) -> None:
        self._file.write(line)
        self._file.flush()  # a killed run keeps every row that it reported

    def close(self) -> None:
        self._file.close()


def read_rows(path: Path) -> Iterator[dict[str, float | None]]:
    """The rows of a metrics.csv, oldest first; None where a figure was not taken.

    Raises:
        ConfigError: it cannot be read, or is no such file.
    """
    columns, rows = read_csv(path, "restore the file from a copy")
    for row in rows.values():
        pairs = zip(columns, row, strict=True)
        yield {name: float(text) if text else None for name, text in pairs}


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


def metric_names(metrics: dict[str, Any], tasks: tuple[str, ...]) -> list[str]:
    """Columns of metrics.csv for one iteration's metrics: `train/x`, or `train/<task>/x`."""
    names = []
    for name, value in metrics.items():
        per_task = [f"train/{task}/{name}" for task in tasks]
        names += per_task if len(value.shape) else [f"train/{name}"]
    return names


def metric_row(metrics: dict[str, Any], tasks: tuple[str, ...]) -> dict[str, float | None]:
    """Host figures of one iteration's metrics; NaN (no gradient step yet) becomes None."""
    row: dict[str, float | None] = {}
    for name, value in metrics.items():
        values = np.atleast_1d(np.asarray(value))
        for column, figure in zip(metric_names({name: value}, tasks), values, strict=True):
            row[column] = None if np.isnan(figure) else float(figure)
    return row


def figures_of(row: Row) -> dict[str, float]:
    """What was taken in a row, without the columns that every row has."""
    taken = row.items()
    return {n: float(v) for n, v in taken if n not in LEADING_COLUMNS and v is not None}
