"""A resumed run is the undisturbed run, bit for bit, in a new process."""

import json
import shutil
import subprocess
import sys

import pytest
from run_helpers import (
    ITERATIONS,
    ROOT,
    assert_same_result,
    csv_points,
    native,
    policy_steps,
    rows_of,
    smoke,
    smoke_words,
    tensorboard_points,
)

HALF = ITERATIONS // 2


def train_in_new_process(run, *words):
    command = [sys.executable, str(ROOT / "train.py"), *smoke_words(run, *words)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=run.parent)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_resume_in_a_new_process_equals_an_undisturbed_run(undisturbed, tmp_path):
    run = tmp_path / "run"
    train_in_new_process(run, *native(HALF))
    assert len(rows_of(run)) == HALF
    out = train_in_new_process(run, *native(), "--resume")
    assert f"resuming {run} after iteration {HALF}" in out
    assert_same_result(run, undisturbed)
    scores = [json.loads((r / "eval.json").read_text()) for r in (run, undisturbed)]
    assert scores[0] == scores[1]


def test_tensorboard_has_every_row_once_wherever_it_is_switched_on(undisturbed, tmp_path):
    pytest.importorskip("tensorboardX")
    run = tmp_path / "run"
    shutil.copytree(undisturbed, run)
    assert smoke(run, *native(), "--log.tensorboard", "true", "--resume") == 0
    assert tensorboard_points(run / "tensorboard") == csv_points(run / "metrics.csv")


def test_policies_are_kept_by_iterations_not_by_the_clock(tmp_path):
    run = tmp_path / "run"
    late = "--checkpoint.minutes", "60", "--checkpoint.policy_every", "2"
    assert smoke(run, *native(5), *late) == 0
    assert policy_steps(run) == [2, 4, 5]  # the last always
