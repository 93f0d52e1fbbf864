"""Sweeps over runs of random policies on native physics, six control steps an episode."""

import csv
import json
import shutil
from dataclasses import replace

import jax
import pytest
from policy_fixtures import save_run, small_config

from cmrl_jax.bench import sweep as bench_sweep
from cmrl_jax.bench.sweep import command_words
from cmrl_jax.cli.evaluate_flags import eval_parser, options_of, sweep_parser
from cmrl_jax.cli.flags import parse
from cmrl_jax.cli.main import main
from cmrl_jax.evaluation import sweep as sweep_module
from cmrl_jax.evaluation.cells import CellTable
from cmrl_jax.evaluation.evaluator import Evaluator
from cmrl_jax.evaluation.session import Session, forget_programs
from cmrl_jax.evaluation.sweep import INTERRUPTED
from cmrl_jax.evaluation.targets import targets_of
from envs.physics.native import NativePhysics

GOALS, KS, TASKS = 3, ("0", "2"), 4
PROTOCOL = ["--goals", str(GOALS), "--k", ",".join(KS)]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs of one program, with two and one checkpoints, and one of another, with one."""
    folder = tmp_path_factory.mktemp("runs")
    held_out = {"tasks.train": "[window-close, drawer-close, window-open]"}
    held_out |= {"tasks.test": "[drawer-open]", "seed": "1"}
    save_run(folder / "a", Session(small_config()), seeds=(1, 2))
    save_run(folder / "b", Session(small_config(**held_out)), seeds=(3,))
    save_run(folder / "c", Session(small_config(**{"model.net": "mlp"})), seeds=(4,))
    return folder


@pytest.fixture(scope="module")
def swept(runs):
    """A finished sweep -> its rows by cell, its JSON, and the memory of each program compiled."""
    memory = []
    compile_, memory_bytes = Evaluator.compile, Evaluator.memory_bytes

    def recorded(self, params, width):
        if not self.is_compiled:
            compile_(self, params, width)
            memory.append((self.policies * self.lanes, memory_bytes(self)))

    forget_programs()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Evaluator, "compile", recorded)
        assert sweep(runs, runs / "s.csv", "--json", str(runs / "s.json")) == 0
    return read(runs / "s.csv"), json.loads((runs / "s.json").read_text()), memory


def sweep(runs, csv_path, *words):
    own = ["--csv", str(csv_path)] if csv_path else []
    return main(["sweep", "--runs", f"{runs}/?", "--checkpoints", "all", *PROTOCOL, *own, *words])


def read(path):
    """{(run, checkpoint, task, goal, draw, k): row}; every cell stands there once."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    cells = {
        tuple(r[c] for c in ("run", "checkpoint", "task", "goal", "draw", "k")): r for r in rows
    }
    assert len(cells) == len(rows)
    return cells


def test_every_cell_has_a_row(runs, swept):
    cells, result, memory = swept
    assert len(cells) == 4 * TASKS * GOALS * len(KS) == result["cells"]
    targets = {(key[0], key[1]) for key in cells}
    named = {
        (str(runs / run), step) for run, step in (("a", "1"), ("a", "2"), ("b", "1"), ("c", "1"))
    }
    assert targets == named
    assert [(e["run"], e["iteration"]) for e in result["evaluations"]] == [
        (str(runs / run), step) for run, step in (("a", 1), ("a", 2), ("b", 1), ("c", 1))
    ]
    # Checkpoints of one program share it, whatever their tasks are.
    assert sorted(lanes for lanes, _ in memory) == [12, 36]
    assert 0 < dict(memory)[12] < dict(memory)[36]


def test_figures_are_those_of_eval(runs, swept, tmp_path):
    """Stacked with others and in another order of tasks, a checkpoint scores as it does alone."""
    _, result, _ = swept
    for found in result["evaluations"][1:3]:
        words = ["--checkpoint", str(found["iteration"]), "--json", str(tmp_path / "e.json")]
        assert main(["eval", "--run", found["run"], *PROTOCOL, *words]) == 0
        alone = json.loads((tmp_path / "e.json").read_text())
        assert {k: v for k, v in found.items() if k != "tasks"} == {
            k: v for k, v in alone.items() if k not in ("tasks", "origin")
        }
        assert set(found["tasks"]) == set(alone["tasks"])
        for task, by_k in alone["tasks"].items():
            assert list(found["tasks"][task]) == list(by_k) == list(KS)
            for k, figures in by_k.items():
                assert found["tasks"][task][k]["return"] == pytest.approx(figures["return"], 1e-4)


