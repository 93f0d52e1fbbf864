"""Flags of `train.py plot`, and the check of `--inspect`, before jax is imported."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from cmrl_jax.cli.flags import add_force, add_runs
from cmrl_jax.config.files import run_config
from cmrl_jax.config.schema import ConfigError, require
from cmrl_jax.storage.kept_policies import is_kept
from cmrl_jax.storage.run_dir import find_own_run, find_run
from envs.command_line import typed_path

DESCRIPTION = (
    "Draws success, returns, adaptation, routing and latents of runs; seeds of one run as a band."
)
PICTURES = ("success.png", "returns.png", "bars.png", "k_shot.png", "routing.png", "z.png")


def add_flags(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Adds the flags of `plot`."""
    add_runs(parser)
    parser.add_argument(
        "--out", metavar="DIR", type=typed_path, help="directory [plots/ of the first]"
    )
    parser.add_argument(
        "--inspect",
        action="store_true",
        help="first roll out each run's policy and write DIR/inspection.json, for routing and z",
    )
    add_force(parser)
    return parser


def check_runs(runs: Sequence[Path]) -> None:
    """Whether each is a run, and another one than those before it: a mean counts each once.

    Raises:
        ConfigError: one is not.
    """
    places = [find_run(run).resolve() for run in runs]
    for run, place in zip(runs, places, strict=True):
        cause = f"{run} comes with the project without the curves of its training"
        require(not is_kept(place), cause, "give a run of your own, or eval it with --json")
        if places.count(place) > 1:
            raise ConfigError(f"--run {run} stands there twice", "name each run once")


def check_inspectable(run: Path) -> None:
    """Whether `--inspect` finds a policy in a run.

    Raises:
        ConfigError: it does not, or this version could not act by it.
    """
    if not (find_own_run(run) / "policy").is_dir():
        cause = f"--inspect needs a policy checkpoint, and {run / 'policy'} does not exist"
        cure = "let the run reach one (checkpoint.policy_every), or leave --inspect out"
        raise ConfigError(cause, cure)
    run_config(run)
