"""From evaluation options to what lanes are given: goals, sentences, and how many lanes at once."""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from cmrl_jax.config.files import run_config
from cmrl_jax.config.schema import Config, ConfigError
from cmrl_jax.evaluation.controls import text_per_goal
from cmrl_jax.evaluation.evaluator import Trial
from cmrl_jax.evaluation.options import EvalOptions, ks_of
from cmrl_jax.evaluation.session import Policy, Session
from cmrl_jax.registry import other_task
from cmrl_jax.text.goals import GoalTable, load_goals
from envs.goal_names import GOALS

LANES = {"cpu": 256}
LANES_ON_ACCELERATORS = 8192
MEMORY_SHARE = 0.7


def evaluation_config(run: Path, physics: Literal["mjx", "native"] | None) -> Config:
    """A run's configuration with the backend to evaluate in; None for the one it was trained in."""
    config = run_config(run)
    if physics is None:
        return config
    return replace(config, env=replace(config.env, physics=physics))


def lane_budget(options: EvalOptions) -> int:
    """Parallel episodes in a batch: as asked, else what keeps the device busy."""
    return options.lanes or LANES.get(jax.default_backend(), LANES_ON_ACCELERATORS)


def eval_lanes(options: EvalOptions, tasks: int, unit: int) -> int:
    """Lanes of a batch for an evaluation of one policy.

    By task, an adaptation episode has one lane a task and draw, and fills its batch with copies of
    them. A CPU pays for each, so there a batch is no wider than those need.

    Args:
        unit: see `batch_lanes`.
    """
    budget, lanes = lane_budget(options), tasks * options.draws
    is_narrow = options.protocol == "task" and not options.lanes
    if not (is_narrow and jax.default_backend() == "cpu"):
        lanes *= options.goals
    return batch_lanes(lanes, unit, budget)


def batch_lanes(lanes: int, unit: int, budget: int) -> int:
    """Lanes of a batch for an evaluation of `lanes`, at most `budget`.

    Args:
        unit: lanes of one periodic evaluation of a training run; a small evaluation is rounded up
            to it, so that the program which training compiled is found in the cache.
    """
    return min(math.ceil(lanes / unit) * unit, max(budget, 1))


@dataclass(frozen=True)
class Plan:
    """The shape of a batch: policies side by side, and lanes of each."""

    policies: int
    lanes: int


