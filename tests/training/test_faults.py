"""Faults of a whole run: each ends in the undisturbed result, or in one cause and one cure.

docs/faults.md lists them. What a checkpoint store does about damage is in test_checkpoint_damage.
"""

import contextlib
import errno
import os
import re
import resource
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from run_helpers import (
    ITERATIONS,
    abstract_run,
    checkpoint_leaves,
    go_on,
    native,
    rows_of,
    run_and_signal,
    smoke,
    start,
    steps,
)

from cmrl_jax.config.schema import ConfigError
from cmrl_jax.evaluation.evaluator import Evaluator
from cmrl_jax.storage.checkpoint import full_store, policy_store
from cmrl_jax.storage.run_dir import LOCK, writing_to
from cmrl_jax.training.trainer import COMPILING
from envs.physics.native import NativePhysics


@pytest.fixture
def stopped(capfd):
    """Runs a smoke run that must stop with exit code 2; returns its last two lines."""

    def run(path: Path, *words: str) -> tuple[str, str]:
        code = smoke(path, *words)
        err = capfd.readouterr().err
        assert code == 2 and "Traceback" not in err, err
        cause, cure = err.splitlines()[-2:]
        assert cause.startswith("error: ") and cure.startswith("fix: "), err
        return cause.removeprefix("error: "), cure.removeprefix("fix: ")

    return run


@pytest.fixture
def unfinished(undisturbed, tmp_path):
    """The undisturbed run as it was when its last iteration was done but not saved."""
    run = tmp_path / "run"
    shutil.copytree(undisturbed, run)
    for store in ("ckpt", "policy"):
        shutil.rmtree(run / store / str(ITERATIONS))
    (run / "eval.json").unlink()
    return run


# Signals and kills ------------------------------------------------------------------------------


def test_sigint_saves_and_resume_goes_on(undisturbed, tmp_path):
    run = tmp_path / "run"
    code, lines = run_and_signal(run, "iter    0", *native(), signals=(signal.SIGINT,))
    assert code == 0, lines
    assert f"train.py --run {run} --resume" in lines[-1], lines
    done = len(rows_of(run))
    assert 1 <= done < ITERATIONS and steps(run)[-1] == done
    go_on(run, undisturbed)


def test_a_second_signal_stops_at_once_even_in_a_compile(tmp_path):
    """XLA's threads are busy, and nobody waits for them."""
    run = tmp_path / "run"
    lines = []
    with start(run, *native(), JAX_ENABLE_COMPILATION_CACHE="false") as process:
        assert process.stdout is not None
        for line in process.stdout:
            lines.append(line)
            if line.startswith(("compiling", "stopping at the end")):
                process.send_signal(signal.SIGTERM)
        assert process.wait() == 128 + signal.SIGTERM
    assert lines[-2:] == [
        f"compiling the training iteration ({COMPILING}) ...\n",
        "stopping at the end of this iteration; once more stops at once\n",
    ]
    assert steps(run) == [0]


def test_a_program_that_does_not_compile_ends_the_run_in_its_one_error(
    stopped, tmp_path, monkeypatch
):
    """The evaluation's compile goes on in a thread; its error comes where it is waited for."""

    def refuse(self, *args):
        raise ConfigError("no memory is left", "give it less to do")

    monkeypatch.setattr(Evaluator, "compile", refuse)
    # Of another size than any run of this process, so that it is not compiled already.
    run = tmp_path / "run"
    cause, _ = stopped(run, *native(), "--eval.goals", "3")
    assert cause == "no memory is left" and len(rows_of(run)) < ITERATIONS


def test_kill_9_in_a_save_leaves_the_checkpoint_before_and_no_lock(undisturbed, tmp_path):
    """Kills until one lands in a save, which its temporary directory shows."""
    run = tmp_path / "run"
    words = native()
    for _ in range(5):
        with start(run, *words) as process:
            while process.poll() is None:
                saving = list((run / "ckpt").glob("*.orbax-checkpoint-tmp"))
                if saving and not saving[0].name.startswith("0."):
                    process.kill()
                time.sleep(0.0005)
        assert process.returncode == -signal.SIGKILL, "ended before a save was seen"
        assert (run / LOCK).read_text().startswith(f"process {process.pid} ")
        if left := [path for path in saving if path.exists()]:
            break
        words = (*native(), "--resume")  # the save was over before the signal came
    assert left
    before = steps(run)
    assert before and int(left[0].name.split(".")[0]) == before[-1] + 1
    go_on(run, undisturbed)
    assert not left[0].exists()


