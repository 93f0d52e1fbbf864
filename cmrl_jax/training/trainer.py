"""The host loop: iterations, their rows and loggers, periodic evaluation, checkpoints, stops.

Everything numerical happens in two compiled programs (a training iteration, an evaluation episode);
this file only decides when, and writes things down. NOTE: this is the one impure layer.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cmrl_jax import parallel
from cmrl_jax.algorithms.base import Algorithm, RunState
from cmrl_jax.config.schema import Config, ConfigError, require
from cmrl_jax.evaluation.scores import fault_warning, format_scores, of_policy, summarise
from cmrl_jax.evaluation.session import Session, prepare_jax
from cmrl_jax.jax_runtime import free_bytes
from cmrl_jax.registry import rules_of
from cmrl_jax.stop import Stop
from cmrl_jax.storage.checkpoint import full_store, policy_store
from cmrl_jax.storage.run_dir import write_text
from cmrl_jax.training.logger import Logger, Progress
from cmrl_jax.training.metrics import LEADING_COLUMNS, metric_names, metric_row
from cmrl_jax.training.run import Run

COMPILING = "a minute on a CPU, some on a GPU, seconds where they are cached"
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
        steps = rules_of(config).steps_per_iteration()
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
    """How a run ended; everything is saved.

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


def train_seeds(
    configs: Sequence[Config],
    run_dirs: Sequence[Path],
    loggers: Sequence[Sequence[Logger]],
    stop: Stop | None = None,
    resume: bool = False,
) -> list[Outcome]:
    """Trains to the end of the schedule, or to a stop: one run, or several that differ in their
    seed alone, all in one program.

    Each leaves what it would leave if it were trained alone. Figures are not equal to the last bit:
    a product of matrices for several seeds adds up in another order than one for each. A seed whose
    gradients or physics are non-finite for good stops all; the others can be gone on with alone.

    Args:
        configs, run_dirs, loggers: one a run. The `config.yaml` of a directory is written, and it
            is held (`run_dir.begun`); loggers are started and closed here.
        stop: is looked at between iterations, and in the last evaluation.

    Raises:
        ConfigError: anything the user can mend, before the first compile where possible.
    """
    # All that refuses a configuration stands before the stores: they are what makes a run begin.
    config, device = configs[0], prepare_jax(configs[0])
    mesh = parallel.make_mesh()
    if len(configs) == 1:
        rules_of(config).check_devices(parallel.size(mesh))
    session = Session(config)
    check_seeds(session.algorithm, len(configs))
    with contextlib.ExitStack() as stores:
        runs = []
        for config, run_dir, told in zip(configs, run_dirs, loggers, strict=True):
            full = stores.enter_context(full_store(run_dir, config.checkpoint.keep))
            policy = stores.enter_context(policy_store(run_dir))
            label = f"seed {config.seed}: " if len(configs) > 1 else ""
            runs.append(Run(config, run_dir, session, (full, policy), told, label))
        return _Training(session, runs, stop or Stop()).go(device, resume)


