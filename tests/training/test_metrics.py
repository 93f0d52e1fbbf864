"""The host's sinks: what they write, byte for byte, and how they go on after a kill."""

import io
import json
import math
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from run_helpers import csv_points, tensorboard_points

from cmrl_jax import formats
from cmrl_jax.config.schema import Config, ConfigError
from cmrl_jax.storage import versions
from cmrl_jax.training import console, metrics
from cmrl_jax.training.logger import Progress, RunInfo
from cmrl_jax.training.tensorboard import TensorBoard

COLUMNS = (*metrics.LEADING_COLUMNS, "train/critic_loss", "eval/drawer-open/k0/success_any")


def make_row(iteration: int, **figures: object) -> dict[str, object]:
    leading = {"env_steps": 10 * iteration, "gradient_steps": 4, "wall_s": 0.5, "seed": 7}
    return {"iteration": iteration, **leading, **figures}


@pytest.mark.parametrize(
    "value, text",
    [
        (None, ""),
        (3, "3"),
        (True, "1"),
        (np.int32(-4), "-4"),
        (123_456_789_012, "123456789012"),
        (0.1, "0.1"),
        (jnp.float32(0.1), "0.1"),
        (float(np.float32(0.1)), "0.1"),
        (math.nan, "nan"),
        (-math.inf, "-inf"),
        (1e-8, "1e-08"),
    ],
)
def test_figures_are_the_shortest_exact_text(value: object, text: str):
    assert formats.format_figure(value) == text


def test_every_float32_reads_back_as_itself():
    bits = np.random.default_rng(0).integers(0, 2**32, 5000, dtype=np.uint32)
    values = bits.view(np.float32)
    values = values[np.isfinite(values)]
    back = np.array([np.float32(formats.format_figure(v)) for v in values])
    np.testing.assert_array_equal(back, values)


@pytest.mark.parametrize("value", ["0.1", np.zeros(2), 1j])
def test_what_is_not_one_number_is_refused(value: object):
    with pytest.raises(TypeError, match="one number"):
        formats.format_figure(value)


def test_rows_are_written_at_once_and_empty_where_nothing_was_taken(tmp_path):
    path = tmp_path / "metrics.csv"
    csv = metrics.MetricsCsv(path, COLUMNS)
    csv.write(make_row(0, **{"train/critic_loss": jnp.float32(0.25)}))
    csv.write(make_row(1, **{"eval/drawer-open/k0/success_any": 1.0}))
    # Read before close: a killed process keeps these rows.
    assert path.read_text().splitlines() == [
        ",".join(COLUMNS),
        "0,0,4,0.5,7,0.25,",
        "1,10,4,0.5,7,,1.0",
    ]
    assert csv.offset == path.stat().st_size
    csv.close()


def test_a_resumed_file_goes_on_without_a_gap_or_a_repeat(tmp_path):
    path = tmp_path / "metrics.csv"
    csv = metrics.MetricsCsv(path, COLUMNS)
    csv.write(make_row(0))
    offset = csv.offset
    csv.write(make_row(1))
    csv.close()
    with open(path, "ab") as file:
        file.write(b"2,20,4,0")  # killed in the middle of a row
    csv = metrics.MetricsCsv(path, COLUMNS, offset)
    assert path.stat().st_size == offset, "rows after the checkpoint were kept"
    csv.write(make_row(1))
    csv.write(make_row(2))
    csv.close()
    iterations = [line.split(",")[0] for line in path.read_text().splitlines()]
    assert iterations == ["iteration", "0", "1", "2"]
    assert csv.offset == path.stat().st_size


def test_a_file_that_does_not_fit_its_checkpoint_is_refused(tmp_path):
    path = tmp_path / "metrics.csv"
    with pytest.raises(ConfigError, match="is missing"):
        metrics.MetricsCsv(path, COLUMNS, 10)
    csv = metrics.MetricsCsv(path, COLUMNS)
    csv.write(make_row(0))
    csv.close()
    size = path.stat().st_size
    for offset in (size + 1, size - 1, size + 100, 0, 5):
        with pytest.raises(ConfigError, match=f"at byte {offset}"):
            metrics.MetricsCsv(path, COLUMNS, offset)
    with pytest.raises(ConfigError, match="other columns.*train/new"):
        metrics.MetricsCsv(path, (*COLUMNS, "train/new"), size)
    assert path.stat().st_size == size, "a refused file must not be touched"