def test_two_processes_do_not_write_to_one_run(undisturbed, tmp_path, refused):
    run = tmp_path / "run"
    with start(run, *native(1000)) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("device"):
                break
        cause, cure = refused("--run", str(run), "--resume")
        assert f"process {process.pid} on " in cause and str(run) in cause and "--run DIR" in cure
        process.kill()
    with writing_to(run):
        pass  # the lock of a dead process holds nobody up
    other = tmp_path / "other"
    other.mkdir()
    with writing_to(other):
        assert "is writing to" in refused("--config", "smoke.yaml", "--run", str(other))[0]
    assert [path.name for path in other.iterdir()] == [LOCK]


# Files ------------------------------------------------------------------------------------------


def test_a_damaged_checkpoint_is_passed_over_for_the_one_before(undisturbed, tmp_path, capfd):
    run = tmp_path / "run"
    shutil.copytree(undisturbed, run)
    newest = run / "ckpt" / str(ITERATIONS)
    victim = max((p for p in newest.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
    data = bytearray(victim.read_bytes())
    data[len(data) // 2] ^= 1
    victim.write_bytes(data)
    go_on(run, undisturbed)
    [warning] = [line for line in capfd.readouterr().err.splitlines() if "damaged" in line]
    name = victim.relative_to(newest)
    assert f"{newest} is damaged: {name} is not what was written" in warning
    assert f"kept as damaged-{ITERATIONS}, going on from {ITERATIONS - 1}" in warning
    with policy_store(run, read_only=True) as store:
        assert store.steps()[-1] == ITERATIONS


def test_a_run_whose_checkpoints_are_all_damaged_or_gone_stops(unfinished, stopped):
    kept = (unfinished / "metrics.csv").read_bytes()
    [newest] = (unfinished / "ckpt").iterdir()
    (newest / "meta" / "metadata").unlink()
    cause, cure = stopped(unfinished, *native(), "--resume")
    assert f"{newest} is damaged: meta/metadata is missing" in cause and "new run" in cure
    shutil.rmtree(unfinished / "ckpt")
    cause, cure = stopped(unfinished, *native(), "--resume")
    assert f"has {ITERATIONS} rows in metrics.csv but no checkpoint" in cause and "copy" in cure
    assert (unfinished / "metrics.csv").read_bytes() == kept


def test_a_csv_cut_in_a_row_after_the_checkpoint_goes_on(undisturbed, unfinished):
    path = unfinished / "metrics.csv"
    path.write_bytes(path.read_bytes()[:-20])
    go_on(unfinished, undisturbed)


def test_a_csv_cut_before_the_checkpoint_stops(unfinished, stopped):
    path = unfinished / "metrics.csv"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[: ITERATIONS - 1])[:-20])
    cause, cure = stopped(unfinished, *native(), "--resume")
    assert "metrics.csv does not end a row at byte" in cause and "from a copy" in cure
    assert steps(unfinished) == [ITERATIONS - 1]


@contextlib.contextmanager
def small_files():
    """No file may grow beyond 100 KB, as on a disk that fills up in the middle of one."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextlib.contextmanager
def little_room(run, left):
    """`run` on a small disk of its own that has `left` bytes free."""
    disk, moved = run.with_name("disk"), run.with_name("moved")
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(disk)]
    if subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("needs the right to mount a file system")
    try:
        shutil.copytree(run, disk / "run")
        run.rename(moved)
        run.symlink_to(disk / "run")
        free = os.statvfs(disk).f_bavail * os.statvfs(disk).f_frsize
        (disk / "filler").write_bytes(bytes(free - left))
        yield
        (disk / "filler").unlink()
        run.unlink()
        shutil.copytree(disk / "run", run)
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.parametrize(
    "fault",
    [
        lambda run: small_files(),
        lambda run: little_room(run, 500_000),
        lambda run: little_room(run, 0),
    ],
    ids=["a file hits a limit", "disk full in a save", "disk full at the start"],
)
# What orbax leaves of the arrays beside the one that failed, which pytest collects later.
@pytest.mark.filterwarnings("ignore:coroutine .* was never awaited:RuntimeWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_full_disk_stops_and_resume_goes_on(undisturbed, unfinished, stopped, fault):
    with fault(unfinished):
        cause, cure = stopped(unfinished, *native(), "--resume")
        reasons = [os.strerror(number) for number in (errno.EFBIG, errno.ENOSPC)]
        assert re.fullmatch(f"cannot write to run directory {unfinished}: (.*)", cause), cause
        assert any(cause.endswith(reason) for reason in reasons)
        assert "make room" in cure and f"--run {unfinished} --resume" in cure
        assert steps(unfinished) == [ITERATIONS - 1]
    go_on(unfinished, undisturbed)


def test_a_run_directory_that_may_not_be_written_stops_before_any_work(undisturbed, refused):
    """Root may write everywhere, so it becomes another user for a moment."""
    with contextlib.ExitStack() as stack:
        base = Path(stack.enter_context(tempfile.TemporaryDirectory()))  # others may look into it
        run = base / "run"
        shutil.copytree(undisturbed, run)
        for path in (base, run):
            path.chmod(0o555)
            stack.callback(path.chmod, 0o755)
        if os.geteuid() == 0:
            os.seteuid(65534)
            stack.callback(os.seteuid, 0)
        for path, words in ((run, ["--resume"]), (base / "new", ["--config", "smoke.yaml"])):
            cause, cure = refused("--run", str(path), *words)
            assert cause == f"cannot write to run directory {path}: Permission denied"
            assert "--run DIR" in cure


# Numbers ----------------------------------------------------------------------------------------


def poison_rewards(run, every):
    """Sets every n-th reward in the replay ring of the newest checkpoint to an absurd number."""
    abstract = abstract_run(run)
    with full_store(run) as store:
        trees, meta = store.restore(abstract)
        ring = trees["replay"]
        column = ring.obs_size + ring.action_size
        rows = ring.rows.at[:, ::every, column].set(1e38)
        shutil.rmtree(run / "ckpt")
    with full_store(run) as store:
        store.save(trees | {"replay": ring.replace(rows=rows)}, meta)


def test_non_finite_gradients_for_a_while_are_skipped_and_counted(unfinished, capfd):
    poison_rewards(unfinished, every=150)
    assert smoke(unfinished, *native(), "--resume") == 0
    share = float(rows_of(unfinished)[-1]["train/skipped"])
    assert 0.1 < share < 0.9
    assert f"warning: {share:.1%} of the gradients were non-finite" in capfd.readouterr().out
    leaves, _ = checkpoint_leaves(unfinished)
    before, _ = checkpoint_leaves(unfinished, step=ITERATIONS - 1)
    name = "['learner']['state'].{}".format
    assert leaves[name("skipped_updates")] == round(50 * share)
    assert leaves[name("gradient_steps")] == before[name("gradient_steps")] + round(
        50 * (1 - share)
    )


def test_non_finite_gradients_for_good_stop_the_run(unfinished, stopped):
    poison_rewards(unfinished, every=1)
    cause, cure = stopped(unfinished, *native(), "--resume")
    assert cause == f"iteration {ITERATIONS - 1}: every gradient was non-finite"
    assert "lower sac.lr" in cure and f"keeps iteration {ITERATIONS - 1}" in cure
    assert len(rows_of(unfinished)) == ITERATIONS - 1 == steps(unfinished)[-1]


@pytest.fixture
def break_physics(monkeypatch):
    """Makes MuJoCo C fail from control step `first` of an iteration on, `count` times."""

    def arrange(first, count, harm):
        calls = iter(range(10**9))
        original = NativePhysics._simulate

        def simulate(self, words, placement, action, scene_id):
            is_broken = first <= next(calls) < first + count
            if is_broken and harm == "action":
                action = np.full_like(action, np.nan)
            results = original(self, words, placement, action, scene_id)
            if is_broken and harm == "unnoticed":
                results = (results[0], np.full_like(results[1], np.nan), *results[2:])
            return results

        monkeypatch.setattr(NativePhysics, "_simulate", simulate)

    return arrange


def test_non_finite_physics_for_a_while_is_put_back_and_counted(unfinished, break_physics, capfd):
    break_physics(first=7, count=3, harm="action")
    assert smoke(unfinished, *native(), "--resume") == 0
    assert rows_of(unfinished)[-1]["train/physics_faults"] == "36.0"  # 12 lanes, 3 steps
    assert "warning: 36 lane(s) left the range" in capfd.readouterr().out
    assert steps(unfinished)[-1] == ITERATIONS


def test_non_finite_physics_for_good_stops_the_run(unfinished, break_physics, stopped):
    break_physics(first=0, count=10**9, harm="action")
    cause, cure = stopped(unfinished, *native(), "--resume")
    assert cause.endswith("the physics of 600 of 600 control steps was non-finite")
    assert "env.physics: mjx" in cure and f"keeps iteration {ITERATIONS - 1}" in cure
    assert len(rows_of(unfinished)) == ITERATIONS - 1 == steps(unfinished)[-1]


def test_a_state_that_is_not_finite_is_never_saved(unfinished, break_physics, stopped):
    """At the last control step: too late for this iteration's gradients to show it."""
    break_physics(first=49, count=1, harm="unnoticed")
    cause, cure = stopped(unfinished, *native(), "--resume")
    assert re.search(f"iteration {ITERATIONS} is not saved: .* is not finite", cause), cause
    assert steps(unfinished)[-1] == ITERATIONS - 1
