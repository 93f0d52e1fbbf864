"""Whatever is typed or written ends as a config, in the program, or as one cause and one cure.

That is everything before jax is imported: YAML documents against `config_io`, flags and paths
against every command. 2,000 examples, the same each time, whose counts `pytest -s` prints. More of
them, and others: `FUZZ=10 pytest tests/config/test_fuzz.py -s --hypothesis-seed 7`.
"""

import contextlib
import io
import os
import re
import shutil
from collections import Counter
from pathlib import Path
from types import ModuleType

import hypothesis.configuration
import pytest
from fuzz_inputs import RUNS, command_lines, documents
from hypothesis import HealthCheck, given, settings
from hypothesis.internal.conjecture import providers
from hypothesis.internal.constants_ast import Constants
from test_structure import LIGHT, LIGHT_OF_ENVS, MODULES

from cmrl_jax.cli import main as cli
from cmrl_jax.config.files import read_yaml, resolve, to_yaml
from cmrl_jax.config.schema import ConfigError

TIMES = int(os.environ.get("FUZZ", "1"))


SLOW_MACHINES = (
    HealthCheck.too_slow,
    HealthCheck.data_too_large,
    HealthCheck.filter_too_much,
    HealthCheck.function_scoped_fixture,
)


def examples(count: int) -> settings:
    return settings(
        max_examples=count * TIMES,
        derandomize=TIMES == 1,
        deadline=None,
        database=None,
        suppress_health_check=SLOW_MACHINES,
    )


@pytest.fixture(autouse=True)
def same_examples_each_time(tmp_path_factory, monkeypatch):
    """Hypothesis also tries constants of the modules that happen to be loaded, and keeps files."""
    hypothesis.configuration.set_hypothesis_home_dir(tmp_path_factory.mktemp("hypothesis"))
    monkeypatch.setattr(providers, "_get_local_constants", Constants)


class Outcomes:
    """Counts what examples end as; a refusal must be one line of cause and one of cure."""

    def __init__(self):
        self.count: Counter[str] = Counter()
        self.causes: set[str] = set()

    def refused(self, cause: str, cure: str) -> None:
        for text in (cause, cure):
            assert text.strip() and text.splitlines() == [text], (cause, cure)
        self.count["refused"] += 1
        self.causes.add(re.sub(r"'.*'|[0-9.]+|\(.*\)", "", cause)[:40])

    def report(self, what: str, record) -> None:
        ends = ", ".join(f"{n} {name}" for name, n in self.count.most_common())
        line = f"{self.count.total()} {what}: {ends}; {len(self.causes)} different causes"
        print(line)
        record("fuzz", line)


@examples(500)
@given(document=documents())
def check_document(path: Path, outcomes: Outcomes, document: bytes) -> None:
    """Reads a document as a config, which must read back from what it is written as."""
    path.write_bytes(document)
    try:
        config = resolve(*read_yaml(path))
    except ConfigError as error:
        return outcomes.refused(error.cause, error.cure)
    outcomes.count["a config"] += 1
    path.write_text(to_yaml(config), encoding="utf-8")
    assert resolve(*read_yaml(path)) == config


def test_documents(tmp_path, record_property):
    outcomes = Outcomes()
    check_document(tmp_path / "x.yaml", outcomes)
    outcomes.report("documents", record_property)
    assert outcomes.count.total() >= 500
    assert min(outcomes.count[end] for end in ("refused", "a config")) > 50


# The command line ---------------------------------------------------------------------------------


class Reached(BaseException):
    """The light half is over: the program would be imported now."""


class Stub(ModuleType):
    """In place of a module that imports jax: whatever is called, the program is reached."""

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return self._reached

    def _reached(self, *args, **kwargs):
        raise Reached


class Sandbox:
    """A directory with runs and files of all sorts, two levels down, put back after each change."""

    def __init__(self, top: Path):
        self.top, self.home = top, top / "middle" / "here"
        self.restore()

    def __repr__(self) -> str:
        return "sandbox"

    def restore(self) -> None:
        os.chdir(self.top.parent)
        shutil.rmtree(self.top, ignore_errors=True)
        self.home.mkdir(parents=True)
        os.chdir(self.home)
        for run, text in RUNS.items():
            Path(run, "policy").mkdir(parents=True)
            Path(run, "config.yaml").write_text(text)
        Path("file").write_text("text")
        Path("x.npz").write_text("")
        Path("round").symlink_to("round")
        Path("loose").symlink_to("nowhere/at/all")
        self.before = self._files()

    def _files(self) -> set[tuple[str, int, float]]:
        """What there is below the top directory's parent: name, mode, time of the last change."""
        found = set()
        for folder, folders, names in os.walk(self.top.parent):
            for name in (*folders, *names):
                status = os.lstat(os.path.join(folder, name))
                when = 0.0 if name in folders else status.st_mtime
                found.add((os.path.join(folder, name), status.st_mode, when))
        return found

    def changes(self) -> set[str]:
        """What is new, gone or rewritten since `restore`."""
        return {os.path.relpath(name, self.home) for name, _, _ in self.before ^ self._files()}


@pytest.fixture
def sandbox(tmp_path, monkeypatch, replace_module):
    light = {f"cmrl_jax.{name}" for name in LIGHT} | {f"envs.{name}" for name in LIGHT_OF_ENVS}
    for name, path in MODULES.items():
        if path.stem != "__init__" and name not in light:
            replace_module(name, Stub(name))
    monkeypatch.chdir(tmp_path)  # and back at the end
    return Sandbox(tmp_path / "top")


def check_words(sandbox: Sandbox, outcomes: Outcomes, words: list[str]) -> None:
    """Runs one command line up to the program; a refused one must leave nothing behind."""
    said, end = io.StringIO(), "refused"
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            code = cli.main(words)
        assert code == 2, f"{code} without the program: {said.getvalue()}"
    except Reached:
        end = "in the program"
    except SystemExit as stop:
        assert stop.code == 0
        end = "helped"
    finally:
        if changes := sandbox.changes():
            sandbox.restore()
    if end != "refused":
        outcomes.count[end] += 1
        return
    lines = said.getvalue().splitlines()
    assert len(lines) == 2 and lines[0].startswith("error: ") and lines[1].startswith("fix: ")
    assert not changes, f"refused, and yet changed: {changes}, {lines}"
    outcomes.refused(lines[0].removeprefix("error: "), lines[1].removeprefix("fix: "))


check_flags = examples(1000)(given(words=command_lines())(check_words))
check_paths = examples(500)(given(words=command_lines(only_paths=True))(check_words))


@pytest.mark.parametrize(
    ("check", "count"), [(check_flags, 1000), (check_paths, 500)], ids=["flags", "paths"]
)
def test_command_lines(sandbox, record_property, request, check, count):
    outcomes = Outcomes()
    check(sandbox, outcomes)
    outcomes.report(f"command lines ({request.node.callspec.id})", record_property)
    assert outcomes.count.total() >= count
    assert min(outcomes.count[end] for end in ("refused", "in the program")) > count / 10