def test_columns_and_rows_are_checked(tmp_path):
    path = tmp_path / "metrics.csv"
    with pytest.raises(ValueError, match="begin with"):
        metrics.MetricsCsv(path, COLUMNS[1:])
    with pytest.raises(ValueError, match="twice"):
        metrics.MetricsCsv(path, (*COLUMNS, COLUMNS[-1]))
    csv = metrics.MetricsCsv(path, COLUMNS)
    with pytest.raises(ValueError, match="train/typo"):
        csv.write(make_row(0, **{"train/typo": 1.0}))
    with pytest.raises(ValueError, match="seed"):
        csv.write(make_row(0, seed=None))
    csv.close()


def test_tensorboard_events_hold_the_figures(tmp_path):
    pytest.importorskip("tensorboardX")
    sink = TensorBoard()
    sink.start(RunInfo(tmp_path, Config()))
    row = make_row(3, **{"train/critic_loss": jnp.float32(0.25), "train/absent": None})
    sink.row(row, Progress(0.5, 1.0))
    sink.close()
    assert tensorboard_points(tmp_path / "tensorboard") == [(30, "train/critic_loss", 0.25)]


def test_a_killed_process_leaves_every_row_in_tensorboard(tmp_path):
    pytest.importorskip("tensorboardX")
    script = "import os, sys; from pathlib import Path\n"
    script += "from cmrl_jax.config.schema import Config\n"
    script += "from cmrl_jax.training.logger import Progress, RunInfo\n"
    script += "from cmrl_jax.training.tensorboard import TensorBoard\n"
    script += "sink = TensorBoard(); sink.start(RunInfo(Path(sys.argv[1]), Config()))\n"
    script += "row = {'env_steps': 10, 'wall_s': 0.5} | {f'train/{i}': i for i in range(40)}\n"
    script += "sink.row(row, Progress(0.5, 1.0)); os._exit(0)"
    subprocess.run([sys.executable, "-c", script, str(tmp_path)], check=True)
    assert tensorboard_points(tmp_path / "tensorboard") == sorted(
        (10, f"train/{i}", i) for i in range(40)
    )


def test_a_resumed_file_and_tensorboard_have_every_row_once(tmp_path):
    """The checkpoint is that of row 1; row 2 was written after it, row 3 never."""
    pytest.importorskip("tensorboardX")
    path, figure = tmp_path / "metrics.csv", "train/critic_loss"

    def process(iterations, offset=None):
        """Writes rows as one process does; returns the length of the CSV after each."""
        csv = metrics.MetricsCsv(path, COLUMNS, offset)
        board = TensorBoard()
        board.start(RunInfo(tmp_path, Config(), csv.rows()))
        offsets = []
        for iteration in iterations:
            row = make_row(iteration, **{figure: 0.1 * iteration})
            csv.write(row)
            board.row(row, Progress(0.5, 1.0))
            offsets.append(csv.offset)
        csv.close()
        board.close()
        return offsets

    offsets = process((0, 1, 2))
    process((2, 3), offset=offsets[1])
    expected = [(10 * i, figure, float(np.float32(0.1 * i))) for i in range(4)]
    assert tensorboard_points(tmp_path / "tensorboard") == csv_points(path) == expected


