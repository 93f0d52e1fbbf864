"""The host loop: iterations, their rows and loggers, periodic evaluation, checkpoints, stops.

Everything numerical happens in two compiled programs (a training iteration, an evaluation episode);
this file only decides when, and writes things down. NOTE: this is the one impure layer.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cmrl_jax import parallel
from cmrl_jax.algorithms.base import RunState
from cmrl_jax.config.schema import Config, ConfigError, lanes_per_task
from cmrl_jax.evaluation.scores import fault_warning, format_scores, of_policy, summarise
from cmrl_jax.evaluation.session import Session, prepare_jax
from cmrl_jax.registry import rules_of
from cmrl_jax.stop import Stop
from cmrl_jax.storage.checkpoint import full_store, join_run, policy_store, split_run
from cmrl_jax.storage.run_dir import write_text
from cmrl_jax.storage.versions import package_versions, write_versions
from cmrl_jax.text.goals import check_same_table
from cmrl_jax.training.loggers import Logger, Progress, RunInfo
from cmrl_jax.training.metrics import LEADING_COLUMNS, MetricsCsv, metric_names, metric_row

EVAL_FIGURES = ("success_any", "success_last", "return")


@dataclasses.dataclass(frozen=True)
class Schedule:
    """When a run ends and when it is evaluated, in iterations; a function of the config alone.

    So two runs of one config evaluate at the same iterations, whatever the machine's speed.
    """

    steps_per_iteration: int
    iterations: int | None  # None: limited by time alone
    eval_interval: int

    @classmethod
    def of(cls, config: Config) -> Schedule:
        steps = config.collect.lanes * config.env.horizon
        total = math.ceil(config.train.env_steps / steps) if config.train.env_steps else None
        tasks = len(config.tasks.train) + len(config.tasks.test)
        episodes = max(config.eval.k) + 1
        eval_steps = episodes * config.eval.goals * tasks * config.env.horizon
        # Evaluation steps cost no more than training steps (which carry gradient steps too), so
        # this bound on steps keeps evaluation within its share of the wall time.
        interval = math.ceil(eval_steps / (config.eval.wall_share * steps))
        if total is not None:
            interval = max(interval, math.ceil(config.eval.every * total))
        return cls(steps, total, interval)

    def is_eval_due(self, iterations_done: int) -> bool:
        return iterations_done % self.eval_interval == 0


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a call of `train` ended; everything is saved.

    Attributes:
        iteration: iterations done.
        is_finished: whether the schedule was; else it was asked to stop.
        evaluation: of the end, as `scores.summarise` has it; None where it was stopped before.
        wall_s: seconds of training, those of resumed processes added up.
    """

    iteration: int
    is_finished: bool
    evaluation: dict[str, Any] | None
    wall_s: float


def train(
    config: Config,
    run_dir: Path,
    loggers: Sequence[Logger] = (),
    stop: Stop | None = None,
    resume: bool = False,
) -> Outcome:
    """Trains to the end of the schedule, or to a stop.

    Args:
        run_dir: its `config.yaml` is written, and it is held (`run_dir.begun`).
        loggers: are started and closed here.
        stop: is looked at between iterations, and in the last evaluation.

    Raises:
        ConfigError: anything the user can mend, before the first compile where possible.
    """
    # All that refuses a configuration stands before the stores: they are what makes a run begin.
    device = prepare_jax(config)
    rules_of(config).check_devices(parallel.size(parallel.make_mesh()))
    session = Session(config)
    with full_store(run_dir, config.checkpoint.keep) as full, policy_store(run_dir) as policy:
        run = _Run(config, run_dir, session, full, policy, loggers, stop or Stop())
        return run.go(device, resume)


class _Stopped(Exception):
    """The final evaluation is left: it was asked to stop."""


