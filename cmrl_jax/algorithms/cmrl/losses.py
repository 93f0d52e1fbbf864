"""The losses, one equation each (docs/algorithm.md).

All act on arrays that the networks have already computed, with leading dims (task, batch) or
(critic, task, batch), and return one loss per task row, which `over_tasks` reduces. What is
stopped or differentiated is decided in objectives.py, apart from the targets, stopped here.
"""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient

from cmrl_jax.jax_runtime import apart


def soft_value(q: jax.Array, log_prob: jax.Array, alpha: jax.Array) -> jax.Array:
    """V(s) = min_k Q_k(s, a) - alpha_i log pi(a | s).

    Args:
        q: (critic, task, batch); log_prob: (task, batch); alpha: (task,).
    """
    return jnp.min(q, axis=0) - alpha[:, None] * log_prob


def td_target(reward: jax.Array, discount: jax.Array, next_value: jax.Array) -> jax.Array:
    """y = r + gamma^n (1 - term) V(s'), without gradient; all (task, batch)."""
    return stop_gradient(reward + discount * next_value)


def critic_loss(q: jax.Array, target: jax.Array) -> jax.Array:
    """L_i = mean_b sum_k (Q_k - y)^2; q (critic, task, batch), target (task, batch) -> (task,)."""
    return jnp.mean(jnp.sum(jnp.square(q - target), axis=0), axis=-1)


def critic_support(v_max: float, bins: int) -> jax.Array:
    """Values b_k of the categorical critic's bins, (bin,)."""
    return jnp.linspace(-v_max, v_max, bins)


def project_categorical(
    probabilities: jax.Array, values: jax.Array, support: jax.Array
) -> jax.Array:
    """Splits the mass at each value linearly over its two neighbouring bins (C51).

    Values beyond the support go to its ends.

    Args:
        probabilities, values: (..., atom).
        support: equally spaced, increasing, (bin,).

    Returns:
        (..., bin), with the total mass of `probabilities`.
    """
    width = support[1] - support[0]
    values = jnp.clip(values, support[0], support[-1])
    distance = jnp.abs(values[..., None, :] - support[:, None]) / width  # (..., bin, atom)
    return jnp.sum(jnp.maximum(1.0 - distance, 0.0) * probabilities[..., None, :], axis=-1)


def categorical_target(
    next_logits: jax.Array,
    next_log_prob: jax.Array,
    reward: jax.Array,
    discount: jax.Array,
    alpha: jax.Array,
    support: jax.Array,
    aggregate: Literal["min", "mean"],
) -> tuple[jax.Array, jax.Array]:
    """C51 target: the twins' next distribution at r + gamma^n (1 - term) (b_k - alpha log pi).

    `mean` averages the two target distributions (naumix/BiggerRegularizedCategorical:
    jaxrl/agent/update.py); `min` takes, per transition, the one with the smaller mean.

    Args:
        next_logits: (critic, task, batch, bin).
        next_log_prob, reward, discount: (task, batch); alpha: (task,).

    Returns:
        Target probabilities (task, batch, bin), and the share of their mass that was clipped.
    """
    twins = jax.nn.softmax(next_logits, axis=-1)
    if aggregate == "mean":
        probabilities = jnp.mean(twins, axis=0)
    else:
        expected = twins @ support  # (critic, task, batch)
        first_is_smaller = expected[0] <= expected[1]
        probabilities = jnp.where(first_is_smaller[..., None], twins[0], twins[1])
    entropy_bonus = -alpha[:, None] * next_log_prob
    values = (reward + discount * entropy_bonus)[..., None] + discount[..., None] * support
    is_clipped = (values < support[0]) | (values > support[-1])
    clipped = jnp.mean(jnp.sum(probabilities * is_clipped, axis=-1))
    probabilities, values = apart((probabilities, values))
    target = apart(project_categorical(probabilities, values, support))
    return stop_gradient(target), stop_gradient(clipped)


def categorical_critic_loss(logits: jax.Array, target: jax.Array) -> jax.Array:
    """L_i = mean_b sum_k cross-entropy(target, softmax(logits_k)).

    Args:
        logits: (critic, task, batch, bin); target: (task, batch, bin).
    """
    cross_entropy = -jnp.sum(target * jax.nn.log_softmax(logits, axis=-1), axis=-1)
    return jnp.mean(jnp.sum(cross_entropy, axis=0), axis=-1)


def value_loss(value: jax.Array, target: jax.Array) -> jax.Array:
    """L_i = mean_b (V(s) - sg(min_k Q_k - alpha log pi))^2; both (task, batch)."""
    return jnp.mean(jnp.square(value - stop_gradient(target)), axis=-1)