def test_missing_tensorboard_names_its_cure(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(ConfigError) as raised:
        TensorBoard()
    assert "tensorboardX" in raised.value.cause and "pip install" in raised.value.cure


@pytest.mark.parametrize(
    "seconds, text",
    [(0, "0s"), (59.4, "59s"), (59.6, "1m00s"), (187, "3m07s"), (7500, "2h05m"), (math.inf, "?")],
)
def test_durations(seconds: float, text: str):
    assert formats.format_duration(seconds) == text


def test_the_console_line_shows_each_figure_once():
    tasks = ("drawer-open", "drawer-close")
    row = make_row(12, env_steps=460_800) | {
        "train/drawer-open/success_any": 0.25,
        "train/drawer-close/success_any": 1.0,
        "train/drawer-open/return": 512.4,
        "train/drawer-close/return": 1830.0,
        "train/critic_loss": 0.01234,
        "train/actor_loss": None,
        "train/drawer-open/kl": 3.0,
        "train/drawer-close/kl": 4.0,
        "train/routing_entropy": 0.98,
        "time/env_steps_per_s": 4123.4,
    }
    assert console.format_iteration(row, tasks, 187.0) == (
        "iter   12     460,800 steps | success drawer-open 0.25 drawer-close 1.00 | "
        "return drawer-open 512 drawer-close 1830 | critic 0.0123  KL 3.50 nats  routing 0.98 | "
        "4,123 steps/s | ETA 3m07s"
    )
    assert console.format_iteration(make_row(0), tasks, math.inf) == (
        "iter    0           0 steps | ETA ?"
    )


def test_the_evaluation_line_groups_by_task():
    row = make_row(1) | {
        "eval/drawer-open/k0/success_any": 0.5,
        "eval/drawer-open/k2/success_any": 0.75,
        "eval/drawer-open/k2/return": 100.0,
        "eval/window-close/k2/success_any": 0.0,
        "eval/window-open/k2/success_any": None,
    }
    expected = "evaluation | drawer-open k0 0.50 k2 0.75 | window-close k2 0.00"
    assert console.format_evaluation(row) == expected
    assert console.format_evaluation(make_row(1)) is None


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_progress_bar_is_drawn_on_a_terminal_only():
    def show(stream: io.StringIO, progress: bool) -> str:
        lines = console.Console(progress, stream)
        lines.start(RunInfo(Path(), Config()))
        lines.message("a line [with] brackets")
        lines.close()
        return stream.getvalue()

    assert show(io.StringIO(), True) == "a line [with] brackets\n"
    assert show(Terminal(), False) == "a line [with] brackets\n"
    drawn = show(Terminal(), True)
    assert "a line [with] brackets" in drawn and "training" in drawn
    refused = Terminal()  # before the run begins: no bar, which nobody would end
    console.Console(True, refused).message("refused")
    assert refused.getvalue() == "refused\n"


def test_versions_name_everything_a_result_depends_on(tmp_path):
    path = tmp_path / "versions.json"
    written = versions.write_versions(path)
    found = json.loads(path.read_text())
    assert found == written
    assert found["jax"] == jax.__version__ and found["numpy"] == np.__version__
    assert found["python"] == sys.version.split()[0]
    assert found["mujoco"] == found["mujoco-mjx"]
    assert None not in [found[p] for p in versions.PACKAGES]
    assert found["device"].startswith("cpu") and found["cpu_count"] >= 1
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT[\d:]{8}\+00:00", found["date"])


def test_a_missing_package_has_no_version(monkeypatch):
    monkeypatch.setattr(versions, "PACKAGES", ("jax", "no-such-package-here"))
    assert versions.package_versions()["no-such-package-here"] is None


def test_the_commit_is_that_of_the_tree_itself(tmp_path):
    def git(*words: str) -> str:
        config = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
        command = ["git", "-C", str(tmp_path), *config, *words]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    git("init", "-q")
    (tmp_path / "file").write_text("one")
    git("add", "file")
    git("commit", "-q", "-m", "first")
    git("tag", "-a", "v1", "-m", "a tag")
    commit = git("rev-parse", "HEAD")
    assert versions.git_commit(tmp_path) == commit
    (tmp_path / "file").write_text("two")
    assert versions.git_commit(tmp_path) == f"{commit}-dirty"
    inside = tmp_path / "site-packages"
    inside.mkdir()
    assert versions.git_commit(inside) is None
