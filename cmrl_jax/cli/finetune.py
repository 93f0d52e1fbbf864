"""`train.py finetune`: restores a run whole, adapts it in each way asked for, writes the curves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cmrl_jax.algorithms.base import RunState
from cmrl_jax.algorithms.cmrl.search import BUDGET
from cmrl_jax.config.files import run_config
from cmrl_jax.config.schema import Config, call_envs
from cmrl_jax.evaluation.finetune import (
    FineTuning,
    Score,
    adaptation_curve,
    finetune_config,
    training_denominator,
)
from cmrl_jax.evaluation.finetune_options import FinetuneOptions, check_run
from cmrl_jax.evaluation.scores import fault_warning
from cmrl_jax.evaluation.session import Policy, Session, prepare_jax
from cmrl_jax.evaluation.trials import evaluation_config
from cmrl_jax.evaluation.winner import search_winner
from cmrl_jax.storage.checkpoint import full_store, join_run, split_run
from cmrl_jax.storage.versions import package_versions
from cmrl_jax.text.goals import check_same_table, load_goals
from envs.outputs import write_json

Curves = dict[str, dict[int, Score]]


def finetune_run(
    run: Path, options: FinetuneOptions, json_path: Path | None, figure: Path | None
) -> int:
    """Adapts a run's last full checkpoint to a task; returns the exit code.

    Raises:
        ConfigError: no checkpoint, another goal table than the run's, or it cannot be adapted so.
    """
    config = run_config(run)
    check_run(config, options)
    # From here on the physics really used, for the results' record.
    options = replace(options, physics=options.physics or config.env.physics)
    print(f"device: {prepare_jax(config)}", flush=True)
    session = Session(config)
    state, meta = load_state(run, config, session)
    trained = state.learner
    goals = load_goals(config.goals.table, (options.task,))
    cure = "put that table back, or adapt a run that was trained with this one"
    check_same_table(goals, meta["goals_sha256"], run, cure)
    text = goals.vectors[0, 0]
    placements = session.placements(options.goal_set, options.goals, (options.task,))[0]
    placements = np.asarray(placements, np.float32)
    denominator = training_denominator(config, trained)
    configs = {  # all of them before the first way compiles: one that is refused costs nothing
        adapt: finetune_config(
            config, options.task, adapt, options.episodes, options.updates, denominator
        )
        for adapt in options.adapt
    }
    print(
        f"checkpoint {meta['iteration']} of {run}, {options.task}: own episodes, success any/last"
    )
    curves: Curves = {}
    for adapt, config_of_way in configs.items():
        keep = _keeper(adapt, curves.setdefault(adapt, {}))
        winner = None
        if adapt == "search":
            winner = search_winner(
                Session(evaluation_config(run, options.physics)),
                policy_of(session, state, meta),
                options,
                keep,
            )
        tuning = FineTuning(config_of_way, adapt, trained, text, options, winner)
        adaptation_curve(tuning, options, placements, keep, BUDGET if winner else None)
        for line in warnings_of(adapt, curves[adapt]):
            print(line, flush=True)
        if json_path is not None:  # after each way: a stopped command keeps what it has
            result = as_json(curves) | asdict(options) | {"run": run.as_posix()}
            result |= {"iteration": meta["iteration"], "versions": package_versions()}
            call_envs(lambda: write_json(json_path, "finetune", result))
    if figure is not None:
        from cmrl_jax.analysis.plots import plot_adaptation

        plot_adaptation(as_json(curves)["curves"], options.task, figure)
    return 0


def load_state(run: Path, config: Config, session: Session) -> tuple[RunState, dict[str, Any]]:
    """The state in a run's newest full checkpoint, and the checkpoint's record."""
    abstract = jax.eval_shape(session.algorithm.init, jax.random.key(0))
    with full_store(run, read_only=True) as store:
        trees, meta = store.restore(split_run(abstract), config, versions=package_versions())
    return join_run(abstract, trees), meta


def policy_of(session: Session, state: RunState, meta: dict[str, Any]) -> Policy:
    """What a policy checkpoint of that state would hold."""
    vectors = dict(zip(session.eval_tasks, session.goals.vectors[:, 0], strict=True))
    return Policy(session.algorithm.policy_params(state), vectors, meta)


def as_json(curves: Curves) -> dict[str, Any]:
    """`{"curves": {adapt: {episodes: {"success_any": .., "success_last": .., "return": .., ..}}}}`.

    The others are `faults`, `own_faults` and `skipped_updates`, see `finetune.Score`.
    """
    figures = {
        adapt: {
            str(n): {
                "success_any": score.success_any,
                "success_last": score.success_last,
                "return": score.returns,
                "faults": score.faults,
                "own_faults": score.own_faults,
                "skipped_updates": score.skipped,
            }
            for n, score in curve.items()
        }
        for adapt, curve in curves.items()
    }
    return {"curves": figures}


def warnings_of(adapt: str, curve: dict[int, Score]) -> list[str]:
    """Lines on what a way's curve rests on beside experience: physics put back, steps dropped."""
    read_outs = {str(n): {"faults": score.faults} for n, score in curve.items()}
    own = {str(n): {"faults": score.own_faults} for n, score in curve.items()}
    lines = fault_warning({f"{adapt} (read-outs)": read_outs, f"{adapt} (own episodes)": own})
    if skipped := max(score.skipped for score in curve.values()):
        lines.append(f"warning: {adapt}: {skipped} gradients were non-finite and were skipped")
    return lines


def _keeper(adapt: str, curve: dict[int, Score]) -> Callable[[int, Score], None]:
    """Takes each read-out of a way in, and prints it."""

    def keep(episodes: int, score: Score) -> None:
        curve[episodes] = score
        figures = f"{score.success_any:.2f} / {score.success_last:.2f}  return {score.returns:.0f}"
        print(f"{adapt:<10} {episodes:>5}  {figures}", flush=True)

    return keep
