"""Flags of `eval` and `sweep`, and every check of them that needs no jax.

Both commands evaluate by the same protocol, described by `EvalOptions`; `eval` scores one
checkpoint, `sweep` many.
"""

from __future__ import annotations

import argparse
import glob
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cmrl_jax.config import MOST_EPISODES, TASKS, Config, ConfigError, suggest
from cmrl_jax.config_io import run_config
from cmrl_jax.flags import (
    adaptation,
    add_force,
    distinct,
    goal_count,
    list_of,
    names,
    natural,
    parse,
    parser_of,
    seed,
    shown,
    steps,
    writable,
)
from cmrl_jax.run_dir import find_run, holds_run
from cmrl_jax.validate import check_goal_set
from envs.command_line import brief, typed_path, what_is, whole
from envs.goal_names import GOALS
from envs.outputs import written_by

Z_SOURCES = ("posterior", "prior", "shuffled", "other", "text")
DONATED = ("shuffled", "other")  # z from another lane's belief: lanes depend on one another
# A draw is one of the numbers that name a lane's noise, in 32 bits (`evaluate.lane_names`), and
# every lane keeps its text in memory.
MOST_DRAWS = 10_000


@dataclass(frozen=True)
class EvalOptions:
    """How policies are scored, whichever they are; None takes the run's own value.

    Attributes:
        k: adaptation episodes.
        tasks: tasks to evaluate.
        goals: goals a task, the first of the set.
        goal_set: train, heldout or fresh:<seed>.
        draws: z draws a goal, each a lane of its own.
        seed: seed of the evaluation's draws.
        horizon: control steps an episode.
        physics: backend to evaluate in.
        policy: deterministic (tanh of the mean) or sampled actions.
        z: where z comes from; posterior is the protocol, the others are controls.
        paraphrases: sentences of the table, the first trained on or the held-out ones.
        text_control: whose sentence a lane is given: its task's, another task's, a zero vector.
        text: one sentence for every lane, in place of the table's.
        weights: folder of the text encoder's weights, where `text` needs them.
        any_table: take sentences from a goal table that is not the run's.
        lanes: parallel episodes in a batch.
        adaptation_episodes, evaluation_episodes: of Meta-World's own function.
    """

    k: tuple[int, ...] | None = None
    tasks: tuple[str, ...] | None = None
    goals: int = GOALS
    goal_set: str = "heldout"
    draws: int = 1
    seed: int = 0
    horizon: int | None = None
    physics: Literal["mjx", "native", "metaworld"] | None = None
    policy: Literal["deterministic", "sampled"] = "deterministic"
    z: Literal["posterior", "prior", "shuffled", "other", "text"] = "posterior"
    paraphrases: Literal["train", "heldout"] = "train"
    text_control: Literal["none", "shuffled", "zero"] = "none"
    text: str | None = None
    weights: Path | None = None
    any_table: bool = False
    lanes: int | None = None
    adaptation_episodes: int = 10
    evaluation_episodes: int = 3


def _parser(command: str, description: str) -> argparse.ArgumentParser:
    """A parser with the flags of the protocol."""
    parser = parser_of(command, description)
    add_force(parser)
    protocol = parser.add_argument_group("protocol")
    add = protocol.add_argument
    add(
        "--k",
        type=adaptation,
        metavar="0,1,2",
        help="adaptation episodes [eval.final_k of the run]",
    )
    add("--tasks", type=names, metavar="A,B", help="tasks to evaluate [those of the run]")
    add("--goals", type=goal_count, default=GOALS, metavar="N", help="goals a task, 1 to 50 [50]")
    add("--goal-set", default="heldout", metavar="SET", help="train, heldout or fresh:<seed>")
    draws = whole(1, MOST_DRAWS, "each is a lane of its own for every goal of every task")
    add("--eval-seeds", type=draws, default=1, metavar="N", help="z draws a goal [1]")
    add("--seed", type=seed, default=0, metavar="S", help="seed of the evaluation's draws [0]")
    add("--horizon", type=steps, metavar="H", help="control steps an episode [env.horizon]")
    backends = ("mjx", "native", *(("metaworld",) if command == "eval" else ()))
    physics = f"{', '.join(backends)} [env.physics of the run]"
    add("--physics", metavar="P", choices=backends, help=physics)
    kinds = ("deterministic", "sampled")
    add(
        "--policy", default=kinds[0], metavar="P", choices=kinds, help=f"or {kinds[1]} [{kinds[0]}]"
    )
    add("--lanes", type=whole(1), metavar="N", help="parallel episodes in a batch [by device]")
    controls = parser.add_argument_group("controls: is z used, is the text?")
    add = controls.add_argument
    add(
        "--z",
        default="posterior",
        metavar="Z",
        choices=Z_SOURCES,
        help="posterior; prior: N(0, I); shuffled: another lane's posterior; other: another "
        "task's; text: no experience [posterior]",
    )
    add(
        "--paraphrases",
        default="train",
        metavar="P",
        choices=("train", "heldout"),
        help="train: the task's first sentence; heldout: those never trained on, in turn [train]",
    )
    add(
        "--text-control",
        default="none",
        metavar="C",
        choices=("none", "shuffled", "zero"),
        help="shuffled: another task's sentence; zero: a zero vector [none]",
    )
    add("--text", metavar="SENTENCE", help="one goal in your own words, for every task")
    add("--weights", type=typed_path, metavar="DIR", help="the text encoder's weights, for --text")
    add("--any-table", action="store_true", help="take sentences from another table than the run's")
    return parser