def check_seeds(algorithm: Algorithm, seeds: int) -> None:
    """Raises ConfigError unless several seeds divide among the devices and fit into their memory.

    A device holds one state more than its own, since what is saved is a copy.
    """
    if seeds == 1:
        return
    devices = parallel.size(parallel.make_mesh())
    cause = f"{seeds} seeds cannot be divided among {devices} devices"
    cure = "show another number of devices (CUDA_VISIBLE_DEVICES, JAX_NUM_CPU_DEVICES)"
    require(seeds % devices == 0, cause, f"{cure}, or --seeds {-(-seeds // devices) * devices}")
    state = jax.eval_shape(algorithm.init, jax.random.key(0))
    each = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state))
    free = free_bytes()
    if free is None:
        return
    fits = devices * max(free // each - 1, 0)
    cause = f"{seeds} seeds of {each / 2**20:.0f} MiB each do not fit into {free / 2**20:.0f} MiB"
    require(seeds <= fits, cause, f"--seeds {fits}" if fits else "set a smaller train.capacity")


class _Stopped(Exception):
    """The final evaluation is left: it was asked to stop."""


def _iteration(meta: dict[str, Any] | None) -> int:
    """Iterations done by a checkpoint's record; 0 before the first save."""
    return meta["iteration"] if meta else 0


class _Training:
    """The loop of one process: the state of all its runs, and what is due after each iteration."""

    def __init__(self, session: Session, runs: Sequence[Run], stop: Stop):
        self.session, self.runs, self.stop = session, runs, stop
        self.algorithm, self.config = session.algorithm, session.config
        self.schedule = Schedule.of(self.config)
        self.threads = ThreadPoolExecutor(1)
        self.evaluation_compile: Future[None] | None = None

    def say(self, text: str) -> None:
        """A message about all runs."""
        for logger in self.runs[0].loggers:
            logger.message(text)

    def go(self, device: str, resume: bool) -> list[Outcome]:
        try:
            return self.train(device, resume)
        finally:
            with contextlib.ExitStack() as left:
                left.callback(self.threads.shutdown)  # last: a compile cannot be left
                for run in reversed(self.runs):
                    left.callback(run.close)

    def train(self, device: str, resume: bool) -> list[Outcome]:
        self.say(f"device: {device}")
        self.program = self.session.training(parallel.make_mesh(), len(self.runs))
        self.start(resume)
        if self.iterations_left() and not self.stop.requested:
            self.compile_iteration()
            self.iteration = self.program.compile()
        while self.iterations_left() and not self.stop.requested:
            self.step()
        self.save()
        found = None if self.stop.requested else self.finish()
        evaluations = found or [None] * len(self.runs)
        return [Outcome(self.done, found is not None, e, self.wall) for e in evaluations]

    def columns(self) -> list[str]:
        config, tasks = self.config, self.session.eval_tasks
        evals = [f"eval/{t}/k{k}/{f}" for t in tasks for k in config.eval.k for f in EVAL_FIGURES]
        times = ["time/iteration_s", "time/env_steps_per_s", "time/evaluation_s"]
        names = metric_names(self.program.metrics, config.tasks.train)
        return [*LEADING_COLUMNS, *names, *evals, *times]

    def start(self, resume: bool) -> None:
        """A new state, saved before its first iteration, or the state of the last checkpoint."""
        seeds = [run.config.seed for run in self.runs]
        state: Any = None
        metas: list[Any] = [None] * len(self.runs)
        for i, run in enumerate(self.runs if resume else ()):
            found = run.saved(self.program.one)
            if found:  # one after another: memory is asked for one more than there are
                if state is None and len(seeds) > 1:
                    state = self.program.init(seeds)
                state, metas[i] = self.program.with_seed(state, i, found.state), found.meta
        if state is None:
            state = self.program.init(seeds)
        state, metas = self.in_step(state, metas)
        self.state, self.done = state, max(_iteration(meta) for meta in metas)
        self.wall = max((meta["wall_s"] for meta in metas if meta), default=0.0)
        columns = self.columns()
        for run, meta in zip(self.runs, metas, strict=True):
            run.start(columns, meta)
        self.evaluator = self.session.evaluator(policies=len(self.runs))
        self.clock = time.monotonic() - self.wall
        self.started_at, self.paced_from = self.done, (self.done, self.wall)
        self.save()

    def in_step(self, state: RunState, metas: list[Any]) -> tuple[RunState, list[Any]]:
        """Takes runs back that were saved when a process was killed, before it saved the others.

        Raises:
            ConfigError: they differ because one was gone on with alone.
        """
        iterations = [_iteration(meta) for meta in metas]
        least, most = min(iterations), max(iterations)
        for i, run in enumerate(self.runs):
            cause = f"{run.run_dir} has done {iterations[i]} iterations, another seed {most}"
            cure = "go on with each alone: --run DIR/seedN --resume"
            require(iterations[i] == most or run.rows_written() >= most, cause, cure)
        for i, run in enumerate(self.runs):
            if iterations[i] > least:
                found = run.saved(self.program.one, least)
                assert found is not None  # it has a newer one, and keeps two
                state = self.program.with_seed(state, i, found.state)
                metas[i] = found.meta
        return state, metas

    def compile_iteration(self) -> None:
        if self.program.is_compiled:
            return
        started = time.monotonic()
        self.say(f"compiling the training iteration ({COMPILING}) ...")
        self.program.compile()
        self.say(f"compiling the training iteration took {time.monotonic() - started:.1f} s")

    def begin_evaluation_compile(self) -> None:
        """Compiles the evaluation episode beside training, in a thread: XLA works outside Python's
        lock. What reads jax's settings, each thread's own, is done here."""
        if self.evaluation_compile or self.evaluator.is_compiled:
            return
        params = jax.eval_shape(self.algorithm.policy_params, self.program.one)
        shapes = params, self.session.goals.vectors.shape[-1]
        lowered = self.evaluator.traced(*shapes).lower()
        self.evaluation_compile = self.threads.submit(self.evaluator.compile, *shapes, lowered)

    def end_evaluation_compile(self) -> None:
        if self.evaluator.is_compiled:
            return
        self.begin_evaluation_compile()
        assert self.evaluation_compile is not None
        if not self.evaluation_compile.done():
            started = time.monotonic()
            self.say("compiling the evaluation episode ...")
            wait([self.evaluation_compile])
            self.say(
                f"compiling the evaluation episode took {time.monotonic() - started:.1f} s more"
            )
        self.evaluation_compile.result()

    def iterations_left(self) -> bool:
        minutes, total = self.config.train.minutes, self.schedule.iterations
        in_time = not minutes or self.wall < 60 * minutes
        return in_time and (total is None or self.done < total)

    def step(self) -> None:
        """One iteration, its rows, and whatever is due after it."""
        started = time.monotonic()
        # Of a whole iteration jax could only say that there is a NaN, and iteration 0's losses are
        # NaN on purpose; `check_health` does what JAX_DEBUG_NANS asks for.
        with jax.debug_nans(False), jax.debug_infs(False):
            self.state, metrics = self.iteration(self.state)
        self.begin_evaluation_compile()  # while the iteration runs
        metrics = jax.tree.map(np.asarray, metrics)
        seconds = time.monotonic() - started
        self.done += 1
        gradient_steps = self.program.gradient_steps(self.state)
        rows = [self.row(i, metrics, int(n), seconds) for i, n in enumerate(gradient_steps)]
        self.check_health(rows)
        if self.schedule.is_eval_due(self.done):
            rows = [row | found for row, found in zip(rows, self.evaluate(), strict=True)]
        self.wall = time.monotonic() - self.clock
        if self.done <= self.started_at + 2:
            self.paced_from = self.done, self.wall
        progress = Progress(self.share_done(), self.seconds_left())
        for run, row in zip(self.runs, rows, strict=True):
            run.write(row | {"wall_s": self.wall}, progress)
        if self.is_policy_due() or self.wall - self.saved_at >= 60 * self.config.checkpoint.minutes:
            self.save()

    def check_health(self, rows: list[dict[str, Any]]) -> None:
        """Warns, and stops where a run cannot recover; the others are saved before."""
        errors: dict[int, ConfigError] = {}
        for i, (run, row) in enumerate(zip(self.runs, rows, strict=True)):
            try:
                run.check_health(row)
            except ConfigError as error:
                errors[i] = error
        if not errors:
            return
        first = next(iter(errors.values()))
        if len(self.runs) == 1:
            raise first
        self.wall = time.monotonic() - self.clock
        for i, run in enumerate(self.runs):
            if i not in errors:
                run.write(rows[i] | {"wall_s": self.wall}, Progress(self.share_done(), math.inf))
                run.save(self.program.of_seed(self.state, i), self.done, self.wall, False)
        cure = f"{first.cure}; the other seeds go on alone: --run DIR/seedN --resume"
        raise ConfigError(first.cause, cure)

    def row(
        self, i: int, metrics: dict[str, Any], gradient_steps: int, seconds: float
    ) -> dict[str, Any]:
        """The figures of an iteration of the i-th run."""
        if len(self.runs) > 1:
            metrics = {name: value[i] for name, value in metrics.items()}
        return {
            "iteration": self.done - 1,
            "env_steps": self.done * self.schedule.steps_per_iteration,
            "gradient_steps": gradient_steps,
            "seed": self.runs[i].config.seed,
            "time/iteration_s": seconds,
            "time/env_steps_per_s": self.schedule.steps_per_iteration / seconds,
        } | metric_row(metrics, self.config.tasks.train)

    def is_policy_due(self) -> bool:
        """Whether this border has a policy checkpoint, however long the iterations took."""
        intervals = self.config.checkpoint.policy_every, self.config.log.video_every
        return self.done > 0 and any(n and self.done % n == 0 for n in intervals)

    def evaluate(self) -> list[dict[str, Any]]:
        """Columns of a periodic evaluation of every run: few goals, few k, all tasks."""
        started, evaluation, rows = time.monotonic(), self.config.eval, []
        summaries = self.scores(evaluation.goals, evaluation.k)
        for run, summary in zip(self.runs, summaries, strict=True):
            for line in fault_warning(summary):
                run.say(line)
            rows.append(
                {
                    f"eval/{task}/k{k}/{figure}": figures[figure]
                    for task, by_k in summary.items()
                    for k, figures in by_k.items()
                    for figure in EVAL_FIGURES
                }
            )
        return [row | {"time/evaluation_s": time.monotonic() - started} for row in rows]

    def scores(
        self, goals: int, k: tuple[int, ...], check: Callable[[], None] = lambda: None
    ) -> list[dict[str, Any]]:
        """The summary of every run's policy."""
        states = (self.program.of_seed(self.state, i) for i in range(len(self.runs)))
        act = self.algorithm.policy_params
        policies = [parallel.on_one_device(act(state)) for state in states]
        trial = self.session.trial(self.config.eval.goal_set, goals)
        self.end_evaluation_compile()
        scores = self.evaluator.run(policies, trial, k, self.config.eval.seed, check)
        return [summarise(of_policy(scores, i), trial.tasks) for i in range(len(policies))]

    def share_done(self) -> float:
        total, minutes = self.schedule.iterations, self.config.train.minutes
        shares = [self.done / total] if total else []
        if minutes:
            shares.append(self.wall / (60 * minutes))
        return max(shares, default=0.0)

    def seconds_left(self) -> float:
        """By the pace of this process since its second iteration: what comes before is compilation,
        and an iteration that learns nothing."""
        minutes, total = self.config.train.minutes, self.schedule.iterations
        done, wall = self.paced_from
        left = [60 * minutes - self.wall] if minutes else []
        if total and self.done > done:
            left.append((total - self.done) * (self.wall - wall) / (self.done - done))
        return max(min(left), 0.0) if left and (not total or self.done > done) else math.inf

    def save(self) -> None:
        """A checkpoint of this border, of every run."""
        self.saved_at = self.wall
        is_last = self.stop.requested or not self.iterations_left()
        with_policy = self.is_policy_due() or bool(self.done and is_last)
        for i, run in enumerate(self.runs):
            run.save(self.program.of_seed(self.state, i), self.done, self.wall, with_policy)

    def finish(self) -> list[dict[str, Any]] | None:
        """The final evaluation: more goals, every k, written beside the CSV.

        Left at once, with None, where a stop is asked for: all is saved, and a resumed run
        evaluates anew.
        """
        evaluation = self.config.eval
        try:
            summaries = self.scores(evaluation.final_goals, evaluation.final_k, self.check_stop)
        except _Stopped:
            return None
        for run, summary in zip(self.runs, summaries, strict=True):
            result = {
                "tasks": summary,
                "goals": evaluation.final_goals,
                "goal_set": evaluation.goal_set,
                "horizon": self.evaluator.horizon,
                "iteration": self.done,
                "seed": evaluation.seed,
            }
            write_text(run.run_dir / "eval.json", json.dumps(result, indent=2) + "\n")
            run.say(("\n" if run.label else "") + format_scores(summary))
        return summaries

    def check_stop(self) -> None:
        if self.stop.requested:
            raise _Stopped
