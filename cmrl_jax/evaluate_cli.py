"""`train.py eval`: restores a policy checkpoint in a process of its own and scores it."""

from __future__ import annotations

import json
from pathlib import Path

from cmrl_jax.evaluate import Evaluator
from cmrl_jax.evaluate_flags import EvalOptions, evaluated_tasks
from cmrl_jax.scores import ScoreCsv, cell_rows, format_scores, of_policy, summarise
from cmrl_jax.session import Session, load_policy, prepare_jax
from cmrl_jax.settings import describe, result_fields, row_columns
from cmrl_jax.trials import batch_lanes, evaluation_config, lane_budget, trial_of


def evaluate_run(
    run: Path,
    options: EvalOptions,
    checkpoint: int | None,
    json_path: Path | None,
    csv_path: Path | None,
) -> int:
    """Scores a run's policy, prints a table, writes JSON and CSV; returns the exit code.

    Args:
        checkpoint: iteration; None for the newest.

    Raises:
        ConfigError: no such checkpoint, or it does not fit this program.
    """
    if options.physics == "metaworld":
        from cmrl_jax.evaluate_metaworld import evaluate_in_metaworld

        return evaluate_in_metaworld(run, options, checkpoint, json_path, csv_path)
    config = evaluation_config(run, options.physics)
    print(f"device: {prepare_jax(config)}", flush=True)
    session = Session(config)
    policy = load_policy(run, session, checkpoint)
    tasks = evaluated_tasks(options, config)
    trial = trial_of([policy], session, options, tasks)
    unit = config.eval.goals * len(session.eval_tasks)
    lanes = batch_lanes(len(tasks) * options.goals * options.draws, unit, lane_budget(options))
    evaluator = Evaluator(config, session.env, session.learner, lanes, options.horizon)
    k = options.k if options.k is not None else config.eval.final_k
    scores = of_policy(evaluator.run([policy.params], trial, k, options.seed), 0)
    summary = summarise(scores, tasks)
    print(f"checkpoint {policy.meta['iteration']} of {run}: {describe(options, config)}")
    print(format_scores(summary))
    if csv_path is not None:
        with ScoreCsv(csv_path, resume=False) as table:
            table.add(cell_rows(scores, tasks, row_columns(run, policy.meta, options, config)))
    if json_path is not None:
        result = {"tasks": summary} | result_fields(run, policy.meta, options, config)
        json_path.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    return 0
