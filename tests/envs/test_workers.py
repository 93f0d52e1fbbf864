"""Processes that simulate: whatever happens to them, the numbers are those of one process alone."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from run_helpers import ROOT

from envs.physics import workers
from envs.physics.base import settled_starts
from envs.physics.native import scenes, step_inputs
from envs.physics.simulator import OUTPUTS, Batch
from envs.physics.workers import Workers
from envs.tasks.specs import SCENE_ID

LANES = 12


def some_batch() -> Batch:
    """Control steps of every task from its start, by random actions."""
    generator = np.random.default_rng(0)
    task = np.arange(LANES) % len(SCENE_ID)
    start = settled_starts()
    carried = np.concatenate(
        [leaf[task] for leaf in (start.qpos, start.qvel, start.warm_start, start.mocap)], -1
    )
    return Batch(
        given=step_inputs(carried, generator.uniform(-1, 1, (LANES, 4))),
        placement=generator.uniform((-0.1, 0.7, 0.1), (0.1, 0.9, 0.2), (LANES, 3)),
        scene=SCENE_ID[task].astype(np.int64),
        carried=carried,
        bodies=np.zeros((LANES, 4, 3)),
        sites=np.zeros((LANES, 2, 3)),
        is_sound=np.zeros(LANES, bool),
    )


@pytest.fixture(scope="module")
def expected() -> Batch:
    return simulated(Workers(scenes(), 1))


@pytest.fixture
def pool():
    pool = Workers(scenes(), 3)
    yield pool
    pool.close()


def simulated(pool: Workers) -> Batch:
    batch = some_batch()
    pool.simulate(batch, np.random.default_rng(1).permutation(LANES))
    return batch


def assert_same(one: Batch, other: Batch) -> None:
    assert one.is_sound.all()
    for name in OUTPUTS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def is_running(pid: int) -> bool:
    """Whether a process of that number is there and has not ended."""
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False


def wait_until_ended(pids: list[int]) -> None:
    deadline = time.monotonic() + 20
    while any(map(is_running, pids)):
        assert time.monotonic() < deadline, f"still running: {pids}"
        time.sleep(0.05)


def test_more_lanes_than_fit_are_taken_in_rounds(pool, expected, monkeypatch):
    monkeypatch.setattr(pool, "at_once", 1)
    assert_same(simulated(pool), expected)


def test_lanes_that_were_not_given_are_left_alone(pool):
    batch, before = some_batch(), some_batch()
    pool.simulate(batch, np.arange(4))
    assert batch.is_sound.tolist() == [True] * 4 + [False] * (LANES - 4)
    np.testing.assert_array_equal(batch.carried[4:], before.carried[4:])


def test_a_few_lanes_start_no_more_processes_than_lanes(expected):
    pool, batch = Workers(scenes(), 4), some_batch()
    pool.simulate(batch, np.arange(1))
    assert pool.pids() == []
    pool.simulate(batch, np.arange(1, 3))
    assert len(pool.pids()) == 1
    pool.close()


def test_what_cannot_be_started_is_warned_of_once(expected, monkeypatch):
    pool = Workers(scenes(), 3)

    def refused(*args, **options):
        raise BlockingIOError(11, "Resource temporarily unavailable")

    before = len(os.listdir("/proc/self/fd"))
    monkeypatch.setattr(workers.subprocess, "Popen", refused)
    with pytest.warns(UserWarning, match="no more processes can simulate .Resource temp"):
        assert_same(simulated(pool), expected)
    assert_same(simulated(pool), expected)
    assert len(os.listdir("/proc/self/fd")) == before


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_what_stops_a_run_does_not_stop_its_workers(pool, expected, name):
    assert_same(simulated(pool), expected)
    pids = pool.pids()
    for pid in pids:
        os.kill(pid, getattr(signal, name))
    assert_same(simulated(pool), expected)
    assert pool.pids() == pids and all(map(is_running, pids))


def test_the_others_take_over_from_a_worker_that_was_killed(pool, expected):
    assert_same(simulated(pool), expected)
    killed, other = pool.pids()
    os.kill(killed, signal.SIGKILL)
    with pytest.warns(UserWarning, match="has ended .exit code -9.; the others go on"):
        assert_same(simulated(pool), expected)
    assert pool.pids() == [other]
    assert_same(simulated(pool), expected)  # and is not warned of again


def test_an_error_on_the_way_leaves_no_answer_behind(pool, expected, monkeypatch):
    """What the workers had done by then is not taken for the answer to the next batch."""

    def interrupted(*args):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(workers, "simulate", interrupted)
        with pytest.raises(KeyboardInterrupt):
            simulated(pool)
    assert pool.pids() == []
    assert_same(simulated(pool), expected)


SCRIPT = """
import os, sys
sys.path.insert(0, "tests/envs")
from test_workers import *
pool = Workers(scenes(), 3)
first = simulated(pool)
print(*pool.pids(), flush=True)
"""


def started(rest: str) -> tuple[subprocess.Popen, list[int]]:
    """A process that has simulated a batch and goes on with `rest`, and its workers."""
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    parent = subprocess.Popen(
        [sys.executable, "-c", SCRIPT + rest],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": paths, "JAX_PLATFORMS": "cpu"},
        stdin=subprocess.PIPE,  # one that stays open: the tests' own may be at its end
        stdout=subprocess.PIPE,
        text=True,
    )
    assert parent.stdout is not None
    return parent, list(map(int, parent.stdout.readline().split()))


@pytest.mark.parametrize("how", ["killed", "at its end"])
def test_workers_end_with_their_parent(how):
    parent, pids = started("input()" if how == "killed" else "")
    assert len(pids) == 2
    if how == "killed":
        assert all(map(is_running, pids))
        parent.kill()
    parent.communicate()
    assert parent.returncode == (-9 if how == "killed" else 0)
    wait_until_ended(pids)


def test_a_forked_process_has_workers_of_its_own():
    parent, pids = started("""
idle = os.fork()
if not idle:
    time.sleep(100)  # it holds what its parent held, and must not keep the workers waiting
child = os.fork()
assert_same(simulated(pool), first)
if child:
    code = os.waitpid(child, 0)[1]
    assert_same(simulated(pool), first)
    pool.close()
    os.kill(idle, signal.SIGKILL)
    sys.exit(code != 0)
print(*pool.pids(), flush=True)
pool.close()
os._exit(0)
""")
    own = list(map(int, parent.communicate()[0].split()))
    assert parent.returncode == 0
    assert len(own) == 2 and not set(own) & set(pids)
    wait_until_ended(own + pids)
