"""Where tables of text vectors lie. Imports no numpy, so that a missing one is reported at once."""

from __future__ import annotations

from pathlib import Path

from cmrl_jax.config import GOAL_ABLATIONS, TEXT_ENCODERS, ConfigError
from cmrl_jax.validate import check_goal_table

DATA = Path(__file__).parent / "data"
PROMPTS_FILE = DATA / "goal_prompts.yaml"
DEFAULT_TABLE = TEXT_ENCODERS[0]
BUILD = "python train.py goals"


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
        path, cure = Path(table), f"build it: {BUILD} --weights DIR --out {table}"
    else:
        encoder = DEFAULT_TABLE if table in GOAL_ABLATIONS else table
        path, cure = table_path(encoder), f"build it: {BUILD} --encoder {encoder}"
    if not path.is_file():
        raise ConfigError(f"the goal table {table} is not there: {path} does not exist", cure)
    return path
