"""inspection.json and its figures, from arrays written here."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cmrl_jax.analysis import inspection_figures
from cmrl_jax.analysis.inspection_figures import between_tasks, plot_latents, plot_routing, verdict
from cmrl_jax.analysis.inspection_file import (
    Inspection,
    Latents,
    Usage,
    read_inspection,
    write_inspection,
)
from cmrl_jax.analysis.pca import principal_axes
from cmrl_jax.analysis.plots import _pyplot
from cmrl_jax.cli.main import main
from cmrl_jax.config.files import load_config, to_yaml
from cmrl_jax.config.schema import ConfigError

TASKS = ("drawer-open", "drawer-close", "window-open", "window-close")
FACTS = {"k": 2, "goals": 5, "draws": 2, "goal_set": "heldout", "env_steps": 1200000}
FACTS |= {"train_tasks": list(TASKS[:3]), "test_tasks": [TASKS[3]]}


@pytest.fixture
def run(tmp_path):
    """What results/ keeps of a run, but for its inspection."""
    run = tmp_path / "soft-seed0"
    run.mkdir()
    (run / "metrics.csv").write_text("iteration,env_steps,train/window-open/return\n0,100,1.0\n")
    (run / "config.yaml").write_text(to_yaml(load_config("smoke.yaml")))
    return run


def latents(spread, kl):
    """z around centres of the tasks that lie `spread` apart from the origin; 10 runs, 6 numbers."""
    rng = np.random.default_rng(0)
    mean = spread * np.eye(4, 6)[:, None] + np.zeros((4, 10, 6))
    z = mean + rng.normal(size=mean.shape)
    return Latents(mean, z, np.full(4, kl), mean[:, 0] + 0.1, np.full(4, kl / 2))


def inspection(spread=0.0, kl=0.0):
    share = np.random.default_rng(1).dirichlet(np.ones(3), size=(4, 2))
    usage = Usage(share, 0.5 * share, 0.5 + 0.5 * share)
    return Inspection(TASKS, usage, latents(spread, kl), FACTS)


def test_a_file_gives_back_what_was_written(tmp_path):
    written: Any = inspection(2.0, 1.5)
    path = write_inspection(tmp_path, written)
    assert path.name == "inspection.json" and path.stat().st_size < 6000
    read: Any = read_inspection(tmp_path)
    assert (read.tasks, read.facts) == (TASKS, FACTS)
    for part in ("routing", "latents"):
        for name, value in vars(getattr(written, part)).items():
            found = getattr(getattr(read, part), name)
            np.testing.assert_allclose(found, value, atol=5e-5, err_msg=name)
    assert [read.is_held_out(task) for task in TASKS] == [False, False, False, True]


def test_what_a_policy_lacks_stays_away(tmp_path):
    parts = replace(latents(0, 0), kl=None, text_mean=None, text_kl=None)
    write_inspection(tmp_path, replace(inspection(), routing=None, latents=parts))
    read = read_inspection(tmp_path)
    assert read is not None and read.routing is None and read.latents is not None
    assert (read.latents.kl, read.latents.text_mean, read.latents.text_kl) == (None, None, None)
    write_inspection(tmp_path, replace(inspection(), latents=None))
    read = read_inspection(tmp_path)
    assert read is not None and read.latents is None
    assert read_inspection(tmp_path / "elsewhere") is None


def test_a_file_that_is_none_is_refused(tmp_path):
    for text in ("{", "{}", '{"tasks": [], "routing": null, "latents": {"z": []}, "facts": {}}'):
        (tmp_path / "inspection.json").write_text(text)
        with pytest.raises(ConfigError) as error:
            read_inspection(tmp_path)
        assert "inspection.json" in error.value.cause and "--inspect" in error.value.cure


DAMAGED = {
    "list": (lambda d: [d], "holds no JSON object"),
    "no facts": (lambda d: d | {"facts": []}, "is no inspection"),
    "no k": (lambda d: d | {"facts": {**FACTS, "k": None}}, "k is None"),
    "a fact less": (lambda d: d | {"facts": {"k": 2}}, "lacks the field 'env_steps'"),
    "unknown task": (lambda d: d | {"tasks": [*TASKS[:3], "push"]}, "tasks are ('drawer-open'"),
    "task twice": (lambda d: d | {"tasks": [TASKS[0]] * 4}, "tasks are"),
    "no tasks": (lambda d: d | {"tasks": 3}, "is no inspection"),
    "a task less": (lambda d: d | {"tasks": list(TASKS[:3])}, "routing has the shape (4, 2, 3)"),
    "routing as list": (lambda d: d | {"routing": [1]}, "is no inspection"),
    "a part less": (lambda d: d | {"routing": {"mean": d["routing"]["mean"]}}, "is no inspection"),
    "flat z": (lambda d: d | {"latents": d["latents"] | {"z": [[1.0] * 6] * 4}}, "z has the shape"),
    "ragged z": (lambda d: d | {"latents": d["latents"] | {"z": [[1.0], []]}}, "is no inspection"),
    "no z": (lambda d: d | {"latents": d["latents"] | {"z": None}}, "z is nothing"),
    "no draw": (
        lambda d: d | {"latents": d["latents"] | {"mean": [[]] * 4}},
        "has the shape (4, 0)",
    ),
    "kl of one": (lambda d: d | {"latents": d["latents"] | {"kl": [0.5]}}, "kl has the shape (1,)"),
    "NaN": (lambda d: d | {"latents": d["latents"] | {"kl": [float("nan")] * 4}}, "NaN is no num"),
    "overflow": (lambda d: d | {"latents": d["latents"] | {"kl": [None] * 4}}, "is not finite"),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_a_damaged_file_is_refused_before_it_is_drawn(tmp_path, damage):
    path = write_inspection(tmp_path, inspection(2.0, 1.5))
    change, said = DAMAGED[damage]
    path.write_text(json.dumps(change(json.loads(path.read_text()))))
    with pytest.raises(ConfigError) as error:
        read_inspection(tmp_path)
    assert "inspection.json" in error.value.cause and said in error.value.cause


def test_titles_say_what_episodes_each_panel_shows_where_they_differ(tmp_path, monkeypatch):
    """A policy without z is inspected at k = 0, others after own experience."""
    pyplot, figures = _pyplot(), []
    monkeypatch.setattr(pyplot, "close", figures.append)
    monkeypatch.setattr(inspection_figures, "DPI", 10)  # drawn for its titles alone
    other = replace(inspection(), facts=FACTS | {"k": 0})
    for last in (inspection(), other):
        for plot in (plot_routing, plot_latents):
            plot(pyplot, [("x", inspection()), ("y", last)], tmp_path / "f.png")
    monkeypatch.undo()
    pyplot.close("all")
    whole = [figure.get_suptitle() for figure in figures]
    panels = [[axis.get_title() for axis in figure.axes if axis.get_title()] for figure in figures]
    for n in (0, 1):
        assert "k = 2, 10 a task" in whole[n]
        assert panels[n] == ["x, 1,200,000 env steps", "y, 1,200,000 env steps"]
    for n in (2, 3):
        assert "k = " not in whole[n]
        assert "k = 2, 10 a task" in panels[n][0] and "k = 0, 10 a task" in panels[n][1]


def test_one_module_a_layer_is_drawn(tmp_path):
    whole = np.ones((4, 2, 1))
    alone = replace(inspection(), routing=Usage(whole, whole, whole))
    assert min(size_of(plot_routing(_pyplot(), [("x", alone)], tmp_path / "routing.png"))) > 100


def test_figures_need_no_checkpoint(run, capsys):
    write_inspection(run, inspection())
    other = run.parent / "plain"
    other.mkdir()
    for file in ("metrics.csv", "config.yaml"):
        (other / file).write_bytes((run / file).read_bytes())
    write_inspection(other, replace(inspection(), routing=None))
    assert main(["plot", "--run", str(run), "--run", str(other), "--out", str(run / "p")]) == 0
    out, err = capsys.readouterr()
    assert [line.rpartition("/")[2] for line in out.splitlines()][-2:] == ["routing.png", "z.png"]
    assert err == "plain is not in routing.png: its policy has no modules to route to\n"
    heights = {}
    for runs in ([run], [run, other]):
        words = [word for one in runs for word in ("--run", str(one))]
        assert main(["plot", *words, "--out", str(run / "p")]) == 0
        heights[len(runs)] = [size_of(run / "p" / f"{name}.png") for name in ("routing", "z")]
    assert heights[1][0] == heights[2][0]  # one panel of routing either way
    assert heights[2][1][0] == 2 * heights[1][1][0]  # two of z, side by side


def size_of(png):
    """Width and height in pixels, from a PNG's header."""
    content = png.read_bytes()
    assert content.startswith(b"\x89PNG") and len(content) > 5000
    return int.from_bytes(content[16:20]), int.from_bytes(content[20:24])


