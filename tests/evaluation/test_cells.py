"""The table of cells: what a command did not write it neither loses nor takes for its own."""

import errno
import fcntl
from dataclasses import fields, replace
from typing import Any

import pytest
from policy_fixtures import small_config

from cmrl_jax.config.schema import ConfigError
from cmrl_jax.evaluation.cells import CELL, COLUMNS, FIGURES, RENAMED, SETTINGS, UNNAMED, CellTable
from cmrl_jax.evaluation.options import EvalOptions
from cmrl_jax.evaluation.settings import settings

OPTIONS = EvalOptions(horizon=200, physics="native")


def row(k=0, goal=0, run="runs/a", **figures):
    """A row as text, of one cell."""
    common = {"run": run, "checkpoint": 20, "policy_sha256": "0123456789ab"}
    common |= {"config": "cmrl", "train_seed": 0, "env_steps": 9}
    cell = {"task": "window-open", "goal": goal, "draw": 0, "k": k}
    values = common | settings(OPTIONS, small_config()) | cell | dict.fromkeys(FIGURES, 0) | figures
    return {name: "" if values[name] is None else str(values[name]) for name in COLUMNS}


def cell(of):
    return {name: of[name] for name in (*CELL, *SETTINGS)}


ROWS = [row(k, goal) for k in (0, 1) for goal in range(5)]


@pytest.fixture
def path(tmp_path):
    """A table of the first seven rows, in a directory of its own that was not there."""
    with CellTable(tmp_path / "new" / "s.csv") as table:
        assert table.add(ROWS[:7]) == ROWS[:7]
    return tmp_path / "new" / "s.csv"


def test_a_table_is_gone_on_with(path):
    whole = path.read_bytes()
    path.write_bytes(whole + b"runs/a,20,window-open,4")  # killed while it wrote
    with CellTable(path) as table:
        assert [table.holds(cell(r)) for r in ROWS[:9]] == [True] * 7 + [False] * 2
        assert not table.holds(cell(ROWS[0]) | {"horizon": 500})  # another setting, another cell
        assert not table.holds(cell(ROWS[0]) | {"run": "runs/b"})
        assert table.add(ROWS) == ROWS[7:]
    assert path.read_bytes().startswith(whole)
    assert path.read_text().count("\n") == 1 + len(ROWS)  # each once
    with CellTable(path) as table:
        assert table.rows({}) == ROWS


def test_rows_of_one_checkpoint():
    table = CellTable(None)
    table.add([r | {"checkpoint": c} for r in ROWS for c in ("20", "40")])
    assert len(table.rows({"checkpoint": 40, "text": None})) == len(ROWS)
    assert {r["checkpoint"] for r in table.rows({"checkpoint": 40})} == {"40"}


def damaged(path, change):
    """The refusal of a table some of whose bytes are changed; it is left as it is."""
    path.write_bytes(change(path.read_bytes()))
    before = path.read_bytes()
    with pytest.raises(ConfigError) as error:
        CellTable(path)
    assert path.read_bytes() == before
    return error.value


HEADER = ",".join(COLUMNS).encode()


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda x: b"iteration,env_steps\n0,1\n", "does not hold the columns of a sweep"),
        (lambda x: b"\x89PNG", "does not hold the columns"),
        (lambda x: x.replace(b",sentences", b"", 1), "of another version: it has no column sent"),
    ],
)
def test_another_file_stays_unless_it_is_forced(path, change, cause):
    error = damaged(path, change)
    assert cause in error.cause and "--force" in error.cure
    with CellTable(path, force=True) as table:
        table.add(ROWS[:1])
    with CellTable(path) as table:
        assert table.rows({}) == ROWS[:1]


@pytest.mark.parametrize("force", [False, True])
def test_no_table_of_cells_is_begun_anew(path, force):
    with CellTable(path, force) as table:
        assert table.rows({}) == ROWS[:7]


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        # Rows of two processes that wrote at once: one ends inside the other.
        (lambda x: x.replace(b",0,0,0\n", b",0,runs/a,20,01", 1), "line 2"),
        (lambda x: x + b"runs/a,20\n" + b"", "line 9"),
        (lambda x: x.replace(b",deterministic", b",determ\xffnistic", 3), "line 2"),
        (lambda x: x.replace(b"window-open,3,", b"window-open,x,", 1), "line 5"),
    ],
)
def test_a_damaged_row_is_named_by_its_line(path, change, cause):
    error = damaged(path, change)
    assert f"{cause} of {path} is damaged" in error.cause and "delete that line" in error.cure


def test_a_row_with_a_number_too_many_is_damaged(path):
    text = path.read_text().splitlines(keepends=True)
    path.write_text("".join([*text[:3], text[3].replace("\n", ",7\n"), *text[4:]]))
    with pytest.raises(ConfigError, match=f"line 4 of .* {len(COLUMNS) + 1} columns"):
        CellTable(path)


def test_two_processes_do_not_write_to_one_table(path):
    """The lock belongs to the open file, so a second one of this process is as another process."""
    whole = path.read_bytes()
    with CellTable(path):
        with pytest.raises(ConfigError, match="another process is writing to") as error:
            CellTable(path)
        assert "another file" in error.value.cure
    with CellTable(path) as table:  # and it is given back
        table.add(ROWS[7:8])
    assert path.read_bytes().startswith(whole)


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK])
def test_a_file_system_without_locks_is_warned_of(path, monkeypatch, capsys, number):
    def flock(*args):
        raise OSError(number, "not here")

    monkeypatch.setattr(fcntl, "flock", flock)
    with CellTable(path) as table:
        table.add(ROWS)
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith("warning: ") and str(path) in line and "without locks" in line


def test_a_disk_that_refuses_a_row_is_two_lines():
    with CellTable(None) as table:
        table._file = open("/dev/full", "ab", buffering=0)
        with pytest.raises(ConfigError, match="No space left") as error:
            table.add(ROWS)
    assert "make room" in error.value.cure


# What names a cell ------------------------------------------------------------------------------

CHANGED: dict[str, Any] = {
    "goal_set": "fresh:3", "seed": 5, "horizon": 100, "physics": "mjx", "policy": "sampled",
    "z": "prior", "paraphrases": "heldout", "text_control": "zero", "text": "shut it",
    "adapt": "search", "protocol": "task",
}  # fmt: skip


def test_every_option_names_a_cell_or_has_a_reason_not_to():
    """A new option is a column of its own, or somebody has thought about it."""
    names = {f.name for f in fields(EvalOptions)}
    assert names == CHANGED.keys() | UNNAMED.keys()
    assert not CHANGED.keys() & UNNAMED.keys() and all(UNNAMED.values())
    usual = settings(OPTIONS, small_config())
    assert tuple(usual) == SETTINGS
    for name, value in CHANGED.items():
        other = settings(replace(OPTIONS, **{name: value}), small_config())
        assert other[RENAMED.get(name, name)] == value != usual[RENAMED.get(name, name)]


def test_an_empty_sentence_is_not_no_sentence():
    table = CellTable(None)
    table.add([row()])
    empty = settings(replace(OPTIONS, text=""), small_config())
    assert table.holds(row()) and not table.holds(row() | empty)
