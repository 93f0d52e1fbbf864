"""TensorBoard events, for `log.tensorboard`."""

from __future__ import annotations

import os
import struct
import time
from pathlib import Path
from typing import Any

from cmrl_jax.config.extras import require_extra
from cmrl_jax.training.films import sheets_of
from cmrl_jax.training.logger import Logger, Progress, RunInfo
from cmrl_jax.training.metrics import Row, figures_of


class TensorBoard(Logger):
    """The rows of metrics.csv once more, over env steps, and films as pictures.

    An event file begins with all rows so far and takes the place of the one before, so that it
    holds what metrics.csv holds, whatever a kill or a resume has cut there. Records are written by
    this thread: tensorboardX's own writer queues them, and a killed process loses its queue.
    """

    def __init__(self) -> None:
        """Events go to the run directory's `tensorboard/`.

        Raises:
            ConfigError: tensorboardX is not installed.
        """
        require_extra("log.tensorboard")
        from tensorboardX import RecordWriter
        from tensorboardX.proto import event_pb2

        self._record_writer, self._writer = RecordWriter, None
        events: Any = event_pb2  # made at run time, so that no type checker knows what is in it
        self._event = events.Event
        self._session_log = events.SessionLog

    def start(self, run: RunInfo) -> None:
        directory = run.run_dir / "tensorboard"
        self._begun = run.begun
        directory.mkdir(parents=True, exist_ok=True)
        before = list(directory.glob("events.*"))
        # TensorBoard reads the files of a directory in the order of their names.
        self._writer = self._record_writer(str(directory / f"events.out.tfevents.{time.time_ns()}"))
        self._add(self._event(file_version="brain.Event:2", wall_time=self._begun))
        # One that looks on drops what it has read of the files before.
        start = self._session_log(status=self._session_log.START)
        self._add(self._event(session_log=start, wall_time=self._begun))
        last = 0
        for row in run.rows:
            self._add_row(row)
            last = int(row["env_steps"])
        for steps, sheet in sheets_of(run.run_dir):
            if steps <= last:
                self._add_picture(f"film/{sheet.stem}", steps, sheet)
        self._flush()
        for path in before:
            os.truncate(path, 0)  # a TensorBoard that looks on would not go past one that is gone

    def row(self, row: Row, progress: Progress) -> None:
        self._add_row(row)
        self._flush()

    def film(self, task: str, row: Row, video: Path, sheet: Path) -> None:
        self._add_picture(f"film/{task}", int(row["env_steps"]), sheet)
        self._flush()

    def _add_picture(self, tag: str, step: int, png: Path) -> None:
        data = png.read_bytes()
        event = self._event(step=step, wall_time=png.stat().st_mtime)
        picture = event.summary.value.add(tag=tag).image
        picture.encoded_image_string, picture.colorspace = data, 3
        picture.width, picture.height = struct.unpack(">II", data[16:24])  # PNG's first chunk
        self._add(event)

    def _add_row(self, row: Row) -> None:
        event = self._event(step=int(row["env_steps"]), wall_time=self._begun + row["wall_s"])
        for name, value in figures_of(row).items():
            event.summary.value.add(tag=name, simple_value=value)
        self._add(event)

    def _add(self, event: Any) -> None:
        assert self._writer is not None  # started
        self._writer.write(event.SerializeToString())

    def _flush(self) -> None:
        assert self._writer is not None
        self._writer.flush()

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