def test_a_collapsed_posterior_is_called_so():
    assert verdict(latents(0.0, 0.02)).startswith("collapsed: at most 0.02 nats from N(0, I)")
    assert "collapsed" not in verdict(latents(0.0, 0.3))  # far from the prior, alike for all tasks
    one_task = replace(latents(2.0, 0.0), kl=np.array([0.0, 0.0, 0.0, 1.5]))
    assert verdict(one_task).startswith("0.00 to 1.50 nats from N(0, I)")
    assert verdict(replace(latents(1.0, 0.0), kl=None)).startswith("z is the posterior's mean")


def test_variance_between_tasks_is_what_chance_gives_where_tasks_are_alike():
    rng = np.random.default_rng(0)
    shares = [between_tasks(rng.normal(size=(4, 10, 6)))[0] for _ in range(400)]
    chance = between_tasks(np.zeros((4, 10, 6)))[1]
    assert np.mean(shares) == pytest.approx(chance, rel=0.03) and chance == pytest.approx(3 / 39)
    apart = np.arange(4.0)[:, None, None] + np.zeros((4, 10, 6))
    assert between_tasks(apart)[0] == pytest.approx(1)
    # One dimension of variance 1.25 between the tasks' centres 0 .. 3, and 1 within each.
    z = np.arange(4.0)[:, None, None] + np.tile([-1.0, 1.0], 5)[None, :, None]
    assert between_tasks(z)[0] == pytest.approx(1.25 / 2.25)


