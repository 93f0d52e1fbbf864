"""Flags of `train.py finetune`, and what they mean; read and checked before jax is imported."""

from __future__ import annotations

import argparse
from dataclasses import dataclass

from cmrl_jax.config import MOST_EPISODES, MOST_UPDATES, TASKS, Config, ConfigError, suggest
from cmrl_jax.flags import add_force, goal_count, names, seed
from cmrl_jax.validate import check_goal_set
from envs.command_line import typed_path, whole
from envs.goal_names import GOALS

DESCRIPTION = "Adapts a trained policy to a task it never saw, with gradient steps on its own data."
# What gradient steps may change; `posterior`: nothing, `scratch`: SAC that begins from nothing.
ADAPT = ("posterior", "z", "router", "all", "scratch")
READ_OUTS = (0, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


@dataclass(frozen=True)
class FinetuneOptions:
    """What `finetune` was asked for.

    Attributes:
        task: the task to adapt to.
        adapt: ways to adapt, each from the same checkpoint.
        episodes: of own experience.
        updates: gradient steps a control step.
        goals: of a read-out, the first of `goal_set`.
        seed: of the own episodes, and of the read-outs' draws.
        physics: backend; None for the run's own.
    """

    task: str
    adapt: tuple[str, ...] = ADAPT
    episodes: int = 100
    updates: int = 1
    goals: int = GOALS
    goal_set: str = "heldout"
    seed: int = 0
    physics: str | None = None

    @property
    def read_outs(self) -> tuple[int, ...]:
        """Episodes after which the policy is scored; the last always is."""
        early = [n for n in READ_OUTS if n < self.episodes]
        return (*early, self.episodes)


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
    if args.task not in TASKS:
        cure = f"{suggest(args.task, TASKS)}tasks: {', '.join(TASKS)}"
        raise ConfigError(f"unknown task '{args.task}'", cure)
    for word in args.adapt or ("",):
        if word not in ADAPT:
            raise ConfigError(f"--adapt '{word}' is no way to adapt", f"use: {', '.join(ADAPT)}")
        if args.adapt.count(word) > 1:
            raise ConfigError(f"--adapt names {word} twice", "name each way once")
    check_goal_set(args.goal_set, "--goal-set")
    fields = ("task", "adapt", "episodes", "updates", "goals", "goal_set", "seed", "physics")
    return FinetuneOptions(**{name: getattr(args, name) for name in fields})


def check_run(config: Config, options: FinetuneOptions) -> None:
    """Whether a run can be adapted so.

    Raises:
        ConfigError: it was trained on the task, or lacks a part that a way to adapt needs.
    """
    if options.task in config.tasks.train:
        held = [task for task in TASKS if task not in config.tasks.train]
        cause = f"the run was trained on {options.task}"
        raise ConfigError(cause, f"give --task one of: {', '.join(held) or 'none is left'}")
    # Without z a network is told the training tasks' one-hot, or nothing: no part of it is made for
    # another task.
    has = {"z": config.model.conditioning == "z", "router": config.model.net == "soft"}
    needs = {"posterior": ("z",), "z": ("z",), "router": ("z", "router"), "all": ("z",)}
    lacks = {way: [part for part in needs.get(way, ()) if not has[part]] for way in ADAPT}
    if missing := [way for way in options.adapt if lacks[way]]:
        left = [way for way in options.adapt if not lacks[way]]
        left = left or [way for way in ADAPT if not lacks[way]]
        cause = f"--adapt {missing[0]}: the run has no {lacks[missing[0]][0]}"
        raise ConfigError(cause, f"use --adapt {','.join(left)}")
