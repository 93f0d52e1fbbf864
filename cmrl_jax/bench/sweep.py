"""`train.py sweep --compare N`: the sweep's cells taken one checkpoint and one goal at a time.

Two baselines, both with every k from one adaptation run, as the sweep has them:

* a loop in this process: for each checkpoint, task and goal one call of a program that is compiled
  once, for a single lane. Compiling counts for neither side.
* the command `eval` for each of them, its programs in the compilation cache. Start-up and compiling
  count for both sides.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cmrl_jax.commands import CHILD
from cmrl_jax.evaluation.cells import CellTable
from cmrl_jax.evaluation.options import EvalOptions
from cmrl_jax.evaluation.scores import cell_rows, of_policy
from cmrl_jax.evaluation.session import Session
from cmrl_jax.evaluation.sweep import Progress
from cmrl_jax.evaluation.targets import Target, columns_of, load_target
from cmrl_jax.evaluation.trials import trial_of
from cmrl_jax.places import ROOT

COMMANDS = 2  # calls of `eval` that are timed: each takes seconds to start


def time_one_by_one(
    targets: Sequence[Target], options: EvalOptions, table: CellTable, count: int
) -> dict[str, Any]:
    """Scores `count` lanes, spread evenly over the sweep's, each by a call of its own.

    Args:
        targets: checkpoints that share a program.
        table: the sweep's rows, to compare with.

    Returns:
        `cells`, `seconds`, `cpu_seconds`, `compile_seconds`; `equal_success`, cells whose success
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
    evaluator = session.evaluator(1, options.horizon)
    started = time.monotonic()
    evaluator.compile(policies[targets[0]].params, next(iter(trials.values())).texts.shape[-1])
    compiled, worked = time.monotonic(), time.process_time()
    rows = []
    for target, task, goal in (lanes[i] for i in index):
        trial = trials[target, task].of_goal(goal)
        found = evaluator.run([policies[target].params], trial, target.k, options.seed)
        common = columns_of(target, options)
        new = cell_rows(of_policy(found, 0), trial.tasks, common)
        rows += [row | {"goal": str(goal)} for row in new]
    seconds, cpu_seconds = time.monotonic() - compiled, time.process_time() - worked
    swept = [table.find(row) for row in rows]
    differs = [
        abs(float(a["return"]) - float(b["return"])) for a, b in zip(rows, swept, strict=True)
    ]
    equal = [a["success_any"] == b["success_any"] for a, b in zip(rows, swept, strict=True)]
    return {
        "cells": len(rows),
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "compile_seconds": compiled - started,
        "equal_success": sum(equal),
        "largest_return_difference": max(differs),
    }


def time_commands(target: Target, options: EvalOptions) -> dict[str, Any]:
    """Runs `eval` on the first goal of `COMMANDS` tasks, after one that fills the cache.

    Returns:
        `cells`, `seconds`.
    """
    paths = os.pathsep.join(p for p in (str(ROOT), os.environ.get("PYTHONPATH")) if p)
    started = 0.0
    for call in range(COMMANDS + 1):
        if call == 1:
            started = time.monotonic()
        task = target.tasks[call % len(target.tasks)]
        subprocess.run(
            [sys.executable, "-c", CHILD, "eval", *command_words(target, options, task)],
            check=True,
            capture_output=True,
            env=os.environ | {"PYTHONPATH": paths},
        )
    return {"cells": COMMANDS * len(target.k), "seconds": time.monotonic() - started}


def command_words(target: Target, options: EvalOptions, task: str) -> list[str]:
    """Flags of `eval` for one goal of one task under a sweep's protocol."""
    flags = {
        "run": target.run,
        "checkpoint": target.checkpoint,
        "tasks": task,
        "k": ",".join(map(str, target.k)),
        "goals": 1,
        "goal-set": options.goal_set,
        "seed": options.seed,
        "horizon": options.horizon,
        "physics": options.physics,
        "policy": options.policy,
        "z": options.z,
        "paraphrases": options.paraphrases,
        "text-control": options.text_control,
        "text": options.text,
        "weights": options.weights,
    }
    words = [w for name, x in flags.items() if x is not None for w in (f"--{name}", str(x))]
    return [*words, "--any-table"] if options.any_table else words


def compared(
    members: Sequence[Target],
    options: EvalOptions,
    table: CellTable,
    count: int,
    progress: Progress,
) -> dict[str, Any]:
    """Times some of the cells one checkpoint and one goal at a time, beside what the sweep took."""
    compiling = progress.compile_seconds
    baselines = {
        "loop": (time_one_by_one(members, options, table, count), 0.0),
        "commands": (time_commands(members[0], options), compiling),
    }
    found = {}
    for name, (taken, overhead) in baselines.items():
        rate = taken["cells"] / taken["seconds"]
        seconds = progress.seconds + overhead
        swept = progress.cells / seconds if progress.cells else None
        ratio = swept / rate if swept else None
        found[name] = taken | {"cells_per_s": rate, "sweep_cells_per_s": swept, "ratio": ratio}
        faster = f"the sweep is {ratio:.1f} times as fast" if ratio else "nothing was swept"
        print(f"one by one ({name}): {taken['cells']} cells, {rate:.2f} cells/s; {faster}")
    loop = found["loop"]
    if progress.cells:
        together = progress.cpu_seconds / progress.cells
        alone = loop["cpu_seconds"] / loop["cells"]
        print(f"processor time a cell: {together:.3f} s in the sweep, {alone:.3f} s in the loop")
    print(f"success as in the sweep in {loop['equal_success']} of {loop['cells']} cells")
    return found
