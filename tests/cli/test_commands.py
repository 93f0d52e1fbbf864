"""Commands that are printed for pasting: called as the user called, quoted for a shell."""

import errno
import os
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from cmrl_jax import commands
from cmrl_jax.cli import train
from cmrl_jax.commands import command
from cmrl_jax.config.schema import Config
from cmrl_jax.stop import Stop
from cmrl_jax.storage import run_dir

ROOT = Path(__file__).parents[2]
NAMES = ["my run/a b", "it's", "$HOME", "a;b", "plain/run-1"]


@pytest.fixture(autouse=True)
def activated(monkeypatch):
    """`python` is this Python, whoever runs the tests."""
    which = commands.shutil.which
    own = lambda name: sys.executable if name == "python" else which(name)
    monkeypatch.setattr(commands.shutil, "which", own)


@pytest.mark.parametrize(
    ("started", "program"),
    [
        ("train.py", "python train.py"),
        ("../my clone/train.py", "python '../my clone/train.py'"),
        ("/venv/bin/pytest", "python train.py"),
        ("-c", "python train.py"),
        ("/not on/the path/cmrl", "'/not on/the path/cmrl'"),
    ],
)
def test_the_program_is_called_as_it_was_started(monkeypatch, started, program):
    monkeypatch.setattr(sys, "argv", [started])
    assert commands.program() == program


def test_python_is_named_by_its_path_where_python_is_another_one(monkeypatch, tmp_path):
    """As for who calls `make train` and has activated nothing."""
    monkeypatch.setattr(sys, "argv", ["train.py"])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(commands.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(sys, "executable", str(tmp_path / ".venv" / "bin" / "python"))
    assert command("--resume") == ".venv/bin/python train.py --resume"
    monkeypatch.setattr(sys, "executable", "/else where/bin/python")
    assert command("--resume") == "'/else where/bin/python' train.py --resume"


@pytest.mark.parametrize("name", NAMES)
def test_a_shell_reads_back_what_was_meant(name):
    assert shlex.split(command("--run", Path(name), "--resume")) == [
        "python", "train.py", "--run", name, "--resume",
    ]  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_commands_to_go_on_with_a_run_are_quoted(name, replace_module, capsys):
    outcome = SimpleNamespace(is_finished=False, iteration=3)
    replace_module("cmrl_jax.training.trainer", SimpleNamespace(train_seeds=lambda **_: [outcome]))
    assert train._in_console([(Config(), Path(name))], Path(name), Stop(), False) == 0
    stopped = capsys.readouterr().out.partition("go on with: ")[2]
    error = run_dir.cannot_write(Path(name), OSError(errno.ENOSPC, "No space left on device"))
    for said in (error.cure.partition(": ")[2], stopped):
        assert shlex.split(said)[-3:] == ["--run", name, "--resume"]


@pytest.fixture
def cmrl(tmp_path):
    """Runs the console script as an installed package has it; returns its output and errors."""
    script = tmp_path / "bin" / "cmrl"
    script.parent.mkdir()
    script.write_text(f"#!{sys.executable}\n{commands.CHILD}\n")
    script.chmod(0o755)
    path = f"{script.parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT)}

    def run(*words: str, by: str = "cmrl") -> tuple[str, str]:
        done = subprocess.run(
            [by, *words], env=environment, capture_output=True, text=True, cwd=tmp_path
        )
        return done.stdout, done.stderr

    return run


def test_an_installed_script_speaks_of_itself(cmrl, tmp_path):
    assert "see: cmrl --help" in cmrl("--config", "ml4.yaml", "--sac", "1")[1]
    assert "see: cmrl eval --help" in cmrl("eval")[1]
    for words in (["--help"], ["sweep", "--help"], ["goals", "--help"]):
        text = cmrl(*words)[0]
        assert text.startswith("usage: cmrl") and "train.py" not in text
    assert "build it: cmrl goals" in cmrl("--config", "ml4.yaml", "--goals.table", "my t.npz")[1]
    assert "'my t.npz'" in cmrl("--config", "ml4.yaml", "--goals.table", "my t.npz")[1]
    assert "train first: cmrl --config ml4.yaml" in cmrl("eval", "--run", "no")[1]
