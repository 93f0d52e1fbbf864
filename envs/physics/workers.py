"""Processes that simulate beside this one, each a share of the lanes.

MuJoCo lets go of the interpreter lock while it simulates, but a lane's step is some 60 microseconds
with Python between the calls, so that threads of one process stop gaining after a few. A worker is
a process of its own with its own models. Its share of the lanes lies in memory that both see; two
pipes say how many lanes there are and that they are done.

A worker ends when the pipe it reads from is closed, which the kernel does however its parent ends.
It does not listen to signals that stop a run: its parent decides when to stop.
"""

from __future__ import annotations

import atexit
import contextlib
import mmap
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
import warnings
from pathlib import Path
from typing import IO

import numpy as np

from envs.engine import WITHOUT_GL, mujoco
from envs.physics.simulator import (
    INPUTS,
    LANE_BYTES,
    OUTPUTS,
    Batch,
    Simulator,
    batch_in,
    simulate,
)

SHARE = 1024  # lanes that a worker is given at once
DONE = b"."

Scenes = list[tuple[mujoco.MjModel, str, str]]  # arguments of `Simulator`, by scene


def processors() -> int:
    """Processors that this process may use; from Python 3.13 on PYTHON_CPU_COUNT sets it."""
    if hasattr(os, "process_cpu_count"):
        return vars(os)["process_cpu_count"]() or 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Worker:
    """One process and its share of the lanes."""

    def __init__(self, scenes_file: int):
        """Starts it; `scenes_file` is open and holds the pickled `Scenes`.

        Raises:
            OSError: it cannot be started; nothing is left of it.
        """
        with contextlib.ExitStack() as ours:
            file = ours.enter_context(_memory_file())
            file.truncate(SHARE * LANE_BYTES)
            self._memory = mmap.mmap(file.fileno(), SHARE * LANE_BYTES)
            told, self._tell = os.pipe()
            ours.callback(os.close, told)
            failed = contextlib.ExitStack()
            failed.callback(os.close, self._tell)
            with failed:
                self._heard, answer = os.pipe()
                ours.callback(os.close, answer)
                failed.callback(os.close, self._heard)
                handed = (scenes_file, file.fileno(), told, answer)
                # The same code as this process runs, and nothing to draw with.
                root = str(Path(__file__).parents[2])
                paths = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-m", __spec__.name, *map(str, handed)],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    pass_fds=handed,
                    env=os.environ | {"PYTHONPATH": paths, "MUJOCO_GL": WITHOUT_GL},
                    start_new_session=True,  # Ctrl-C is for this process alone, at any time
                )
                failed.pop_all()
        self._batch = batch_in(self._memory, SHARE)

    @property
    def pid(self) -> int:
        return self._process.pid

    def begin(self, batch: Batch, lanes: np.ndarray) -> None:
        """Gives it `lanes` (at most `SHARE` indices) of a batch."""
        for name in INPUTS:
            getattr(self._batch, name)[: len(lanes)] = getattr(batch, name)[lanes]
        with contextlib.suppress(BrokenPipeError):  # it has ended, as `finish` will find
            os.write(self._tell, len(lanes).to_bytes(4))

    def finish(self, batch: Batch, lanes: np.ndarray) -> bool:
        """Waits for it, and writes what came out into the batch; False if it has ended instead."""
        if os.read(self._heard, 1) != DONE:
            return False
        for name in OUTPUTS:
            getattr(batch, name)[lanes] = getattr(self._batch, name)[: len(lanes)]
        return True

    def hang_up(self) -> None:
        """Closes this process's ends of the pipes: the worker ends when no one else holds them."""
        for pipe in (self._tell, self._heard):
            os.close(pipe)

    def close(self) -> int:
        """Ends it, whoever else holds the pipe; its exit code."""
        self.hang_up()
        self._process.kill()  # it holds nothing that could be lost
        return self._process.wait()


