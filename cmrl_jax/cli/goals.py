"""The command `goals`: its flags, and what they do. Imports what it needs when it runs."""

from __future__ import annotations

import argparse

from cmrl_jax.storage.output_files import distinct
from envs.command_line import typed_path
from envs.outputs import FORCE_HELP

DESCRIPTION = (
    "Makes the table of text vectors that `goals.table` names, from the sentences in "
    "cmrl_jax/data/goal_prompts.yaml. With --show or --figure alone it only looks at a table."
)


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Adds the flags of `goals`."""
    add = parser.add_argument
    add(
        "--encoder",
        default="minilm-l6-v2",
        metavar="E",
        help="minilm-l6-v2 or clip-vit-b-32 [minilm-l6-v2]",
    )
    add(
        "--weights",
        type=typed_path,
        metavar="DIR",
        help="directory of the model [the pip package (minilm), the hub or its cache (clip)]",
    )
    add(
        "--out",
        type=typed_path,
        metavar="F",
        help="table to write or to look at [the packaged one]",
    )
    add("--force", action="store_true", help=f"{FORCE_HELP}, or a table of another encoder")
    add("--show", action="store_true", help="print the cosines between the tasks")
    add("--figure", type=typed_path, metavar="F.png", help="draw the cosines and a PCA (extra viz)")


def run(args: argparse.Namespace) -> int:
    """Builds or shows a table; returns the exit code.

    Raises:
        ConfigError: anything the user can mend.
    """
    distinct(out=args.out, figure=args.figure)

    from cmrl_jax.text import goal_builder, goals

    is_look = args.show or args.figure is not None
    if args.figure is not None:
        from cmrl_jax.analysis import plots

        plots.check_figure(args.figure, "goals", args.force)
    if not is_look or args.weights:
        path = goal_builder.build(args.encoder, args.weights, args.out, args.force)
        print(f"{path}: sha256 {goal_builder.file_sha256(path)}")
    if not is_look:
        return 0
    table = goals.read_table(args.out) if args.out else goals.load_goals(args.encoder)
    if args.show:
        print(goal_builder.format_cosines(table))
    if args.figure is not None:
        from cmrl_jax.analysis import goal_figure

        goal_figure.draw(table, args.figure)
        print(args.figure)
    return 0
