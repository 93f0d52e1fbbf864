"""Figures from a small metrics.csv written here."""

import pytest

from cmrl_jax.cli import main
from cmrl_jax.config_io import load_config, to_yaml
from cmrl_jax.plots import read_metrics, series

CSV = """iteration,env_steps,train/window-open/success_any,eval/window-open/k0/success_any
0,100,0.0,
1,200,0.5,0.25
2,300,1.0,
"""


@pytest.fixture
def run(tmp_path):
    (tmp_path / "metrics.csv").write_text(CSV)
    (tmp_path / "config.yaml").write_text(to_yaml(load_config("smoke.yaml")))
    return tmp_path


def test_series_keeps_the_rows_that_have_the_figure(run):
    rows = read_metrics(run)
    assert series(rows, "train/window-open/success_any") == [(100, 0.0), (200, 0.5), (300, 1.0)]
    assert series(rows, "eval/window-open/k0/success_any") == [(200, 0.25)]
    assert series(rows, "train/drawer-open/success_any") == []


def test_plot_draws_a_picture_of_the_run(run, capsys):
    out = run / "picture.png"
    assert main(["plot", "--run", str(run), "--out", str(out)]) == 0
    assert out.read_bytes().startswith(b"\x89PNG") and capsys.readouterr().out.strip() == str(out)


def test_a_directory_without_metrics_is_refused(tmp_path, refused):
    cause, cure = refused("plot", "--run", str(tmp_path))
    assert "metrics.csv does not exist" in cause and "--run" in cure
