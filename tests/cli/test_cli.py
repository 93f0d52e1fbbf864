"""The command line: what it hands on, its errors, its run directories, and the set-up."""

import ast
import datetime
import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from cmrl_jax.cli.main import main
from cmrl_jax.config.files import load_config, to_yaml
from cmrl_jax.storage import run_dir

ROOT = Path(__file__).parents[2]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def calls(here, replace_module):
    """Puts recorders in place of the programs; returns the list of (program, keywords)."""
    made = []

    def recorder(name, result):
        return lambda *args, **kwargs: made.append((name, args, kwargs)) or result

    finished = SimpleNamespace(is_finished=True, wall_s=1.0)
    trainer = SimpleNamespace(train_seeds=recorder("trainer", [finished]))
    replace_module("cmrl_jax.training.trainer", trainer)
    replace_module("cmrl_jax.bench.main", SimpleNamespace(main=recorder("bench", 0)))
    return made


def make_run(path: Path, config: str = "ml4.yaml", **flags: Any) -> Path:
    path.mkdir(parents=True)
    (path / "config.yaml").write_text(to_yaml(load_config(config, flags)))
    return path


# Training ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", [[], ["train"]])
def test_bare_config_trains(calls, command):
    flags = ["--train.env_steps", "100", "--sac.batch=64", "--seed=7"]
    assert main([*command, "--config", "pearl.yaml", *flags]) == 0
    [(name, args, kwargs)] = calls
    assert (name, args) == ("trainer", ())
    [config], [run] = kwargs["configs"], kwargs["run_dirs"]
    assert (config.train.env_steps, config.sac.batch, config.seed) == (100, 64, 7)
    assert kwargs["resume"] is False
    assert run.is_dir() and run.parent == Path("runs")
    assert run.name.startswith("pearl-2")


def test_run_directory_of_ones_own(calls):
    assert main(["--config", "ml4.yaml", "--run", "a/b"]) == 0
    assert calls[0][2]["run_dirs"] == [Path("a/b")] and Path("a/b").is_dir()


def test_run_directory_that_holds_a_run_needs_resume(calls, refused, here):
    make_run(here / "r")
    cause, cure = refused("--config", "ml4.yaml", "--run", "r")
    assert "already holds a run" in cause and "--resume" in cure
    assert main(["--config", "ml4.yaml", "--run", "r", "--resume"]) == 0
    assert main(["--run", "r", "--resume"]) == 0  # its own config
    for _, _, kwargs in calls:
        assert (kwargs["run_dirs"], kwargs["resume"]) == ([Path("r")], True)


def test_resume_takes_the_newest_run_of_that_config(calls, refused, here):
    assert "no run of 'ml4'" in refused("--config", "ml4.yaml", "--resume")[0]
    for name in ("ml4-20260102-000000", "ml4-20260103-000000", "ml4-20260103-000000-2"):
        make_run(here / "runs" / name)
    make_run(here / "runs" / "ml4-large-20260104-000000")
    make_run(here / "runs" / "ml4-mine")
    (here / "runs" / "ml4-20260105-000000").mkdir()  # nothing was written yet
    assert main(["--config", "ml4.yaml", "--resume"]) == 0
    newest = Path("runs/ml4-20260103-000000-2")
    assert calls[0][2]["run_dirs"] == [newest]
    assert main(["--config", str(newest / "config.yaml"), "--resume"]) == 0
    assert calls[1][2]["run_dirs"] == [newest]
    seeds = here / "runs" / "ml4-20260106-000000"
    for seed in (3, 4):
        make_run(seeds / f"seed{seed}", seed=seed)
    assert main(["--config", "ml4.yaml", "--resume"]) == 0
    assert [config.seed for config in calls[2][2]["configs"]] == [3, 4]
    assert main(["--config", str(newest / "config.yaml")]) == 0
    assert main(["--config", str(seeds / "seed4" / "config.yaml")]) == 0
    assert calls[4][2]["run_dirs"][0].name.startswith("ml4-2")


def test_resume_refuses_a_changed_field_by_name(calls, refused, here):
    make_run(here / "r")
    cause, cure = refused("--config", "ml4.yaml", "--run", "r", "--resume", "--sac.lr", "0.1")
    assert "sac.lr: 0.0003 -> 0.1" in cause and "r/config.yaml" in cure
    longer = ["--train.env_steps", "9000000", "--eval.goals", "5"]
    assert main(["--config", "ml4.yaml", "--run", "r", "--resume", *longer]) == 0
    assert not list(here.glob("runs/*"))


def test_resume_of_a_directory_without_a_run(refused, here):
    (here / "empty").mkdir()
    make_run(here / "runs" / "ml4-20260102-000000")
    cause, cure = refused("--config", "ml4.yaml", "--run", "empty", "--resume")
    assert "holds no run" in cause and "runs/ml4-20260102-000000" in cure


