"""`train.py eval`: restores a policy checkpoint in a process of its own and scores it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cmrl_jax.config.schema import call_envs
from cmrl_jax.evaluation.cells import CellTable, Row
from cmrl_jax.evaluation.options import EvalOptions
from cmrl_jax.evaluation.results import score
from cmrl_jax.evaluation.session import Session, load_policy, prepare_jax
from cmrl_jax.evaluation.trials import evaluation_config
from envs.outputs import write_json


def evaluate_run(
    run: Path,
    options: EvalOptions,
    checkpoint: int | None,
    json_path: Path | None,
    csv_path: Path | None,
    force: bool,
) -> int:
    """Scores a run's policy, prints a table, writes JSON and CSV; returns the exit code.

    Args:
        checkpoint: iteration; None for the newest.
        csv_path: gone on with where it is there.
        force: begin a CSV anew that is no table of cells.

    Raises:
        ConfigError: no such checkpoint, or it does not fit this program; a CSV that cannot be gone
            on with.
    """
    evaluate = _evaluate
    if options.physics == "metaworld":
        from cmrl_jax.evaluation.metaworld import evaluate_in_metaworld as evaluate
    with CellTable(csv_path, force) as table:  # held throughout, as by a sweep
        result, rows = evaluate(run, options, checkpoint)
        new = table.add(rows)
        if csv_path is not None:
            print(f"{csv_path}: {len(new)} rows added, {len(rows) - len(new)} were there")
    if json_path is not None:
        call_envs(lambda: write_json(json_path, "eval", result))
    return 0


def _evaluate(
    run: Path, options: EvalOptions, checkpoint: int | None
) -> tuple[dict[str, Any], list[Row]]:
    """Scores a policy in one of our backends: the result as JSON has it, and the cells."""
    assert options.physics != "metaworld"  # the caller has looked
    config = evaluation_config(run, options.physics)
    print(f"device: {prepare_jax(config)}", flush=True)
    session = Session(config)
    policy = load_policy(run, session, checkpoint)
    found = score(run, session, policy, options)
    print(f"checkpoint {policy.meta['iteration']} of {run}: {found.setting}")
    print(found.table())
    return found.as_json(), found.cells