def test_a_stopped_sweep_goes_on_and_runs_no_cell_twice(runs, swept, tmp_path, monkeypatch):
    path, calls = tmp_path / "s.csv", []
    original = Evaluator.run

    def recorded(self, policies, trial, k, seed):
        if len(calls) == stop_at:
            raise KeyboardInterrupt
        calls.append(len(policies) * len(trial.tasks))
        return original(self, policies, trial, k, seed)

    monkeypatch.setattr(Evaluator, "run", recorded)
    small = ["--lanes", str(2 * GOALS)]  # two checkpoints, one task a batch
    stop_at = 3
    assert sweep(runs, path, *small) == INTERRUPTED
    first = read(path)
    assert len(first) == sum(calls) * GOALS * len(KS) == 6 * GOALS * len(KS)
    path.write_bytes(path.read_bytes()[:-5])  # and the last row only half written
    stop_at = None
    assert sweep(runs, path, *small) == 0
    wanted = swept[0]
    assert sum(calls) == 4 * TASKS + 1  # each (checkpoint, task) once, and the torn one again
    found = read(path)
    assert found.keys() == wanted.keys()
    for cell, row in wanted.items():
        assert float(found[cell]["return"]) == pytest.approx(float(row["return"]), 1e-4)
    calls.clear()
    assert sweep(runs, path, *small) == 0
    assert calls == [] and read(path) == found


def test_eval_adds_to_a_sweeps_table(runs, swept, tmp_path, capsys):
    """Its own rows, each once; the sweep's stay as they are."""
    path = shutil.copy(runs / "s.csv", tmp_path / "s.csv")
    before = path.read_bytes()
    words = ["eval", "--run", str(runs / "b"), *PROTOCOL, "--csv", str(path)]
    assert main(words) == 0
    assert path.read_bytes() == before and "0 rows added, 24 were there" in capsys.readouterr().out
    assert main([*words, "--seed", "7"]) == 0
    assert "24 rows added, 0 were there" in capsys.readouterr().out
    assert path.read_bytes().startswith(before)
    with path.open(newline="") as file:
        seeds = [row["eval_seed"] for row in csv.DictReader(file)]
    assert seeds == ["0"] * len(swept[0]) + ["7"] * TASKS * GOALS * len(KS)


def test_a_table_that_another_process_writes_to_is_refused_before_any_work(runs, tmp_path, refused):
    path = tmp_path / "s.csv"
    with CellTable(path):
        for words in (["sweep", "--runs"], ["eval", "--run"]):
            cause, cure = refused(*words, str(runs / "b"), "--csv", str(path))
            assert f"another process is writing to {path}" in cause and "--csv" in cure


def test_other_settings_are_other_cells(runs, tmp_path):
    path = tmp_path / "s.csv"
    words = ["--runs", str(runs / "a"), *PROTOCOL, "--csv", str(path)]
    assert main(["sweep", *words]) == 0
    assert main(["sweep", *words, "--z", "shuffled"]) == 0
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["z"] for row in rows].count("shuffled") == len(rows) / 2 == TASKS * GOALS * 2
    assert {row["checkpoint"] for row in rows} == {"2"}  # the last


