"""Figures of small runs written here, by the lines and bars that are in them."""

import importlib.util
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from run_file_helpers import CSV, evaluation, write_run

from cmrl_jax.analysis import plots
from cmrl_jax.analysis.run_set import Runs, band, series
from cmrl_jax.cli.main import main
from cmrl_jax.config.schema import ConfigError
from cmrl_jax.storage.run_files import read_metrics
from envs.tasks import METAWORLD_TASKS as TASKS

ROOT = Path(__file__).parents[2]
# One panel is drawn faster than four.
ONE_TASK = {"tasks.train": "window-open", "tasks.test": "", "train.capacity": "2004"}
ONE_TASK |= {"encoder.aux": "none"}
OTHER = {"tasks.train": "drawer-close,window-open,window-close", "tasks.test": "drawer-open"}


@pytest.fixture
def run(tmp_path):
    return write_run(tmp_path / "single")


@pytest.fixture
def drawn(monkeypatch):
    """What was last drawn: {title of a panel: {label: points, in their order}}; bars by height.

    Nothing is saved, which is most of a figure's time.
    """
    panels = {}

    def spy(pyplot, figure, axes, out, *_):
        pyplot.close(figure)
        panels.clear()
        for axis in axes:
            lines = [(line.get_label(), line.get_xydata().tolist()) for line in axis.get_lines()]
            bars = [(bar.get_label(), bar[0].get_height()) for bar in axis.containers]
            shown = panels.setdefault(axis.get_title(), {})
            for label, found in (*lines, *bars):
                shown.setdefault(label, []).append(found)
        return out

    monkeypatch.setattr(plots, "_finish", spy)
    return panels


def test_series_keeps_the_rows_that_have_the_figure(run):
    rows = read_metrics(run)
    assert series(rows, "train/window-open/success_any") == [(100, 0.0), (200, 0.5), (300, 1.0)]
    assert series(rows, "eval/window-open/k0/success_any") == [(200, 0.25)]
    assert series(rows, "train/drawer-open/success_any") == []


def seed_of(folder, number, csv=CSV, by_k=None, flags=None, **facts):
    """`folder`/soft-seed<N>, a run of that seed."""
    flags = {"seed": str(number)} | (flags or {})
    return write_run(folder / f"soft-seed{number}", csv, by_k, flags, **facts)


def test_seeds_of_a_run_are_one_band(run, tmp_path):
    ends = [CSV.replace("2,300,1.0", f"2,300,{0.6 + 0.2 * n}") for n in (0, 1)]
    seeds = [seed_of(tmp_path, n, ends[n], {0: 0.5, 2: 0.5}) for n in (0, 1)]
    runs = Runs([*seeds, run])
    assert list(runs.groups) == ["soft", run.name]
    steps, mean, low, high = band(runs.curves("soft", "train/window-open/success_any"))
    assert steps.tolist() == [100, 200, 300]
    np.testing.assert_allclose(mean, [0, 0.5, 0.7])
    np.testing.assert_allclose([low[-1], high[-1]], [0.6, 0.8])
    assert len(runs.final("soft", "window-open")) == 2 and not runs.final(run.name, "window-open")


def test_a_task_is_held_out_by_a_group_or_by_all(run, tmp_path):
    other, third = (write_run(tmp_path / name) for name in ("other", "third"))
    held = write_run(tmp_path / "held", flags=OTHER)
    runs = Runs([held, other])
    assert [runs.holds_out("held", task) for task in TASKS] == [True, False, False, False]
    assert [runs.holds_out("other", task) for task in TASKS] == [False, False, False, True]
    assert runs.mark("held", "drawer-open") and not runs.mark("other", "drawer-open")
    assert not any(map(runs.is_held_out, TASKS))
    assert Runs([other, third]).is_held_out("window-close")


