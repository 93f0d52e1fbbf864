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
from flax import struct

from cmrl_jax import parallel
from cmrl_jax.algorithms.cmrl.diagnostics import make_diagnose
from cmrl_jax.algorithms.cmrl.learner import Learner, TrainState
from cmrl_jax.algorithms.common import replay as rings
from cmrl_jax.algorithms.common.replay import ReplayState, Transition
from cmrl_jax.algorithms.common.rollout import correlated_noise, rollout
from cmrl_jax.config.schema import Config, lane_groups, lanes_per_task
from cmrl_jax.nn import normalizers
from envs.sawyer import ACTION_SIZE, OBS_SIZE, Ml4Env, State
from envs.tasks import task_id

LATE_STEPS = 50  # the last steps of an episode, whose mean reward shows the grip-and-wait optimum
Z_SOURCES = ("prior", "text", "posterior")


class RunState(struct.PyTreeNode):
    """Everything that flows from one iteration to the next."""

    learner: TrainState
    replay: ReplayState
    context: ReplayState
    key: jax.Array
    iteration: jax.Array  # () int32, iterations done


TrainIteration = Callable[[RunState], tuple[RunState, dict[str, jax.Array]]]


def init_run(config: Config, learner: Learner, key: jax.Array) -> RunState:
    """The state before iteration 0."""
    k_init, key = jax.random.split(key)
    tasks, lanes = len(config.tasks.train), lanes_per_task(config)
    writers = lane_groups(config)[0] if config.collect.context_lanes == "prior" else lanes
    return RunState(
        learner=learner.init(k_init),
        replay=rings.init_replay(tasks, config.train.capacity, lanes, OBS_SIZE, ACTION_SIZE),
        context=rings.init_context(
            tasks,
            config.collect.context_episodes,
            config.env.horizon,
            writers,
            OBS_SIZE,
            ACTION_SIZE,
        ),
        key=key,
        iteration=jnp.zeros((), jnp.int32),
    )


