"""Where tables of text vectors lie. Imports no numpy, so that a missing one is reported at once."""

from __future__ import annotations

from pathlib import Path

from cmrl_jax.commands import command
from cmrl_jax.config.rules import check_goal_table
from cmrl_jax.config.schema import GOAL_ABLATIONS, TEXT_ENCODERS, ConfigError, call_envs
from cmrl_jax.places import DATA
from envs.command_line import brief, what_is

PROMPTS_FILE = DATA / "goal_prompts.yaml"
DEFAULT_TABLE = TEXT_ENCODERS[0]


def table_path(encoder: str) -> Path:
    """Returns where the packaged table of an encoder lies, whether or not it exists."""
    return DATA / f"goals-{encoder}.npz"


def find_table(table: str) -> Path:
    """Returns the file behind a `goals.table`; behind an ablation, that of the packaged table.

    Raises:
        ConfigError: no table is called so, or it was not built yet.
    """
    check_goal_table(table)
    if table.endswith(".npz"):
        path, build = Path(table), command("goals", "--weights", "DIR", "--out", table)
    else:
        encoder = DEFAULT_TABLE if table in GOAL_ABLATIONS else table
        path, build = table_path(encoder), command("goals", "--encoder", encoder)
    lies_there = call_envs(lambda: what_is(path), "goals.table: ")
    if lies_there != "file":
        state = "is a directory" if lies_there == "directory" else "does not exist"
        cause = f"the goal table {brief(table)} is not there: {brief(path)} {state}"
        raise ConfigError(cause, f"build it: {build}")
    return path
