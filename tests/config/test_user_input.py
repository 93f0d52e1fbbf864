"""Numbers, paths and names that a user typed: every flag of every command has the same bounds.

The lists are not of flags known to have been wrong: they come from the parsers themselves, so a
flag that is added is tested too.
"""

import argparse
import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from cmrl_jax.cli import (
    evaluate_flags,
    finetune_flags,
    plot_flags,
    render_flags,
    report_flags,
    train,
)
from cmrl_jax.cli import goals as goals_cli
from cmrl_jax.cli import main as cli
from cmrl_jax.cli.main import main
from cmrl_jax.config.files import load_config, to_yaml
from cmrl_jax.config.schema import Config, ConfigError, leaves
from envs import command_line, goal_sets
from envs.command_line import Parser, typed_path, what_is
from envs.outputs import check_output
from envs.parity import __main__ as parity
from envs.render import picture

PARSERS = {
    "train": train.train_parser(),
    "eval": evaluate_flags.eval_parser(),
    "sweep": evaluate_flags.sweep_parser(),
    "bench": cli.bench_parser(),
    "render": render_flags.add_flags(Parser()),
    "finetune": finetune_flags.add_flags(Parser()),
    "plot": plot_flags.add_flags(Parser()),
    "report": report_flags.add_flags(Parser()),
    "parity": parity._parser(),
}
goals_cli.add_flags(goals := Parser())
PARSERS["goals"] = goals
ALONE = {"parity": parity.main, "picture": picture.main, "goal_sets": goal_sets.main}
RUN = {"sweep": "--runs"}
RUN |= {command: "--run" for command in ("eval", "finetune", "plot", "render", "report")}


def flags_of(kind: type) -> list[tuple[str, str]]:
    """(command, flag) of every flag whose value is of a kind, or a tuple of it."""
    found = []
    for command, parser in PARSERS.items():
        for action in parser._actions:
            value = action.type("1") if callable(action.type) else None
            one = value[0] if isinstance(value, tuple) else value
            if type(one) is kind or (isinstance(one, Path) and kind is Path):
                found.append((command, action.option_strings[0]))
    return found


NUMBERS, PATHS = flags_of(int), flags_of(Path)


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A working directory with a run `r`, a file, a directory and a loop of links."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "config.yaml").write_text(to_yaml(load_config("smoke.yaml")))
    (tmp_path / "file").write_text("here first")
    (tmp_path / "directory").mkdir()
    (tmp_path / "loop").symlink_to("pool")
    (tmp_path / "pool").symlink_to("loop")
    return tmp_path


def words_of(command: str, flag: str, value: str) -> list[str]:
    """A command that nothing is wrong with but this flag."""
    words = [] if command in ALONE else [command]
    if flag != RUN.get(command) and command in RUN:
        words += [RUN[command], "r"]
    if command == "finetune":
        words += ["--task", "window-close"]
    if command == "train" and flag != "--config":
        words += ["--config", "smoke.yaml"]
    return [*words, flag, value]


@pytest.fixture
def mistake(capsys):
    """Runs a command on a mistake; returns its one line of cause and one of cure."""

    def run(command: str, words: list[str]) -> tuple[str, str]:
        code = ALONE.get(command, main)(words)
        out, err = capsys.readouterr()
        assert code == 2 and out == "", (out, err)
        cause, cure = err.splitlines()
        assert cause.startswith("error: ") and cure.startswith("fix: ")
        return cause, cure

    return run


# Numbers ----------------------------------------------------------------------------------------


def test_the_lists_have_the_flags_that_they_are_for():
    assert {("eval", "--seed"), ("eval", "--k"), ("render", "--every")} <= set(NUMBERS)
    assert {("finetune", "--episodes"), ("parity", "--seed")} <= set(NUMBERS)
    assert {("train", "--config"), ("plot", "--run"), ("goals", "--weights")} <= set(PATHS)
    assert not [a for p in PARSERS.values() for a in p._actions if a.type in (int, Path)]


