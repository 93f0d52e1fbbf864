"""A second algorithm: random search over linear policies, with nothing of CMRL's.

No gradient, no replay, no latent: what it shares with CMRL are the interfaces. Each iteration plays
one perturbed policy a lane and moves the mean to those that earned most (cross-entropy method).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from cmrl_jax.algorithms.base import Algorithm, RunState
from cmrl_jax.algorithms.common.rollout import episode_figures, rollout
from cmrl_jax.algorithms.rules import AlgorithmRules
from cmrl_jax.config.schema import Config
from envs.base import MetaEnv

ELITE = 8


class Rules(AlgorithmRules):
    """It is told nothing and adapts to nothing."""

    IDLE = ("collect.", "sac.", "kl.", "model.", "encoder.")


class Weights(struct.PyTreeNode):
    """A Gaussian over linear policies: action = tanh(weights @ [obs, 1])."""

    mean: jax.Array
    std: jax.Array


@dataclass(frozen=True)
class LinearAgent:
    """Acts with the mean; a lane's memory is a number that nothing reads."""

    adapts = False
    explores = False
    chunk = 1

    def init(self, told: Any) -> Any:
        return jnp.zeros(told.task_row.shape)

    def begin_episode(
        self, params: Any, memory: Any, source: Any, keys: jax.Array, exploit: jax.Array
    ) -> Any:
        return memory

    def act(
        self, params: Any, memory: Any, obs: jax.Array, noise: jax.Array, deterministic: Any
    ) -> jax.Array:
        return action_of(params.mean, obs)

    def observe(self, params: Any, memory: Any, transitions: Any, mask: jax.Array) -> Any:
        return memory


def action_of(weights: jax.Array, obs: jax.Array) -> jax.Array:
    """Actions (lane, act) of weights (act, obs + 1), or (lane, act, obs + 1)."""
    seen = jnp.concatenate([obs, jnp.ones((len(obs), 1))], -1)
    return jnp.tanh(jnp.einsum("...ij,...j->...i", weights, seen))


def make(config: Config, env: MetaEnv, goal_vectors: jax.Array) -> Algorithm:
    """The algorithm of a configuration: `collect.lanes` policies an iteration, one task."""
    [task] = config.tasks.train
    lanes, horizon = config.collect.lanes, config.env.horizon
    shape = env.action_size, env.observation_size + 1

    def init(key: jax.Array) -> RunState:
        weights = Weights(jnp.zeros(shape), jnp.ones(shape))
        return RunState(weights, (), (), key, jnp.zeros((), jnp.int32))

    def iteration(run: RunState) -> tuple[RunState, dict[str, jax.Array]]:
        k_weights, k_reset, k_play, key = jax.random.split(run.key, 4)
        noise = jax.random.normal(k_weights, (lanes, *shape))
        weights = run.learner.mean + run.learner.std * noise
        ids = jnp.full(lanes, env.tasks.index(task))
        state = jax.vmap(env.reset)(jax.random.split(k_reset, lanes), ids)
        act = lambda obs, key, noise: action_of(weights, obs)
        _, steps, stats = rollout(env, act, state, k_play, horizon, horizon)
        figures = episode_figures(steps.reward, stats, steps.terminated)
        best = weights[jnp.argsort(-figures.returns)[:ELITE]]
        learner = Weights(jnp.mean(best, 0), jnp.std(best, 0) + 0.02)
        metrics = {
            "success_any": jnp.mean(figures.success_any, dtype=jnp.float32)[None],
            "return": jnp.mean(figures.returns)[None],
        }
        run = run.replace(learner=learner, key=key, iteration=run.iteration + 1)
        return run, metrics

    return Algorithm(
        agents={"none": LinearAgent()},
        init=init,
        make_iteration=lambda goals: iteration,
        policy_params=lambda run: run.learner,
        gradient_steps=lambda run: jnp.zeros((), jnp.int32),
    )
