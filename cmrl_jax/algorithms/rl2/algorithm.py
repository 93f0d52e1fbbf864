"""RL2 (Duan et al. 2016; Wang et al. 2016) as an entry of the registry.

A recurrent policy is shown its own last action and reward, and its hidden state is carried over the
episodes of a trial: to adapt is to go on.

# NOTES: where it differs from the papers and from what is published of it
1. PPO in place of TRPO (Duan) and A3C (Wang); trials of `rl2.episodes` episodes of one goal.
2. A minibatch is whole trials, and gradients go back through all their steps: no stale hidden state
   and no truncation, as rlworkgroup/garage has it (RL2PPO).
3. Policy and value share the GRU, and both read its input beside its output.
4. Advantages are normalised by training task, and rewards are divided by the task's own denominator
   (`sac.reward_norm`, `sac.return_max`), so that no task is louder than another.
5. A trial is cut by time, so the value of what would follow stands at its end; between episodes
   returns run on.
6. No clipping of the value's loss, and a constant learning rate (Andrychowicz et al. 2021).
7. Actions are tanh of a Gaussian (gaussian_policy.py).
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
    keys_of,
    make_reset,
    rollout,
    select_lanes,
)
from cmrl_jax.algorithms.rl2.agent import Memory, Rl2Agent
from cmrl_jax.algorithms.rl2.learner import Learner, LearnerState, Trials
from cmrl_jax.config.schema import Config, lanes_per_task
from cmrl_jax.nn import normalizers
from cmrl_jax.nn.gaussian_policy import log_prob
from cmrl_jax.nn.recurrent import RecurrentActorCritic
from envs.base import MetaEnv


class Step(NamedTuple):
    """A control step of all lanes, (lane, ...)."""

    obs: jax.Array
    inputs: jax.Array
    u: jax.Array
    log_prob: jax.Array
    value: jax.Array
    reward: jax.Array
    mask: jax.Array
    terminated: jax.Array
    stats: StepStats


def make(config: Config, env: MetaEnv, goal_vectors: jax.Array) -> Algorithm:
    """The algorithm of a configuration; it reads no text."""
    del goal_vectors
    rl2, tasks = config.rl2, len(config.tasks.train)
    net = RecurrentActorCritic(rl2.width, rl2.hidden, env.action_size, config.ppo.std_init)
    agent = Rl2Agent(net, rl2.reward_scale)
    learner = Learner(config, net)

    def init(key: jax.Array) -> RunState:
        k_net, key = jax.random.split(key)
        memory = agent.blank((1,))
        stats = normalizers.init_obs_stats(env.observation_size)
        shown = agent.inputs(stats, memory, jnp.zeros((1, env.observation_size)))
        params = net.init(k_net, memory.hidden, shown)
        state = LearnerState(
            params=params,
            opt_state=learner.optimizer.init(params),
            obs_stats=stats,
            return_stats=normalizers.init_return_stats(tasks, lanes_per_task(config)),
            gradient_steps=jnp.zeros((), jnp.int32),
        )
        return RunState(state, (), (), key, jnp.zeros((), jnp.int32))

    def make_iteration(goals: jax.Array | None) -> TrainIteration:
        return Iteration(config, env, agent, learner, goals)

    return Algorithm(
        agents={"hidden-state": agent},
        init=init,
        make_iteration=make_iteration,
        policy_params=lambda run: PolicyParams(run.learner.params, run.learner.obs_stats),
        gradient_steps=lambda run: run.learner.gradient_steps,
        parts=learner,
    )


class Iteration:
    """The iteration of a validated configuration: a trial of every lane, then PPO on all of them.

    Args:
        goals: see `Algorithm.make_iteration`.
    """

    def __init__(
        self,
        config: Config,
        env: MetaEnv,
        agent: Rl2Agent,
        learner: Learner,
        goals: jax.Array | None,
    ):
        self.__name__ = "train_iteration"  # as profilers and compilation logs show it
        self.config, self.env, self.agent, self.learner = config, env, agent, learner
        self.tasks, self.per_task = len(config.tasks.train), lanes_per_task(config)
        self.lanes = config.collect.lanes
        self.task = jnp.repeat(jnp.arange(self.tasks), self.per_task)
        self.reset = make_reset(config, env, goals, self.task)

    def __call__(self, run: RunState) -> tuple[RunState, dict[str, jax.Array]]:
        k_trial, k_update, key = jax.random.split(run.key, 3)
        state = run.learner
        params = PolicyParams(state.params, state.obs_stats)
        memory, steps = self.trial(params, k_trial)  # (episode, time, lane, ...)
        state = self.with_statistics(state, steps)
        trials = self.trials_of(state, params, memory, steps)
        state, metrics = self.learner.update(state, trials, k_update)
        last = jax.tree.map(lambda x: x[-1], steps)
        first = jax.tree.map(lambda x: x[0], steps)
        metrics |= self.figures(last) | {
            "success_first": self.figures(first)["success_any"],
            "physics_faults": jnp.sum(steps.stats.faults).astype(jnp.float32),
            "reward_denominator": self.denominator(state),
        }
        run = run.replace(learner=state, key=key, iteration=run.iteration + 1)
        return run, metrics

    def trial(self, params: PolicyParams, key: jax.Array) -> tuple[Memory, Step]:
        """Episodes of one goal a lane, one after another: memories after them, all steps."""
        k_reset, key = jax.random.split(key)
        starts = keys_of(k_reset, self.lanes)

        def episode(memory: Memory, key: jax.Array):
            memory = memory.replace(start=jnp.ones(self.lanes))
            carry = self.reset(starts), memory, jnp.zeros(self.lanes, bool)
            times = jnp.arange(self.config.env.horizon)
            step = lambda carry, time: self.step(params, carry, time, jax.random.fold_in(key, time))
            (_, memory, _), steps = jax.lax.scan(step, carry, times)
            return memory, steps

        keys = jax.random.split(key, self.config.rl2.episodes)
        return jax.lax.scan(episode, self.agent.blank((self.lanes,)), keys)

    def step(self, params: PolicyParams, carry: Any, time: jax.Array, key: jax.Array):
        """A control step of every lane; those whose episode has ended stand still."""
        state, memory, ended = carry
        k_noise, k_env = jax.random.split(key)
        hidden, (head, value) = self.agent.step(params, memory, state.obs)
        noise = jax.random.normal(k_noise, (self.lanes, self.env.action_size))
        u = head.mean + jnp.exp(head.log_std) * noise
        new, transitions, stats = rollout(
            self.env,
            lambda obs, key, noise: jnp.tanh(u),
            state,
            k_env,
            steps=1,
            horizon=self.config.env.horizon,
            begun=time,
        )
        transition, stats = jax.tree.map(lambda x: x[0], (transitions, stats))
        record = Step(
            obs=state.obs,
            inputs=self.agent.inputs(params.obs_stats, memory, state.obs),
            u=u,
            log_prob=log_prob(head, u),
            value=value,
            reward=transition.reward,
            mask=~ended,
            terminated=transition.terminated,
            stats=stats,
        )
        seen = memory.after(hidden, transition.action, transition.reward)
        memory = select_lanes(~ended, seen, memory)
        return (new, memory, ended | transition.terminated), record

    def trials_of(
        self, state: LearnerState, params: PolicyParams, memory: Memory, steps: Step
    ) -> Trials:
        """What PPO learns from: rewards in units of the task, episodes one after another."""
        flat = lambda x: x.reshape(-1, *x.shape[2:])
        reward = steps.reward / self.denominator(state)[self.task]
        # What would follow: one more episode, which begins as the last one did.
        again = memory.replace(start=jnp.ones(self.lanes))
        _, (_, last_value) = self.agent.step(params, again, steps.obs[-1, 0])
        found = map(flat, (steps.inputs, steps.u, steps.log_prob, steps.value, reward, steps.mask))
        return Trials(*found, last_value=last_value)

    def denominator(self, state: LearnerState) -> jax.Array:
        """What rewards are divided by, (task,)."""
        return normalizers.reward_denominator(state.return_stats, self.config.sac)

    def with_statistics(self, state: LearnerState, steps: Step) -> LearnerState:
        """The running statistics with a trial's steps; a new episode has returns of its own."""
        horizon = self.config.env.horizon
        episodes = steps.reward.shape[0]
        reward = steps.reward.reshape(episodes * horizon, self.tasks, self.per_task)
        first = jnp.tile(jnp.arange(horizon) == 0, episodes)[:, None, None]
        return state.replace(
            obs_stats=normalizers.update_obs_stats(state.obs_stats, steps.obs),
            return_stats=normalizers.update_return_stats(
                state.return_stats,
                reward,
                jnp.broadcast_to(first, reward.shape),
                self.config.ppo.gamma,
            ),
        )

    def figures(self, steps: Step) -> dict[str, jax.Array]:
        """Means by task of an episode (time, lane)."""
        terminated = steps.terminated if self.env.can_terminate else None
        return figures_by_task(steps.reward, steps.stats, terminated, self.tasks)
