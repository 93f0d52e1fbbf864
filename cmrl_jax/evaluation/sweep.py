"""`train.py sweep`: many checkpoints of one or more runs, scored side by side.

Checkpoints that the same program can act for are stacked and evaluated together, in batches that
fit the memory. Every finished batch is written to the CSV at once, and cells that stand there are
not run again: a sweep that was stopped goes on when its command is repeated.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax

from cmrl_jax.config.schema import call_envs
from cmrl_jax.evaluation.cells import CellTable
from cmrl_jax.evaluation.evaluator import Evaluator
from cmrl_jax.evaluation.options import DONATED, EvalOptions
from cmrl_jax.evaluation.scores import cell_rows, fault_warning, of_policy, summarise_rows
from cmrl_jax.evaluation.session import Policy, Session, prepare_jax
from cmrl_jax.evaluation.settings import result_fields, row_columns
from cmrl_jax.evaluation.targets import (
    Target,
    cells_per_task,
    columns_of,
    load_target,
    pending_tasks,
    program_key,
    targets_of,
)
from cmrl_jax.evaluation.trials import (
    Plan,
    fitted,
    lane_budget,
    memory_limit,
    plan_batches,
    trial_of,
)
from cmrl_jax.formats import format_duration
from cmrl_jax.registry import task_names
from cmrl_jax.stop import is_interrupt
from envs.outputs import write_json

INTERRUPTED = 130  # exit code after Ctrl-C, as a shell has it


@dataclass
class Progress:
    """Cells done and to do, and the seconds that evaluating (not compiling) took.

    `cpu_seconds` is what the processors worked in them: near `seconds` times the processors, and
    a sweep is as fast as this machine can be.
    """

    total: int
    cells: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    compile_seconds: float = 0.0

    def line(self) -> str:
        rate = self.cells / max(self.seconds, 1e-9)
        left = format_duration((self.total - self.cells) / max(rate, 1e-9))
        return f"{self.cells:>8,} of {self.total:,} cells | {rate:,.1f} cells/s | ETA {left}"


# Checkpoints that share a program, the table with their cells, what they took -> figures.
Compare = Callable[[Sequence[Target], CellTable, Progress], dict[str, Any]]


def sweep(
    runs: Sequence[Path],
    checkpoints: tuple[int, ...] | Literal["all", "last"],
    options: EvalOptions,
    json_path: Path | None,
    csv_path: Path | None,
    compare: Compare | None,
    force: bool,
) -> int:
    """Scores the checkpoints, prints a table, writes JSON and CSV; returns the exit code.

    Args:
        compare: measures the first group by other means, too.
        force: begin a CSV anew that is no table of cells.

    Raises:
        ConfigError: a run without such a checkpoint, or one that does not fit this program; a CSV
            that cannot be gone on with.
    """
    targets = [t for run in runs for t in targets_of(run, checkpoints, options)]
    with CellTable(csv_path, force) as table:
        print(f"device: {prepare_jax(targets[0].config)}", flush=True)
        todo = {target: pending_tasks(target, options, table) for target in targets}
        cells = [len(tasks) * cells_per_task(target, options) for target, tasks in todo.items()]
        progress = Progress(total=sum(cells))
        held = sum(len(t.tasks) * cells_per_task(t, options) for t in targets) - progress.total
        print(f"{len(targets)} checkpoints, {progress.total:,} cells to run, {held:,} there")
        comparison = None
        try:
            key = lambda target: program_key(target, options.adapt)
            for _, group in itertools.groupby(sorted(targets, key=key), key):
                members = list(group)
                evaluate_group({t: todo[t] for t in members if todo[t]}, options, table, progress)
                if compare is not None and comparison is None:
                    comparison = compare(members, table, progress)
        except (KeyboardInterrupt, jax.errors.JaxRuntimeError) as error:
            if not is_interrupt(error):
                raise
            where = "nothing was kept: add --csv F" if csv_path is None else "repeat it to go on"
            print(f"stopped after {progress.cells:,} of {progress.total:,} cells; {where}")
            return INTERRUPTED
        evaluations = [evaluation_of(target, options, table) for target in targets]
    print(format_sweep(evaluations))
    if json_path is not None:
        result = {
            "evaluations": evaluations,
            "cells": progress.cells,
            "seconds": progress.seconds,
            "cpu_seconds": progress.cpu_seconds,
            "compile_seconds": progress.compile_seconds,
            "one_by_one": comparison,
        }
        call_envs(lambda: write_json(json_path, "sweep", result))
    return 0


def evaluate_group(
    todo: dict[Target, tuple[str, ...]], options: EvalOptions, table: CellTable, progress: Progress
) -> None:
    """Runs the pending tasks of targets that share a program, and writes their cells."""
    if not todo:
        return
    targets = sorted(todo, key=lambda t: [task_names().index(task) for task in todo[t]])
    prepare_jax(targets[0].config)  # each program has the precision of its own runs
    session = Session(targets[0].config)
    most = max(len(tasks) for tasks in todo.values())
    plan = plan_batches(len(targets), most, options.goals * options.draws, lane_budget(options))
    first = load_target(targets[0], session)
    evaluator = compiled_evaluator(session, first, options, plan, progress)
    per_task = options.goals * options.draws
    for tasks, members in itertools.groupby(targets, todo.__getitem__):
        # Donors of a whole evaluation stay together; else as few tasks as fill a batch, so that
        # their rows are written early.
        whole = options.z in DONATED
        parts = [tasks] if whole else list(chunks(tasks, max(1, evaluator.lanes // per_task)))
        for batch in chunks(list(members), evaluator.policies):
            policies = [load_target(target, session) for target in batch]
            for part in parts:
                run_batch(evaluator, session, batch, policies, part, options, table, progress)


def compiled_evaluator(
    session: Session, policy: Policy, options: EvalOptions, plan: Plan, progress: Progress
) -> Evaluator:
    """The evaluator of a plan, or of the part of it that the memory holds."""
    width = next(iter(policy.goal_vectors.values())).shape[-1]
    started = time.monotonic()
    while True:
        print(f"compiling {plan.policies} x {plan.lanes} lanes ...", flush=True)
        evaluator = session.evaluator(plan.lanes, options.horizon, plan.policies, options.adapt)
        evaluator.compile(policy.params, width)
        smaller = fitted(plan, evaluator.memory_bytes(), memory_limit())
        if smaller == plan:
            break
        print(f"memory is short: {evaluator.memory_bytes() / 2**30:.1f} GiB needed")
        session.forget(evaluator)
        plan = smaller
    progress.compile_seconds += time.monotonic() - started
    return evaluator


def run_batch(
    evaluator: Evaluator,
    session: Session,
    batch: Sequence[Target],
    policies: list[Policy],
    tasks: tuple[str, ...],
    options: EvalOptions,
    table: CellTable,
    progress: Progress,
) -> None:
    """Scores a batch of checkpoints on some tasks and writes the rows."""
    trial = trial_of(policies, session, options, tasks)
    started, worked = time.monotonic(), time.process_time()
    scores = evaluator.run([p.params for p in policies], trial, batch[0].k, options.seed)
    progress.seconds += time.monotonic() - started
    progress.cpu_seconds += time.process_time() - worked
    for place, (target, policy) in enumerate(zip(batch, policies, strict=True)):
        common = row_columns(target.run, policy.meta, options, target.config)
        rows = cell_rows(of_policy(scores, place), tasks, common)
        table.add(rows)
        progress.cells += len(rows)
    print(progress.line(), flush=True)


def evaluation_of(target: Target, options: EvalOptions, table: CellTable) -> dict[str, Any]:
    """What `eval` would write of the target, from the table's rows."""
    rows = [
        row
        for row in table.rows(columns_of(target, options))
        if row["task"] in target.tasks
        and int(row["goal"]) < options.goals
        and int(row["draw"]) < options.draws
        and int(row["k"]) in target.k
    ]
    meta = {"iteration": target.checkpoint, "env_steps": int(rows[0]["env_steps"])}
    fields = result_fields(target.run, meta, options, target.config)
    return {"tasks": summarise_rows(rows)} | fields


def format_sweep(evaluations: Sequence[dict[str, Any]]) -> str:
    """Success at any step of every checkpoint, task and k."""
    lines = []
    for found in evaluations:
        lines.append(f"{found['run']}, checkpoint {found['iteration']}")
        for task, by_k in found["tasks"].items():
            figures = "  ".join(f"k{k} {f['success_any']:.2f}" for k, f in by_k.items())
            lines.append(f"  {task:<14} {figures}")
        lines += fault_warning(found["tasks"])
    return "\n".join(lines)


def chunks(items: Any, size: int) -> Iterator[Any]:
    """Slices of `size` items, the last one with what is left."""
    for start in range(0, len(items), size):
        yield items[start : start + size]
