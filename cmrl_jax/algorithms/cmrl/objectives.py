"""What is differentiated with respect to what: the losses joined to the networks.

Gradient routing: the encoder learns from the critic loss, the KL and the
auxiliary loss of `encoder.aux`, nothing else. So z enters with its gradient in `critic`, at the
trained transitions, and nowhere else.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient

from cmrl_jax.algorithms.cmrl import losses
from cmrl_jax.config.schema import Config
from cmrl_jax.nn.context import ContextInference, Transitions, init_belief
from cmrl_jax.nn.distributions import kl_to_standard_normal, sample_tanh_gaussian
from cmrl_jax.nn.networks import Networks, Params, Routing

Metrics = dict[str, jax.Array]


class Minibatch(NamedTuple):
    """What one gradient step sees: observations normalised, rewards scaled; R task rows.

    Attributes:
        task_ids: training task of each row, (task,).
        obs, next_obs: (task, batch, obs). next_obs is n steps later.
        action: (task, batch, act).
        reward: n-step discounted sum in critic units, (task, batch).
        discount: gamma^n (1 - term), (task, batch).
        next_noise, action_noise: standard normal draws of the two actions, (task, batch, act).
        context: raw rewards, (task, context, ...); None without an encoder, as all that follow.
        context_mask: (task, context).
        goal: text vector, (task, G).
        goal_mask: (task,).
        z_noise: standard normal draw of z, (task, latent).
    """

    task_ids: jax.Array
    obs: jax.Array
    action: jax.Array
    reward: jax.Array
    discount: jax.Array
    next_obs: jax.Array
    next_noise: jax.Array
    action_noise: jax.Array
    context: Transitions | None = None
    context_mask: jax.Array | None = None
    goal: jax.Array | None = None
    goal_mask: jax.Array | None = None
    z_noise: jax.Array | None = None


class Inferred(NamedTuple):
    """What the encoder makes of a minibatch.

    Attributes:
        zc: conditioning (task, conditioning).
        kl: nats (task, latent); None without an information bottleneck.
        experience: posterior mean of the whole context without its sentence (task, latent); None
            unless `encoder.aux` is contrastive.
    """

    zc: jax.Array
    kl: jax.Array | None = None
    experience: jax.Array | None = None


class CriticSide(NamedTuple):
    """Parameters trained by the critic objective; no encoder: None."""

    critic: Params
    encoder: Params | None


class ActorSide(NamedTuple):
    """Parameters trained by the actor objective; no V network (`sac.variant: twin_q`): None."""

    actor: Params
    value: Params | None


def routing_health(routing: Routing, task_ids: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Routing entropy / log n of each row, (task,), and the distance between tasks, ().

    The distance is the total variation between two tasks' mean routings, averaged over their
    distributions and over all pairs of rows of different tasks; 0 with a single task.
    """
    n = routing.final.shape[-1]
    flat = routing.matrices.reshape(*routing.matrices.shape[:-3], -1, n)
    rows = jnp.concatenate([flat, routing.final[..., None, :]], axis=-2)  # (task, batch, row, n)
    entropy = jnp.sum(jax.scipy.special.entr(rows), axis=-1) / jnp.log(n)
    usage = jnp.mean(rows, axis=1)  # (task, row, n)
    variation = 0.5 * jnp.sum(jnp.abs(usage[:, None] - usage[None]), axis=-1)
    differs = (task_ids[:, None] != task_ids[None]).astype(jnp.float32)
    distance = jnp.sum(differs * jnp.mean(variation, axis=-1)) / jnp.maximum(jnp.sum(differs), 1.0)
    return jnp.mean(entropy, axis=(1, 2)), distance