def eval_parser() -> argparse.ArgumentParser:
    """Flags of `eval`."""
    text = "Evaluates a policy checkpoint: k adaptation episodes, then the one counted."
    parser = _parser("eval", text)
    add = parser.add_argument
    add("--run", metavar="DIR", type=typed_path, required=True, help="run directory")
    add("--checkpoint", type=natural, metavar="N", help="iteration of the checkpoint [the last]")
    add("--json", type=typed_path, metavar="F", help="write the figures to this file")
    add("--csv", type=typed_path, metavar="F", help="add to this table: a row a goal, draw and k")
    own = parser.add_argument_group("Meta-World's own function, with --physics metaworld")
    for name, low, default in (("adaptation", 0, 10), ("evaluation", 1, 3)):
        text = f"its {name} episodes [{default}]"
        kind = whole(low, MOST_EPISODES, "each is an episode of its own on every goal")
        own.add_argument(f"--{name}-episodes", type=kind, metavar="N", help=text)
    return parser


def sweep_parser() -> argparse.ArgumentParser:
    """Flags of `sweep`."""
    text = "Evaluates many checkpoints of one or more runs at once; goes on where its CSV ends."
    parser = _parser("sweep", text)
    add = parser.add_argument
    add("--runs", metavar="GLOB", nargs="+", required=True, help="run directories, or patterns")
    add("--checkpoints", default="last", metavar="C", help="all, last, or iterations N,M [last]")
    add("--json", type=typed_path, metavar="F", help="write the figures to this file")
    add(
        "--csv",
        type=typed_path,
        metavar="F",
        help="one row a cell; rows that are there are not run",
    )
    add(
        "--compare",
        type=natural,
        default=0,
        metavar="N",
        help="time N adaptation runs one at a time, and eval as a command, too [0]",
    )
    return parser


def options_of(args: argparse.Namespace) -> EvalOptions:
    """The protocol of parsed flags.

    Raises:
        ConfigError: a value out of range, an unknown name, or flags that contradict each other.
    """
    check_goal_set(args.goal_set, "--goal-set")
    for task in args.tasks or ():
        if task not in TASKS:
            cure = f"{suggest(task, TASKS)}valid: {', '.join(TASKS)}"
            raise ConfigError(f"unknown task '{task}' in --tasks", cure)
    for flag, values in (("tasks", args.tasks), ("k", args.k)):
        if values is not None and (not values or len(set(values)) < len(values)):
            raise ConfigError(f"--{flag} is '{shown(values)}'", "name at least one, each once")
    changed = [
        flag
        for flag, value, default in (
            ("--paraphrases", args.paraphrases, "train"),
            ("--text-control", args.text_control, "none"),
        )
        if value != default
    ]
    if args.text is not None and not args.text.strip():
        cure = "write a sentence, or --text-control zero for a policy that is told nothing"
        raise ConfigError("--text is empty", cure)
    if args.text is not None and changed:
        raise ConfigError(f"--text with {changed[0]}", "give one of the two: each names the text")
    if args.weights is not None and what_is(args.weights) != "directory":
        cause = f"--weights {brief(args.weights)} is no directory"
        raise ConfigError(cause, "give the one that holds the text encoder's model")
    if args.physics == "metaworld" and args.z in DONATED:
        cause = f"--z {args.z} with --physics metaworld, where lanes know nothing of each other"
        raise ConfigError(cause, "use --z posterior, prior or text, or --physics native")
    own = {}
    for name in ("adaptation_episodes", "evaluation_episodes"):
        if (value := getattr(args, name, None)) is not None:
            flag = f"--{name.replace('_', '-')}"
            if args.physics != "metaworld":
                raise ConfigError(f"{flag} without --physics metaworld", "leave it out")
            own[name] = value
    return EvalOptions(
        **own,
        k=args.k,
        tasks=args.tasks,
        goals=args.goals,
        goal_set=args.goal_set,
        draws=args.eval_seeds,
        seed=args.seed,
        horizon=args.horizon,
        physics=args.physics,
        policy=args.policy,
        z=args.z,
        paraphrases=args.paraphrases,
        text_control=args.text_control,
        text=args.text,
        weights=args.weights,
        any_table=args.any_table,
        lanes=args.lanes,
    )