@pytest.mark.slow
def test_short_memory_makes_smaller_batches(runs, swept, monkeypatch, capsys):
    needed = []

    def memory(self):
        needed.append(self.policies * self.lanes)
        return 1000 * self.policies * self.lanes

    monkeypatch.setattr(Evaluator, "memory_bytes", memory)
    monkeypatch.setattr(sweep_module, "memory_limit", lambda: 7000)
    assert sweep(runs, None, "--json", str(runs / "small.json")) == 0
    assert "memory is short" in capsys.readouterr().out
    assert max(needed) == 36 and needed.count(7) == 2
    small = json.loads((runs / "small.json").read_text())["evaluations"]
    for a, b in zip(small, swept[1]["evaluations"], strict=True):
        for task in a["tasks"]:
            returns = [e["tasks"][task]["2"]["return"] for e in (a, b)]
            assert returns[0] == pytest.approx(returns[1], 1e-4)


@pytest.mark.slow
def test_compare_takes_the_same_cells_one_by_one(runs, tmp_path, monkeypatch):
    monkeypatch.setattr(bench_sweep, "COMMANDS", 1)
    path = tmp_path / "c.json"
    assert sweep(runs, None, "--compare", "5", "--json", str(path)) == 0
    result = json.loads(path.read_text())
    found = result["one_by_one"]
    loop, commands = found["loop"], found["commands"]
    assert result["cpu_seconds"] > 0 and loop["cpu_seconds"] > 0
    assert loop["cells"] == 5 * len(KS) == loop["equal_success"]
    assert loop["largest_return_difference"] < 1e-3
    assert commands["cells"] == len(KS)
    for baseline in (loop, commands):
        assert baseline["cells_per_s"] == pytest.approx(baseline["cells"] / baseline["seconds"])
        ratio = baseline["sweep_cells_per_s"] / baseline["cells_per_s"]
        assert baseline["ratio"] == pytest.approx(ratio)


def test_the_compared_command_is_the_sweeps_protocol(runs):
    words = [*PROTOCOL, "--policy", "sampled", "--any-table", "--horizon", "4"]
    options = options_of(parse(sweep_parser(), ["--runs", "x", *words]))
    [target] = targets_of(runs / "b", "all", options)
    again = parse(eval_parser(), command_words(target, options, "window-open"))
    assert (again.run, again.checkpoint) == (runs / "b", 1)
    assert options_of(again) == replace(options, tasks=("window-open",), goals=1)


def test_missing_checkpoints_are_named(runs, refused, tmp_path):
    words = ["--runs", f"{runs}/?", "--checkpoints"]
    cause, cure = refused("sweep", *words, "1,2", *PROTOCOL)
    assert cause == f"{runs / 'b'} has no checkpoint 2" and cure == "there are: 1"
    run = save_run(tmp_path / "none", Session(small_config()), seeds=())
    assert "no policy checkpoint" in refused("sweep", "--runs", str(run))[0]


def test_a_sweep_has_the_precision_of_each_run(runs, tmp_path, monkeypatch):
    """Two runs that differ in it alone are two programs, each compiled with its own."""
    config = small_config(**{"runtime.matmul_precision": "default"})
    save_run(tmp_path / "default", Session(config), seeds=(1,))
    shutil.copytree(runs / "a", tmp_path / "highest")
    found, compile_ = [], Evaluator.compile

    def recorded(self, params, width):
        if not self.is_compiled:
            found.append(jax.config.jax_default_matmul_precision)
        compile_(self, params, width)

    monkeypatch.setattr(Evaluator, "compile", recorded)
    words = ["--runs", str(tmp_path / "default"), str(tmp_path / "highest")]
    before = jax.config.jax_default_matmul_precision
    try:
        assert main(["sweep", *words, *PROTOCOL]) == 0
    finally:
        jax.config.update("jax_default_matmul_precision", before)
    assert sorted(map(str, found)) == ["None", "highest"]


def test_ctrl_c_while_mujoco_steps_stops_the_sweep(runs, tmp_path, monkeypatch, capsys):
    simulate, calls = NativePhysics._simulate, []

    def interrupted(self, *args):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt  # what Python raises where Ctrl-C finds it
        return simulate(self, *args)

    monkeypatch.setattr(NativePhysics, "_simulate", interrupted)
    path = tmp_path / "s.csv"
    words = ["--runs", str(runs / "b"), "--csv", str(path), *PROTOCOL]
    assert main(["sweep", *words]) == INTERRUPTED
    assert "stopped after 0 of" in capsys.readouterr().out