def plan_batches(policies: int, tasks: int, per_task: int, budget: int) -> Plan:
    """Policies side by side first, then as many whole tasks of them as `budget` lanes hold.

    Batches are equally full: 6 policies where 5 have room are 3 and 3, not 5 and 1 beside 4 copies.

    Args:
        per_task: lanes of one policy on one task.
    """
    side = _even(policies, max(1, budget // per_task))
    lanes = min(tasks * per_task, max(1, budget // side))
    return Plan(side, lanes - lanes % per_task if lanes > per_task else lanes)


def fitted(plan: Plan, needed: int, limit: int | None) -> Plan:
    """The plan, or as much of it as fits: memory grows in proportion to the lanes.

    Args:
        needed: bytes that the plan's program takes.
        limit: bytes there are; None: unknown.
    """
    if limit is None or needed <= limit:
        return plan
    if plan.policies > 1:
        side = max(1, math.floor(plan.policies * limit / needed))
        return Plan(_even(plan.policies, side), plan.lanes)
    return Plan(1, max(1, math.floor(plan.lanes * limit / needed)))


def _even(count: int, most: int) -> int:
    """The size of as few batches as hold `count`, at most `most` each, where none is fuller."""
    return math.ceil(count / math.ceil(count / most))


def memory_limit() -> int | None:
    """Bytes that a program may take: most of what the device, or this machine, has free."""
    stats = jax.local_devices()[0].memory_stats()
    if stats and "bytes_limit" in stats:
        return int(MEMORY_SHARE * (stats["bytes_limit"] - stats.get("bytes_in_use", 0)))
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    [free] = [line for line in lines if line.startswith("MemAvailable:")] or ["0 0"]
    return int(MEMORY_SHARE * int(free.split()[1]) * 1024) or None


def trial_of(
    policies: list[Policy],
    session: Session,
    options: EvalOptions,
    tasks: tuple[str, ...],
) -> Trial:
    """What policies of one configuration are scored on.

    Raises:
        ConfigError: a sentence that cannot be had, or a goal set that cannot be read.
    """
    if options.adapt != "posterior" and any(map(_is_incomplete, policies)):
        cause = f"--adapt {options.adapt} with a policy that was saved before there was a search"
        raise ConfigError(cause, "resume its run, whose next policy has what is searched")
    texts = [task_sentences(policy, session.config, options, tasks) for policy in policies]
    return Trial(
        tasks=tasks,
        placements=session.placements(options.goal_set, options.goals, tasks),
        adaptation=adaptation_goals(session, options, tasks),
        texts=np.stack([text_per_goal(vectors, options.goals) for vectors in texts]),
        draws=options.draws,
        z=options.z,
        deterministic=options.policy == "deterministic",
    )


def _is_incomplete(policy: Policy) -> bool:
    """Whether an older version saved it, without all that is saved today (NaN)."""
    return any(np.isnan(np.asarray(leaf)).any() for leaf in jax.tree.leaves(policy.params))


def adaptation_goals(
    session: Session, options: EvalOptions, tasks: tuple[str, ...]
) -> np.ndarray | None:
    """Goals that the task protocol learns on (task, draw, episode, goal_size); None by goal.

    Each draw takes the `train` set in an order of its own, which the seed names.
    """
    if options.protocol == "goal":
        return None
    k = ks_of(options, session.config)
    goals = session.placements("train", GOALS, tasks)
    orders = [
        np.random.default_rng([options.seed, draw]).permutation(goals.shape[1])
        for draw in range(options.draws)
    ]
    turns = np.arange(max(*k, 1)) % goals.shape[1]
    return goals[:, np.stack(orders)[:, turns]]


def task_sentences(
    policy: Policy, config: Config, options: EvalOptions, tasks: tuple[str, ...]
) -> list[np.ndarray]:
    """The text vectors that goals of each task take turns in, [task] (n, G).

    The first sentence of a task that the run knows is the one in its checkpoint, whatever table
    lies here now; others come from the table, which must be the one that the run was trained with.

    Raises:
        ConfigError: the table is another one, or the sentence cannot be embedded.
    """
    width = next(iter(policy.goal_vectors.values())).shape[-1]
    if options.text_control == "zero":
        return [np.zeros((1, width), np.float32) for _ in tasks]
    if options.text is not None:
        vector = _embed(options, config.goals.table)
        if vector.shape != (1, width):
            cause = f"--text gives {vector.shape[-1]} numbers, the run was trained on {width}"
            raise ConfigError(cause, f"use the encoder of its table, {config.goals.table}")
        return [vector for _ in tasks]
    read = [other_task(task) for task in tasks] if options.text_control == "shuffled" else tasks
    if options.paraphrases == "heldout":
        return list(_table(policy, config, options, tuple(read)).heldout_vectors)
    return [
        policy.goal_vectors[task][None]
        if task in policy.goal_vectors
        else _table(policy, config, options, (task,)).vectors[0, :1]
        for task in read
    ]


def _table(
    policy: Policy, config: Config, options: EvalOptions, tasks: tuple[str, ...]
) -> GoalTable:
    table = load_goals(config.goals.table, tasks)
    trained = policy.meta["goals_sha256"]
    if table.sha256 != trained and not options.any_table:
        raise ConfigError(
            f"the goal table {config.goals.table} ({table.sha256[:12]}) is not the one the run was "
            f"trained with ({trained[:12]})",
            "put that table back, or take this one's sentences with --any-table",
        )
    return table


def _embed(options: EvalOptions, encoder: str) -> np.ndarray:
    """The vector of `--text` (1, G), by the encoder of a goal table."""
    try:
        encoders: Any = importlib.import_module("cmrl_jax.text.encoders")
    except ModuleNotFoundError as error:
        cause = f"--text needs the sentence encoder {encoder}: {error}"
        raise ConfigError(cause, "use --paraphrases heldout, whose vectors are packaged") from None
    return np.asarray(encoders.embed([options.text], encoder, options.weights), np.float32)