class Workers:
    """This process and others beside it, which are started at the first batch.

    Args:
        scenes: what `Simulator` is made of, by index of the scene.
        count: processes, this one among them; None: as many as the processors that it may use.

    Attributes:
        at_once: lanes that each is given in a round, at most `SHARE`.
    """

    at_once = SHARE

    def __init__(self, scenes: Scenes, count: int | None = None):
        self._scenes, self._count = scenes, count or processors()
        self._simulators = [Simulator(*scene) for scene in scenes]
        self._workers: list[Worker] = []
        self._missing = 0  # processes that ended, or could not be started
        self._lock = threading.Lock()  # several devices may ask at once
        atexit.register(self.close)
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(after_in_child=self._forget)

    def simulate(self, batch: Batch, lanes: np.ndarray) -> None:
        """One control step of the given `lanes` of a batch; outputs are written into it.

        A worker that has ended, or cannot be started, is warned of once; the others take over.
        """
        with self._lock:
            try:
                self._start(min(self._count - self._missing, len(lanes)) - 1)
                while len(lanes):
                    size = self.at_once * (1 + len(self._workers))
                    self._round(batch, lanes[:size])
                    lanes = lanes[size:]
            except BaseException:
                self._close()  # what the others are at is not known
                raise

    def close(self) -> None:
        """Ends the workers; the next batch starts new ones."""
        with self._lock:
            self._close()

    def pids(self) -> list[int]:
        """Process ids of the workers at hand."""
        return [worker.pid for worker in self._workers]

    def _start(self, count: int) -> None:
        """Starts what is missing of `count` workers."""
        if len(self._workers) >= count:
            return
        try:
            with _memory_file() as file:
                pickle.dump(self._scenes, file)
                file.flush()
                while len(self._workers) < count:
                    self._workers.append(Worker(file.fileno()))
        except OSError as error:
            self._missing = self._count - 1 - len(self._workers)
            cause = f"no more processes can simulate ({error.strerror}); those at hand go on"
            warnings.warn(cause, stacklevel=1)

    def _round(self, batch: Batch, lanes: np.ndarray) -> None:
        # Dealt out: lanes of a task, which cost alike, go to different ones.
        count = min(1 + len(self._workers), len(lanes))
        own, *others = (lanes[first::count] for first in range(count))
        shares = list(zip(self._workers, others, strict=False))
        for worker, share in shares:
            worker.begin(batch, share)
        simulate(self._simulators, batch, own.tolist())
        for worker, share in shares:
            if not worker.finish(batch, share):
                self._workers.remove(worker)
                self._missing += 1
                code = worker.close()
                cause = f"a process that simulates has ended (exit code {code}); the others go on"
                warnings.warn(cause, stacklevel=1)
                simulate(self._simulators, batch, share.tolist())

    def _close(self) -> None:
        while self._workers:
            self._workers.pop().close()

    def _forget(self) -> None:
        """After a fork, in the new process: the workers are its parent's."""
        self._lock = threading.Lock()
        while self._workers:
            self._workers.pop().hang_up()


def _memory_file() -> IO[bytes]:
    """A file without a name, in memory where the system has such."""
    if hasattr(os, "memfd_create"):
        return os.fdopen(os.memfd_create("cmrl"), "w+b")
    return tempfile.TemporaryFile()


def serve(scenes_file: int, memory: int, told: int, answer: int) -> None:
    """What a worker does until its parent has ended; all arguments are open files."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        with contextlib.suppress(AttributeError):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    with mmap.mmap(scenes_file, 0, access=mmap.ACCESS_READ) as pickled:
        simulators = [Simulator(*scene) for scene in pickle.loads(pickled)]
    batch = batch_in(mmap.mmap(memory, SHARE * LANE_BYTES), SHARE)
    while lanes := os.read(told, 4):
        simulate(simulators, batch, range(int.from_bytes(lanes)))
        with contextlib.suppress(BrokenPipeError):  # the parent has ended meanwhile
            os.write(answer, DONE)


if __name__ == "__main__":
    serve(*map(int, sys.argv[1:]))
