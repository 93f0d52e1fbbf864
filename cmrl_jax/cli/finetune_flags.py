"""Flags of `train.py finetune`, and what they mean; read and checked before jax is imported."""

from __future__ import annotations

import argparse

from cmrl_jax.cli.flags import add_force, goal_count, names, seed
from cmrl_jax.config.rules import check_goal_set
from cmrl_jax.config.schema import MOST_EPISODES, MOST_UPDATES, ConfigError
from cmrl_jax.evaluation.finetune_options import ADAPT, FinetuneOptions
from cmrl_jax.registry import task_names
from envs.command_line import suggest, typed_path, whole
from envs.goal_names import GOALS

DESCRIPTION = "Adapts a trained policy to a task it never saw, with gradient steps on its own data."


def add_flags(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Adds the flags of `finetune`."""
    add = parser.add_argument
    add(
        "--run", metavar="DIR", type=typed_path, required=True, help="run directory, with its ckpt/"
    )
    add("--task", metavar="T", required=True, help="task to adapt to, as window-close")
    add("--adapt", type=names, default=ADAPT, metavar="A,B", help=f"[{','.join(ADAPT)}]")
    episodes = whole(1, MOST_EPISODES, "all of them are kept in memory")
    updates = whole(1, MOST_UPDATES, "all of a chunk's are one compiled loop")
    add("--episodes", type=episodes, default=100, metavar="N", help="own experience [100]")
    add("--updates", type=updates, default=1, metavar="N", help="gradient steps a control step [1]")
    add("--goals", type=goal_count, default=GOALS, metavar="N", help="of a read-out, 1 to 50 [50]")
    add("--goal-set", default="heldout", metavar="SET", help="train, heldout or fresh:<seed>")
    add("--seed", type=seed, default=0, metavar="S", help="of episodes and read-outs [0]")
    add("--physics", choices=("mjx", "native"), metavar="P", help="mjx, native [the run's own]")
    add("--json", type=typed_path, metavar="F", help="write the figures to this file")
    add("--figure", type=typed_path, metavar="F", help="draw the curves to this PNG")
    add_force(parser)
    return parser


def options_of(args: argparse.Namespace) -> FinetuneOptions:
    """The options of parsed flags.

    Raises:
        ConfigError: a flag that cannot be.
    """
    if args.task not in task_names():
        cure = f"{suggest(args.task, task_names())}tasks: {', '.join(task_names())}"
        raise ConfigError(f"unknown task '{args.task}'", cure)
    for word in args.adapt or ("",):
        if word not in ADAPT:
            raise ConfigError(f"--adapt '{word}' is no way to adapt", f"use: {', '.join(ADAPT)}")
        if args.adapt.count(word) > 1:
            raise ConfigError(f"--adapt names {word} twice", "name each way once")
    check_goal_set(args.goal_set, "--goal-set")
    fields = ("task", "adapt", "episodes", "updates", "goals", "goal_set", "seed", "physics")
    return FinetuneOptions(**{name: getattr(args, name) for name in fields})
