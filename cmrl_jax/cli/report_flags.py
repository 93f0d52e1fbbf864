"""Flags of `train.py report`, before anything is read."""

from __future__ import annotations

import argparse

from cmrl_jax.cli.flags import add_force, add_runs
from envs.command_line import typed_path

DESCRIPTION = "Writes runs as one web page that needs no network: curves, tables, z, films."


def add_flags(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Adds the flags of `report`."""
    add_runs(parser)
    parser.add_argument(
        "--json",
        metavar="F",
        type=typed_path,
        default=[],
        action="append",
        help="figures to add, that eval or finetune wrote with --json; again for more",
    )
    parser.add_argument(
        "--out", metavar="F.html", type=typed_path, help="[report.html of the first run]"
    )
    add_force(parser)
    return parser
