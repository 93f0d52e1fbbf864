"""Flags of `train.py render`, and every check of them that needs no jax."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from cmrl_jax.analysis.film_options import FilmOptions
from cmrl_jax.cli.flags import add_force, episodes, goal_index, names, natural, seed, steps
from cmrl_jax.config.extras import require_extra
from cmrl_jax.config.files import run_config
from cmrl_jax.config.schema import call_envs, require
from cmrl_jax.evaluation.options import (
    ADAPT,
    SEARCH_K,
    EvalOptions,
    check_options,
    check_run,
    evaluated_tasks,
)
from cmrl_jax.registry import rules_of
from cmrl_jax.storage.output_files import writable
from cmrl_jax.storage.run_dir import find_run, place_beside
from envs.command_line import make_directory, typed_path, whole
from envs.outputs import written_by

DESCRIPTION = (
    "Films one adaptation run per task in Meta-World's own scene: k exploration episodes, then the "
    "reported one, as an mp4 and a contact sheet (PNG). Physics: MuJoCo C."
)


def add_flags(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Adds the flags of `render`."""
    add = parser.add_argument
    add("--run", metavar="DIR", type=typed_path, required=True, help="run directory")
    text = "exploration episodes [1; 0 without a latent z; 20 with --adapt search]"
    add("--k", type=episodes, metavar="N", help=text)
    text = "posterior, search or arms, as eval's [posterior]"
    add("--adapt", default="posterior", metavar="A", choices=ADAPT, help=text)
    add("--tasks", type=names, metavar="A,B", help="tasks to film [those of the run]")
    add("--goal", type=goal_index, default=0, metavar="N", help="goal of the set, 0 to 49 [0]")
    add("--goal-set", default="heldout", metavar="SET", help="train, heldout or fresh:<seed>")
    add("--seed", type=seed, default=0, metavar="S", help="seed of the z draws [0]")
    add("--horizon", type=steps, metavar="H", help="control steps an episode [env.horizon]")
    add("--checkpoint", type=natural, metavar="N", help="iteration of the checkpoint [the last]")
    add("--every", type=whole(1), default=4, metavar="N", help="control steps a video frame [4]")
    text = "episodes on a contact sheet, the first and the last among them [3]"
    add("--sheet-rows", type=whole(1), default=3, metavar="N", help=text)
    add("--out", type=typed_path, metavar="DIR", help="where the files go [RUN/render]")
    add_force(parser)
    return parser


def options_of(args: argparse.Namespace) -> tuple[Path, FilmOptions, Path]:
    """Run, options and output directory, which is made.

    Raises:
        ConfigError: no goal set or run, an option that does not apply to it, a package that is
            missing, or a directory that cannot be written.
    """
    k = SEARCH_K[-1] if args.k is None and args.adapt == "search" else args.k
    asked = EvalOptions(
        k=None if k is None else (k,),
        tasks=args.tasks,
        goal_set=args.goal_set,
        adapt=args.adapt,
        physics="native",
    )
    check_options(asked)
    run = find_run(args.run)
    config = run_config(run)
    cause = f"render with env.name {config.env.name}"
    require(config.env.name == "ml4", cause, "give a run of ml4: films show Meta-World's scenes")
    check_run(replace(asked, k=asked.k or (0,)), run)
    require_extra("render")
    out = args.out or place_beside(run) / "render"
    call_envs(lambda: make_directory(out, "--out"))
    for task in evaluated_tasks(asked, config):
        for ending in ("mp4", "png"):
            writable(out / f"{task}.{ending}", "--out", written_by("render"), args.force)
    options = FilmOptions(
        k=k if k is not None else int(call_envs(lambda: rules_of(config)).adapts),
        goal=args.goal,
        goal_set=args.goal_set,
        seed=args.seed,
        adapt=args.adapt,
        tasks=args.tasks,
        horizon=args.horizon,
        checkpoint=args.checkpoint,
        every=args.every,
        rows=args.sheet_rows,
    )
    return run, options, out