@pytest.mark.parametrize("number", ["4294967296", "18446744073709551616", "9" * 5000, "-1"])
@pytest.mark.parametrize(("command", "flag"), NUMBERS, ids=map(" ".join, NUMBERS))
def test_a_number_that_would_wrap_is_refused(mistake, here, command, flag, number):
    cause, cure = mistake(command, words_of(command, flag, number))
    assert flag in cause and "no whole number from" in cause and "in this range" in cure
    assert len(cause) < 300
    assert sorted(os.listdir(here / "r")) == ["config.yaml"]


SEEDS = [pair for pair in NUMBERS if pair[1] == "--seed"]


@pytest.mark.parametrize(("command", "flag"), SEEDS, ids=map(" ".join, SEEDS))
def test_a_seed_has_the_bounds_of_the_configs_seed(mistake, here, command, flag):
    seed = next(f for name, f, _ in leaves(Config()) if name == "seed")
    largest = seed.metadata["high"]
    assert largest == 2**31 - 1
    [action] = [a for a in PARSERS[command]._actions if flag in a.option_strings]
    assert callable(action.type) and action.type(str(largest)) == largest
    assert str(largest) in mistake(command, words_of(command, flag, str(largest + 1)))[0]


WHOLE = [
    name
    for name, _, value in leaves(Config())
    if type(value) is int or (isinstance(value, tuple) and type(value[0]) is int)
]


@pytest.mark.parametrize("name", WHOLE)
def test_a_whole_number_of_the_config_has_an_upper_bound(name):
    """Steps of a whole run are counted by Python, where none wraps."""
    too_large = 10**13 if name == "train.env_steps" else 2**31
    value = dict((n, v) for n, _, v in leaves(Config()))[name]
    text = f"{too_large}" if isinstance(value, int) else ",".join([f"{too_large}"] * len(value))
    with pytest.raises(ConfigError, match=f"^{name} is {too_large}\ngive {name} .* at most "):
        load_config("ml4.yaml", {name: text})


def test_a_run_of_many_env_steps_is_none_of_them():
    assert load_config("ml4.yaml", {"train.env_steps": "5000000000"}).train.env_steps == 5 * 10**9


def test_a_ring_of_too_many_slots_is_refused():
    with pytest.raises(ConfigError, match="collect.context_episodes .* slots") as error:
        load_config("ml4.yaml", {"collect.context_episodes": "2000000"})
    most = error.value.cure.split()[-1]
    config = load_config("ml4.yaml", {"collect.context_episodes": most})
    assert int(most) * 32 * config.env.horizon < 2**31 < 2000000 * 32 * config.env.horizon


# Paths ------------------------------------------------------------------------------------------

EVERY_PATH = [*PATHS, ("picture", "--out"), ("goal_sets", "--out"), ("sweep", "--runs")]
NOWHERE = {"too long": "x" * 300, "NUL": "a\0b", "loop": "loop", "in a loop": "loop/x"}


@pytest.mark.parametrize("path", NOWHERE.values(), ids=NOWHERE)
@pytest.mark.parametrize(("command", "flag"), EVERY_PATH, ids=map(" ".join, EVERY_PATH))
def test_a_path_that_leads_nowhere_is_refused(mistake, here, command, flag, path):
    cause, cure = mistake(command, words_of(command, flag, path))
    assert flag in cause and cure and len(cause) < 300
    assert sorted(os.listdir(here)) == ["directory", "file", "loop", "pool", "r"]


@pytest.mark.parametrize(("command", "flag"), EVERY_PATH, ids=map(" ".join, EVERY_PATH))
def test_a_path_through_a_file_is_refused(mistake, here, monkeypatch, command, flag):
    monkeypatch.setattr(picture, "choose_gl", lambda: None)
    shutil.copy(Path(__file__).parents[2] / "results/pearl/metrics.csv", here / "r")
    path = "file/x.png" if flag == "--figure" else "file/x"
    cause, _ = mistake(command, words_of(command, flag, path))
    assert "file" in cause
    assert (here / "file").read_text() == "here first"


