"""The learner: its state, and one gradient step as a pure function.

`make_learner` returns pure functions closed over the configuration; the caller scans `update`.
Order of a step (as in oyster): critics and encoder, actor, temperature, target networks.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from cmrl_jax import parallel
from cmrl_jax.algorithms.cmrl.objectives import (
    ActorSide,
    CriticSide,
    Metrics,
    Minibatch,
    Objectives,
    make_objectives,
)
from cmrl_jax.algorithms.common import replay
from cmrl_jax.config.schema import Config, lanes_per_task
from cmrl_jax.nn import normalizers
from cmrl_jax.nn.context import ContextInference, context_mask, make_context_inference
from cmrl_jax.nn.distributions import sample_tanh_gaussian
from cmrl_jax.nn.networks import Networks, Params, Routing, make_networks
from cmrl_jax.nn.optimizers import adam_step, init_adam, polyak


@struct.dataclass
class TrainState:
    """Everything that is learned or counted; a field that the configuration lacks is None.

    Attributes:
        critic_params, target_critic_params: leading axis 2 on every leaf, the twin critics.
        value_params, target_value_params: the V network of `sac.variant: v`.
        encoder_params: None unless `model.conditioning` is z.
        log_alpha: log temperature of every training task, (T,).
        obs_stats, return_stats: running statistics (normalizers.py), updated by collection.
        gradient_steps: gradient steps applied, int32; exact below 2^31, where it stands still.
        skipped_updates: gradient steps dropped for a non-finite gradient, int32.
    """

    actor_params: Params
    critic_params: Params
    target_critic_params: Params | None
    value_params: Params | None
    target_value_params: Params | None
    encoder_params: Params | None
    log_alpha: jax.Array
    actor_opt_state: Any
    critic_opt_state: Any
    value_opt_state: Any
    encoder_opt_state: Any
    alpha_opt_state: Any
    obs_stats: Any
    return_stats: Any
    gradient_steps: jax.Array
    skipped_updates: jax.Array


@dataclass(frozen=True)
class Learner:
    """Pure functions of one configuration.

    Attributes:
        networks, objectives: what the learner is made of.
        inference: context inference, None unless `model.conditioning` is z.
        init: key -> TrainState.
        update: (TrainState, replay_state, context_state, key) -> TrainState, metrics; one
            gradient step. Metrics are float32, () or (T,); with `sac.task_rows` a task that was
            not drawn has NaN.
        task_losses: (TrainState, replay_state, context_state, key) -> a function of the critics'
            parameters: the TD loss of every training task on one minibatch, (T,).
        policy: (actor_params, obs_stats, obs (lane, obs) raw, zc (lane, conditioning), key,
            deterministic, noise=None) -> action (lane, act), Routing or None. `noise` (lane, act),
            standard normal, takes the place of a draw from `key`.
        normalize_obs: (obs_stats, obs (..., obs)) -> (..., obs); the identity by configuration.
        task_conditioning: task ids (lane,) -> zc (lane, conditioning) where it is no latent.
    """

    networks: Networks
    objectives: Objectives
    inference: ContextInference | None
    init: Callable[[jax.Array], TrainState]
    update: Callable[[TrainState, Any, Any, jax.Array], tuple[TrainState, Metrics]]
    task_losses: Callable[[TrainState, Any, Any, jax.Array], Callable[[Params], jax.Array]]
    policy: Callable[..., tuple[jax.Array, Routing | None]]
    normalize_obs: Callable[[Any, jax.Array], jax.Array]
    task_conditioning: Callable[[jax.Array], jax.Array]


def per_task(rows: jax.Array, task_ids: jax.Array, num_tasks: int) -> jax.Array:
    """Mean over the rows of each task, (row,) -> (T,); NaN for a task without a row."""
    one_hot = jax.nn.one_hot(task_ids, num_tasks)  # (row, T)
    return (rows @ one_hot) / jnp.sum(one_hot, axis=0)


def make_learner(
    cfg: Config,
    goal_vectors: jax.Array,
    obs_size: int = 39,
    action_size: int = 4,
    inference: ContextInference | None = None,
) -> Learner:
    """Builds the learner of a validated configuration.

    Args:
        goal_vectors: text vectors of the training tasks, float32 (T, paraphrase, G).
        inference: in place of the encoder's own, for parameters that the caller puts into
            `encoder_params`.

    Raises:
        ValueError: `goal_vectors` does not fit `tasks.train`.
    """
    sac = cfg.sac
    num_tasks = len(cfg.tasks.train)
    if goal_vectors.ndim != 3 or goal_vectors.shape[0] != num_tasks:
        raise ValueError(
            f"goal_vectors has shape {goal_vectors.shape}, "
            f"expected ({num_tasks} training tasks, paraphrases, G)"
        )
    networks = make_networks(cfg, obs_size, action_size, goal_vectors.shape[-1], num_tasks)
    has_encoder = cfg.model.conditioning == "z"
    if inference is None and has_encoder:
        inference = make_context_inference(cfg, networks)
    objectives = make_objectives(cfg, networks, inference, action_size)
    has_value = sac.variant == "v"
    latent_dim = inference.latent_dim if inference else 0

    def normalize_obs(obs_stats: Any, obs: jax.Array) -> jax.Array:
        return normalizers.normalize_obs(obs_stats, obs) if sac.normalize_obs else obs

    def task_conditioning(task_ids: jax.Array) -> jax.Array:
        if has_encoder:
            raise ValueError("model.conditioning is z: draw it with `inference`")
        return jax.nn.one_hot(task_ids, networks.conditioning_size)

    def policy(actor_params, obs_stats, obs, zc, key, deterministic, noise=None):
        mean, log_std, routing = networks.actor(actor_params, normalize_obs(obs_stats, obs), zc)
        if noise is None:
            noise = jax.random.normal(key, mean.shape)
        action, _ = sample_tanh_gaussian(mean, log_std, noise)
        return jnp.where(deterministic, jnp.tanh(mean), action), routing

    def init(key: jax.Array) -> TrainState:
        k_actor, k_critic, k_value, k_encoder = jax.random.split(key, 4)
        actor_params = networks.init_actor(k_actor)
        critic_params = networks.init_critic(k_critic)
        value_params = networks.init_value(k_value) if has_value else None
        encoder_params = networks.init_encoder(k_encoder) if networks.init_encoder else None
        log_alpha = jnp.full((num_tasks,), math.log(sac.alpha_init), jnp.float32)

        def copy(params: Any) -> Any:  # a donated state must not hold one buffer twice
            return jax.tree.map(jnp.copy, params)

        return TrainState(
            actor_params=actor_params,
            critic_params=critic_params,
            target_critic_params=None if has_value else copy(critic_params),
            value_params=value_params,
            target_value_params=copy(value_params) if has_value else None,
            encoder_params=encoder_params,
            log_alpha=log_alpha,
            actor_opt_state=init_adam(actor_params),
            critic_opt_state=init_adam(critic_params, stacked=True),
            value_opt_state=init_adam(value_params),
            encoder_opt_state=init_adam(encoder_params),
            alpha_opt_state=init_adam(log_alpha if sac.alpha != "fixed" else None),
            obs_stats=normalizers.init_obs_stats(obs_size),
            return_stats=normalizers.init_return_stats(num_tasks, lanes_per_task(cfg)),
            gradient_steps=jnp.zeros((), jnp.int32),
            skipped_updates=jnp.zeros((), jnp.int32),
        )

    def draw_minibatch(
        state: TrainState, replay_state: Any, context_state: Any, key: jax.Array
    ) -> Minibatch:
        # Few large draws: every call of the generator costs a CPU more than its numbers do.
        k_ids, k_batch, k_context, k_uniform, k_normal = jax.random.split(key, 5)
        task_ids = jnp.arange(num_tasks)
        if sac.task_rows:
            task_ids = jax.random.randint(k_ids, (sac.task_rows,), 0, num_tasks)
        rows, actions = task_ids.shape[0], sac.batch * action_size
        noise = jax.random.normal(k_normal, (rows, 2 * actions + latent_dim))
        action_noise = noise[:, : 2 * actions].reshape(rows, 2, sac.batch, action_size)
        batch = replay.sample(replay_state, k_batch, task_ids, sac.batch, sac.n_step, sac.gamma)
        batch, action_noise = parallel.split(batch, 1), parallel.split(action_noise, 2)
        scale = sac.reward_scale / normalizers.reward_denominator(state.return_stats, sac)
        data = Minibatch(
            task_ids=task_ids,
            obs=normalize_obs(state.obs_stats, batch.obs),
            action=batch.action,
            reward=batch.reward * scale[task_ids, None],
            discount=batch.discount,
            next_obs=normalize_obs(state.obs_stats, batch.next_obs),
            next_noise=action_noise[:, 0],
            action_noise=action_noise[:, 1],
        )
        if not has_encoder:
            return data
        n_max = cfg.encoder.context_max
        if cfg.collect.context_source == "all":
            context = replay.sample_transitions(replay_state, k_context, task_ids, n_max)
        else:
            context = replay.sample_transitions(context_state, k_context, task_ids, n_max)
        u_length, u_empty, u_goal, u_text = jax.random.uniform(k_uniform, (4, rows))
        paraphrase = (u_text * goal_vectors.shape[1]).astype(jnp.int32)
        return data._replace(
            context=replace(
                context,
                obs=normalize_obs(state.obs_stats, context.obs),
                next_obs=normalize_obs(state.obs_stats, context.next_obs),
            ),
            context_mask=context_mask(u_length, u_empty, cfg.encoder),
            goal=goal_vectors[task_ids, paraphrase],
            goal_mask=(u_goal >= cfg.encoder.p_drop_goal).astype(jnp.float32),
            z_noise=noise[:, 2 * actions :],
        )

    def task_losses(
        state: TrainState, replay_state: Any, context_state: Any, key: jax.Array
    ) -> Callable[[Params], jax.Array]:
        data = draw_minibatch(state, replay_state, context_state, key)
        target_params = state.target_value_params if has_value else state.target_critic_params

        def losses(critic_params: Params) -> jax.Array:
            side = CriticSide(critic_params, state.encoder_params)
            _, (_, metrics) = objectives.critic(
                side, state.actor_params, target_params, state.log_alpha, data
            )
            rows = metrics["td_loss"]
            # A task without a row (`sac.task_rows`) has no loss here, not NaN: it has no gradient.
            one_hot = jax.nn.one_hot(data.task_ids, num_tasks)
            return (rows @ one_hot) / jnp.maximum(jnp.sum(one_hot, axis=0), 1.0)

        return losses

    step = partial(adam_step, lr=sac.lr, max_norm=sac.grad_clip)

    def update(
        state: TrainState, replay_state: Any, context_state: Any, key: jax.Array
    ) -> tuple[TrainState, Metrics]:
        data = draw_minibatch(state, replay_state, context_state, key)
        norms = {}

        trained = CriticSide(state.critic_params, state.encoder_params)
        target_params = state.target_value_params if has_value else state.target_critic_params
        critic_grad = jax.grad(objectives.critic, has_aux=True)
        grads, (zc, critic_metrics) = critic_grad(
            trained, state.actor_params, target_params, state.log_alpha, data
        )
        critic_params, critic_opt_state, norms["critic"] = step(
            grads.critic, state.critic_opt_state, state.critic_params, stacked=True
        )
        new = replace(state, critic_params=critic_params, critic_opt_state=critic_opt_state)
        if has_encoder:
            params, opt_state, norms["encoder"] = step(
                grads.encoder, state.encoder_opt_state, state.encoder_params
            )
            new = replace(new, encoder_params=params, encoder_opt_state=opt_state)

        trained = ActorSide(state.actor_params, state.value_params)
        actor_grad = jax.grad(objectives.actor, has_aux=True)
        grads, (log_prob, actor_metrics) = actor_grad(
            trained, critic_params, zc, state.log_alpha, data
        )
        params, opt_state, norms["actor"] = step(
            grads.actor, state.actor_opt_state, state.actor_params
        )
        new = replace(new, actor_params=params, actor_opt_state=opt_state)
        if has_value:
            params, opt_state, norms["value"] = step(
                grads.value, state.value_opt_state, state.value_params
            )
            target = polyak(params, state.target_value_params, sac.tau)
            new = replace(
                new, value_params=params, value_opt_state=opt_state, target_value_params=target
            )
        else:
            target = polyak(critic_params, state.target_critic_params, sac.tau)
            new = replace(new, target_critic_params=target)

        if sac.alpha != "fixed":
            grad = jax.grad(objectives.alpha)(state.log_alpha, log_prob, data.task_ids)
            log_alpha, opt_state, norms["alpha"] = adam_step(
                grad, state.alpha_opt_state, state.log_alpha, sac.lr, max_norm=0.0
            )
            new = replace(new, log_alpha=log_alpha, alpha_opt_state=opt_state)

        new = replace(new, gradient_steps=optax.safe_increment(state.gradient_steps))
        finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(norm)) for norm in norms.values()]))
        new = jax.lax.cond(finite, lambda: new, lambda: state)
        skipped = 1 - finite.astype(jnp.int32)
        new = replace(new, skipped_updates=state.skipped_updates + skipped)

        metrics = critic_metrics | actor_metrics
        if sac.task_rows:
            metrics = {
                name: per_task(value, data.task_ids, num_tasks) if value.ndim else value
                for name, value in metrics.items()
            }
        metrics |= {f"grad_norm_{name}": jnp.mean(norm) for name, norm in norms.items()}
        metrics |= {"alpha": jnp.exp(state.log_alpha), "skipped": skipped.astype(jnp.float32)}
        return new, metrics

    return Learner(
        networks=networks,
        objectives=objectives,
        inference=inference,
        init=init,
        update=update,
        task_losses=task_losses,
        policy=policy,
        normalize_obs=normalize_obs,
        task_conditioning=task_conditioning,
    )
