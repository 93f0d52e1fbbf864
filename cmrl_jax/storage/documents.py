"""JSON and CSV that somebody else may have cut, edited or copied badly since they were written.

What cannot be read is one line of cause and one of cure, whatever is wrong with it. What the fields
mean is the business of who asks: `run_files.py` for the files of a run.
"""

from __future__ import annotations

import csv
import io
import json
import sys
from pathlib import Path
from typing import Any, NoReturn

from cmrl_jax.config.schema import ConfigError, call_envs
from envs.command_line import what_is


def is_there(path: Path) -> bool:
    """Whether there is such a file.

    Raises:
        ConfigError: the system cannot follow its path.
    """
    return call_envs(lambda: what_is(path)) == "file"


def read_text(path: Path, cure: str) -> str:
    """A file's text, without the mark that spreadsheets put before it.

    Raises:
        ConfigError: with `cure`, where it cannot be opened or is no UTF-8.
    """
    try:
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        cause = f"{path} is not UTF-8 text: {error.reason} at byte {error.start}"
        raise ConfigError(cause, cure) from error
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}", cure) from error


def read_json(path: Path, cure: str) -> dict[str, Any]:
    """The object that a JSON file holds.

    Raises:
        ConfigError: with `cure`, where it is no such file, names a key of an object twice, or holds
            NaN or an infinity, which are no JSON and no figure of ours.
    """
    try:
        found = json.loads(
            read_text(path, cure), parse_constant=_no_number, object_pairs_hook=_no_key_twice
        )
    except ConfigError:
        raise
    except RecursionError as error:
        raise ConfigError(f"{path} is not JSON: brackets without end", cure) from error
    except ValueError as error:
        raise ConfigError(f"{path} is not JSON: {error}", cure) from error
    if not isinstance(found, dict):
        raise ConfigError(f"{path} holds no JSON object, but {_kind(found)}", cure)
    return found


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is no number")


def _no_key_twice(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key '{twice}' stands twice")
    return found


def _kind(value: Any) -> str:
    kinds = {list: "a list", str: "text", bool: "true or false"}
    return kinds.get(type(value), "nothing" if value is None else "a number")


def read_csv(path: Path, cure: str) -> tuple[list[str], dict[int, list[str]]]:
    """Columns of a CSV, and its rows as text by their line, each with a cell for every column.

    A last line that does not end is half a row, of a writer that was killed or is at work: it is
    left out, with a line on standard error.

    Raises:
        ConfigError: with `cure`, where it is no such file or names a column twice.
    """
    text = read_text(path, cure)
    whole = text[: text.rfind("\n") + 1]
    if len(whole) < len(text):
        print(f"{path} ends in half a row, which is left out", file=sys.stderr)
    reader = csv.reader(io.StringIO(whole, newline=""))
    rows: dict[int, list[str]] = {}
    try:
        columns = next(reader, [])
        for row in reader:
            if row:
                rows[reader.line_num] = row
    except csv.Error as error:
        raise ConfigError(f"{path}:{reader.line_num} is no CSV: {error}", cure) from error
    if len(set(columns)) < len(columns):
        twice = next(name for name in columns if columns.count(name) > 1)
        raise ConfigError(f"{path} has the column '{twice}' twice", cure)
    for line, row in rows.items():
        if len(row) != len(columns):
            cause = f"{path}:{line} has {len(row)} cells for {len(columns)} columns"
            raise ConfigError(cause, cure)
    return columns, rows
