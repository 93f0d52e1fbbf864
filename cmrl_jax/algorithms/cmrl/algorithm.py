"""CMRL as an entry of the registry: learner, agent and training iteration of one configuration.

PEARL, MTSAC and SAC are configurations of it.
"""

from __future__ import annotations

import jax

from cmrl_jax.algorithms.base import Agent, Algorithm, RunState, iteration_alone
from cmrl_jax.algorithms.cmrl.agent import CmrlAgent, make_policy_params
from cmrl_jax.algorithms.cmrl.collect import TrainIteration, init_run
from cmrl_jax.algorithms.cmrl.learner import Learner
from cmrl_jax.algorithms.cmrl.search import ArmsInTurn, SearchAgent
from cmrl_jax.config.schema import Config
from envs.base import MetaEnv

RINGS = ("replay", "context")  # of a RunState


def make(config: Config, env: MetaEnv, goal_vectors: jax.Array) -> Algorithm:
    """The algorithm of a configuration; its `parts` are the `Learner`.

    Args:
        goal_vectors: text vectors of the training tasks (task, paraphrase, G).
    """
    learner = Learner(config, goal_vectors, env.observation_size, env.action_size)

    def make_iteration(goals: jax.Array | None) -> TrainIteration:
        return TrainIteration(config, env, learner, goal_vectors, goals)

    def gradient_steps(run: RunState) -> jax.Array:
        return run.learner.gradient_steps

    def in_step(run: RunState) -> RunState:
        same = iteration_alone(run)
        rings = {name: getattr(same, name).replace(index=True, size=True) for name in RINGS}
        return same.replace(**rings)

    agents: dict[str, Agent] = {"posterior": CmrlAgent(learner, config.collect.chunk)}
    if learner.inference is not None:
        seen = env.symmetries, env.reaches
        agents["search"] = SearchAgent(learner, config.collect.chunk, *seen)
        agents["arms"] = ArmsInTurn(learner, config.collect.chunk, *seen)
    return Algorithm(
        agents=agents,
        init=lambda key: init_run(config, env, learner, key),
        make_iteration=make_iteration,
        policy_params=make_policy_params(learner),
        gradient_steps=gradient_steps,
        in_step=in_step,
        parts=learner,
    )
