"""One training iteration as a jittable function: whole episodes, interleaved with gradient steps.

Episodes begin and end inside an iteration, so no physics state crosses its border. Inside, chunks
of control steps alternate with gradient steps on the rings just written. Per task the lanes are
split into groups by where their z comes from: prior, text, posterior over the task's context ring.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cmrl_jax import parallel
from cmrl_jax.algorithms.base import RunState
from cmrl_jax.algorithms.cmrl.diagnostics import make_diagnose
from cmrl_jax.algorithms.cmrl.learner import Learner
from cmrl_jax.algorithms.cmrl.rules import context_writers, lane_groups
from cmrl_jax.algorithms.cmrl.train_state import TrainState
from cmrl_jax.algorithms.common import replay as rings
from cmrl_jax.algorithms.common.replay import Transition
from cmrl_jax.algorithms.common.rollout import (
    StepStats,
    correlated_noise,
    episode_figures,
    keys_of,
    make_reset,
    rollout,
)
from cmrl_jax.config.schema import Config, lanes_per_task
from cmrl_jax.nn import normalizers
from envs.base import MetaEnv

LATE_STEPS = 50  # the last steps of an episode, whose mean reward shows the grip-and-wait optimum
LANE_GROUPS = ("prior", "text", "posterior")


def init_run(config: Config, env: MetaEnv, learner: Learner, key: jax.Array) -> RunState:
    """The state before iteration 0."""
    k_init, key = jax.random.split(key)
    tasks, lanes = len(config.tasks.train), lanes_per_task(config)
    sizes = env.observation_size, env.action_size
    episodes, horizon = config.collect.context_episodes, config.env.horizon
    return RunState(
        learner=learner.init(k_init),
        replay=rings.init_replay(tasks, config.train.capacity, lanes, *sizes),
        context=rings.init_context(tasks, episodes, horizon, context_writers(config), *sizes),
        key=key,
        iteration=jnp.zeros((), jnp.int32),
    )


class TrainIteration:
    """The iteration of a validated configuration: (RunState) -> RunState, metrics.

    Metrics are float32, () or one value a training task (task,). Without `learn_at_once` iteration
    0 makes no gradient step, and its losses are NaN.

    Args:
        goal_vectors: text vectors of the training tasks (task, paraphrase, G).
        goals: goals (task, goal, goal_size) to draw from at a reset (`env.variation: fixed_50`);
            None draws by the environment's own `reset`.
        freeze_statistics: keep the statistics of observations and returns as they are.
        learn_at_once: iteration 0 makes gradient steps, as every later one.
    """

    def __init__(
        self,
        config: Config,
        env: MetaEnv,
        learner: Learner,
        goal_vectors: jax.Array,
        goals: jax.Array | None,
        freeze_statistics: bool = False,
        learn_at_once: bool = False,
    ):
        self.__name__ = "train_iteration"  # as profilers and compilation logs show it
        self.config, self.env, self.learner = config, env, learner
        self.goal_vectors = goal_vectors
        self.freeze_statistics, self.learn_at_once = freeze_statistics, learn_at_once
        self.num_tasks, self.per_task = len(config.tasks.train), lanes_per_task(config)
        self.lanes = self.num_tasks * self.per_task
        self.train_task = jnp.repeat(jnp.arange(self.num_tasks), self.per_task)  # row of the rings
        self.reset = make_reset(config, env, goals, self.train_task)
        # (lane,) index of LANE_GROUPS.
        self.source = np.tile(np.repeat(np.arange(3), lane_groups(config)), self.num_tasks)
        self.noise_scale = make_noise_scale(config)
        self.diagnose = make_diagnose(config, learner, goal_vectors)
        # Jitted so that `skip_steps`, which only asks for shapes, does not trace it once more.
        self.train_steps = jax.jit(self._train_steps)

    def __call__(self, run: RunState) -> tuple[RunState, dict[str, jax.Array]]:
        config, env = self.config, self.env
        collect, horizon = config.collect, config.env.horizon
        is_first = run.iteration == 0
        k_z, k_reset, k_noise, k_imposed, k_chunks, k_diagnose, key = jax.random.split(run.key, 7)
        zc, actual_source = self.draw_conditioning(run, k_z)
        shape = (self.lanes, env.action_size)
        noise = self.noise_scale(k_noise)[:, None] * correlated_noise(
            k_noise, horizon, shape, collect.noise_correlation
        )

        imposed = imposed_actions(config, env.action_size, k_imposed, is_first)

        def chunk(carry: tuple[RunState, Any], inputs: Any):
            run, state = carry
            index, key, chunk_noise, chunk_imposed = inputs
            k_act, k_update = jax.random.split(key)
            actor_params, obs_stats = run.learner.actor_params, run.learner.obs_stats

            def act(obs: jax.Array, key: jax.Array, noise: jax.Array | None) -> jax.Array:
                return self.learner.policy(actor_params, obs_stats, obs, zc, key, False, noise)[0]

            state, transitions, stats = rollout(
                env,
                act,
                state,
                k_act,
                collect.chunk,
                horizon,
                begun=index * collect.chunk,
                imposed=chunk_imposed,
                noise=chunk_noise,
                restart=self.reset_lanes,
            )
            run = self.store(run, jax.tree.map(self.by_task, parallel.gather(transitions)))
            if self.learn_at_once:
                run, metrics = self.train_steps(run, k_update)
            else:
                run, metrics = jax.lax.cond(
                    is_first, self.skip_steps, self.train_steps, run, k_update
                )
            return (run, state), (metrics, transitions.reward, transitions.terminated, stats)

        run = run.replace(key=key)
        chunks = horizon // collect.chunk
        in_chunks = lambda tree: jax.tree.map(
            lambda x: x.reshape(chunks, collect.chunk, *x.shape[1:]), tree
        )
        keys = jax.random.split(k_chunks, chunks)
        (run, _), (metrics, reward, terminated, stats) = jax.lax.scan(
            chunk,
            (run, self.reset_lanes(k_reset)),
            (jnp.arange(chunks), keys, *map(in_chunks, (noise, imposed))),
        )
        metrics = {name: jnp.mean(value, 0) for name, value in metrics.items()}
        flat = lambda x: self.by_task(x.reshape(horizon, self.lanes))  # (time, task, lane)
        metrics |= self.episode_metrics(
            flat(reward), StepStats(*map(flat, stats)), flat(terminated)
        )
        if self.learner.inference is not None:
            for index, name in enumerate(LANE_GROUPS):
                metrics[f"episodes_{name}"] = jnp.sum(actual_source == index).astype(jnp.float32)
        metrics["physics_faults"] = jnp.sum(stats.faults).astype(jnp.float32)
        denominator = normalizers.reward_denominator(run.learner.return_stats, config.sac)
        metrics["reward_denominator"] = denominator
        metrics |= self.diagnose(run.learner, run.replay, run.context, k_diagnose)
        return run.replace(iteration=run.iteration + 1), metrics

    def by_task(self, x: jax.Array) -> jax.Array:
        """(time, lane, ...) -> (time, task, lane of the task, ...)."""
        return x.reshape(x.shape[0], self.num_tasks, self.per_task, *x.shape[2:])

    def draw_conditioning(self, run: RunState, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Each lane's zc for the episode, and where it really came from (lane,)."""
        learner, inference, task = self.learner, self.learner.inference, self.train_task
        if inference is None:
            return learner.task_conditioning(task), jnp.zeros((self.lanes,), jnp.int32)
        k_paraphrase, k_context, k_z = jax.random.split(key, 3)
        n = self.config.encoder.context_max
        ring = run.replay if self.config.collect.context_source == "all" else run.context
        context = rings.sample_transitions(ring, k_context, task, n)  # (lane, n, ...)
        # An empty ring leaves a posterior lane with the text, or with the prior without text.
        fallback = 1 if inference.has_goal_factor else 0
        actual = jnp.where(self.source == 2, jnp.where(ring.size > 0, 2, fallback), self.source)
        paraphrase = jax.random.randint(k_paraphrase, (self.lanes,), 0, self.goal_vectors.shape[1])
        posterior = inference.posterior(
            run.learner.encoder_params,
            learner.normalized(run.learner.obs_stats, context),
            jnp.broadcast_to((actual == 2)[:, None], (self.lanes, n)),
            self.goal_vectors[task, paraphrase],
            (actual >= 1).astype(jnp.float32),
        )
        return inference.sample_z(k_z, posterior), actual

    def reset_lanes(self, key: jax.Array) -> Any:
        """A fresh episode of every lane, each by a key of its own."""
        return self.reset(keys_of(key, self.lanes))

    def _train_steps(self, run: RunState, key: jax.Array) -> tuple[RunState, dict[str, jax.Array]]:
        """The chunk's gradient steps; metrics are their means."""
        collect = self.config.collect
        keys = jax.random.split(key, collect.chunk * collect.updates_per_vector_step)
        state, metrics = self.learner.updates(run.learner, run.replay, run.context, keys)
        mean = {name: jnp.nanmean(value, 0) for name, value in metrics.items()}
        return run.replace(learner=state), mean

    def skip_steps(self, run: RunState, key: jax.Array) -> tuple[RunState, dict[str, jax.Array]]:
        """No gradient steps; metrics are NaN."""
        _, metrics = jax.eval_shape(self.train_steps, run, key)
        return run, jax.tree.map(lambda x: jnp.full(x.shape, jnp.nan, x.dtype), metrics)

    def store(self, run: RunState, transitions: Transition) -> RunState:
        """A chunk (time, task, lane, ...) into rings and running statistics."""
        state = run.learner
        if not self.freeze_statistics:
            state = self.with_statistics(state, transitions)
        writers = context_writers(self.config)
        eligible = jax.tree.map(lambda x: x[:, :, :writers], transitions)
        return run.replace(
            learner=state,
            replay=rings.add(run.replay, transitions),
            context=rings.add(run.context, eligible),
        )

    def with_statistics(self, state: TrainState, transitions: Transition) -> TrainState:
        gamma = self.config.sac.gamma
        return replace(
            state,
            obs_stats=normalizers.update_obs_stats(state.obs_stats, transitions.obs),
            return_stats=normalizers.update_return_stats(
                state.return_stats, transitions.reward, transitions.first, gamma
            ),
        )

    def episode_metrics(
        self, reward: jax.Array, stats: StepStats, terminated: jax.Array
    ) -> dict[str, jax.Array]:
        """Means per task of each lane's first episode, from (time, task, lane).

        `late_reward` is of the iteration's last steps, whichever episode they belong to.
        """
        figures = episode_figures(reward, stats, terminated if self.env.can_terminate else None)
        mean = lambda x: jnp.mean(x, -1, dtype=jnp.float32)
        return {
            "success_any": mean(figures.success_any),
            "success_last": mean(figures.success_last),
            "return": mean(figures.returns),
            "late_reward": jnp.mean(reward[-LATE_STEPS:], (0, 2)),
            "final_distance": mean(figures.final_distance),
        }