def test_a_band_is_where_all_curves_have_a_figure():
    steps, mean, low, high = band([[(0, 0.0), (10, 1.0)], [(0, 1.0), (4, 1.0), (20, 0.2)]])
    np.testing.assert_allclose(steps, [0, 4, 10])
    np.testing.assert_allclose([low[2], high[2]], [0.7, 1.0])
    np.testing.assert_allclose(mean, [0.5, 0.7, 0.85])
    # Evaluated every 200 steps and every 300: before 300 and after 600 the second has no figure,
    # and in which order they came does not matter.
    often = [(n, n / 1000) for n in (200.0, 400.0, 600.0, 800.0)]
    seldom = [(300.0, 0.0), (600.0, 1.0)]
    for curves in ([often, seldom], [seldom, often]):
        steps, mean, *_ = band(curves)
        np.testing.assert_allclose(steps, [300, 400, 600])
        np.testing.assert_allclose(mean, [(0.3 + 0) / 2, (0.4 + 1 / 3) / 2, (0.6 + 1) / 2])
    assert [len(x) for x in band([[(1.0, 0.5)], [(2.0, 0.5), (3.0, 0.5)]])] == [0, 0, 0, 0]


def test_curves_are_drawn_at_rising_k_and_bars_at_the_largest(tmp_path, drawn):
    """Written by a resume with --eval.final_k 2,1,0, or with 10 before 2."""
    for by_k in ({2: 0.3, 1: 0.2, 0: 0.1}, {10: 0.3, 2: 0.2, 0: 0.1}):
        run = write_run(tmp_path / f"run{len(list(tmp_path.iterdir()))}", by_k=by_k)
        plots.plot_k_shot(Runs([run]), tmp_path / "k.png")
        points = [[k, success] for k, success in reversed(by_k.items())]
        assert drawn["window-open"] == {run.name: [points]}
        plots.plot_bars(Runs([run]), tmp_path / "b.png")
        assert drawn[""][f"{run.name}, k = {max(by_k)} (filled: last step)"] == [0.3]


def test_two_seeds_of_unsorted_files_are_averaged_at_their_own_k(tmp_path, drawn):
    """np.interp on a falling axis took another k's figure."""
    scores = ({2: 0.6, 1: 0.24, 0: 0.0}, {2: 0.4, 1: 0.16, 0: 0.0})
    runs = [seed_of(tmp_path, n, by_k=by_k) for n, by_k in enumerate(scores)]
    plots.plot_k_shot(Runs(runs), tmp_path / "k.png")
    [points] = drawn["window-open"]["soft"]
    np.testing.assert_allclose(points, [[0, 0.0], [1, 0.2], [2, 0.5]])


@pytest.mark.parametrize("order", [1, -1])
def test_seeds_with_other_k_are_drawn_at_those_they_share(tmp_path, drawn, order):
    runs = [seed_of(tmp_path, 0, by_k={0: 0.2, 1: 0.9}), seed_of(tmp_path, 1, by_k={0: 0.4})]
    plots.plot_bars(Runs(runs[::order]), tmp_path / "b.png")
    [height] = drawn[""]["soft, k = 0 (filled: last step)"]
    assert height == pytest.approx(0.3)
    plots.plot_k_shot(Runs(runs[::order]), tmp_path / "k.png")
    [points] = drawn["window-open"]["soft"]
    np.testing.assert_allclose(points, [[0, 0.3]])


def test_seeds_without_a_common_k_have_no_bar(tmp_path):
    runs = Runs([seed_of(tmp_path, 0, by_k={0: 0.2}), seed_of(tmp_path, 1, by_k={1: 0.4})])
    assert runs.final("soft", "window-open") == []


def test_different_runs_of_one_name_are_two_curves(tmp_path, drawn):
    runs = [write_run(tmp_path / "a" / "run", by_k={0: 0.2})]
    csv = CSV.replace("2,300,1.0", "2,300,0.0")
    runs.append(write_run(tmp_path / "b" / "run", csv, {0: 0.6}, {"env.horizon": "200"}))
    plots.plot_success(Runs(runs), tmp_path / "s.png")
    lines = drawn["window-open"]
    [short], [long] = (lines[f"run, env.horizon {n}, training, any step"] for n in (50, 200))
    assert (short[-1], long[-1]) == ([300, 1.0], [300, 0.0])
    plots.plot_bars(Runs(runs), tmp_path / "b.png")
    heights = [drawn[""][f"run, env.horizon {n}, k = 0 (filled: last step)"] for n in (50, 200)]
    assert heights == [[0.2], [0.6]]


