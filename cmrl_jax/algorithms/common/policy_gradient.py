"""What policy-gradient methods share: advantages, PPO's clipped surrogate, the optimizer.

A step that a mask leaves out (what comes after an episode's terminal) is passed over: the step
before it is followed by the step after it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from cmrl_jax.config.schema import PpoConfig
from cmrl_jax.nn.normalizers import ObsStats


class PolicyParams(NamedTuple):
    """What acting needs: the policy checkpoint's arrays."""

    params: Any
    obs_stats: ObsStats


def gae(
    reward: jax.Array,
    value: jax.Array,
    last_value: jax.Array,
    mask: jax.Array,
    gamma: float,
    gae_lambda: float,
) -> jax.Array:
    """Generalised advantage estimation (Schulman et al. 2016): advantages (time, ...).

    Args:
        reward, value: (time, ...), of a step and of the state that it was taken in.
        last_value: (...), of the state after the last step; 0 where it is a terminal.
        mask: (time, ...) bool; masked steps have no advantage.
    """

    def step(following: tuple[jax.Array, jax.Array], inputs: Any):
        advantage, next_value = following
        reward, value, counts = inputs
        delta = reward + gamma * next_value - value
        new = delta + gamma * gae_lambda * advantage
        following = jnp.where(counts, new, advantage), jnp.where(counts, value, next_value)
        return following, jnp.where(counts, new, 0.0)

    start = jnp.zeros_like(last_value), last_value
    return jax.lax.scan(step, start, (reward, value, mask), reverse=True)[1]


def normalized(advantage: jax.Array, mask: jax.Array, axes: tuple[int, ...]) -> jax.Array:
    """Advantages less their mean over their standard deviation, both over the axes' unmasked."""
    weight = mask.astype(jnp.float32)
    count = jnp.maximum(jnp.sum(weight, axes, keepdims=True), 1.0)
    mean = jnp.sum(weight * advantage, axes, keepdims=True) / count
    centred = (advantage - mean) * weight
    variance = jnp.sum(jnp.square(centred), axes, keepdims=True) / count
    return centred / (jnp.sqrt(variance) + 1e-8)


def masked_mean(x: jax.Array, mask: jax.Array) -> jax.Array:
    """The mean of the unmasked, (); 0 if there are none."""
    weight = mask.astype(jnp.float32)
    return jnp.sum(x * weight) / jnp.maximum(jnp.sum(weight), 1.0)


def clipped_surrogate(
    log_prob: jax.Array, old_log_prob: jax.Array, advantage: jax.Array, clip: float
) -> jax.Array:
    """PPO's objective of each step (Schulman et al. 2017, equation 7), to be maximised."""
    ratio = jnp.exp(log_prob - old_log_prob)
    return jnp.minimum(ratio * advantage, jnp.clip(ratio, 1.0 - clip, 1.0 + clip) * advantage)


def make_optimizer(ppo: PpoConfig) -> optax.GradientTransformation:
    """Clipped Adam that leaves a gradient out which is not finite."""
    adam = optax.chain(optax.clip_by_global_norm(ppo.grad_clip), optax.adam(ppo.lr, eps=1e-5))
    return optax.apply_if_finite(adam, max_consecutive_errors=2**31 - 1)


def gradient_step(
    optimizer: optax.GradientTransformation, grads: Any, opt_state: Any, params: Any
) -> tuple[Any, Any, dict[str, jax.Array]]:
    """New parameters and optimizer state; `grad_norm` before clipping, `skipped` (0 or 1)."""
    found: Any = optimizer.update(grads, opt_state, params)
    updates, new_state = found
    skipped = 1.0 - new_state.last_finite.astype(jnp.float32)
    figures = {"grad_norm": optax.tree.norm(grads), "skipped": skipped}
    return optax.apply_updates(params, updates), new_state, figures


def learned(
    optimizer: optax.GradientTransformation, state: Any, grads: Any
) -> tuple[Any, dict[str, jax.Array]]:
    """A learner's state (`params`, `opt_state`, `gradient_steps`) after a step, and its figures."""
    params, opt_state, figures = gradient_step(optimizer, grads, state.opt_state, state.params)
    count = optax.safe_increment(state.gradient_steps)
    return state.replace(params=params, opt_state=opt_state, gradient_steps=count), figures
