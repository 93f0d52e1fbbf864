"""MAML's outer step: PPO on what adapted policies earn, through their inner steps."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from cmrl_jax.algorithms.common.policy_gradient import (
    clipped_surrogate,
    learned,
    make_optimizer,
    masked_mean,
)
from cmrl_jax.algorithms.maml.inner import Episodes, InnerStep
from cmrl_jax.nn.gaussian_policy import entropy, kl, log_prob
from cmrl_jax.nn.normalizers import ObsStats


class LearnerState(struct.PyTreeNode):
    """Everything that is learned or counted.

    Attributes:
        params: what inner steps begin from.
        obs_stats: running statistics (normalizers.py), updated by collection.
        gradient_steps: outer ones, int32; exact below 2^31, where it stands still.
    """

    params: Any
    opt_state: Any
    obs_stats: ObsStats
    gradient_steps: jax.Array


class Learner:
    """The outer step of a configuration."""

    def __init__(self, inner: InnerStep):
        self.inner = inner
        self.ppo, self.maml = inner.config.ppo, inner.config.maml
        self.optimizer = make_optimizer(self.ppo)

    def adapted(self, params: Any, inner: Episodes) -> tuple[Any, jax.Array]:
        """The parameters after all inner steps of a group, and how far the policies of these have
        moved from those that collected (mean KL in nats).

        Args:
            inner: leading axes (step, episode, time).
        """

        def step(params: Any, episodes: Episodes):
            moved = kl(episodes.head, self.inner.head(params, episodes.obs))
            return self.inner(params, episodes), masked_mean(moved, episodes.mask)

        params, moved = jax.lax.scan(step, params, inner)
        return params, jnp.mean(moved)

    def loss(
        self, params: Any, inner: Episodes, outer: Episodes, advantage: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """The outer loss, mean over groups.

        Args:
            inner: (group, step, episode, time, ...).
            outer: of the adapted policies (group, episode, time, ...).
            advantage: of `outer`.
        """

        def of_group(inner: Episodes, outer: Episodes, advantage: jax.Array):
            adapted, moved = self.adapted(params, inner)
            head = self.inner.head(adapted, outer.obs)
            new, old = log_prob(head, outer.u), log_prob(outer.head, outer.u)
            gain = clipped_surrogate(new, old, advantage, self.ppo.clip)
            clipped = jnp.abs(jnp.expm1(new - old)) > self.ppo.clip
            return {
                "policy_loss": -masked_mean(gain, outer.mask),
                "inner_kl": moved,
                "entropy": masked_mean(
                    jnp.broadcast_to(entropy(head), outer.mask.shape), outer.mask
                ),
                "clip_fraction": masked_mean(clipped, outer.mask),
            }

        metrics = jax.tree.map(jnp.mean, jax.vmap(of_group)(inner, outer, advantage))
        loss = metrics["policy_loss"] + self.maml.kl * metrics["inner_kl"]
        return loss - self.ppo.entropy * metrics["entropy"], metrics

    def update(
        self, state: LearnerState, inner: Episodes, outer: Episodes
    ) -> tuple[LearnerState, dict[str, jax.Array]]:
        """`ppo.epochs` outer steps on all groups; metrics are means over them, ()."""
        advantage = jax.vmap(self.inner.advantages)(outer)

        def step(state: LearnerState, _: None):
            grads, metrics = jax.grad(self.loss, has_aux=True)(
                state.params, inner, outer, advantage
            )
            state, figures = learned(self.optimizer, state, grads)
            return state, metrics | figures

        state, metrics = jax.lax.scan(step, state, None, length=self.ppo.epochs)
        return state, jax.tree.map(jnp.nanmean, metrics)
