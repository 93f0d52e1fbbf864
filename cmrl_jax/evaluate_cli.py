"""`train.py eval`: restores a policy checkpoint in a process of its own and scores it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Literal

import jax
import numpy as np

from cmrl_jax.checkpoint import policy_store
from cmrl_jax.config_io import read_yaml, resolve
from cmrl_jax.evaluate import format_scores, summarise
from cmrl_jax.metrics import package_versions
from cmrl_jax.session import Session, policy_params, prepare_jax


def evaluate_run(
    run: Path,
    k: tuple[int, ...],
    goals: int,
    goal_set: str,
    seed: int,
    horizon: int | None,
    physics: Literal["mjx", "native"] | None,
    checkpoint: int | None,
    json_path: Path | None,
) -> int:
    """Scores a run's policy, prints a table and writes JSON; returns the exit code.

    Args:
        k: adaptation episodes.
        goals: goals a task, the first of the set.
        horizon: control steps an episode; None for the run's own.
        physics: backend to evaluate in; None for the one the run was trained in.
        checkpoint: iteration; None for the newest.

    Raises:
        ConfigError: no such checkpoint, or it does not fit this program.
    """
    config = resolve(*read_yaml(run / "config.yaml"))
    if physics is not None:
        # A policy does not know its simulator. impl belongs to mjx, and its default serves both.
        impl = config.env.impl if physics == config.env.physics else "jax"
        config = replace(config, env=replace(config.env, physics=physics, impl=impl))
    print(f"device: {prepare_jax(config)}", flush=True)
    session = Session(config)
    state = jax.eval_shape(session.learner.init, jax.random.key(0))
    vectors = session.goals.vectors[:, 0]
    abstract = {
        "params": policy_params(state),
        "goal_vectors": jax.ShapeDtypeStruct(vectors.shape, np.float32),
    }
    with policy_store(run, read_only=True) as store:
        trees, meta = store.restore(
            {"policy": abstract}, step=checkpoint, versions=package_versions()
        )
    policy = trees["policy"]
    # The vectors that the run was trained with, not those of a table that may have changed since.
    evaluator = session.evaluator(horizon, np.asarray(policy["goal_vectors"]))
    scores = evaluator.run(policy["params"], session.placements(goal_set, goals), k, seed)
    summary = summarise(scores, session.eval_tasks)
    where = f"{goals} goals of '{goal_set}', horizon {evaluator.horizon}, seed {seed}"
    print(f"checkpoint {meta['iteration']} of {run}: {where}, {config.env.physics}")
    print(format_scores(summary))
    if json_path is not None:
        result = {
            "tasks": summary,
            "goals": goals,
            "goal_set": goal_set,
            "physics": config.env.physics,
            "horizon": evaluator.horizon,
            "iteration": meta["iteration"],
            "env_steps": meta["env_steps"],
            "seed": seed,
            "versions": package_versions(),
        }
        json_path.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    return 0