def test_two_runs_in_one_second_get_two_directories(here):
    now = datetime.datetime(2026, 1, 2, 3, 4, 5)
    names = [run_dir.new_run("ml4", None, now).name for _ in range(3)]
    assert names == ["ml4-20260102-030405", "ml4-20260102-030405-1", "ml4-20260102-030405-2"]


def test_run_directory_that_cannot_be_written(refused, here):
    (here / "file").write_text("")
    cause, cure = refused("--config", "ml4.yaml", "--run", "file/run")
    assert "cannot write to run directory file/run" in cause and "--run DIR" in cure


def test_missing_extra(refused, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    cause, cure = refused("--config", "ml4.yaml", "--log.tensorboard", "true")
    assert "tensorboardX" in cause and "cmrl-jax[viz]" in cure


# Errors -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "cause", "cure"),
    [
        ([], "no --config given", "ml4.yaml"),
        (["--resume"], "no --config given", "ml4.yaml"),
        (["trian"], "unknown command 'trian'", "did you mean 'train'?"),
        (["configs/ml4.yaml"], "unknown command 'configs/ml4.yaml'", "--config ml4.yaml"),
        (["goals", "--shwo"], "unknown argument '--shwo'", "'--show'?"),
        (["goals", "--encoder", "clip"], "unknown encoder 'clip'", "clip-vit-b-32"),
        (["goals", "--show", "--encoder", "zeor"], "'zeor' (goals.table)", "did you mean 'zero'?"),
        (["--config", "ml4.yaml", "--sac.rl", "1"], "unknown argument '--sac.rl'", "'--sac.lr'?"),
        (["--config", "ml4.yaml", "--sac.rl=1"], "unknown argument '--sac.rl'", "'--sac.lr'?"),
        (["--config", "ml4.yaml", "--sac", "1"], "unknown argument '--sac'", "--help"),
        (["--config", "ml4.yaml", "more"], "unknown argument 'more'", "--help"),
        (["--config", "ml4.yaml", "--sac.lr"], "--sac.lr: expected one argument", "--help"),
        (["--config"], "--config: expected one argument", "--help"),
        (["--config", "ml4.yaml", "--sac.lr", "3e-4"], "the text '3e-4' (--sac.lr)", "3.0e-4"),
        (["--config", "ml4.yaml", "--seed", "1e3"], "the text '1e3' (--seed)", "write 1000"),
        (["--config", "ml4.yaml", "--log.progress", "maybe"], "true or false", "true or false"),
        (["--config", "ml4.yaml", "--model.net", "sotf"], "(--model.net)", "did you mean 'soft'?"),
        (["render", "--run", "nope"], "run directory nope does not exist", "train"),
        (["render", "--run", "x", "--k", "-1"], "--k: -1 is no whole number from 0", "one in this"),
        (
            ["render", "--run", "x", "--every", "0"],
            "--every: 0 is no whole number from 1",
            "one in",
        ),
        (["render", "--run", "x", "--goal", "50"], "50 is no whole number from 0 to 49", "has 50"),
        (["render", "--run", "x", "--goal-set", "trian"], "'trian'", "did you mean 'train'?"),
        (["bench", "--jsn", "x"], "unknown argument '--jsn'", "'--json'?"),
        (["bench", "--json", "/dev/null/x"], "cannot write /dev/null/x", "--json"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_mistake_is_one_cause_and_one_cure(refused, here, words, cause, cure):
    got = refused(*words)
    assert cause in got[0] and cure in got[1]
    assert not list(here.iterdir())  # nothing was begun


def test_other_exceptions_keep_their_traceback(calls, replace_module):
    def broken(**kwargs):
        raise ValueError("a bug of ours")

    replace_module("cmrl_jax.training.trainer", SimpleNamespace(train_seeds=broken))
    with pytest.raises(ValueError, match="a bug of ours"):
        main(["--config", "ml4.yaml"])


# Benchmark --------------------------------------------------------------------------------------


def test_bench_hands_over_its_flags(calls):
    assert main(["bench", "--rows", "mjx,learner", "--json", "b.json"]) == 0
    assert calls == [("bench", (), {"json_path": Path("b.json"), "rows": ("mjx", "learner")})]


# train.py and set-up ----------------------------------------------------------------------------


def test_help_and_mistakes_import_neither_jax_nor_mujoco():
    """What makes `--help` answer in under a second."""
    script = """
import sys
from cmrl_jax.cli.main import main
for command in ([], ["eval"], ["sweep"], ["finetune"], ["bench"], ["render"], ["goals"]):
    try:
        main([*command, "--help"])
    except SystemExit as stop:
        assert stop.code == 0
assert main(["--config", "ml4.yaml", "--sac.lr", "3e-4"]) == 2
print(sorted({"jax", "mujoco", "flax", "transformers"} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"
    texts = (
        "--collect.lanes N",
        "--goal-set SET",
        "--rows A,B",
        "--every N",
        "--weights DIR",
        "[96]",
    )
    for text in texts:
        assert text in done.stdout


def entry() -> Any:
    spec = importlib.util.spec_from_file_location("train_entry", ROOT / "train.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_train_py_parses_on_old_pythons():
    source = (ROOT / "train.py").read_text()
    assert not [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.JoinedStr)]
    ast.parse(source, feature_version=(3, 7))  # the oldest that ast knows
    assert len(source.splitlines()) <= 45


def test_train_py_on_an_old_python(monkeypatch, capsys):
    """The environment that is there, with what was typed; else what makes one."""
    monkeypatch.setattr(sys, "version_info", (3, 11, 7))
    monkeypatch.setattr(sys, "argv", ["train.py", "--run", "my run"])
    own = sys.executable
    monkeypatch.setattr(sys, "executable", "/usr/bin/python")
    for place, cure in (
        (own, f"{os.path.relpath(own)} train.py --run 'my run'"),
        ("/nowhere", "run `make train`, which finds or makes the right environment"),
    ):
        module = entry()
        module.OWN = place
        assert module.start() == 2
        assert capsys.readouterr().err.splitlines() == [
            "error: Python >= 3.12 is needed, this is 3.11",
            f"fix: {cure}",
        ]


@pytest.mark.parametrize("name", ["nosuchpackage", "nosuchpackage.part"])
def test_train_py_without_a_package(monkeypatch, capsys, name):
    def missing():
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setitem(sys.modules, "cmrl_jax.cli.main", SimpleNamespace(main=missing))
    module = entry()
    module.OWN = "/nowhere"
    assert module.start() == 2
    error, fix = capsys.readouterr().err.splitlines()
    assert error == "error: the package 'nosuchpackage' is not installed for this Python"
    assert "make train" in fix


@pytest.mark.parametrize("name", ["cmrl_jax.nosuch", "envs.nosuch", "yaml.nosuch", "_lzma", None])
def test_train_py_keeps_the_traceback_of_our_own_bugs(monkeypatch, name):
    def broken():
        raise ModuleNotFoundError("a bug of ours", name=name)

    monkeypatch.setitem(sys.modules, "cmrl_jax.cli.main", SimpleNamespace(main=broken))
    with pytest.raises(ModuleNotFoundError):
        entry().start()


def make_env(home: Path, **more: str) -> subprocess.CompletedProcess:
    """Runs scripts/make_env.sh where nothing but `home` can be found."""
    env = {"HOME": str(home), "PATH": str(home / "bin"), "VENV": str(home / "venv"), **more}
    command = ["/bin/sh", str(ROOT / "scripts" / "make_env.sh")]
    return subprocess.run(command, env=env, capture_output=True, text=True, cwd=home)


def script(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    os.chmod(path, 0o755)


def test_set_up_passes_over_pythons_that_do_not_start(tmp_path):
    """A pyenv shim fails, python3 is too old, pyenv's own 3.12 is the one."""
    script(tmp_path / "bin" / "python3.13", "exit 127")
    script(tmp_path / "bin" / "python3", "exit 1")
    good = tmp_path / ".pyenv" / "versions" / "3.12.9" / "bin" / "python"
    log = tmp_path / "log"
    copy = f'/bin/mkdir -p "$3/bin" && /bin/cp {good} "$3/bin/python"'
    script(good, f'echo "$@" >> {log}\nif [ "$2" = venv ]; then {copy}; fi')
    done = make_env(tmp_path)
    assert done.returncode == 0, done.stderr
    assert f"making {tmp_path / 'venv'} with {good}" in done.stdout
    installs = [line for line in log.read_text().splitlines() if " install " in line]
    assert [line.split("--quiet ")[1] for line in installs] == [
        "-r requirements.lock",
        "--no-deps --no-build-isolation -e .",
    ]


def test_set_up_without_a_python(tmp_path):
    done = make_env(tmp_path)
    assert done.returncode == 2
    assert done.stderr.splitlines()[0] == "error: no Python >= 3.12, < 3.14 found"
    assert done.stderr.splitlines()[1].startswith("fix: install one, or uv")


def test_set_up_refuses_an_old_environment(tmp_path):
    script(tmp_path / "venv" / "bin" / "python", "exit 1")
    done = make_env(tmp_path)
    assert done.returncode == 2
    error, fix = done.stderr.splitlines()
    assert "is not an environment of Python >= 3.12" in error and "remove it" in fix
