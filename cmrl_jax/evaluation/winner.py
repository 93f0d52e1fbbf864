"""Search before fine-tuning: the first episodes choose the arm that it goes on from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from cmrl_jax.algorithms.cmrl.search import BUDGET, SearchAgent
from cmrl_jax.evaluation.finetune import Score, Winner, mean_score
from cmrl_jax.evaluation.finetune_options import FinetuneOptions
from cmrl_jax.evaluation.options import EvalOptions
from cmrl_jax.evaluation.session import Policy, Session
from cmrl_jax.evaluation.trials import trial_of


def search_winner(
    session: Session,
    policy: Policy,
    options: FinetuneOptions,
    say: Callable[[int, Score], None],
) -> Winner:
    """Searches by the task protocol, as `eval --adapt search --protocol task` does.

    Args:
        session: of the run.
        say: is given each read-out until the search ends: episodes before it, and its score.
    """
    agent: Any = session.agent_of("search")
    assert isinstance(agent, SearchAgent)
    spent = min(BUDGET, options.episodes)
    counted = sorted({spent, *(k for k in options.read_outs if k < spent)})
    asked = EvalOptions(
        k=tuple(counted),
        tasks=(options.task,),
        goals=options.goals,
        goal_set=options.goal_set,
        seed=options.seed,
        adapt="search",
        protocol="task",
    )
    trial = trial_of([policy], session, asked, (options.task,))
    evaluator = session.evaluator(options.goals, adapt="search")
    last: Any = None
    for played in evaluator.episodes(
        [policy.params], trial, spent + 1, options.seed, counted=counted
    ):
        if played.is_counted:
            say(played.number, mean_score(played.score))
            last = played.after  # every lane's is the task's one search
    return Winner(jnp.asarray(last.z[0, 0]), *agent.matrices(int(last.arm[0, 0])))