def make_train_iteration(
    config: Config,
    env: Ml4Env,
    learner: Learner,
    goal_vectors: jax.Array,
    placements: jax.Array | None,
    freeze_statistics: bool = False,
    learn_at_once: bool = False,
) -> TrainIteration:
    """Builds the iteration of a validated configuration.

    Args:
        goal_vectors: text vectors of the training tasks (task, paraphrase, G).
        placements: fixture placements (task, goal, 3) to draw from at a reset
            (`env.variation: fixed_50`); None draws from Meta-World's reset box.
        freeze_statistics: keep the statistics of observations and returns as they are.
        learn_at_once: iteration 0 makes gradient steps, as every later one.

    Returns:
        (RunState) -> RunState, metrics. Without `learn_at_once` iteration 0 makes no gradient step,
        and its losses are NaN. Metrics are float32, () or one value a training task (task,).
    """
    collect, horizon = config.collect, config.env.horizon
    num_tasks, per_task = len(config.tasks.train), lanes_per_task(config)
    lanes = num_tasks * per_task
    env_task = jnp.repeat(jnp.array([task_id(name) for name in config.tasks.train]), per_task)
    train_task = jnp.repeat(jnp.arange(num_tasks), per_task)  # (lane,) row of the rings
    groups = lane_groups(config)
    source = np.tile(np.repeat(np.arange(3), groups), num_tasks)  # (lane,) index of Z_SOURCES
    noise_scale = make_noise_scale(config)
    writers = groups[0] if collect.context_lanes == "prior" else per_task
    inference = learner.inference
    diagnose = make_diagnose(config, learner, goal_vectors)

    def by_task(x: jax.Array) -> jax.Array:
        """(time, lane, ...) -> (time, task, lane of the task, ...)."""
        return x.reshape(x.shape[0], num_tasks, per_task, *x.shape[2:])

    def draw_conditioning(run: RunState, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Each lane's zc for the episode, and where it really came from (lane,)."""
        if inference is None:
            return learner.task_conditioning(train_task), jnp.zeros((lanes,), jnp.int32)
        k_paraphrase, k_context, k_z = jax.random.split(key, 3)
        n = config.encoder.context_max
        ring = run.replay if collect.context_source == "all" else run.context
        context = rings.sample_transitions(ring, k_context, train_task, n)  # (lane, n, ...)
        stats = run.learner.obs_stats
        context = replace(
            context,
            obs=learner.normalize_obs(stats, context.obs),
            next_obs=learner.normalize_obs(stats, context.next_obs),
        )
        # An empty ring leaves a posterior lane with the text, or with the prior without text.
        fallback = 1 if inference.has_goal_factor else 0
        actual = jnp.where(source == 2, jnp.where(ring.size > 0, 2, fallback), source)
        paraphrase = jax.random.randint(k_paraphrase, (lanes,), 0, goal_vectors.shape[1])
        posterior = inference.posterior(
            run.learner.encoder_params,
            context,
            jnp.broadcast_to((actual == 2)[:, None], (lanes, n)),
            goal_vectors[train_task, paraphrase],
            (actual >= 1).astype(jnp.float32),
        )
        return inference.sample_z(k_z, posterior), actual

    def reset_lanes(key: jax.Array) -> State:
        lane_key = jax.vmap(lambda lane: jax.random.fold_in(key, lane))(jnp.arange(lanes))
        if placements is None:
            return parallel.by_part(jax.vmap(env.reset))(lane_key, env_task)
        goals = placements.shape[1]
        goal = jax.vmap(lambda k: jax.random.randint(k, (), 0, goals))(lane_key)
        return parallel.by_part(jax.vmap(env.reset_to))(env_task, placements[train_task, goal])

    @jax.jit  # so that `skip_steps`, which only asks for shapes, does not trace it once more
    def train_steps(run: RunState, key: jax.Array) -> tuple[RunState, dict[str, jax.Array]]:
        """The chunk's gradient steps; metrics are their means."""

        def step(state: TrainState, key: jax.Array):
            return learner.update(state, run.replay, run.context, key)

        keys = jax.random.split(key, collect.chunk * collect.updates_per_vector_step)
        state, metrics = jax.lax.scan(step, run.learner, keys)
        mean = {name: jnp.nanmean(value, 0) for name, value in metrics.items()}
        return run.replace(learner=state), mean

    def skip_steps(run: RunState, key: jax.Array) -> tuple[RunState, dict[str, jax.Array]]:
        _, metrics = jax.eval_shape(train_steps, run, key)
        return run, jax.tree.map(lambda x: jnp.full(x.shape, jnp.nan, x.dtype), metrics)

    def train_iteration(run: RunState) -> tuple[RunState, dict[str, jax.Array]]:
        is_first = run.iteration == 0
        random_actions = is_first & (collect.initial == "random")
        k_z, k_reset, k_noise, k_chunks, k_diagnose, key = jax.random.split(run.key, 6)
        zc, actual_source = draw_conditioning(run, k_z)

        noise = noise_scale(k_noise)[:, None] * correlated_noise(
            k_noise, horizon, (lanes, ACTION_SIZE), collect.noise_correlation
        )
        noise = noise.reshape(-1, collect.chunk, lanes, ACTION_SIZE)

        def chunk(carry: tuple[RunState, State], inputs: tuple[jax.Array, jax.Array]):
            run, state = carry
            key, chunk_noise = inputs
            k_act, k_update = jax.random.split(key)
            state, transitions, stats = rollout(
                env,
                learner,
                (run.learner.actor_params, run.learner.obs_stats),
                state,
                zc,
                k_act,
                collect.chunk,
                horizon,
                random_actions=random_actions,
                noise=chunk_noise,
            )
            run = store(run, jax.tree.map(by_task, parallel.gather(transitions)))
            if learn_at_once:
                run, metrics = train_steps(run, k_update)
            else:
                run, metrics = jax.lax.cond(is_first, skip_steps, train_steps, run, k_update)
            return (run, state), (metrics, transitions.reward, stats)

        run = run.replace(key=key)
        keys = jax.random.split(k_chunks, horizon // collect.chunk)
        (run, state), (metrics, reward, stats) = jax.lax.scan(
            chunk, (run, reset_lanes(k_reset)), (keys, noise)
        )
        metrics = {name: jnp.mean(value, 0) for name, value in metrics.items()}
        flat = lambda x: by_task(x.reshape(horizon, lanes))  # (time, task, lane)
        metrics |= episode_metrics(flat(reward), flat(stats.success), flat(stats.distance))
        if inference is not None:
            for index, name in enumerate(Z_SOURCES):
                metrics[f"episodes_{name}"] = jnp.sum(actual_source == index).astype(jnp.float32)
        metrics["physics_faults"] = jnp.sum(state.faults).astype(jnp.float32)
        denominator = normalizers.reward_denominator(run.learner.return_stats, config.sac)
        metrics["reward_denominator"] = denominator
        metrics |= diagnose(run.learner, run.replay, run.context, k_diagnose)
        return run.replace(iteration=run.iteration + 1), metrics

    def store(run: RunState, transitions: Transition) -> RunState:
        """A chunk (time, task, lane, ...) into rings and running statistics."""
        state = run.learner
        if not freeze_statistics:
            state = with_statistics(state, transitions)
        eligible = jax.tree.map(lambda x: x[:, :, :writers], transitions)
        return run.replace(
            learner=state,
            replay=rings.add(run.replay, transitions),
            context=rings.add(run.context, eligible),
        )

    def with_statistics(state: TrainState, transitions: Transition) -> TrainState:
        return replace(
            state,
            obs_stats=normalizers.update_obs_stats(state.obs_stats, transitions.obs),
            return_stats=normalizers.update_return_stats(
                state.return_stats, transitions.reward, transitions.first, config.sac.gamma
            ),
        )

    return train_iteration


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


def episode_metrics(
    reward: jax.Array, success: jax.Array, distance: jax.Array
) -> dict[str, jax.Array]:
    """Figures of finished episodes per task, (task,), from (time, task, lane) arrays."""
    return {
        "success_any": jnp.mean(jnp.any(success, 0), -1, dtype=jnp.float32),
        "success_last": jnp.mean(success[-1], -1, dtype=jnp.float32),
        "return": jnp.mean(jnp.sum(reward, 0), -1),
        "late_reward": jnp.mean(reward[-LATE_STEPS:], (0, 2)),
        "final_distance": jnp.mean(distance[-1], -1),
    }


def metric_names(metrics: dict[str, Any], tasks: tuple[str, ...]) -> list[str]:
    """Columns of metrics.csv for one iteration's metrics: `train/x`, or `train/<task>/x`."""
    names = []
    for name, value in metrics.items():
        per_task = [f"train/{task}/{name}" for task in tasks]
        names += per_task if len(value.shape) else [f"train/{name}"]
    return names


def metric_row(metrics: dict[str, Any], tasks: tuple[str, ...]) -> dict[str, float | None]:
    """Host figures of one iteration's metrics; NaN (no gradient step yet) becomes None."""
    row: dict[str, float | None] = {}
    for name, value in metrics.items():
        values = np.atleast_1d(np.asarray(value))
        for column, figure in zip(metric_names({name: value}, tasks), values, strict=True):
            row[column] = None if np.isnan(figure) else float(figure)
    return row