def actor_loss(q: jax.Array, log_prob: jax.Array, alpha: jax.Array) -> jax.Array:
    """L_i = mean_b [alpha_i log pi(a | s) - min_k Q_k(s, a)], a reparameterised.

    Args:
        q: (critic, task, batch); log_prob: (task, batch); alpha: (task,).
    """
    return jnp.mean(-soft_value(q, log_prob, alpha), axis=-1)


def policy_regulariser(mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """mean_b,d mean^2 + mean_b,d log_std^2 of PEARL's policy, (task, batch, act) -> (task,)."""
    return jnp.mean(jnp.square(mean) + jnp.square(log_std), axis=(-2, -1))


def alpha_loss(log_alpha: jax.Array, log_prob: jax.Array, target_entropy: float) -> jax.Array:
    """L = -mean_i log alpha_i sg(mean_b log pi + H_target).

    Args:
        log_alpha: (task,); log_prob: (task, batch).
    """
    excess = stop_gradient(jnp.mean(log_prob, axis=-1) + target_entropy)
    return -jnp.mean(log_alpha * excess)


def kl_loss(
    kl: jax.Array, reduce: Literal["mean_tasks", "sum_tasks"], free_bits: float
) -> jax.Array:
    """sum_d max(mean_i kl, free_bits), or oyster's sum_i sum_d max(kl, free_bits).

    Args:
        kl: nats, (task, latent).
    """
    per_dim = jnp.mean(kl, axis=0) if reduce == "mean_tasks" else kl
    return jnp.sum(jnp.maximum(per_dim, free_bits) if free_bits > 0 else per_dim)


def reconstruction_loss(predicted: jax.Array, reward: jax.Array, change: jax.Array) -> jax.Array:
    """Squared error of predicted rewards and changes of the observation.

    Both over the n steps of the Bellman target (`sac.n_step`), from its first action.
    Targets are standardised over the minibatch, dimension by dimension, so that a loss of 1 is
    what a constant prediction gets; the reward counts as much as all of the observation.

    Args:
        predicted: (task, batch, 1 + obs), the reward first.
        reward: n-step sum, (task, batch); change: observation n steps later minus observation,
            (task, batch, obs).

    Returns:
        (task,)
    """

    def standardised(x: jax.Array) -> jax.Array:
        scale = jnp.std(x, axis=(0, 1))
        return (x - jnp.mean(x, axis=(0, 1))) / jnp.maximum(scale, 1e-6)

    reward_error = jnp.square(predicted[..., 0] - standardised(reward))
    change_error = jnp.mean(jnp.square(predicted[..., 1:] - standardised(change)), axis=-1)
    return jnp.mean(0.5 * (reward_error + change_error), axis=-1)


def contrastive_loss(experience: jax.Array, text: jax.Array, task_ids: jax.Array) -> jax.Array:
    """Cross-entropy of pairing every row's experience with its task's text, and the reverse.

    Scores are inner products of posterior means; all rows of a task are right answers alike. A
    posterior that says nothing scores log R for R rows of different tasks (InfoNCE, van den Oord
    et al. 2018; symmetric as in CLIP, Radford et al. 2021).

    Args:
        experience: mean of q(z | transitions), (task, latent).
        text: mean of q(z | text), (task, latent).
        task_ids: (task,).
    """
    scores = experience @ text.T  # (task, task)
    same = (task_ids[:, None] == task_ids[None]).astype(jnp.float32)
    target = same / jnp.sum(same, axis=-1, keepdims=True)  # symmetric: rows of a task are alike
    by_text = -jnp.sum(target * jax.nn.log_softmax(scores, axis=1), axis=1)
    by_experience = -jnp.sum(target * jax.nn.log_softmax(scores, axis=0), axis=0)
    return 0.5 * jnp.mean(by_text + by_experience)


def task_weights(log_alpha: jax.Array, balance: Literal["none", "sac_temp"]) -> jax.Array:
    """w_i = T softmax_i(-log alpha_i) without gradient, or ones; (task,) -> (task,).

    Source: RchalYang/Soft-Module: torchrl/algo/off_policy/mt_sac.py (the paper prints
    softmax(-alpha)).
    """
    if balance == "none":
        return jnp.ones_like(log_alpha)
    return stop_gradient(log_alpha.shape[0] * jax.nn.softmax(-log_alpha))


def over_tasks(losses: jax.Array, weights: jax.Array, reduce: Literal["mean", "sum"]) -> jax.Array:
    """(1/R) sum_i w_i L_i, or the plain sum; losses and weights (task,)."""
    weighted = weights * losses
    return jnp.mean(weighted) if reduce == "mean" else jnp.sum(weighted)
