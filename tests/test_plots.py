"""Figures from a small metrics.csv written here."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from cmrl_jax.cli import main
from cmrl_jax.config import TASKS
from cmrl_jax.config_io import load_config, to_yaml
from cmrl_jax.plots import Runs, band, read_metrics, series

CSV = """iteration,env_steps,train/window-open/success_any,eval/window-open/k0/success_any
0,100,0.0,
1,200,0.5,0.25
2,300,1.0,
"""


@pytest.fixture
def run(tmp_path):
    run = tmp_path / "single"
    run.mkdir()
    (run / "metrics.csv").write_text(CSV)
    (run / "config.yaml").write_text(to_yaml(load_config("smoke.yaml")))
    return run


def test_series_keeps_the_rows_that_have_the_figure(run):
    rows = read_metrics(run)
    assert series(rows, "train/window-open/success_any") == [(100, 0.0), (200, 0.5), (300, 1.0)]
    assert series(rows, "eval/window-open/k0/success_any") == [(200, 0.25)]
    assert series(rows, "train/drawer-open/success_any") == []


def another(run, name, success):
    """A copy of a run with another success at its end, and a final evaluation."""
    copy = run.parent / name
    shutil.copytree(run, copy)
    (copy / "metrics.csv").write_text(CSV.replace("2,300,1.0", f"2,300,{success}"))
    figures = {"success_any": success, "success_last": success / 2, "return": 1.0}
    result = {"tasks": {"window-open": {"0": figures, "2": figures}}}
    (copy / "eval.json").write_text(json.dumps(result))
    return copy


def test_seeds_of_a_run_are_one_band(run):
    seeds = [another(run, f"soft-seed{n}", 0.6 + 0.2 * n) for n in (0, 1)]
    runs = Runs([*seeds, run])
    assert list(runs.groups) == ["soft", run.name]
    steps, mean, low, high = band(runs.curves("soft", "train/window-open/success_any"))
    assert steps.tolist() == [100, 200, 300]
    np.testing.assert_allclose(mean, [0, 0.5, 0.7])
    np.testing.assert_allclose([low[-1], high[-1]], [0.6, 0.8])
    assert len(runs.final("soft", "window-open")) == 2 and not runs.final(run.name, "window-open")


def test_a_task_is_held_out_by_a_group_or_by_all(run):
    other = another(run, "other", 0.5)
    third = another(run, "third", 0.5)
    tasks = {"tasks.train": "drawer-close,window-open,window-close", "tasks.test": "drawer-open"}
    (run / "config.yaml").write_text(to_yaml(load_config("smoke.yaml", tasks)))
    runs = Runs([run, other])
    assert [runs.holds_out(run.name, task) for task in TASKS] == [True, False, False, False]
    assert [runs.holds_out("other", task) for task in TASKS] == [False, False, False, True]
    assert runs.mark(run.name, "drawer-open") and not runs.mark("other", "drawer-open")
    assert not any(map(runs.is_held_out, TASKS))
    assert Runs([other, third]).is_held_out("window-close")


def test_a_band_reads_longer_runs_between_their_points():
    steps, mean, low, high = band([[(0, 0.0), (10, 1.0)], [(0, 1.0), (4, 1.0), (20, 0.2)]])
    np.testing.assert_allclose(steps, [0, 10])
    np.testing.assert_allclose([low[1], high[1]], [0.7, 1.0])
    np.testing.assert_allclose(mean[1], 0.85)


def test_plot_draws_pictures_of_the_runs(run, capsys, tmp_path):
    seeds = [another(run, f"soft-seed{n}", 0.5) for n in (0, 1)]
    out = tmp_path / "pictures"
    words = [word for seed in seeds for word in ("--run", str(seed))]
    assert main(["plot", *words, "--out", str(out)]) == 0
    written = capsys.readouterr().out.split()
    assert [p.rpartition("/")[2] for p in written] == [
        "success.png",
        "returns.png",
        "bars.png",
        "k_shot.png",
    ]
    for path in written:
        content = Path(path).read_bytes()
        assert content.startswith(b"\x89PNG") and len(content) > 5000


def test_a_directory_without_metrics_is_refused(tmp_path, refused):
    cause, cure = refused("plot", "--run", str(tmp_path))
    assert "holds no run" in cause and "train first" in cure
