"""What a run tells: figures, films and messages, to any number of loggers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from cmrl_jax.config.schema import Config
from cmrl_jax.training.metrics import Row


@dataclass(frozen=True)
class RunInfo:
    """What loggers are told of a run when it begins or goes on.

    Attributes:
        run_dir: its directory.
        config: what is trained; loggers of services keep it beside the figures.
        rows: those of metrics.csv so far, oldest first.
        begun: clock time (s) from which the rows' `wall_s` counts.
    """

    run_dir: Path
    config: Config
    rows: Iterable[Row] = ()
    begun: float = 0.0


@dataclass(frozen=True)
class Progress:
    """How far a run is: share done, 0 to 1, and seconds until it ends (inf: unknown)."""

    share: float
    seconds_left: float


class Logger:
    """What a logger is told, in this order. Yours is a subclass with the methods that it needs."""

    def start(self, run: RunInfo) -> None:
        """The run begins, or goes on."""

    def row(self, row: Row, progress: Progress) -> None:
        """An iteration is done; `row` holds the columns of metrics.csv that were taken."""

    def film(self, task: str, row: Row, video: Path, sheet: Path) -> None:
        """An episode was filmed (`log.video_every`).

        Args:
            row: the last one whose iteration the filmed policy has done.
            video: an mp4.
            sheet: a PNG of frames of it.
        """

    def message(self, text: str) -> None:
        """A line for the user: what takes long, what is wrong, how it ended."""

    def close(self) -> None:
        """Nothing comes any more."""
