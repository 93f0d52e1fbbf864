"""What surrounds a process: its terminal, its streams, its signals, its file system.

Whole runs end in the undisturbed result; other commands end as any tool of the shell does.
"""

import contextlib
import datetime
import errno
import fcntl
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from run_helpers import (
    ITERATIONS,
    ROOT,
    TRAIN,
    assert_same_result,
    go_on,
    native,
    rows_of,
    run_and_signal,
    run_in_shell,
    smoke,
    smoke_words,
    steps,
)

from cmrl_jax.cli import main as cli
from cmrl_jax.evaluation.evaluator import Evaluator
from cmrl_jax.storage import run_dir
from cmrl_jax.storage.run_dir import LOCK, new_run, writing_to


def run_unread(lines, *words):
    """`train.py WORDS | head -LINES` -> exit code, what went to standard error."""
    with subprocess.Popen(
        [*TRAIN, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        for _ in range(lines):
            process.stdout.readline()
        process.stdout.close()
        return process.wait(), process.stderr.read()


# Signals ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_closed_terminal_saves_and_ends_like_sigterm(tmp_path):
    """A terminal that closes sends SIGHUP more than once: the kernel does, and the shell."""
    run = tmp_path / "run"
    hang_up, as_in_a_terminal = (signal.SIGHUP, signal.SIGHUP), ("env", "--default-signal=HUP")
    code, lines = run_and_signal(
        run, "iter    0", *native(), signals=hang_up, under=as_in_a_terminal
    )
    assert code == 0, lines
    assert f"train.py --run {run} --resume" in lines[-1], lines
    done = len(rows_of(run))
    assert 1 <= done < ITERATIONS and steps(run)[-1] == done


def test_a_run_under_nohup_goes_on_when_the_terminal_closes(undisturbed, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(undisturbed, run)
    (run / "eval.json").unlink()
    hang_up = (signal.SIGHUP,)
    code, lines = run_and_signal(
        run, "device", *native(), "--resume", signals=hang_up, under=("nohup",)
    )
    assert code == 0 and lines[-1].startswith("done in"), lines
    assert (run / "eval.json").read_bytes() == (undisturbed / "eval.json").read_bytes()


def test_sigterm_in_the_final_evaluation_leaves_it_to_the_resumed_run(
    undisturbed, tmp_path, monkeypatch, capfd
):
    run = tmp_path / "run"
    shutil.copytree(undisturbed, run)
    (run / "eval.json").unlink()
    batches, original = [], Evaluator.compile

    def compile(self, *args):
        if self.is_compiled:
            return
        original(self, *args)
        program = self._compiled

        def counted(*args):
            batches.append(args)
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.2)  # for the thread that reads the signal's number
            return program(*args)

        self._compiled = counted

    monkeypatch.setattr(Evaluator, "compile", compile)
    assert smoke(run, *native(), "--resume") == 0
    out = capfd.readouterr().out.splitlines()
    assert len(batches) == 1  # of two: an episode for each k
    assert out[-1].startswith(f"stopped after iteration {ITERATIONS}; go on with: "), out
    assert not (run / "eval.json").exists()
    monkeypatch.undo()
    go_on(run, undisturbed)
    assert (run / "eval.json").read_bytes() == (undisturbed / "eval.json").read_bytes()


# Streams ----------------------------------------------------------------------------------------


def test_a_run_whose_reader_leaves_saves_and_ends_like_sigterm(tmp_path):
    run = tmp_path / "run"
    code, err = run_unread(2, *smoke_words(run, *native()))
    assert code == 0 and "Traceback" not in err, err
    assert f"train.py --run {run} --resume" in err.splitlines()[-1]
    done = len(rows_of(run))
    assert done < ITERATIONS and steps(run)[-1] == done


def test_a_run_with_its_output_on_a_full_disk_saves_and_says_so(tmp_path):
    run = tmp_path / "run"
    done = run_in_shell("> /dev/full", *smoke_words(run, *native()))
    assert done.returncode == 2 and "Traceback" not in done.stderr, done.stderr
    stopped, cause, cure = done.stderr.splitlines()[-3:]
    assert "stopped after iteration 0; go on with" in stopped
    assert cause == "error: cannot write the output: No space left on device"
    assert cure.startswith("fix: ") and steps(run) == [0]


@pytest.mark.slow
def test_a_run_without_standard_streams_is_the_undisturbed_one(undisturbed, tmp_path):
    """Closed, not sent to /dev/null: a file would get the number of standard error."""
    run = tmp_path / "run"
    done = run_in_shell("<&- >&- 2>&-", *smoke_words(run, *native()))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert_same_result(run, undisturbed)


def test_other_commands_end_quietly_when_their_reader_leaves(undisturbed, tmp_path):
    plot = "plot", "--run", str(undisturbed), "--out", str(tmp_path)
    assert run_unread(0, "--help") == (128 + signal.SIGPIPE, "")
    assert run_unread(0, *plot) == (128 + signal.SIGPIPE, "")


def test_output_that_cannot_be_written_is_two_lines():
    done = run_in_shell("> /dev/full", "--help")
    assert done.returncode == 2
    assert done.stderr.splitlines() == [
        "error: cannot write the output: No space left on device",
        "fix: send the output to a file or a terminal that can be written",
    ]


@pytest.mark.parametrize("closed", ["2>&-", "2> /dev/full", ">&- 2>&-"])
def test_a_mistake_that_cannot_be_told_has_its_exit_code(closed):
    done = run_in_shell(closed, "--config", "no-such.yaml")
    assert (done.returncode, done.stdout, done.stderr) == (2, "", "")
    assert run_in_shell(closed, "--help").returncode == 0


@pytest.mark.parametrize(
    "error",
    [
        KeyboardInterrupt(),
        RuntimeError("XlaRuntimeError: INTERNAL: ... KeyboardInterrupt: <EMPTY>"),
    ],
    ids=["Python", "a callback of jax"],
)
def test_ctrl_c_ends_a_command_without_a_traceback(monkeypatch, capfd, error):
    def interrupted(words):
        raise error

    monkeypatch.setattr(cli, "_plot", interrupted)
    assert cli.main(["plot"]) == 128 + signal.SIGINT
    assert capfd.readouterr() == ("", "")


# Directories, locks -----------------------------------------------------------------------------

STARTS = """
import datetime, multiprocessing, sys
from cmrl_jax.storage.run_dir import new_run

def start(barrier, queue):
    for second in range(ROUNDS):
        barrier.wait()
        queue.put(str(new_run("x", None, datetime.datetime(2026, 1, 2, 3, 4, second))))

ROUNDS, fork = 10, multiprocessing.get_context("fork")
barrier, queue = fork.Barrier(8), fork.Queue()
processes = [fork.Process(target=start, args=(barrier, queue)) for _ in range(8)]
for process in processes:
    process.start()
found = [queue.get() for _ in range(8 * ROUNDS)]
print(len(found), len(set(found)))
"""


def test_starts_in_one_second_get_a_directory_each(tmp_path):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", STARTS]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.stdout.split() == ["80", "80"], done
    assert len(list((tmp_path / "runs").iterdir())) == 80


def test_a_directory_that_another_start_has_just_made_is_not_shared(tmp_path, monkeypatch):
    """The other one comes after any look at what is there, just before ours is made."""
    monkeypatch.chdir(tmp_path)
    now, original = datetime.datetime(2026, 1, 2, 3, 4, 5), Path.mkdir

    def late(self, *args, **options):
        if self.name == "x-20260102-030405":
            original(self, parents=True, exist_ok=True)
        original(self, *args, **options)

    monkeypatch.setattr(Path, "mkdir", late)
    assert new_run("x", None, now) == Path("runs/x-20260102-030405-1")
    assert new_run("x", None, now) == Path("runs/x-20260102-030405-2")


def test_a_run_that_came_before_the_lock_is_not_overwritten(
    undisturbed, tmp_path, monkeypatch, refused
):
    """Another process began and ended between the first look and the lock."""
    run, files = tmp_path / "run", ("config.yaml", "metrics.csv")

    @contextlib.contextmanager
    def late(path, place):
        shutil.copytree(undisturbed, path, dirs_exist_ok=True)
        with writing_to(path, place):
            yield

    monkeypatch.setattr(run_dir, "writing_to", late)
    assert "already holds a run" in refused("--config", "smoke.yaml", "--run", str(run))[0]
    assert all((run / f).read_bytes() == (undisturbed / f).read_bytes() for f in files)


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK])
def test_a_file_system_without_locks_is_warned_of(tmp_path, monkeypatch, capfd, number):
    def flock(file, operation):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", flock)
    with writing_to(tmp_path):
        assert (tmp_path / LOCK).read_text().startswith(f"process {os.getpid()} on ")
    [warning] = capfd.readouterr().err.splitlines()
    assert warning.startswith(f"warning: run directory {tmp_path} is on a file system without")
    assert os.strerror(number) in warning
