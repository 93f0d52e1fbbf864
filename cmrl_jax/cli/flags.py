"""Command-line parsing shared by all commands: kinds of values, and what is no mistake of ours.

Every flag of every command takes its kind from here, so that a number has the same bounds and a
path is judged in the same way wherever it stands. Imports neither jax nor numpy, so that `--help`
and a user's mistake are answered at once.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

from cmrl_jax.commands import program
from cmrl_jax.config.schema import MOST_EPISODES, MOST_STEPS, ConfigError, call_envs
from envs.command_line import Parser, suggest, typed_path, whole
from envs.goal_names import GOALS, LARGEST_SEED
from envs.outputs import FORCE_HELP

# `train` is what is meant where none is named.
COMMANDS = ("train", "eval", "sweep", "finetune", "plot", "report", "bench", "render", "goals")


def parser_of(command: str, description: str) -> Parser:
    """An empty parser of a command, which says how this program was started."""
    return Parser(prog=f"{program()} {command}", description=description, allow_abbrev=False)


def parse(parser: argparse.ArgumentParser, words: Sequence[str]) -> argparse.Namespace:
    """Parses all of `words`; the first that means nothing is an error with a suggestion."""
    args, unknown = call_envs(lambda: parser.parse_known_args(words))
    if unknown:
        word = unknown[0].partition("=")[0]
        flags = [flag for flag in parser._option_string_actions if flag.startswith("--")]
        cure = f"{suggest(word, flags)}see: {parser.prog} --help"
        raise ConfigError(f"unknown argument '{word}'", cure)
    return args


def list_of(kind: Callable[[str], int]) -> Callable[[str], tuple[int, ...]]:
    """An argparse type: numbers of a kind, comma separated."""
    return lambda text: tuple(kind(item) for item in text.split(","))


natural = whole()
seed = whole(0, LARGEST_SEED)
goal_count = whole(1, GOALS, f"a goal set has {GOALS} goals a task")
goal_index = whole(0, GOALS - 1, f"a goal set has {GOALS} goals a task")
steps = whole(1, MOST_STEPS, "control steps of an episode")
episodes = whole(0, MOST_EPISODES, "each is played from its first step to its last")
adaptation = list_of(episodes)


def names(text: str) -> tuple[str, ...]:
    """Words, comma separated, as an argparse type."""
    return tuple(item.strip() for item in text.split(",") if item.strip())


def add_runs(parser: argparse.ArgumentParser) -> None:
    """Adds `--run` of the commands that show several runs together."""
    parser.add_argument(
        "--run",
        metavar="DIR",
        type=typed_path,
        required=True,
        action="append",
        help="run directory, again for more; DIR-seed0, DIR-seed1 of one config are one band",
    )


def add_force(parser: argparse.ArgumentParser) -> None:
    """Adds `--force`, which every command that writes output files has."""
    parser.add_argument("--force", action="store_true", help=FORCE_HELP)
