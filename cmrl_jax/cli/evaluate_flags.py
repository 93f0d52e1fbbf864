"""Flags of `eval` and `sweep`, and every check of them that needs no jax.

Both commands evaluate by the same protocol, described by `EvalOptions`; `eval` scores one
checkpoint, `sweep` many.
"""

from __future__ import annotations

import argparse
import glob
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from cmrl_jax.cli.flags import (
    adaptation,
    add_force,
    goal_count,
    list_of,
    names,
    natural,
    parse,
    parser_of,
    seed,
    steps,
)
from cmrl_jax.config.schema import MOST_EPISODES, ConfigError
from cmrl_jax.evaluation.options import (
    ADAPT,
    DONATED,
    MOST_DRAWS,
    Z_CONTROLS,
    EvalOptions,
    check_options,
    check_run,
)
from cmrl_jax.storage.kept_policies import kept_policies
from cmrl_jax.storage.output_files import distinct, writable
from cmrl_jax.storage.run_dir import find_run, holds_run
from envs.command_line import brief, typed_path, whole
from envs.goal_names import GOALS
from envs.outputs import written_by


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
        help="adaptation episodes [eval.final_k of the run; 0,1,2,5,10,20 with --adapt search]",
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
    add(
        "--adapt",
        default="posterior",
        metavar="A",
        choices=ADAPT,
        help="what own episodes change: posterior: the belief over z; search: which z is "
        "acted on, and how the scene is seen; arms: a control, the k-th of those [posterior]",
    )
    add(
        "--protocol",
        default="goal",
        metavar="P",
        choices=("goal", "task"),
        help="goal: adapt to each goal by itself; task: each of --eval-seeds runs adapts once, on "
        "goals of the train set, and is scored on all goals [goal]",
    )
    controls = parser.add_argument_group("controls: is z used, is the text?")
    add = controls.add_argument
    add(
        "--z",
        default="posterior",
        metavar="Z",
        choices=tuple(Z_CONTROLS),
        help="; ".join(f"{name}: {z.help}" for name, z in Z_CONTROLS.items()) + " [posterior]",
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
    own = {}
    for name in ("adaptation_episodes", "evaluation_episodes"):
        if (value := getattr(args, name, None)) is not None:
            flag = f"--{name.replace('_', '-')}"
            if args.physics != "metaworld":
                raise ConfigError(f"{flag} without --physics metaworld", "leave it out")
            own[name] = value
    options = EvalOptions(
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
        adapt=args.adapt,
        protocol=args.protocol,
        z=args.z,
        paraphrases=args.paraphrases,
        text_control=args.text_control,
        text=args.text,
        weights=args.weights,
        any_table=args.any_table,
        lanes=args.lanes,
    )
    check_options(options)
    return options


def find_runs(patterns: Sequence[str]) -> list[Path]:
    """Run directories that match, in the order of the patterns and then by name.

    Each once, under the first name that was found for it.

    Raises:
        ConfigError: a pattern that matches no run.
    """
    found: dict[Path, Path] = {}
    for pattern in patterns:
        runs = [Path(p) for p in sorted(glob.glob(pattern)) if holds_run(Path(p))]
        runs = runs or list(kept_policies(pattern).values())
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
    from cmrl_jax.evaluation.cells import MARK

    distinct(json=args.json, csv=args.csv)
    writable(args.json, "--json", written_by(command), args.force)
    writable(args.csv, "--csv", MARK, args.force)


def run_eval(words: Sequence[str]) -> int:
    """The command `eval`; returns the exit code."""
    args = parse(eval_parser(), words)
    options = options_of(args)
    run = find_run(args.run)
    check_run(options, run)
    _check_outputs(args, "eval")

    from cmrl_jax.cli import evaluate as evaluate_cli

    return evaluate_cli.evaluate_run(
        run=run,
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
    if args.compare and (options.adapt != "posterior" or options.protocol != "goal"):
        raise ConfigError("--compare with --adapt or --protocol", "leave --compare out")
    if args.compare and options.z in DONATED:
        cause = f"--compare with --z {options.z}, which no adaptation run has by itself"
        raise ConfigError(cause, "leave --compare out, or use --z posterior")
    checkpoints = checkpoint_choice(args.checkpoints)
    runs = find_runs(args.runs)
    for run in runs:
        check_run(options, run)
    _check_outputs(args, "sweep")

    from cmrl_jax.evaluation import sweep

    def compare(members: Any, table: Any, progress: Any) -> dict[str, Any]:
        from cmrl_jax.bench.sweep import compared

        return compared(members, options, table, args.compare, progress)

    return sweep.sweep(
        runs=runs,
        checkpoints=checkpoints,
        options=options,
        json_path=args.json,
        csv_path=args.csv,
        force=args.force,
        compare=compare if args.compare else None,
    )