def make_noise_scale(config: Config) -> Callable[[jax.Array], jax.Array]:
    """How much wider than the policy's own the noise of each lane is: key of an episode -> (lane,).

    Several lanes of a task cover 1 to `collect.noise_scale` in every episode. A single one cannot:
    it draws its scale from that range anew in each, so that over episodes it explores as they do.
    """
    per_task, widest = lanes_per_task(config), config.collect.noise_scale
    lanes = len(config.tasks.train) * per_task
    if per_task == 1:
        return lambda key: widest ** jax.random.uniform(jax.random.fold_in(key, 0), (lanes,))
    # Dealt out so that each group of a task has the whole range of scales.
    shuffled = np.random.default_rng(0).permutation(per_task)
    scale = np.geomspace(1.0, widest, per_task)[shuffled]
    fixed = jnp.asarray(np.tile(scale, lanes // per_task), jnp.float32)
    return lambda key: fixed


def imposed_actions(
    config: Config, action_size: int, key: jax.Array, is_first: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Actions (time, lane, act) in place of the policy's in an iteration, and where (time, lane).

    Iteration 0 may be uniform noise throughout. In any other an episode begins with up to
    `collect.scatter` steps, and half of it at most, of one random action, so that the policy
    learns to go on from wherever they lead to.
    """
    collect, horizon = config.collect, config.env.horizon
    k_uniform, k_push, k_length = jax.random.split(key, 3)
    draw = lambda key, *lead: jax.random.uniform(
        key, (*lead, collect.lanes, action_size), minval=-1.0, maxval=1.0
    )
    most = min(collect.scatter, horizon // 2)
    length = jax.random.randint(k_length, (collect.lanes,), 0, most + 1)
    scattered = jnp.arange(horizon)[:, None] < length
    is_random = is_first & (collect.initial == "random")
    return jnp.where(is_random, draw(k_uniform, horizon), draw(k_push)), scattered | is_random
