"""Weights & Biases and films: what a run leaves for people who look elsewhere than metrics.csv."""

import csv
import dataclasses
import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from run_helpers import csv_points, smoke, tensorboard_points, wandb_points
from test_metrics import COLUMNS, make_row

from cmrl_jax import registry
from cmrl_jax.config.files import load_config
from cmrl_jax.config.schema import Config, ConfigError, LogConfig
from cmrl_jax.training import films, metrics
from cmrl_jax.training.console import Console
from cmrl_jax.training.films import Films
from cmrl_jax.training.logger import Logger, Progress, RunInfo
from cmrl_jax.training.loggers import loggers_of
from cmrl_jax.training.tensorboard import TensorBoard
from cmrl_jax.training.weights_and_biases import WeightsAndBiases

HALF = Progress(0.5, 1.0)
FILMED = dataclasses.replace(Config(), log=LogConfig(video_every=2))


@pytest.fixture
def offline(monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")


class Told(Logger):
    def __init__(self):
        self.films: list[Any] = []
        self.messages: list[str] = []

    def film(self, task, row, video, sheet):
        self.films.append((task, row["iteration"], video.read_bytes()))

    def message(self, text):
        self.messages.append(text)


def test_a_resumed_run_is_one_run_of_wandb_with_every_row(tmp_path, offline):
    """The checkpoint is that of row 1; row 2 was written after it, row 3 never."""
    path, figure = tmp_path / "metrics.csv", "train/critic_loss"

    def process(iterations, offset=None):
        table, sink = metrics.MetricsCsv(path, COLUMNS, offset), WeightsAndBiases()
        sink.start(RunInfo(tmp_path, Config(), table.rows()))
        offsets = []
        for iteration in iterations:
            row = make_row(iteration, **{figure: 0.1 * iteration})
            table.write(row)
            sink.row(row, HALF)
            offsets.append(table.offset)
        table.close()
        sink.close()
        return offsets

    offsets = process((0, 1, 2))
    process((2, 3), offset=offsets[1])
    expected = [(10 * i, figure, float(np.float32(0.1 * i))) for i in range(4)]
    assert wandb_points(tmp_path / "wandb") == csv_points(path) == expected
    kept = (tmp_path / "wandb" / "id.txt").read_text()
    names = [path.name for path in (tmp_path / "wandb").glob("offline-run-*")]
    assert len(names) == 2 and all(kept in name for name in names)


def test_two_runs_of_one_process_are_two_of_wandb(tmp_path, offline):
    sinks = [WeightsAndBiases(), WeightsAndBiases()]
    for i, sink in enumerate(sinks):
        (tmp_path / str(i)).mkdir()
        sink.start(RunInfo(tmp_path / str(i), Config()))
    for i, sink in enumerate(sinks):
        sink.row(make_row(1, **{"train/critic_loss": i}), HALF)
    for sink in sinks:
        sink.close()
    for i in range(2):
        assert wandb_points(tmp_path / str(i) / "wandb") == [(10, "train/critic_loss", i)]


@pytest.mark.parametrize(
    ("key", "module"), [("wandb", "wandb"), ("tensorboard", "tensorboardX"), ("video_every", "PIL")]
)
def test_a_missing_package_names_its_cure(monkeypatch, key, module):
    monkeypatch.setitem(sys.modules, module, None)
    config = load_config("smoke", {f"log.{key}": "1" if key == "video_every" else "true"})
    with pytest.raises(ConfigError, match=f"log.{key}") as raised:
        loggers_of(Console(stream=sys.stderr), config)
    assert "pip install 'cmrl-jax[" in raised.value.cure


def test_films_are_of_meta_world_alone(monkeypatch):
    monkeypatch.setitem(registry.ENVIRONMENTS, "other", registry.environment("ml4"))
    load_config("smoke", {"env.name": "other"})
    with pytest.raises(ConfigError, match="video_every"):
        load_config("smoke", {"log.video_every": 1, "env.name": "other"})


# Stands in for `render`: ends when it is told its exit code, with more to say than a pipe holds.
FILMING = """
import pathlib, sys, time
out = pathlib.Path(sys.argv[sys.argv.index("--out") + 1])
told = out.parent.parent / "exit"
while not told.exists():
    time.sleep(0.01)
sys.stderr.write("x" * 200_000 + "\\nthe last line\\n")
out.mkdir(parents=True)
(out / "window-open.mp4").write_bytes(b"film")
sys.exit(int(told.read_text()))
"""


@pytest.fixture
def stage(tmp_path, monkeypatch):
    """Films by a short process, the logger that it tells, and its run directory."""
    monkeypatch.setattr(films, "CHILD", FILMING)
    told = Told()
    sink = Films([told])
    sink.start(RunInfo(tmp_path, FILMED))
    for iteration in (2, 4, 6):
        (tmp_path / "policy" / str(iteration)).mkdir(parents=True)
    yield sink, told, tmp_path
    sink.close()


def ended(sink, run, code):
    """Lets the film end that is being made."""
    part = run / "exit.part"
    part.write_text(str(code))
    part.rename(run / "exit")
    sink._child.wait(30)


def test_the_loop_never_waits_for_a_film(stage):
    sink, told, run = stage
    for iteration in range(5):  # policies 2 and 4 are due, and 2 is not there before the end
        sink.row(make_row(iteration), HALF)
    assert not told.films
    ended(sink, run, 0)
    sink.row(make_row(5), HALF)
    assert told.films == [("window-open", 1, b"film")]
    sink.row(make_row(6), HALF)  # policy 6
    sink._child.wait(30)
    sink.row(make_row(7), HALF)
    assert told.films == [("window-open", iteration, b"film") for iteration in (1, 5)]


def test_a_run_waits_for_its_last_film_at_its_end_alone(stage):
    sink, told, run = stage
    for iteration in range(3):
        sink.row(make_row(iteration), HALF)
    sink.close()  # stopped
    assert not told.films and sink._child.returncode < 0
    sink = Films([told])
    sink.start(RunInfo(run, FILMED))
    (run / "exit").write_text("0")
    for iteration in range(4):
        sink.row(make_row(iteration), Progress((iteration + 1) / 4, 0.0))
    sink.close()
    assert [iteration for _, iteration, _ in told.films][-1] == 3
    assert "waiting 120 s at most for a film" in told.messages


def test_a_film_that_fails_is_a_message(stage):
    sink, told, run = stage
    for iteration in range(3):
        sink.row(make_row(iteration), HALF)
    ended(sink, run, 2)
    sink.row(make_row(3), HALF)
    assert told.messages == ["no film of iteration 2: the last line"] and not told.films


def test_a_policy_that_was_not_saved_is_not_filmed(stage):
    sink, _, run = stage
    (run / "policy" / "2").rmdir()
    for iteration in range(3):
        sink.row(make_row(iteration), HALF)
    assert sink._child is None


def test_what_was_never_started_can_be_closed():
    Films([]).close()


def test_tensorboard_shows_sheets_also_after_a_resume(tmp_path):
    pytest.importorskip("tensorboardX")
    image = pytest.importorskip("PIL.Image")
    folder = tmp_path / "films" / "20"
    folder.mkdir(parents=True)
    for place in ("20", "30", "best"):  # 30 is after the checkpoint, best is the user's own
        (tmp_path / "films" / place).mkdir(exist_ok=True)
        image.new("RGB", (8, 4)).save(tmp_path / "films" / place / "window-open.png")
    for _ in range(2):
        board = TensorBoard()
        board.start(RunInfo(tmp_path, Config(), [make_row(1), make_row(2)]))
        board.close()
        shown = tensorboard_points(tmp_path / "tensorboard")
        assert [p for p in shown if p[1].startswith("film/")] == [(20, "film/window-open", 0.0)]


@pytest.mark.slow
def test_a_run_with_every_logger(tmp_path, offline):
    """Films are made by the real command, and every service has what metrics.csv has."""
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        pytest.skip("no ffmpeg")
    run = tmp_path / "run"
    flags = ["--log.tensorboard", "true", "--log.wandb", "true", "--log.video_every", "2"]
    assert smoke(run, "--env.physics", "native", *flags) == 0
    points = csv_points(run / "metrics.csv")
    assert wandb_points(run / "wandb") == points
    shown = tensorboard_points(run / "tensorboard")
    assert [p for p in shown if not p[1].startswith("film/")] == points
    with (run / "metrics.csv").open() as file:
        steps = [row["env_steps"] for row in csv.DictReader(file)]
    tasks = load_config("smoke").tasks
    assert sorted(p.stem for p in Path(run / "films" / steps[1]).glob("*.mp4")) == sorted(
        tasks.train + tasks.test
    )
    assert {p[1] for p in shown if p[1].startswith("film/")} == {
        f"film/{task}" for task in tasks.train + tasks.test
    }
