"""MAML (Finn et al. 2017) as an entry of the registry, with ProMP's inner gradient.

Parameters are sought from which a policy gradient on a few own episodes leads to a good policy of
whatever task it is: to adapt is to take inner steps.

# NOTES: where it differs from the papers and from what is published of them
1. The inner objective is the likelihood ratio times the advantage, whose second derivatives are
   unbiased (ProMP, Rothfuss et al. 2019); the log-likelihood form that MAML's first code
   differentiates twice is not.
2. The outer step is PPO's, `ppo.epochs` times on all groups at once, in place of TRPO; inner steps
   are taken anew in each from the same episodes, with a KL penalty of fixed weight on how far the
   collecting policies have moved (ProMP, equation 11, likewise).
3. A group is `maml.episodes` lanes of one task on one goal, an episode each.
4. Advantages are normalised over a group, so that no task is louder than another.
5. Actions are tanh of a Gaussian (gaussian_policy.py), and its log standard deviation takes part in
   inner steps.
6. What has no time in it can still tell it: the baseline reads it (baseline.py), the policy does
   not. The return of an episode ends with it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cmrl_jax.algorithms.base import Algorithm, RunState, TrainIteration
from cmrl_jax.algorithms.common.figures import figures_by_task
from cmrl_jax.algorithms.common.policy_gradient import PolicyParams
from cmrl_jax.algorithms.common.rollout import (
    StepStats,
    is_before_the_end,
    keys_of,
    make_reset,
    rollout,
)
from cmrl_jax.algorithms.maml.agent import MamlAgent
from cmrl_jax.algorithms.maml.inner import Episodes, InnerStep
from cmrl_jax.algorithms.maml.learner import Learner, LearnerState
from cmrl_jax.config.schema import Config, lanes_per_task
from cmrl_jax.nn import normalizers
from cmrl_jax.nn.gaussian_policy import Head, MlpPolicy, pre_tanh
from envs.base import MetaEnv


class Phase(NamedTuple):
    """An episode of every lane, (group, episode, time, ...) and for the figures (time, lane)."""

    episodes: Episodes
    obs: jax.Array
    reward: jax.Array
    terminated: jax.Array
    stats: StepStats


def make(config: Config, env: MetaEnv, goal_vectors: jax.Array) -> Algorithm:
    """The algorithm of a configuration; it reads no text."""
    del goal_vectors
    policy = MlpPolicy(config.maml.hidden, env.action_size, config.ppo.std_init)
    inner = InnerStep(config, policy)
    learner = Learner(inner)

    def init_params(key: jax.Array) -> Any:
        return policy.init(key, jnp.zeros((1, env.observation_size)))

    def init(key: jax.Array) -> RunState:
        k_net, key = jax.random.split(key)
        params = init_params(k_net)
        state = LearnerState(
            params=params,
            opt_state=learner.optimizer.init(params),
            obs_stats=normalizers.init_obs_stats(env.observation_size),
            gradient_steps=jnp.zeros((), jnp.int32),
        )
        return RunState(state, (), (), key, jnp.zeros((), jnp.int32))

    def make_iteration(goals: jax.Array | None) -> TrainIteration:
        return Iteration(config, env, learner, goals)

    shapes = jax.eval_shape(init_params, jax.random.key(0))
    return Algorithm(
        agents={"inner-steps": MamlAgent(inner, shapes, env.observation_size, env.action_size)},
        init=init,
        make_iteration=make_iteration,
        policy_params=lambda run: PolicyParams(run.learner.params, run.learner.obs_stats),
        gradient_steps=lambda run: run.learner.gradient_steps,
        parts=learner,
    )


class Iteration:
    """The iteration of a validated configuration: episodes, inner steps, episodes, outer steps.

    Args:
        goals: see `Algorithm.make_iteration`.
    """

    def __init__(self, config: Config, env: MetaEnv, learner: Learner, goals: jax.Array | None):
        self.__name__ = "train_iteration"  # as profilers and compilation logs show it
        self.config, self.env, self.learner, self.inner = config, env, learner, learner.inner
        self.tasks, self.lanes = len(config.tasks.train), config.collect.lanes
        self.groups = self.lanes // config.maml.episodes
        task = jnp.repeat(jnp.arange(self.tasks), lanes_per_task(config))
        self.reset = make_reset(config, env, goals, task)

    def __call__(self, run: RunState) -> tuple[RunState, dict[str, jax.Array]]:
        k_phases, key = jax.random.split(run.key)
        state = run.learner
        phases = self.phases(PolicyParams(state.params, state.obs_stats), k_phases)
        by_group = jax.tree.map(lambda x: jnp.swapaxes(x[:-1], 0, 1), phases.episodes)
        outer = jax.tree.map(lambda x: x[-1], phases.episodes)
        state, metrics = self.learner.update(state, by_group, outer)
        stats = normalizers.update_obs_stats(state.obs_stats, phases.obs)
        first, last = (jax.tree.map(lambda x, at=at: x[at], phases) for at in (0, -1))
        before = self.figures(first)
        metrics |= self.figures(last) | {
            "success_before": before["success_any"],
            "return_before": before["return"],
            "physics_faults": jnp.sum(phases.stats.faults).astype(jnp.float32),
        }
        state = state.replace(obs_stats=stats)
        return run.replace(learner=state, key=key, iteration=run.iteration + 1), metrics

    def phases(self, params: PolicyParams, key: jax.Array) -> Phase:
        """An episode of every lane before each inner step and after the last (phase, ...)."""
        k_reset, key = jax.random.split(key)
        starts = jnp.repeat(keys_of(k_reset, self.groups), self.config.maml.episodes)

        def phase(group_params: Any, key: jax.Array):
            found = self.phase(params.obs_stats, group_params, starts, key)
            return jax.vmap(self.inner)(group_params, found.episodes), found

        same = jax.tree.map(lambda x: jnp.repeat(x[None], self.groups, 0), params.params)
        keys = jax.random.split(key, self.config.maml.inner_steps + 1)
        return jax.lax.scan(phase, same, keys)[1]

    def phase(self, obs_stats: Any, group_params: Any, starts: jax.Array, key: jax.Array) -> Phase:
        """One episode of every lane, each acted on its group's parameters (group, ...)."""
        k_noise, k_env = jax.random.split(key)
        horizon = self.config.env.horizon
        of_group = lambda x: x.reshape(self.groups, -1, *x.shape[1:])

        def head_of(obs: jax.Array) -> Head:
            shown = of_group(normalizers.normalize_obs(obs_stats, obs))
            head = jax.vmap(self.inner.head)(group_params, shown)
            log_std = jnp.broadcast_to(head.log_std[:, None], head.mean.shape)
            return Head(*(x.reshape(self.lanes, -1) for x in (head.mean, log_std)))

        def act(obs: jax.Array, _: Any, noise: Any) -> jax.Array:
            head = head_of(obs)
            return jnp.tanh(head.mean + jnp.exp(head.log_std) * noise)

        noise = jax.random.normal(k_noise, (horizon, self.lanes, self.env.action_size))
        _, steps, stats = rollout(
            self.env, act, self.reset(starts), k_env, horizon, horizon, noise=noise
        )
        by_group = lambda x: of_group(jnp.swapaxes(x, 0, 1))
        head = jax.lax.map(head_of, steps.obs)
        episodes = Episodes(
            obs=by_group(normalizers.normalize_obs(obs_stats, steps.obs)),
            u=by_group(pre_tanh(steps.action)),
            reward=by_group(steps.reward),
            mask=by_group(is_before_the_end(steps.terminated)),
            head=jax.tree.map(by_group, head),
        )
        return Phase(episodes, steps.obs, steps.reward, steps.terminated, stats)

    def figures(self, phase: Phase) -> dict[str, jax.Array]:
        """Means by task of a phase's episodes."""
        terminated = phase.terminated if self.env.can_terminate else None
        return figures_by_task(phase.reward, phase.stats, terminated, self.tasks)