@pytest.mark.parametrize(
    ("command", "flag"), [p for p in PATHS if p[1] in ("--json", "--csv", "--config")]
)
def test_a_directory_where_a_file_is_meant_is_refused(mistake, here, command, flag):
    assert "directory" in mistake(command, words_of(command, flag, "directory"))[0]


@pytest.mark.parametrize("table", ["x" * 300 + ".npz", "loop/t.npz", "file/t.npz", "d.npz"])
def test_a_goal_table_that_leads_nowhere_is_refused(refused, here, table):
    (here / "d.npz").mkdir()
    cause, cure = refused("--config", "smoke.yaml", "--run", "new", "--goals.table", table)
    assert "goal" in cause and table[-5:] in cause and len(cause) < 400 and cure
    assert not (here / "new").exists()


def test_a_goal_table_with_a_nul_in_its_yaml(refused, here):
    (here / "c.yaml").write_text('goals: {table: "a\\0b.npz"}')
    assert r"\x00" in refused("--config", "c.yaml")[0]


def test_a_folder_that_may_not_be_searched_is_said(monkeypatch):
    def denied(path):
        raise PermissionError(13, "Permission denied", path)

    monkeypatch.setattr(command_line, "os", SimpleNamespace(stat=denied))
    with pytest.raises(ValueError, match="secret/run cannot be followed: Permission denied\n"):
        what_is("secret/run")
    with pytest.raises(argparse.ArgumentTypeError, match="folders that you may search"):
        typed_path("secret/run")


def test_a_run_beside_what_cannot_be_looked_at_is_found(refused, here):
    """The list of runs in a cure leaves it out."""
    (here / "runs").mkdir()
    (here / "runs" / "loop").symlink_to("loop")
    shutil.copytree(here / "r", here / "runs" / "my run")
    assert refused("eval", "--run", "no")[1] == "give --run one of: 'runs/my run'"


def test_what_lies_at_a_path(here):
    for path, expected in (("file", "file"), ("r", "directory"), ("no", "nothing")):
        assert what_is(path) == expected
    assert what_is("file/x") == "nothing"
    assert what_is(os.devnull) == "file"


def test_trying_a_file_leaves_what_is_there(here):
    (here / "link").symlink_to("target")
    os.mkfifo(here / "pipe")
    for name in ("new", "file", "link", "pipe"):  # nobody reads the pipe: no waiting
        check_output(Path(name), "--json", "", force=True)
    assert not (here / "new").exists() and (here / "file").read_text() == "here first"
    assert (here / "link").is_symlink() and not (here / "target").exists()


# Names of the same thing ------------------------------------------------------------------------

GOAL_SETS = [c for c, p in PARSERS.items() if "--goal-set" in p._option_string_actions]


@pytest.mark.parametrize(
    ("name", "only"), [("fresh:0", "train"), ("fresh:1000", "heldout"), ("fresh:007", "fresh:7")]
)
@pytest.mark.parametrize("command", GOAL_SETS)
def test_a_goal_set_has_one_name(mistake, here, command, name, only):
    cause, cure = mistake(command, words_of(command, "--goal-set", name))
    assert f"'{name}' is the goal set '{only}'" in cause and cure == f"fix: call it {only}"


def test_a_goal_set_of_the_config_has_one_name(refused, here):
    cause, cure = refused("--config", "smoke.yaml", "--eval.goal_set", "fresh:0")
    assert cause == "eval.goal_set 'fresh:0' is the goal set 'train'" and cure == "call it train"


def test_runs_of_two_names_are_one(here):
    (here / "latest").symlink_to("r")
    assert evaluate_flags.find_runs(["r", "latest", str(here / "r"), "./*"]) == [Path("r")]


def test_a_run_is_drawn_once(refused, here):
    cause, cure = refused("plot", "--run", "r", "--run", str(here / "r"))
    assert "stands there twice" in cause and "once" in cure