def check_run(options: EvalOptions, run: Path) -> Config:
    """The configuration of a run, if it can be evaluated by these options.

    Raises:
        ConfigError: no run there, or one to which an option does not apply.
    """
    config = run_config(find_run(run))
    conditioning, fusion = config.model.conditioning, config.encoder.goal_fusion
    k = options.k if options.k is not None else config.eval.final_k
    tasks = evaluated_tasks(options, config)
    if conditioning != "z":
        told = f"with model.conditioning {conditioning} ({run})"
        if any(k):
            raise ConfigError(f"--k {shown(k)} {told}", "give --k 0: only a latent z can adapt")
        if options.z != "posterior":
            raise ConfigError(f"--z {options.z} {told}", "leave --z out: the policy has no latent")
        if options.adaptation_episodes not in (0, EvalOptions.adaptation_episodes):
            cause = f"--adaptation-episodes {options.adaptation_episodes} {told}"
            raise ConfigError(cause, "leave it out: only a latent z can adapt")
        for task in tasks:
            if task not in config.tasks.train:
                cure = f"use its training tasks: {', '.join(config.tasks.train)}"
                raise ConfigError(f"--tasks {task} {told}, which cannot know it", cure)
    wants_text = (
        options.text is not None
        or options.paraphrases != "train"
        or options.text_control != "none"
        or options.z == "text"
    )
    if wants_text and (conditioning != "z" or fusion == "none"):
        raise ConfigError(f"a text option with a policy that reads no text ({run})", "leave it out")
    if options.z == "text" and fusion == "concat":
        cause = f"--z text with encoder.goal_fusion concat ({run}): no experience, no text"
        raise ConfigError(cause, "use --z prior, which is the same there")
    if options.z == "shuffled" and len(tasks) * options.goals * options.draws < 2:
        raise ConfigError("--z shuffled with one lane", "give more tasks, goals or draws")
    if options.z == "other" and len(tasks) < 2:
        raise ConfigError("--z other with one task", "give at least two: --tasks A,B")
    if options.text is not None and config.goals.table in ("one-hot", "zero"):
        cause = f"--text with goals.table {config.goals.table} ({run}), which has no encoder"
        raise ConfigError(cause, "leave --text out")
    return config


def evaluated_tasks(options: EvalOptions, config: Config) -> tuple[str, ...]:
    """The tasks to evaluate a run on: those asked for, else its training and test tasks."""
    return options.tasks or config.tasks.train + config.tasks.test


def find_runs(patterns: Sequence[str]) -> list[Path]:
    """Run directories that match, in the order of the patterns and then by name.

    Each once, under the first name that was found for it.

    Raises:
        ConfigError: a pattern that matches no run.
    """
    found: dict[Path, Path] = {}
    for pattern in patterns:
        runs = [Path(p) for p in sorted(glob.glob(pattern)) if holds_run(Path(p))]
        if not runs:
            cure = "give directories that hold a run, as --runs 'runs/ml4-*'"
            raise ConfigError(f"--runs {brief(pattern)} matches no run", cure)
        for run in runs:
            found.setdefault(run.resolve(), run)
    return list(found.values())


def checkpoint_choice(text: str) -> tuple[int, ...] | Literal["all", "last"]:
    """`all`, `last`, or iterations.

    Raises:
        ConfigError: anything else.
    """
    if text in ("all", "last"):
        return text  # pyright: ignore[reportReturnType]
    try:
        chosen = list_of(natural)(text)
    except argparse.ArgumentTypeError:
        chosen = ()
    if not chosen or len(set(chosen)) < len(chosen):
        cure = "give all, last, or iterations as 20,40, each once"
        raise ConfigError(f"--checkpoints is '{text}'", cure)
    return chosen


def _check_outputs(args: argparse.Namespace, command: str) -> None:
    """Whether `--json` and `--csv` may be written; the table's rows are read when it is opened."""
    from cmrl_jax.cells import MARK

    distinct(json=args.json, csv=args.csv)
    writable(args.json, "--json", written_by(command), args.force)
    writable(args.csv, "--csv", MARK, args.force)


def run_eval(words: Sequence[str]) -> int:
    """The command `eval`; returns the exit code."""
    args = parse(eval_parser(), words)
    options = options_of(args)
    check_run(options, args.run)
    _check_outputs(args, "eval")

    from cmrl_jax import evaluate_cli

    return evaluate_cli.evaluate_run(
        run=args.run,
        options=options,
        checkpoint=args.checkpoint,
        json_path=args.json,
        csv_path=args.csv,
        force=args.force,
    )


def run_sweep(words: Sequence[str]) -> int:
    """The command `sweep`; returns the exit code."""
    args = parse(sweep_parser(), words)
    options = options_of(args)
    if args.compare and options.z in DONATED:
        cause = f"--compare with --z {options.z}, which no adaptation run has by itself"
        raise ConfigError(cause, "leave --compare out, or use --z posterior")
    checkpoints = checkpoint_choice(args.checkpoints)
    runs = find_runs(args.runs)
    for run in runs:
        check_run(options, run)
    _check_outputs(args, "sweep")

    from cmrl_jax import sweep

    return sweep.sweep(
        runs=runs,
        checkpoints=checkpoints,
        options=options,
        json_path=args.json,
        csv_path=args.csv,
        force=args.force,
        compare=args.compare,
    )
