"""One run's files and loggers: its rows, its checkpoints, and what it is warned of."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from cmrl_jax.algorithms.base import RunState
from cmrl_jax.config.schema import Config, ConfigError
from cmrl_jax.evaluation.session import Session
from cmrl_jax.registry import rules_of
from cmrl_jax.storage.checkpoint import join_run, split_run
from cmrl_jax.storage.versions import package_versions, write_versions
from cmrl_jax.text.goals import check_same_table
from cmrl_jax.training.logger import Logger, Progress, RunInfo
from cmrl_jax.training.metrics import MetricsCsv


@dataclasses.dataclass(frozen=True)
class Saved:
    """What a run goes on from."""

    state: RunState
    meta: dict[str, Any]


class Run:
    """The files and loggers of one run.

    Args:
        stores: of full checkpoints and of policies.
        label: what its messages begin with.
    """

    def __init__(
        self,
        config: Config,
        run_dir: Path,
        session: Session,
        stores: tuple[Any, Any],
        loggers: Sequence[Logger],
        label: str,
    ):
        self.config, self.run_dir, self.loggers, self.label = config, run_dir, loggers, label
        self.full, self.policy = stores
        self.session, self.algorithm = session, session.algorithm
        self.csv: MetricsCsv | None = None
        self.rules = rules_of(config)
        self.steps = self.rules.steps_per_iteration()

    def say(self, text: str) -> None:
        for logger in self.loggers:
            logger.message(self.label + text)

    def close(self) -> None:
        with contextlib.ExitStack() as left:  # one that cannot be closed keeps no other open
            for logger in reversed(self.loggers):
                left.callback(logger.close)
            if self.csv is not None:
                left.callback(self.csv.close)

    def saved(self, one: RunState, newest: int | None = None) -> Saved | None:
        """The newest sound checkpoint, or that of iteration `newest`; None before the first save.

        Raises:
            ConfigError: it cannot be gone on from.
        """
        if not self.full.steps():
            self.check_unsaved()
            self.say(f"{self.run_dir} was stopped before its first save: starting it anew")
            return None
        abstract, versions = split_run(one), package_versions()
        if newest is None:
            trees, meta = self.full.resume(abstract, self.config, versions)
        else:
            trees, meta = self.full.restore(abstract, self.config, newest, versions)
        check_same_table(self.session.goals, meta["goals_sha256"], self.run_dir)
        return Saved(join_run(one, trees), meta)

    def check_unsaved(self) -> None:
        """A run saves before its first row: rows without a checkpoint mean that it was lost."""
        rows = self.rows_written()
        if rows > 0 or self.policy.steps():
            raise ConfigError(
                f"{self.run_dir} has {rows} rows in metrics.csv but no checkpoint in ckpt/",
                "put ckpt/ back from a copy, or start a new run in another --run DIR",
            )

    def rows_written(self) -> int:
        """Rows of metrics.csv, those after the checkpoint too."""
        path = self.run_dir / "metrics.csv"
        return path.read_bytes().count(b"\n") - 1 if path.is_file() else 0

    def start(self, columns: list[str], meta: dict[str, Any] | None) -> None:
        """Opens the CSV and starts the loggers, from the beginning or where it was saved."""
        path, wall = self.run_dir / "metrics.csv", 0.0
        if meta is None:
            self.csv = MetricsCsv(path, columns)
        else:
            wall, iteration = meta["wall_s"], meta["iteration"]
            self.csv = MetricsCsv(path, columns, offset=meta["csv_offset"])
            self.full.drop_after(iteration)
            self.policy.drop_after(iteration)
            self.say(f"resuming {self.run_dir} after iteration {iteration}")
        write_versions(self.run_dir / "versions.json")
        for logger in self.loggers:
            begun = time.time() - wall
            logger.start(RunInfo(self.run_dir, self.config, self.csv.rows(), begun))

    def write(self, row: dict[str, Any], progress: Progress) -> None:
        assert self.csv is not None  # started
        self.csv.write(row)
        for logger in self.loggers:
            logger.row(row, progress)

    def check_health(self, row: dict[str, Any]) -> None:
        """Warns of what was skipped or put back; stops a run that cannot recover by itself.

        Under JAX_DEBUG_NANS or JAX_DEBUG_INFS it stops at the first.
        """
        is_strict = jax.config.jax_debug_nans or jax.config.jax_debug_infs
        config, iteration = self.config, row["iteration"]
        kept = f"{self.full.directory} keeps iteration {self.full.steps()[-1]}"
        skipped = row.get("train/skipped") or 0.0
        faults = int(row.get("train/physics_faults") or 0)
        if skipped == 1.0 or (skipped and is_strict):
            share = (
                "every gradient was" if skipped == 1.0 else f"{skipped:.1%} of the gradients were"
            )
            raise ConfigError(
                f"{self.label}iteration {iteration}: {share} non-finite",
                f"{self.rules.on_bad_gradients}; {kept}",
            )
        # As many as a whole task collects: what is learned from is no longer the task.
        if faults >= self.steps // len(config.tasks.train) or (faults and is_strict):
            other = "native" if config.env.physics == "mjx" else "mjx"
            simulator = f"with env.physics: {other}, or " if config.env.name == "ml4" else ""
            raise ConfigError(
                f"{self.label}iteration {iteration}: the physics of {faults} of "
                f"{self.steps} control steps was non-finite",
                f"start a new run {simulator}without the last change; {kept}",
            )
        if skipped:
            self.say(f"warning: {skipped:.1%} of the gradients were non-finite and were skipped")
        if faults:
            self.say(f"warning: {faults} lane(s) left the range of float32 and were put back")

    def save(self, state: RunState, done: int, wall: float, with_policy: bool) -> None:
        """A full checkpoint after `done` iterations, and a policy checkpoint where one is due."""
        assert self.csv is not None  # started
        meta = {
            "config": dataclasses.asdict(self.config),
            "iteration": done,
            "env_steps": done * self.steps,
            "wall_s": wall,
            "csv_offset": self.csv.offset,
            "versions": package_versions(),
            "goals_sha256": self.session.goals.sha256,
        }
        self.full.save(split_run(state), meta)
        # After the full one: a kill in between leaves a policy to write again, not one too many.
        if with_policy:
            policy = {
                "params": self.algorithm.policy_params(state),
                "goal_vectors": self.session.goals.vectors[:, 0],
            }
            self.policy.save({"policy": policy}, meta)
