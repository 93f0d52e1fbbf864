"""The library: what `import cmrl_jax` offers, in terms of the same parts as the command line.

Loggers apart nothing here prints, nothing installs a signal handler or ends the process, and
everything may be called from any thread, again and again.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, overload

from cmrl_jax.algorithms.base import Agent as Agent
from cmrl_jax.algorithms.base import Algorithm as Algorithm
from cmrl_jax.config.files import load_config as load_config
from cmrl_jax.config.rules import validate
from cmrl_jax.config.schema import Config, ConfigError, call_envs, require
from cmrl_jax.evaluation.options import EvalOptions, check_options, check_run
from cmrl_jax.evaluation.results import Evaluation, score
from cmrl_jax.evaluation.session import Policy, Session, load_policy, prepare_jax
from cmrl_jax.evaluation.trials import evaluation_config
from cmrl_jax.registry import make_environment
from cmrl_jax.registry import register_algorithm as register_algorithm
from cmrl_jax.registry import register_environment as register_environment
from cmrl_jax.stop import Stop
from cmrl_jax.storage.run_dir import all_begun, find_run, runs_at
from cmrl_jax.training import trainer
from cmrl_jax.training.console import Console
from cmrl_jax.training.logger import Logger
from cmrl_jax.training.loggers import loggers_of
from cmrl_jax.training.metrics import read_rows
from envs.base import MetaEnv as MetaEnv

LoggersOf = Callable[[Config], Sequence[Logger]]


@dataclass(frozen=True)
class TrainedAgent:
    """A trained policy, ready to be evaluated.

    Attributes:
        run: its run directory.
        policy: parameters, text vectors of its tasks, and the checkpoint's record.
    """

    run: Path
    policy: Policy = field(repr=False)

    @property
    def iteration(self) -> int:
        """Iterations that it was trained for."""
        return self.policy.meta["iteration"]


@dataclass(frozen=True)
class TrainResult:
    """How training ended.

    Attributes:
        run_dir: the run's directory, with all that `--resume`, `eval` and `plot` read.
        iteration: iterations done.
        is_finished: whether the schedule was; else it was asked to stop and can be resumed.
        evaluation: {task: {k: figures}} of the last evaluation; None where it was stopped.
    """

    run_dir: Path
    iteration: int
    is_finished: bool
    evaluation: dict[str, Any] | None

    @functools.cached_property
    def agent(self) -> TrainedAgent:
        """The policy as it was saved last.

        Raises:
            ConfigError: it was stopped before its first iteration.
        """
        return load_agent(self.run_dir)

    @property
    def metrics(self) -> list[dict[str, float | None]]:
        """The rows of metrics.csv, oldest first; None where a figure was not taken."""
        return list(read_rows(self.run_dir / "metrics.csv"))


@overload
def train(
    config: Config,
    run_dir: str | Path | None = None,
    *,
    seeds: None = None,
    resume: bool = False,
    loggers: Sequence[Logger] | None = None,
    stop: Stop | None = None,
) -> TrainResult: ...
@overload
def train(
    config: Config,
    run_dir: str | Path | None = None,
    *,
    seeds: int,
    resume: bool = False,
    loggers: LoggersOf | None = None,
    stop: Stop | None = None,
) -> list[TrainResult]: ...
def train(
    config: Config,
    run_dir: str | Path | None = None,
    *,
    seeds: int | None = None,
    resume: bool = False,
    loggers: Sequence[Logger] | LoggersOf | None = None,
    stop: Stop | None = None,
) -> TrainResult | list[TrainResult]:
    """Trains to the end of the configuration's schedule.

    Args:
        config: from `load_config`, or built by hand.
        run_dir: a directory without a run; by default a new one in `runs/`. With `resume`, the
            one to go on with, bit for bit as if it had not been left.
        seeds: runs with that many seeds, from `config.seed` on, are trained in one program and
            returned as a list; their directories are `run_dir`/seed0, `run_dir`/seed1 and so on.
            Each leaves what it would leave alone, equal to within rounding.
        loggers: take rows and messages; by default lines on standard output, and what `log` asks
            for (TensorBoard, Weights & Biases, films). An empty list is silent. With `seeds`, a
            function from a run's configuration to its loggers.
        stop: `stop.request()`, from any thread, ends the run at the next border of an iteration.

    Raises:
        ConfigError: what the caller can mend: a rule that the configuration breaks, a directory
            that holds another run, a damaged checkpoint.
    """
    validate(config)
    require(seeds is None or seeds > 0, f"seeds is {seeds}", "give one or more")
    if resume and run_dir is None:
        raise ConfigError("resume without a run directory", "name it: run_dir=")
    place = None if run_dir is None else Path(run_dir)
    _check_loggers(loggers, seeds)
    place, runs = runs_at(config, config.name, place, seeds, resume)
    cause = f"{place} holds {len(runs)} seeds"
    require(seeds is not None or len(runs) == 1, cause, f"give seeds={len(runs)}")
    configs, dirs = zip(*runs, strict=True)
    told = [_loggers_of(one, loggers, seeds) for one in configs]
    with all_begun(runs, resume, place):
        outcomes = trainer.train_seeds(configs, dirs, told, stop, resume)
    results = [
        TrainResult(run, outcome.iteration, outcome.is_finished, outcome.evaluation)
        for (_, run), outcome in zip(runs, outcomes, strict=True)
    ]
    return results if seeds is not None else results[0]


def _check_loggers(loggers: Sequence[Logger] | LoggersOf | None, seeds: int | None) -> None:
    if loggers is None or callable(loggers):
        return
    cause = f"a list of loggers would be shared by {seeds} seeds"
    cure = "give a function: loggers=lambda config: [Mine()]"
    require(seeds is None or not loggers, cause, cure)
    for logger in loggers:
        cause = f"a logger is a {type(logger).__name__}, which is no cmrl_jax.Logger"
        require(isinstance(logger, Logger), cause, "make its class a subclass: class Mine(Logger)")


def _loggers_of(
    config: Config, loggers: Sequence[Logger] | LoggersOf | None, seeds: int | None
) -> Sequence[Logger]:
    """The loggers of one run."""
    if loggers is None:
        label = "" if seeds is None else f"seed {config.seed}: "
        return loggers_of(Console(progress=False, label=label), config)
    if callable(loggers):
        loggers = loggers(config)
        _check_loggers(loggers, None)
    return loggers


def load_agent(run_dir: str | Path, checkpoint: int | None = None) -> TrainedAgent:
    """The policy of a run.

    Args:
        checkpoint: iteration of the policy checkpoint; None for the newest.

    Raises:
        ConfigError: no run or no such checkpoint there, or it does not fit this program.
    """
    run = find_run(Path(run_dir))
    config = evaluation_config(run, "native")  # reading a policy needs no simulator of its own
    prepare_jax(config)
    return TrainedAgent(run, load_policy(run, Session(config), checkpoint))


def evaluate(
    agent: TrainedAgent,
    tasks: Sequence[str] | None = None,
    k: Sequence[int] | None = None,
    **options: Any,
) -> Evaluation:
    """Scores an agent by the meta-test protocol: `k` episodes of own experience, then one counted.

    Args:
        tasks: names; by default those of the run.
        k: numbers of adaptation episodes; by default `eval.final_k` of the run.
        options: other fields of `EvalOptions`: `goals`, `goal_set`, `draws`, `seed`, `physics` ...

    Raises:
        ConfigError: an option out of range, or one that does not apply to the agent.
    """
    known = EvalOptions.__dataclass_fields__
    for name in options:
        if name not in known:
            raise ConfigError(f"unknown option '{name}'", f"valid: {', '.join(known)}")
    chosen = EvalOptions(
        tasks=None if tasks is None else tuple(tasks), k=None if k is None else tuple(k), **options
    )
    if chosen.physics == "metaworld":
        cure = "use mjx or native, or: cmrl eval --physics metaworld"
        raise ConfigError("physics 'metaworld' is the command line's alone", cure)
    check_options(chosen)
    check_run(chosen, agent.run)
    config = evaluation_config(agent.run, chosen.physics)
    prepare_jax(config)
    return score(agent.run, Session(config), agent.policy, chosen)


def make_env(config: Config | None = None, **overrides: Any) -> MetaEnv:
    """The environment of a configuration: pure `reset` and `step` of one lane, for vmap and scan.

    Args:
        config: whose `env` section to build; the defaults' if None.
        overrides: fields of that section, as `physics="native"`.

    Raises:
        ConfigError: a value that the section cannot have.
    """
    config = config or Config()
    env = replace(config.env, **overrides)
    validate(replace(config, env=env))
    return call_envs(lambda: make_environment(env))