def test_runs_from_before_the_origin_was_recorded_are_no_seeds_of_runs_of_today(tmp_path):
    """Their config.yaml does not name it; today's default is not what they were made with."""
    seeds = [seed_of(tmp_path, n, flags={"env.obs_mode": "canonical"}) for n in (0, 1, 2)]
    for old in seeds[:2]:
        config = (old / "config.yaml").read_text()
        assert ", origin: settled" in config
        (old / "config.yaml").write_text(config.replace(", origin: settled", ""))
    assert Runs(seeds).groups == {
        "soft, env.origin reset observation": seeds[:2],
        "soft, env.origin settled": seeds[2:],
    }


def test_a_run_under_two_names_is_not_two_seeds(tmp_path, drawn, refused):
    run, link = seed_of(tmp_path, 0, by_k={0: 0.2}), tmp_path / "link"
    link.symlink_to(run)
    cause, _ = refused("plot", "--run", str(run), "--run", str(link))
    assert "stands there twice" in cause
    plots.plot_bars(Runs([run, run, link]), tmp_path / "b.png")
    labels = [f"soft, seed 0 ({name}), k = 0 (filled: last step)" for name in (run, link)]
    assert [drawn[""][label] for label in labels] == [[0.2], [0.2]]


def test_a_curve_of_one_point_is_seen(tmp_path):
    """A policy without z is evaluated at k = 0 alone."""
    heights = {}
    for name, by_k in (("one", {0: 0.5}), ("none", {0: 5.0})):  # outside the axis
        out = tmp_path / f"{name}.png"
        plots.plot_k_shot(Runs([write_run(tmp_path / name, by_k=by_k, flags=ONE_TASK)]), out)
        heights[name] = _blue(out)
    assert heights["one"] > heights["none"]


def test_a_band_of_one_point_is_seen(tmp_path):
    blue = {}
    for name, high in (("narrow", 0.5), ("wide", 0.9)):
        folder = tmp_path / name
        ends = enumerate((1 - high, high))
        runs = [seed_of(folder, n, by_k={0: end}, flags=ONE_TASK) for n, end in ends]
        plots.plot_k_shot(Runs(runs), tmp_path / f"{name}.png")
        blue[name] = _blue(tmp_path / f"{name}.png")
    assert blue["wide"] > blue["narrow"]


def _blue(png):
    """Pixels of the first group's colour, or of its band."""
    from matplotlib import image

    rgb = image.imread(png)[..., :3]
    return int((rgb[..., 2] > rgb[..., 0] + 0.1).sum())


def test_curves_that_do_not_overlap_are_each_by_itself(tmp_path, drawn):
    later = CSV.replace("0,100", "0,400").replace("1,200", "1,500").replace("2,300", "2,600")
    runs = [seed_of(tmp_path, 0), seed_of(tmp_path, 1, later)]
    plots.plot_success(Runs(runs), tmp_path / "s.png")
    found = drawn["window-open"]["soft, training, any step"]
    assert [points[0][0] for points in found] == [100, 400]


def test_an_evaluation_from_before_the_run_went_on_is_left_out(tmp_path, capsys):
    run = write_run(tmp_path / "run", CSV + "3,400,1.0,\n", {0: 0.2})
    assert Runs([run]).final("run", "window-open") == []
    assert "is of iteration 3 and left out: the run stands at 4" in capsys.readouterr().err


def test_evaluations_taken_otherwise_are_not_averaged(tmp_path):
    runs = [seed_of(tmp_path, 0, by_k={0: 0.2})]
    runs.append(seed_of(tmp_path, 1, by_k={0: 0.2}, goal_set="train"))
    with pytest.raises(ConfigError) as error:
        Runs(runs)
    assert "another goal_set: heldout in" in error.value.cause