class Objectives:
    """Pure functions of one configuration, all randomness in the minibatch.

    Per-row metrics are (task,), others ().

    Args:
        inference: None without an encoder.
    """

    def __init__(
        self,
        config: Config,
        networks: Networks,
        inference: ContextInference | None,
        action_size: int,
    ):
        self.config, self.networks, self.inference = config, networks, inference
        self.action_size = action_size
        self.is_categorical = config.model.critic == "c51"
        self.support = losses.critic_support(config.model.critic_v_max, config.model.critic_bins)

    def infer(self, encoder_params: Params | None, data: Minibatch) -> Inferred:
        if self.inference is None or data.z_noise is None:
            if self.config.model.conditioning == "task_id":
                return Inferred(jax.nn.one_hot(data.task_ids, self.networks.conditioning_size))
            return Inferred(jnp.zeros((data.task_ids.shape[0], 0)))
        experience, mask, goal_mask = None, data.context_mask, data.goal_mask
        both = self.config.encoder.aux == "contrastive"
        if both:  # in one pass: they read the same transitions
            assert mask is not None and goal_mask is not None
            mask = jnp.stack([mask, jnp.ones_like(mask)])
            goal_mask = jnp.stack([goal_mask, jnp.zeros_like(goal_mask)])
        posterior = self.inference.posterior(
            encoder_params, data.context, mask, data.goal, goal_mask
        )
        if both:
            experience = posterior.mean[1]
            posterior = jax.tree.map(lambda x: x[0], posterior)
        has_kl = self.config.encoder.information_bottleneck
        kl = kl_to_standard_normal(posterior) if has_kl else None
        return Inferred(self.inference.z_of_noise(posterior, data.z_noise), kl, experience)

    def act(self, actor_params: Params, obs: jax.Array, zb: jax.Array, noise: jax.Array):
        mean, log_std, routing = self.networks.actor(actor_params, obs, zb[:, None])
        action, log_prob = sample_tanh_gaussian(mean, log_std, noise)
        return action, log_prob, (mean, log_std, routing)

    def expected_q(self, head: jax.Array) -> jax.Array:
        return jax.nn.softmax(head, axis=-1) @ self.support if self.is_categorical else head

    def critic_target(self, actor_params, target_params, alpha, zb, data: Minibatch):
        """The target, (task, batch) or (task, batch, bin), and its clipped share."""
        if self.config.sac.variant == "v":
            next_value = self.networks.value(target_params, data.next_obs, zb[:, None])
            return losses.td_target(data.reward, data.discount, next_value), None
        next_action, next_log_prob, _ = self.act(actor_params, data.next_obs, zb, data.next_noise)
        next_head = self.networks.critic(target_params, data.next_obs, next_action, zb[:, None])
        if self.is_categorical:
            return losses.categorical_target(
                next_head,
                next_log_prob,
                data.reward,
                data.discount,
                alpha,
                self.support,
                self.config.model.critic_agg,
            )
        next_value = losses.soft_value(next_head, next_log_prob, alpha)
        return losses.td_target(data.reward, data.discount, next_value), None

    def auxiliary(self, encoder_params: Params, inferred: Inferred, data: Minibatch) -> jax.Array:
        if self.networks.reconstruct is not None:
            predicted = self.networks.reconstruct(
                encoder_params, data.obs, data.action, inferred.zc[:, None]
            )
            change = data.next_obs - data.obs
            return jnp.mean(losses.reconstruction_loss(predicted, data.reward, change))
        assert self.inference is not None and inferred.experience is not None
        nothing = init_belief(data.task_ids.shape, self.inference.latent_dim)
        shown = jnp.ones(data.task_ids.shape)
        text = self.inference.posterior_of_belief(encoder_params, nothing, data.goal, shown)
        return losses.contrastive_loss(inferred.experience, text.mean, data.task_ids)

    def critic(self, trained: CriticSide, actor_params, target_params, log_alpha, data: Minibatch):
        """Loss, (zc, metrics); `target_params` are the target critics' or the V network's."""
        config = self.config
        inferred = self.infer(trained.encoder, data)
        zc, kl = inferred.zc, inferred.kl
        alpha = jnp.exp(log_alpha)[data.task_ids]
        zb = stop_gradient(zc)  # the target is stopped as a whole; this spares tracing its tangents
        target, clipped = self.critic_target(actor_params, target_params, alpha, zb, data)
        head = self.networks.critic(trained.critic, data.obs, data.action, zc[:, None])
        loss_of = losses.categorical_critic_loss if self.is_categorical else losses.critic_loss
        td_loss = loss_of(head, target)
        weights = losses.task_weights(log_alpha, config.sac.loss_balance)[data.task_ids]
        loss = losses.over_tasks(td_loss, weights, config.sac.task_reduce)
        metrics = {"critic_loss": loss, "td_loss": td_loss}
        metrics["q_mean"] = jnp.mean(self.expected_q(head), axis=(0, 2))
        if clipped is not None:
            metrics["clipped_target_fraction"] = clipped
        if config.encoder.aux != "none":
            metrics["aux_loss"] = self.auxiliary(trained.encoder, inferred, data)
            loss = loss + config.encoder.aux_weight * metrics["aux_loss"]
        if kl is not None:
            kl_loss = losses.kl_loss(kl, config.kl.reduce, config.kl.free_bits)
            loss = loss + config.kl.beta * kl_loss
            metrics["kl"] = jnp.sum(kl, axis=-1)
            metrics["active_dims"] = jnp.sum(jnp.mean(kl, axis=0) > 0.05).astype(jnp.float32)
        return loss, (zc, metrics)

    def actor(self, trained: ActorSide, critic_params, zc, log_alpha, data: Minibatch):
        """Loss, (log_prob (task, batch), metrics)."""
        sac = self.config.sac
        zb = stop_gradient(zc)
        alpha = jnp.exp(log_alpha)[data.task_ids]
        action, log_prob, (mean, log_std, routing) = self.act(
            trained.actor, data.obs, zb, data.action_noise
        )
        q = self.expected_q(self.networks.critic(critic_params, data.obs, action, zb[:, None]))
        row_loss = losses.actor_loss(q, log_prob, alpha)
        if sac.policy_reg:
            row_loss = row_loss + sac.policy_reg * losses.policy_regulariser(mean, log_std)
        weights = losses.task_weights(log_alpha, sac.loss_balance)[data.task_ids]
        loss = losses.over_tasks(row_loss, weights, sac.task_reduce)
        metrics = {"actor_loss": loss, "entropy": -jnp.mean(log_prob, axis=-1)}
        if routing is not None:
            routing = jax.tree.map(stop_gradient, routing)
            health = routing_health(routing, data.task_ids)
            metrics["routing_entropy"], metrics["routing_distance"] = health
        if sac.variant == "v":
            value = self.networks.value(trained.value, data.obs, zb[:, None])
            target = losses.soft_value(q, log_prob, alpha)
            row_loss = losses.value_loss(value, target)
            metrics["value_loss"] = losses.over_tasks(row_loss, weights, sac.task_reduce)
            loss = loss + metrics["value_loss"]
        return loss, (log_prob, metrics)

    def alpha(self, log_alpha: jax.Array, log_prob: jax.Array, task_ids: jax.Array) -> jax.Array:
        """Loss of the temperatures log_alpha (T,)."""
        if self.config.sac.alpha == "shared":
            log_alpha = jnp.full_like(log_alpha, 1.0) * jnp.mean(log_alpha)
        target = self.config.sac.target_entropy * self.action_size
        return losses.alpha_loss(log_alpha[task_ids], log_prob, target)
