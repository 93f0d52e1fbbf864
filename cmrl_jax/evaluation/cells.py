"""The table of an evaluation: a CSV with one row a cell, and what names a cell.

A cell is one number of adaptation episodes of one lane: (run, checkpoint, task, goal, draw, k)
under some settings. A table only grows: cells that stand in it are neither replaced nor lost,
whichever command adds to it, so a sweep that was stopped goes on where it ends.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from cmrl_jax.config.schema import ConfigError
from cmrl_jax.evaluation.options import EvalOptions
from cmrl_jax.storage.locks import lock
from envs.outputs import in_directory

FIGURES = {
    "success_any": "success_any",
    "success_last": "success_last",
    "return": "returns",
    "first_success": "first_success",
    "final_distance": "final_distance",
    "faults": "faults",
}
"""Column -> field of `Episode`."""
CELL = ("run", "checkpoint", "policy_sha256", "task", "goal", "draw", "k")
MARK = ",".join(CELL)
"""What every table begins with, also one of another version."""
RENAMED = {"seed": "eval_seed"}  # options whose column is called otherwise
UNNAMED = {
    "k": "the column k",
    "tasks": "the column task",
    "goals": "the column goal; all of them in `donors` where lanes depend on one another",
    "draws": "the column draw; all of them in `donors`, too",
    "weights": "an encoder of other weights has another name or is refused: see `sentences`",
    "any_table": "the column `sentences` has the table itself, by its digest",
    "lanes": "a lane's noise is named by task, goal and draw, whatever runs beside it",
    "adaptation_episodes": "of Meta-World's own function, whose figures are no cells",
    "evaluation_episodes": "the same",
}
"""Options that are no columns, with the reason why none of them can mix two cells up."""
SETTINGS = (
    *(RENAMED.get(f.name, f.name) for f in fields(EvalOptions) if f.name not in UNNAMED),
    "donors",
    "sentences",
)
FACTS = ("config", "train_seed", "env_steps")  # of the checkpoint, for whoever reads the file
COLUMNS = (*CELL, *FACTS, *SETTINGS, *FIGURES)
_WHOLE = ("checkpoint", "goal", "draw", "k", "env_steps")

Row = dict[str, str]


class CellTable:
    """A CSV of cells that grows by whole batches and knows which cells it holds; close it.

    One process at a time writes to a file.

    Args:
        path: the file, gone on with if it is there, less half a row that a kill left; None keeps
            the rows in memory only.
        force: begin anew where the file is no such table.

    Raises:
        ConfigError: another process writes to it, it is no such table or a row of it is damaged;
            or it cannot be written.
    """

    def __init__(self, path: Path | None, force: bool = False):
        self._path, self._file = path, None
        self._rows: dict[tuple[str, ...], Row] = {}
        if path is None:
            return
        try:
            self._file = open(in_directory(path), "a+b", buffering=0)
            lock(self._file, str(path))
            self._file.seek(0)
            self._go_on(path, self._file.read(), force)
        except BlockingIOError as error:
            self.close()
            cause = f"another process is writing to {path}"
            raise ConfigError(cause, "let it end first, or give --csv another file") from error
        except OSError as error:
            raise self._refused(error) from error
        except ConfigError:
            self.close()
            raise

    def _go_on(self, path: Path, content: bytes, force: bool) -> None:
        """Takes in what the file holds, and cuts what is no whole row."""
        whole = content[: content.rfind(b"\n") + 1]
        header = whole.partition(b"\n")[0].decode(errors="replace").split(",")
        if content and tuple(header) != COLUMNS:
            if not force:
                raise ConfigError(_other_columns(path, header), _OTHER_FILE)
            whole = b""
        for row in _read_rows(path, whole):
            self._rows[_key(row)] = row
        assert self._file is not None  # the caller has opened it
        self._file.truncate(len(whole))
        if not whole:
            self._write(_line(COLUMNS))

    def holds(self, cell: Mapping[str, Any]) -> bool:
        """Whether the cell (columns CELL and SETTINGS) was taken already."""
        return _key(as_text(cell)) in self._rows

    def find(self, cell: Mapping[str, Any]) -> Row:
        """The row of a cell that it holds."""
        return self._rows[_key(as_text(cell))]

    def add(self, rows: Iterable[Row]) -> list[Row]:
        """Writes the rows of cells that are not there yet; returns these.

        Raises:
            ConfigError: the disk refuses them.
        """
        new = {_key(row): row for row in rows}
        new = {key: row for key, row in new.items() if key not in self._rows}
        self._rows |= new
        try:
            self._write("".join(_line([row[c] for c in COLUMNS]) for row in new.values()))
        except OSError as error:
            raise self._refused(error) from error
        return list(new.values())

    def rows(self, common: Mapping[str, Any]) -> list[Row]:
        """The rows whose columns have the values of `common`."""
        wanted = as_text(common)
        return [r for r in self._rows.values() if all(r[n] == v for n, v in wanted.items())]

    def close(self) -> None:
        if self._file is not None:
            self._file.close()

    def __enter__(self) -> CellTable:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _write(self, text: str) -> None:
        left = text.encode()
        while left and self._file is not None:
            left = left[self._file.write(left) :]

    def _refused(self, error: OSError) -> ConfigError:
        cause = f"cannot write {self._path}: {error.strerror}"
        return ConfigError(cause, "make room there, or give --csv another file")


_OTHER_FILE = "give --csv another file, or begin this one anew with --force"


def as_text(columns: Mapping[str, Any]) -> Row:
    """Columns as they stand in the file; None as nothing."""
    return {name: "" if value is None else str(value) for name, value in columns.items()}


def _other_columns(path: Path, header: Sequence[str]) -> str:
    missing = [name for name in COLUMNS if name not in header]
    if not set(CELL) <= set(header) or not missing:
        return f"{path} does not hold the columns of a sweep"
    return f"{path} is of another version: it has no column {', '.join(missing)}"


def _read_rows(path: Path, content: bytes) -> Iterator[Row]:
    """The rows below the header; every one has all columns, and numbers where they belong.

    Raises:
        ConfigError: naming the line that is damaged.
    """
    reader, line = csv.reader(io.StringIO(_decoded(path, content), newline="")), 1
    try:
        next(reader, None)
        for values in reader:
            line += 1
            if len(values) != len(COLUMNS):
                reason = f"it has {len(values)} columns, not {len(COLUMNS)}"
                raise _damaged(path, line, reason)
            row = dict(zip(COLUMNS, values, strict=True))
            for name in (*_WHOLE, *FIGURES):
                kind = int if name in _WHOLE else float
                try:
                    kind(row[name])
                except ValueError:
                    raise _damaged(path, line, f"{name} is '{row[name][:40]}'") from None
            line = reader.line_num
            yield row
    except csv.Error as error:
        raise _damaged(path, reader.line_num, str(error)) from error


def _decoded(path: Path, content: bytes) -> str:
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise _damaged(path, line, f"byte {error.start} is no text") from error


def _damaged(path: Path, line: int, reason: str) -> ConfigError:
    cause = f"line {line} of {path} is damaged: {reason}"
    return ConfigError(cause, "delete that line, whose cells are then taken again, or use a copy")


def _key(row: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(row[name] for name in (*CELL, *SETTINGS))


def _line(values: Sequence[str]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerow(values)
    return out.getvalue()
