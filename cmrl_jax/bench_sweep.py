"""`train.py sweep --compare N`: the sweep's cells taken one adaptation run at a time.

The baseline is the loop one would write first: for each checkpoint, task and goal one call of a
program that is compiled once, for a single lane. It is given that program for free, as the sweep
is; both are timed in one process on one device.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cmrl_jax.evaluate import Evaluator
from cmrl_jax.evaluate_flags import EvalOptions
from cmrl_jax.scores import ScoreCsv, cell_rows, of_policy
from cmrl_jax.session import Session
from cmrl_jax.targets import Target, columns_of, load_target
from cmrl_jax.trials import trial_of


def time_one_by_one(
    targets: Sequence[Target], options: EvalOptions, table: ScoreCsv, count: int
) -> dict[str, Any]:
    """Scores `count` lanes, spread evenly over the sweep's, each by a call of its own.

    Args:
        targets: checkpoints that share a program.
        table: the sweep's rows, to compare with.

    Returns:
        `cells`, `seconds`, `cells_per_s`, `compile_seconds`; `equal_success`, cells whose success
        at any step is the sweep's; `largest_return_difference`.
    """
    lanes = [
        (target, task, goal)
        for target in targets
        for task in target.tasks
        for goal in range(options.goals)
    ]
    index = np.unique(np.linspace(0, len(lanes) - 1, min(count, len(lanes))).astype(int))
    session = Session(targets[0].config)
    policies = {target: load_target(target, session) for target in targets}
    one_draw = replace(options, draws=1)
    trials = {
        (target, task): trial_of([policies[target]], session, one_draw, (task,))
        for target in targets
        for task in target.tasks
    }
    evaluator = Evaluator(session.config, session.env, session.learner, 1, options.horizon)
    started = time.monotonic()
    evaluator.compile(policies[targets[0]].params, next(iter(trials.values())).texts.shape[-1])
    compiled = time.monotonic()
    rows = []
    for target, task, goal in (lanes[i] for i in index):
        trial = trials[target, task].of_goal(goal)
        found = evaluator.run([policies[target].params], trial, target.k, options.seed)
        common = columns_of(target, options)
        new = cell_rows(of_policy(found, 0), trial.tasks, common)
        rows += [row | {"goal": str(goal)} for row in new]
    seconds = time.monotonic() - compiled
    swept = [table.find(row) for row in rows]
    differs = [
        abs(float(a["return"]) - float(b["return"])) for a, b in zip(rows, swept, strict=True)
    ]
    equal = [a["success_any"] == b["success_any"] for a, b in zip(rows, swept, strict=True)]
    return {
        "cells": len(rows),
        "seconds": seconds,
        "cells_per_s": len(rows) / seconds,
        "compile_seconds": compiled - started,
        "equal_success": sum(equal),
        "largest_return_difference": max(differs),
    }
