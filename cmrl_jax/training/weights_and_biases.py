"""Weights & Biases, for `log.wandb` (extra `wandb`); `WANDB_MODE=offline` needs no account."""

from __future__ import annotations

import os
import secrets
from pathlib import Path
from typing import Any

from cmrl_jax.config.extras import require_extra
from cmrl_jax.config.files import to_dict
from cmrl_jax.config.schema import ConfigError
from cmrl_jax.storage.run_dir import seed_dirs, write_text
from cmrl_jax.training.logger import Logger, Progress, RunInfo
from cmrl_jax.training.metrics import Row, figures_of

PROJECT = "cmrl_jax"  # where WANDB_PROJECT names no other


class WeightsAndBiases(Logger):
    """The rows of metrics.csv once more, over env steps, and films; one W&B run for each of ours.

    A resumed run goes on in the same W&B run: rows that are there already are not sent again, and
    rows after a checkpoint are equal when they come a second time. Offline every process leaves a
    directory of its own with all rows, which `wandb sync` joins. A run that was stopped before its
    end is shown as failed until it goes on.
    """

    def __init__(self) -> None:
        """
        Raises:
            ConfigError: wandb is not installed.
        """
        require_extra("log.wandb")
        import wandb

        self._wandb: Any = wandb
        self._run: Any = None
        self._is_over = False

    def start(self, run: RunInfo) -> None:
        wandb = self._wandb
        try:
            self._run = wandb.init(
                project=os.environ.get("WANDB_PROJECT", PROJECT),
                name=_name_of(run.run_dir),
                id=_id_of(run.run_dir),
                resume="allow",
                dir=str(run.run_dir),
                config=to_dict(run.config),
                # Several seeds of one process are runs beside each other; the console is ours.
                reinit="create_new",
                settings=wandb.Settings(console="off", silent=True),
            )
        except wandb.errors.Error as error:
            cause = f"Weights & Biases does not start: {error}"
            raise ConfigError(cause, "run `wandb login`, or set WANDB_MODE=offline") from error
        known = self._run.step
        for row in run.rows:
            if int(row["env_steps"]) > known or not known:
                self._add(row)

    def row(self, row: Row, progress: Progress) -> None:
        self._add(row)
        self._is_over = progress.share >= 1.0

    def film(self, task: str, row: Row, video: Path, sheet: Path) -> None:
        # It belongs to an earlier row, and W&B goes no step back: it stands with the newest.
        caption = f"env step {int(row['env_steps']):,}"
        film = self._wandb.Video(str(video), caption=caption, format="mp4")
        self._run.log({f"film/{task}": film}, commit=False)

    def _add(self, row: Row) -> None:
        self._run.log(figures_of(row), step=int(row["env_steps"]))

    def close(self) -> None:
        if self._run is not None:
            self._run.finish(exit_code=0 if self._is_over else 1)


def _name_of(run_dir: Path) -> str:
    """What W&B calls the run: its directory, with what several seeds have in common."""
    place = run_dir.resolve()
    is_one_of_several = place in seed_dirs(place.parent).values()
    return f"{place.parent.name}/{place.name}" if is_one_of_several else place.name


def _id_of(run_dir: Path) -> str:
    """The W&B run's id, kept in the run directory."""
    path = run_dir / "wandb" / "id.txt"
    if not path.is_file():
        path.parent.mkdir(exist_ok=True)
        write_text(path, secrets.token_hex(4))
    return path.read_text(encoding="utf-8")
