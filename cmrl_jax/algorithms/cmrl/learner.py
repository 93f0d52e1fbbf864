"""The learner: gradient steps as pure functions.

Order of a step (as in oyster): critics and encoder, actor, temperature, target networks;
then the average that acts.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import optax

from cmrl_jax import parallel
from cmrl_jax.algorithms.cmrl.objectives import (
    ActorSide,
    CriticSide,
    Metrics,
    Minibatch,
    Objectives,
)
from cmrl_jax.algorithms.cmrl.train_state import STACKED, Acting, TrainState, pack, unpack
from cmrl_jax.algorithms.common import replay
from cmrl_jax.config.schema import Config, lanes_per_task
from cmrl_jax.nn import normalizers
from cmrl_jax.nn.context import ContextInference, context_mask, make_context_inference
from cmrl_jax.nn.distributions import sample_tanh_gaussian
from cmrl_jax.nn.networks import Params, Routing, make_networks
from cmrl_jax.nn.optimizers import adam_step, init_adam, polyak, ravel, unravel


def per_task(rows: jax.Array, task_ids: jax.Array, num_tasks: int) -> jax.Array:
    """Mean over the rows of each task, (row,) -> (T,); NaN for a task without a row."""
    one_hot = jax.nn.one_hot(task_ids, num_tasks)  # (row, T)
    return (rows @ one_hot) / jnp.sum(one_hot, axis=0)


class Learner:
    """Pure functions of one validated configuration.

    Args:
        goal_vectors: text vectors of the training tasks, float32 (T, paraphrase, G).
        obs_size, action_size: numbers of an observation and of an action.
        inference: in place of the encoder's own, for parameters that the caller puts into
            `encoder_params`.

    Attributes:
        networks, objectives: what the learner is made of.
        inference: context inference, None unless `model.conditioning` is z.

    Raises:
        ValueError: `goal_vectors` does not fit `tasks.train`.
    """

    def __init__(
        self,
        config: Config,
        goal_vectors: jax.Array,
        obs_size: int,
        action_size: int,
        inference: ContextInference | None = None,
    ):
        self.num_tasks = len(config.tasks.train)
        if goal_vectors.ndim != 3 or goal_vectors.shape[0] != self.num_tasks:
            raise ValueError(
                f"goal_vectors has shape {goal_vectors.shape}, "
                f"expected ({self.num_tasks} training tasks, paraphrases, G)"
            )
        self.config, self.goal_vectors = config, goal_vectors
        self.obs_size, self.action_size = obs_size, action_size
        width = goal_vectors.shape[-1]
        self.networks = make_networks(config, obs_size, action_size, width, self.num_tasks)
        self.has_encoder = config.model.conditioning == "z"
        self.has_value = config.sac.variant == "v"
        if inference is None and self.has_encoder:
            inference = make_context_inference(config, self.networks)
        self.inference = inference
        self.objectives = Objectives(config, self.networks, inference, action_size)

    def normalize_obs(self, obs_stats: Any, obs: jax.Array) -> jax.Array:
        """Observations (..., obs) as the networks read them; the identity by configuration."""
        return normalizers.normalize_obs(obs_stats, obs) if self.config.sac.normalize_obs else obs

    def normalized(self, obs_stats: Any, transitions: Any) -> Any:
        """Transitions as context inference reads them: observations normalised, all else raw."""
        return replace(
            transitions,
            obs=self.normalize_obs(obs_stats, transitions.obs),
            next_obs=self.normalize_obs(obs_stats, transitions.next_obs),
        )

    def task_conditioning(self, task_ids: jax.Array) -> jax.Array:
        """Conditioning of training tasks (lane,) -> (lane, conditioning) where it is no latent."""
        if self.has_encoder:
            raise ValueError("model.conditioning is z: draw it with `inference`")
        return jax.nn.one_hot(task_ids, self.networks.conditioning_size)

    def policy(
        self,
        actor_params: Params,
        obs_stats: Any,
        obs: jax.Array,
        zc: jax.Array,
        key: jax.Array | None,
        deterministic: Any,
        noise: jax.Array | None = None,
    ) -> tuple[jax.Array, Routing | None]:
        """Actions (lane, act) and the routing, None without modules.

        Args:
            obs: (lane, obs) raw.
            zc: conditioning (lane, conditioning).
            noise: (lane, act) standard normal, in place of a draw from `key`.
        """
        shown = self.normalize_obs(obs_stats, obs)
        mean, log_std, routing = self.networks.actor(actor_params, shown, zc)
        if noise is None:
            assert key is not None
            noise = jax.random.normal(key, mean.shape)
        action, _ = sample_tanh_gaussian(mean, log_std, noise)
        return jnp.where(deterministic, jnp.tanh(mean), action), routing

    def init(self, key: jax.Array) -> TrainState:
        """The state before the first gradient step."""
        config, networks, has_value = self.config, self.networks, self.has_value
        k_actor, k_critic, k_value, k_encoder = jax.random.split(key, 4)
        actor_params = networks.init_actor(k_actor)
        critic_params = networks.init_critic(k_critic)
        value_params = networks.init_value(k_value) if has_value else None
        encoder_params = networks.init_encoder(k_encoder) if networks.init_encoder else None
        averages = config.sac.policy_average > 0
        log_alpha = jnp.full((self.num_tasks,), math.log(config.sac.alpha_init), jnp.float32)

        def copy(params: Any) -> Any:  # a donated state must not hold one buffer twice
            return jax.tree.map(jnp.copy, params)

        return TrainState(
            actor_params=actor_params,
            critic_params=critic_params,
            target_critic_params=None if has_value else copy(critic_params),
            value_params=value_params,
            target_value_params=copy(value_params) if has_value else None,
            encoder_params=encoder_params,
            averaged=copy(Acting(actor_params, encoder_params)) if averages else None,
            log_alpha=log_alpha,
            actor_opt_state=init_adam(actor_params),
            critic_opt_state=init_adam(critic_params, stacked=True),
            value_opt_state=init_adam(value_params),
            encoder_opt_state=init_adam(encoder_params),
            alpha_opt_state=init_adam(log_alpha if config.sac.alpha != "fixed" else None),
            obs_stats=normalizers.init_obs_stats(self.obs_size),
            return_stats=normalizers.init_return_stats(self.num_tasks, lanes_per_task(config)),
            gradient_steps=jnp.zeros((), jnp.int32),
            skipped_updates=jnp.zeros((), jnp.int32),
        )

    def draw_minibatch(
        self, state: TrainState, replay_state: Any, context_state: Any, key: jax.Array
    ) -> Minibatch:
        """What one gradient step sees, from both rings."""
        sac, encoder, action_size = self.config.sac, self.config.encoder, self.action_size
        latent_dim = self.inference.latent_dim if self.inference else 0
        # Few large draws: every call of the generator costs a CPU more than its numbers do.
        k_ids, k_batch, k_context, k_uniform, k_normal = jax.random.split(key, 5)
        task_ids = jnp.arange(self.num_tasks)
        if sac.task_rows:
            task_ids = jax.random.randint(k_ids, (sac.task_rows,), 0, self.num_tasks)
        rows, actions = task_ids.shape[0], sac.batch * action_size
        noise = jax.random.normal(k_normal, (rows, 2 * actions + latent_dim))
        action_noise = noise[:, : 2 * actions].reshape(rows, 2, sac.batch, action_size)
        batch = replay.sample(replay_state, k_batch, task_ids, sac.batch, sac.n_step, sac.gamma)
        batch, action_noise = parallel.split(batch, 1), parallel.split(action_noise, 2)
        scale = sac.reward_scale / normalizers.reward_denominator(state.return_stats, sac)
        data = Minibatch(
            task_ids=task_ids,
            obs=self.normalize_obs(state.obs_stats, batch.obs),
            action=batch.action,
            reward=batch.reward * scale[task_ids, None],
            discount=batch.discount,
            next_obs=self.normalize_obs(state.obs_stats, batch.next_obs),
            next_noise=action_noise[:, 0],
            action_noise=action_noise[:, 1],
        )
        if not self.has_encoder:
            return data
        is_all = self.config.collect.context_source == "all"
        ring = replay_state if is_all else context_state
        context = replay.sample_transitions(ring, k_context, task_ids, encoder.context_max)
        u_length, u_empty, u_goal, u_text = jax.random.uniform(k_uniform, (4, rows))
        paraphrase = (u_text * self.goal_vectors.shape[1]).astype(jnp.int32)
        return data._replace(
            context=self.normalized(state.obs_stats, context),
            context_mask=context_mask(u_length, u_empty, encoder),
            goal=self.goal_vectors[task_ids, paraphrase],
            goal_mask=(u_goal >= encoder.p_drop_goal).astype(jnp.float32),
            z_noise=noise[:, 2 * actions :],
        )

    def task_losses(
        self, state: TrainState, replay_state: Any, context_state: Any, key: jax.Array
    ) -> Callable[[Params], jax.Array]:
        """The TD loss of every training task on one minibatch (T,), of the critics' parameters."""
        data = self.draw_minibatch(state, replay_state, context_state, key)
        target_params = state.target_value_params if self.has_value else state.target_critic_params

        def losses(critic_params: Params) -> jax.Array:
            side = CriticSide(critic_params, state.encoder_params)
            _, (_, metrics) = self.objectives.critic(
                side, state.actor_params, target_params, state.log_alpha, data
            )
            rows = metrics["td_loss"]
            # A task without a row (`sac.task_rows`) has no loss here, not NaN: it has no gradient.
            one_hot = jax.nn.one_hot(data.task_ids, self.num_tasks)
            return (rows @ one_hot) / jnp.maximum(jnp.sum(one_hot, axis=0), 1.0)

        return losses

    def update(
        self, state: TrainState, replay_state: Any, context_state: Any, key: jax.Array
    ) -> tuple[TrainState, Metrics]:
        """One gradient step.

        Returns:
            The state after it, or the old one where a gradient was not finite; and metrics,
            float32, () or (T,): with `sac.task_rows` a task that was not drawn has NaN.
        """
        state, metrics = self.updates(state, replay_state, context_state, key[None])
        return state, {name: value[0] for name, value in metrics.items()}

    def updates(
        self, state: TrainState, replay_state: Any, context_state: Any, keys: jax.Array
    ) -> tuple[TrainState, Metrics]:
        """A gradient step for every key (step,); metrics as of `update`, leading axis step."""

        def step(flat: TrainState, key: jax.Array) -> tuple[TrainState, Metrics]:
            return self.step(flat, state, replay_state, context_state, key)

        flat, metrics = jax.lax.scan(step, pack(state), keys)
        return unpack(flat, state), metrics

    def step(
        self,
        flat: TrainState,
        like: TrainState,
        replay_state: Any,
        context_state: Any,
        key: jax.Array,
    ) -> tuple[TrainState, Metrics]:
        """One gradient step on a packed state (`train_state.pack`).

        Args:
            like: an unpacked state, of which only trees and shapes are read.

        Returns:
            The packed state after it, and metrics, as of `update`.
        """
        sac = self.config.sac
        state = unpack(flat, like)
        data = self.draw_minibatch(state, replay_state, context_state, key)
        norms: Metrics = {}
        new, zc, critic_metrics = self._critic_step(flat, state, data, norms)
        critics = unravel(new.critic_params, state.critic_params)
        new, log_prob, actor_metrics = self._actor_step(new, state, critics, zc, data, norms)
        new = self._averaging_step(self._target_step(new))
        if sac.alpha != "fixed":
            grad = jax.grad(self.objectives.alpha)(state.log_alpha, log_prob, data.task_ids)
            log_alpha, opt_state, norms["alpha"] = adam_step(
                grad, state.alpha_opt_state, state.log_alpha, sac.lr, max_norm=0.0
            )
            new = replace(new, log_alpha=log_alpha, alpha_opt_state=opt_state)

        new = replace(new, gradient_steps=optax.safe_increment(state.gradient_steps))
        finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(norm)) for norm in norms.values()]))
        # What no step changes is the same array in both.
        choose = lambda new, old: old if new is old else jnp.where(finite, new, old)
        new = jax.tree.map(choose, new, flat)
        skipped = 1 - finite.astype(jnp.int32)
        new = replace(new, skipped_updates=state.skipped_updates + skipped)

        metrics = critic_metrics | actor_metrics
        if sac.task_rows:
            metrics = {
                name: per_task(value, data.task_ids, self.num_tasks) if value.ndim else value
                for name, value in metrics.items()
            }
        metrics |= {f"grad_norm_{name}": jnp.mean(norm) for name, norm in norms.items()}
        metrics |= {"alpha": jnp.exp(state.log_alpha), "skipped": skipped.astype(jnp.float32)}
        return new, metrics

    def _adam(self, flat: TrainState, network: str, grads: Any, norms: Metrics) -> TrainState:
        """Adam's step of one network in a packed state, from the gradient's tree."""
        params, moments = f"{network}_params", f"{network}_opt_state"
        sac = self.config.sac
        new, opt_state, norms[network] = adam_step(
            ravel(grads, stacked=params in STACKED),
            getattr(flat, moments),
            getattr(flat, params),
            lr=sac.lr,
            max_norm=sac.grad_clip,
        )
        return replace(flat, **{params: new, moments: opt_state})

    def _critic_step(
        self, flat: TrainState, state: TrainState, data: Minibatch, norms: Metrics
    ) -> tuple[TrainState, jax.Array, Metrics]:
        """Critics and encoder; also the conditioning zc (task, conditioning) that they saw."""
        trained = CriticSide(state.critic_params, state.encoder_params)
        target = state.target_value_params if self.has_value else state.target_critic_params
        grads, (zc, metrics) = jax.grad(self.objectives.critic, has_aux=True)(
            trained, state.actor_params, target, state.log_alpha, data
        )
        flat = self._adam(flat, "critic", grads.critic, norms)
        if self.has_encoder:
            flat = self._adam(flat, "encoder", grads.encoder, norms)
        return flat, zc, metrics

    def _actor_step(
        self,
        flat: TrainState,
        state: TrainState,
        critic_params: Params,
        zc: jax.Array,
        data: Minibatch,
        norms: Metrics,
    ) -> tuple[TrainState, jax.Array, Metrics]:
        """Actor and V network, by the critics just trained; also log pi (task, batch)."""
        trained = ActorSide(state.actor_params, state.value_params)
        grads, (log_prob, metrics) = jax.grad(self.objectives.actor, has_aux=True)(
            trained, critic_params, zc, state.log_alpha, data
        )
        flat = self._adam(flat, "actor", grads.actor, norms)
        if self.has_value:
            flat = self._adam(flat, "value", grads.value, norms)
        return flat, log_prob, metrics

    def _target_step(self, flat: TrainState) -> TrainState:
        tau = self.config.sac.tau
        if self.has_value:
            target = polyak(flat.value_params, flat.target_value_params, tau)
            return replace(flat, target_value_params=target)
        target = polyak(flat.critic_params, flat.target_critic_params, tau)
        return replace(flat, target_critic_params=target)

    def _averaging_step(self, flat: TrainState) -> TrainState:
        """Polynomial-decay averaging (Shamir and Zhang 2013): the newest weighs 1 / (1 + share n).

        With a share of 0.1 the last tenth of the steps has two thirds of the weight. After n steps
        the mean age of what is averaged is n share / (1 + share), however long a run is; a fixed
        rate would have to be chosen for its length.
        """
        if flat.averaged is None:
            return flat
        steps = flat.gradient_steps.astype(jnp.float32)
        rate = 1.0 / (1.0 + self.config.sac.policy_average * steps)
        newest = Acting(flat.actor_params, flat.encoder_params)
        return replace(flat, averaged=polyak(newest, flat.averaged, rate))