def test_plot_draws_pictures_of_the_runs(capsys, tmp_path):
    seeds = [seed_of(tmp_path, n, by_k={0: 0.5, 2: 0.5}) for n in (0, 1)]
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
    write_run(tmp_path / "begun").joinpath("metrics.csv").unlink()
    cause, cure = refused("plot", "--run", str(tmp_path / "begun"))
    assert "metrics.csv does not exist" in cause and "--run" in cure


def test_adaptation_is_drawn_over_rising_episodes(tmp_path, drawn):
    figures = evaluation({20: 0.9, 5: 0.5, 0: 0.0})["tasks"]["window-open"]
    plots.plot_adaptation({"z": figures}, "window-open", tmp_path / "a.png")
    [panel] = drawn.values()
    assert panel["z"] == [[[0, 0.0], [5, 0.5], [20, 0.9]]]


@pytest.fixture
def results(tmp_path, monkeypatch):
    """scripts/figures.py with an empty results/ of its own."""
    spec = importlib.util.spec_from_file_location("figures", ROOT / "scripts" / "figures.py")
    assert spec is not None and spec.loader is not None
    figures = importlib.util.module_from_spec(spec)
    monkeypatch.syspath_prepend(ROOT)
    spec.loader.exec_module(figures)
    monkeypatch.setattr(figures, "ROOT", tmp_path)
    monkeypatch.setattr(figures, "RESULTS", tmp_path / "results")
    (tmp_path / "results").mkdir()
    return figures


KEPT = "iteration,env_steps,gradient_steps,wall_s,eval/drawer-open/k0/success_any\n2,300,40,60,\n"


def test_every_group_of_results_is_drawn_whatever_its_runs_hold_out(results, capsys, drawn):
    """Each run marks its own task: no other is asked."""
    write_run(results.RESULTS / "cmrl-seed0", KEPT, {0: 0.2}, task="window-close")
    write_run(
        results.RESULTS / "cmrl-holdout-drawer-open", KEPT, {0: 0.4}, OTHER, task="drawer-open"
    )
    assert results.main() == 0
    out, err = capsys.readouterr()
    names = ("success", "returns", "bars", "k_shot")
    assert err.split() == [f"results/figures/held-out/{name}.png" for name in names]
    marked = {
        task: [label for label in panel if "held out" in label] for task, panel in drawn.items()
    }
    assert marked["window-close"] == ["cmrl, held out"]
    assert marked["drawer-open"] == ["cmrl-holdout-drawer-open, held out"]
    held_out = out.partition("\nheld-out\n")[2].partition("\nablations\n")[0]
    rows = [line.split(" | ") for line in held_out.splitlines() if line.startswith("| cmrl")]
    assert rows[0][0] == "| cmrl-seed0" and rows[0][-1] == "0.20 / 0.10 (held out) |"
    assert rows[1][6] == "0.40 / 0.20 (held out)"


def test_curves_kept_of_fine_tuning_are_drawn_by_task(results):
    folder = results.RESULTS / "finetune"
    folder.mkdir()
    curves = {"z": evaluation({1: 0.5, 0: 0.1})["tasks"]["window-open"]}
    (folder / "cmrl.json").write_text(json.dumps({"task": "window-open", "curves": curves}))
    assert [path.name for path in results.adaptation_figures()] == ["window-open.png"]


def test_a_damaged_control_is_refused(results, tmp_path):
    run = write_run(results.RESULTS / "cmrl-seed0", KEPT, {0: 0.2})
    folder = run / "controls"
    folder.mkdir()
    for text in ("{", "[]", '{"tasks": []}'):
        (folder / "posterior.json").write_text(text)
        with pytest.raises(ConfigError) as error:
            results.controls.table(run)
        assert "posterior.json" in error.value.cause
    shutil.copy(run / "eval.json", folder / "posterior.json")
    assert results.controls.table(run)[-1] == "| posterior | 0.20 - - - - |"
