"""Tests run on the CPU, with a compilation cache that outlives them: compiling is most of the time.

Set before jax is imported, as environment variables, so that subprocesses of tests have them too.
"""

import importlib
import os
import signal
import sys
from pathlib import Path
from types import ModuleType

import pytest

from cmrl_jax.cli.main import main  # imports neither jax nor mujoco

# Not in `.cache`, which zensical empties whenever it builds the site.
CACHE = Path(__file__).resolve().parent.parent / ".jax-cache"

# Files of minutes: begun first, so that at the end no process is left with one of them.
LONG = ("train", "finetune", "learner", "faults", "process", "parallel", "api", "film", "sweep")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # Ignored by a shell that began the tests in the background, and so by every run they begin.
    signal.signal(signal.SIGINT, signal.default_int_handler)

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: item.path.stem.removeprefix("test_") not in LONG)


@pytest.fixture
def monkeypatch(monkeypatch):
    """pytest's own; what it patches may be traced, so compiled programs are not shared with it."""

    def forget():
        session = sys.modules.get("cmrl_jax.evaluation.session")
        if type(session) is ModuleType:  # no stand-in for it
            session.forget_programs()

    setattr_, undo = monkeypatch.setattr, monkeypatch.undo
    monkeypatch.setattr = lambda *args, **options: (forget(), setattr_(*args, **options))[1]
    monkeypatch.undo = lambda: (forget(), undo())[1]
    yield monkeypatch
    forget()


@pytest.fixture
def refused(capsys):
    """Runs the command line on a user's mistake; returns its one line of cause and one of cure."""

    def run(*words: str) -> tuple[str, str]:
        code = main(words)
        out, err = capsys.readouterr()
        lines = err.splitlines()
        assert (code, out, len(lines)) == (2, "", 2), (code, out, err)
        assert lines[0].startswith("error: ") and lines[1].startswith("fix: "), err
        return lines[0].removeprefix("error: "), lines[1].removeprefix("fix: ")

    return run


@pytest.fixture
def replace_module(monkeypatch):
    """Puts another object in the place of a module that is imported when it is needed."""

    def replace(name: str, fake: object) -> None:
        package, _, leaf = name.rpartition(".")
        monkeypatch.setitem(sys.modules, name, fake)
        monkeypatch.setattr(importlib.import_module(package), leaf, fake, raising=False)

    return replace


# Imported when asked for, since metaworld and mjx take seconds.


@pytest.fixture(scope="session")
def port():
    """One compiled step of the environment for all tests: `env_fixtures.CountedPort`."""
    from env_fixtures import CountedPort

    return CountedPort()


@pytest.fixture(scope="session")
def rollouts():
    """Recorded episodes of Meta-World, three a task: scripted, perturbed, random."""
    from env_fixtures import record

    return record()


@pytest.fixture(scope="session")
def gl():
    """Value of MUJOCO_GL for a process that draws; skips where no GL library can be had.

    MuJoCo takes its GL from the environment when it is imported, so pictures need processes of
    their own.
    """
    from envs.render.frames import choose_gl

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MUJOCO_GL", os.environ.get("MUJOCO_GL", ""))  # put back afterwards
        try:
            choose_gl()
        except ValueError as error:
            pytest.skip(str(error).partition("\n")[0])
        return os.environ["MUJOCO_GL"]


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """A finished `native` run of smoke.yaml, for others to be compared with; do not change it."""
    from run_helpers import native, smoke

    run = tmp_path_factory.mktemp("undisturbed") / "run"
    assert smoke(run, *native()) == 0
    return run


@pytest.fixture(scope="session")
def undisturbed_modular(tmp_path_factory):
    """The same with the soft modules of smoke.yaml."""
    from run_helpers import modular, smoke

    run = tmp_path_factory.mktemp("modular") / "run"
    assert smoke(run, *modular()) == 0
    return run