class _Run:
    """One process's share of a run."""

    def __init__(
        self,
        config: Config,
        run_dir: Path,
        session: Session,
        full: Any,
        policy: Any,
        loggers: Sequence[Logger],
        stop: Stop,
    ):
        self.config, self.run_dir, self.loggers, self.stop = config, run_dir, loggers, stop
        self.session, self.full, self.policy = session, full, policy
        self.algorithm = session.algorithm
        self.schedule = Schedule.of(config)

    def say(self, text: str) -> None:
        for logger in self.loggers:
            logger.message(text)

    def go(self, device: str, resume: bool) -> Outcome:
        try:
            return self.train(device, resume)
        finally:
            for logger in self.loggers:
                logger.close()

    def train(self, device: str, resume: bool) -> Outcome:
        self.say(f"device: {device}")
        program = self.session.training(parallel.make_mesh())
        self.init = program.init
        self.start(program.abstract, self.columns(program.metrics), resume)
        try:
            if self.iterations_left() and not self.stop.requested:
                if not program.is_compiled:
                    self.timed("the training iteration", program.compile)
                self.iteration = program.compile()
            while self.iterations_left() and not self.stop.requested:
                self.step()
            self.save()
            evaluation = None if self.stop.requested else self.finish()
            return Outcome(self.done, evaluation is not None, evaluation, self.wall)
        finally:
            self.csv.close()

    def columns(self, metrics: dict[str, Any]) -> list[str]:
        config, tasks = self.config, self.session.eval_tasks
        evals = [f"eval/{t}/k{k}/{f}" for t in tasks for k in config.eval.k for f in EVAL_FIGURES]
        times = ["time/iteration_s", "time/env_steps_per_s", "time/evaluation_s"]
        return [*LEADING_COLUMNS, *metric_names(metrics, config.tasks.train), *evals, *times]

    def start(self, abstract: RunState, columns: list[str], resume: bool) -> None:
        """A new state, saved before its first iteration, or the state of the last checkpoint."""
        csv_path = self.run_dir / "metrics.csv"
        config = self.config
        if resume and self.full.steps():
            trees, meta = self.full.resume(split_run(abstract), config, package_versions())
            check_same_table(self.session.goals, meta["goals_sha256"], self.run_dir)
            self.policy.drop_after(meta["iteration"])
            self.state = join_run(abstract, trees)
            self.done, self.wall = meta["iteration"], meta["wall_s"]
            self.csv = MetricsCsv(csv_path, columns, offset=meta["csv_offset"])
            self.say(f"resuming {self.run_dir} after iteration {self.done}")
        else:
            if resume:
                self.check_unsaved(csv_path)
                self.say(f"{self.run_dir} was stopped before its first save: starting it anew")
            self.state = self.init(jax.random.key(config.seed))
            self.done, self.wall = 0, 0.0
            self.csv = MetricsCsv(csv_path, columns)
        write_versions(self.run_dir / "versions.json")
        for logger in self.loggers:
            begun = time.time() - self.wall
            logger.start(RunInfo(self.run_dir, config.tasks.train, self.csv.rows(), begun))
        self.evaluator = self.session.evaluator()
        self.clock = time.monotonic() - self.wall
        self.save()

    def check_unsaved(self, csv_path: Path) -> None:
        """A run saves before its first row: rows without a checkpoint mean that it was lost."""
        rows = csv_path.read_bytes().count(b"\n") - 1 if csv_path.is_file() else 0
        if rows > 0 or self.policy.steps():
            raise ConfigError(
                f"{self.run_dir} has {rows} rows in metrics.csv but no checkpoint in ckpt/",
                "put ckpt/ back from a copy, or start a new run in another --run DIR",
            )

    def timed(self, what: str, compile: Callable[[], Any]) -> Any:
        """Announces a compile and says how long it took."""
        started = time.monotonic()
        self.say(f"compiling {what} ...")
        result = compile()
        self.say(f"compiling {what} took {time.monotonic() - started:.1f} s")
        return result

    def iterations_left(self) -> bool:
        minutes, total = self.config.train.minutes, self.schedule.iterations
        in_time = not minutes or self.wall < 60 * minutes
        return in_time and (total is None or self.done < total)

    def step(self) -> None:
        """One iteration, its row, and whatever is due after it."""
        config, started = self.config, time.monotonic()
        # Of a whole iteration jax could only say that there is a NaN, and iteration 0's losses are
        # NaN on purpose; `check_health` does what JAX_DEBUG_NANS asks for.
        with jax.debug_nans(False), jax.debug_infs(False):
            self.state, metrics = self.iteration(self.state)
        metrics = jax.tree.map(np.asarray, metrics)
        seconds = time.monotonic() - started
        self.done += 1
        steps = self.done * self.schedule.steps_per_iteration
        row: dict[str, Any] = {
            "iteration": self.done - 1,
            "env_steps": steps,
            "gradient_steps": int(self.algorithm.gradient_steps(self.state)),
            "seed": config.seed,
            "time/iteration_s": seconds,
            "time/env_steps_per_s": self.schedule.steps_per_iteration / seconds,
        } | metric_row(metrics, config.tasks.train)
        self.check_health(row)
        if self.schedule.is_eval_due(self.done):
            row |= self.evaluate()
        self.wall = time.monotonic() - self.clock
        row["wall_s"] = self.wall
        self.csv.write(row)
        for logger in self.loggers:
            logger.row(row, Progress(self.share_done(), self.seconds_left()))
        if self.is_policy_due() or self.wall - self.saved_at >= 60 * config.checkpoint.minutes:
            self.save()

    def is_policy_due(self) -> bool:
        """Whether this border has a policy checkpoint, however long the iterations took."""
        return self.done > 0 and self.done % self.config.checkpoint.policy_every == 0

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
                f"iteration {iteration}: {share} non-finite",
                f"{rules_of(config).on_bad_gradients}; {kept}",
            )
        # As many as a whole task collects: what is learned from is no longer the task.
        if faults >= lanes_per_task(config) * config.env.horizon or (faults and is_strict):
            other = "native" if config.env.physics == "mjx" else "mjx"
            simulator = f"with env.physics: {other}, or " if config.env.name == "ml4" else ""
            raise ConfigError(
                f"iteration {iteration}: the physics of {faults} of "
                f"{self.schedule.steps_per_iteration} control steps was non-finite",
                f"start a new run {simulator}without the last change; {kept}",
            )
        if skipped:
            self.say(f"warning: {skipped:.1%} of the gradients were non-finite and were skipped")
        if faults:
            self.say(f"warning: {faults} lane(s) left the range of float32 and were put back")

    def evaluate(self) -> dict[str, Any]:
        """Columns of a periodic evaluation: few goals, few k, all tasks."""
        started, evaluation = time.monotonic(), self.config.eval
        summary = self.scores(evaluation.goals, evaluation.k)
        for line in fault_warning(summary):
            self.say(line)
        row: dict[str, Any] = {
            f"eval/{task}/k{k}/{figure}": figures[figure]
            for task, by_k in summary.items()
            for k, figures in by_k.items()
            for figure in EVAL_FIGURES
        }
        return row | {"time/evaluation_s": time.monotonic() - started}

    def scores(
        self, goals: int, k: tuple[int, ...], check: Callable[[], None] = lambda: None
    ) -> dict[str, Any]:
        params = parallel.on_one_device(self.algorithm.policy_params(self.state))
        trial = self.session.trial(self.config.eval.goal_set, goals)
        if not self.evaluator.is_compiled:
            width = trial.texts.shape[-1]
            self.timed("the evaluation episode", lambda: self.evaluator.compile(params, width))
        scores = self.evaluator.run([params], trial, k, self.config.eval.seed, check)
        return summarise(of_policy(scores, 0), trial.tasks)

    def share_done(self) -> float:
        total, minutes = self.schedule.iterations, self.config.train.minutes
        shares = [self.done / total] if total else []
        if minutes:
            shares.append(self.wall / (60 * minutes))
        return max(shares, default=0.0)

    def seconds_left(self) -> float:
        share = self.share_done()
        return self.wall * max(1 / share - 1, 0.0) if share else math.inf

    def save(self) -> None:
        """A full checkpoint of this border, and a policy checkpoint where one is due."""
        self.saved_at = self.wall
        meta = {
            "config": dataclasses.asdict(self.config),
            "iteration": self.done,
            "env_steps": self.done * self.schedule.steps_per_iteration,
            "wall_s": self.wall,
            "csv_offset": self.csv.offset,
            "versions": package_versions(),
            "goals_sha256": self.session.goals.sha256,
        }
        self.full.save(split_run(self.state), meta)
        is_last = self.stop.requested or not self.iterations_left()
        # After the full one: a kill in between leaves a policy to write again, not one too many.
        if self.is_policy_due() or (self.done and is_last):
            policy = {
                "params": self.algorithm.policy_params(self.state),
                "goal_vectors": self.session.goals.vectors[:, 0],
            }
            self.policy.save({"policy": policy}, meta)

    def finish(self) -> dict[str, Any] | None:
        """The final evaluation: more goals, every k, written beside the CSV.

        Left at once, with None, where a stop is asked for: all is saved, and a resumed run
        evaluates anew.
        """
        evaluation = self.config.eval
        try:
            summary = self.scores(evaluation.final_goals, evaluation.final_k, self.check_stop)
        except _Stopped:
            return None
        result = {
            "tasks": summary,
            "goals": evaluation.final_goals,
            "goal_set": evaluation.goal_set,
            "horizon": self.evaluator.horizon,
            "iteration": self.done,
            "seed": evaluation.seed,
        }
        write_text(self.run_dir / "eval.json", json.dumps(result, indent=2) + "\n")
        self.say(format_scores(summary))
        return summary

    def check_stop(self) -> None:
        if self.stop.requested:
            raise _Stopped
