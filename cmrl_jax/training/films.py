"""Films of a run while it trains, for `log.video_every`: `render` in a process of its own.

The loop never waits for one: while a film is being made, the next that is due is left out. It acts
on the CPU, at the lowest priority, by the policy checkpoint of its iteration.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from cmrl_jax.commands import CHILD
from cmrl_jax.config.extras import require_extra
from cmrl_jax.training.logger import Logger, Progress, RunInfo
from cmrl_jax.training.metrics import Row

FOLDER = "films"  # of a run: FOLDER/ENV_STEPS/TASK.mp4
LONGEST_WAIT = 120.0  # s, for the last film when a run ends


class Films(Logger):
    """Starts a film where one is due, and tells the loggers of it once it is there.

    Args:
        told: loggers.

    Raises:
        ConfigError: a package is missing that films need.
    """

    def __init__(self, told: Sequence[Logger]):
        require_extra("log.video_every")
        self._told = told
        self._child: subprocess.Popen[bytes] | None = None
        self._row: Row = {}  # of the film that is being made
        self._due: Row | None = None
        self._is_over = False

    def start(self, run: RunInfo) -> None:
        self._run_dir, self._every = run.run_dir, run.config.log.video_every

    def row(self, row: Row, progress: Progress) -> None:
        """An iteration's policy is saved after its row: it is filmed when the next row comes."""
        self._collect(wait=0.0)
        if self._child is None and self._due is not None:
            self._begin(self._due)
        done = int(row["iteration"]) + 1
        self._due = row if done % self._every == 0 else None
        self._is_over = progress.share >= 1.0

    def close(self) -> None:
        """Waits for films where the run has come to its end; one that is stopped ends at once."""
        if self._is_over:
            self._collect(wait=LONGEST_WAIT)
            if self._child is None and self._due is not None:
                self._begin(self._due)
                self._collect(wait=LONGEST_WAIT)
        if self._child is not None:
            self._child.kill()
            self._child.wait()
            self._said.close()

    @property
    def _out(self) -> Path:
        return self._run_dir / FOLDER / f"{int(self._row['env_steps'])}"

    def _begin(self, row: Row) -> None:
        iteration = int(row["iteration"]) + 1
        if not (self._run_dir / "policy" / str(iteration)).is_dir():
            return  # the run was stopped before it was saved
        self._row, self._due = row, None
        words = ["render", "--run", self._run_dir, "--checkpoint", iteration, "--out", self._out]
        self._said = tempfile.TemporaryFile()  # a pipe that nobody empties would hold it up
        self._child = subprocess.Popen(
            [sys.executable, "-c", CHILD, *map(str, words)],
            env=os.environ | {"JAX_PLATFORMS": "cpu"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._said,
        )
        os.setpriority(os.PRIO_PROCESS, self._child.pid, 19)

    def _collect(self, wait: float) -> None:
        """Tells of the film that was being made, if it ends within `wait` seconds."""
        if self._child is None:
            return
        if wait and self._child.poll() is None:
            self._message(f"waiting {wait:.0f} s at most for a film")
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._child.wait(wait)
        code = self._child.poll()
        if code is None:
            return
        self._child = None
        with self._said as file:
            file.seek(0)
            said = file.read().decode(errors="replace").strip().splitlines()
        if code:
            last = (said or [f"exit code {code}"])[-1]
            self._message(f"no film of iteration {int(self._row['iteration']) + 1}: {last}")
            return
        for video in sorted(self._out.glob("*.mp4")):
            for logger in self._told:
                logger.film(video.stem, self._row, video, video.with_suffix(".png"))

    def _message(self, text: str) -> None:
        for logger in self._told:
            logger.message(text)


def sheets_of(run_dir: Path) -> list[tuple[int, Path]]:
    """(env steps, contact sheet) of the films that training has left in a run, oldest first."""
    sheets = (run_dir / FOLDER).glob("*/*.png")
    return sorted((int(s.parent.name), s) for s in sheets if s.parent.name.isdigit())