def test_principal_axes_span_the_plane_that_the_points_lie_in():
    rng = np.random.default_rng(0)
    plane = np.linalg.qr(rng.normal(size=(6, 2)))[0]
    flat = rng.normal(size=(40, 2)) * [3.0, 0.5]
    flat -= flat.mean(0)
    rows = flat @ plane.T + 7.0
    centre, axes, shares = principal_axes(rows)
    np.testing.assert_allclose(centre, 7.0)
    assert shares.sum() == pytest.approx(1)
    points = (rows - centre) @ axes.T
    variances = np.linalg.eigvalsh(np.cov(flat.T))[::-1]
    np.testing.assert_allclose(points.var(0, ddof=1), variances)
    np.testing.assert_allclose(shares, variances / variances.sum())
    np.testing.assert_allclose(points @ points.T, flat @ flat.T, atol=1e-9)  # distances are kept


def test_principal_axes_of_points_on_a_line_or_in_one_place():
    line = np.arange(5.0)[:, None]
    centre, axes, shares = principal_axes(line)
    points = np.abs((line - centre) @ axes.T)
    np.testing.assert_allclose(points, [[2, 0], [1, 0], [0, 0], [1, 0], [2, 0]])
    assert shares.tolist() == [1, 0]
    assert principal_axes(np.ones((5, 3)))[2].tolist() == [0, 0]
