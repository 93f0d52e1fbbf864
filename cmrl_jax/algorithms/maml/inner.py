"""The inner step: a policy gradient on a group's own episodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cmrl_jax.algorithms.common.policy_gradient import gae, masked_mean, normalized
from cmrl_jax.algorithms.maml.baseline import baseline, returns_to_go
from cmrl_jax.config.schema import Config
from cmrl_jax.nn.gaussian_policy import Head, MlpPolicy, log_prob


class Episodes(NamedTuple):
    """Episodes of one group (episode, time, ...).

    Attributes:
        obs: normalised.
        u: actions before tanh.
        reward: as the environment gave it.
        mask: bool, the steps that there were.
        head: the policy's when u was drawn.
    """

    obs: jax.Array
    u: jax.Array
    reward: jax.Array
    mask: jax.Array
    head: Head


@dataclass(frozen=True)
class InnerStep:
    """Of a configuration.

    Attributes:
        policy: (..., obs) -> Head.
    """

    config: Config
    policy: MlpPolicy

    def head(self, params: Any, obs: jax.Array) -> Head:
        """The policy of parameters on normalised observations (..., obs)."""
        found: Any = self.policy.apply(params, obs)
        return found

    def advantages(self, episodes: Episodes) -> jax.Array:
        """(episode, time), normalised over the group."""
        ppo, (obs, _, reward, mask, _) = self.config.ppo, episodes
        value = baseline(obs, returns_to_go(reward, mask, ppo.gamma), mask)
        end = jnp.zeros(len(reward))
        advantage = gae(reward.T, value.T, end, mask.T, ppo.gamma, ppo.gae_lambda).T
        return normalized(advantage, mask, (0, 1))

    def objective(self, params: Any, episodes: Episodes, advantage: jax.Array) -> jax.Array:
        """Mean of ratio times advantage, (); its gradient is the policy gradient, and its second
        derivatives are right as well (Rothfuss et al. 2019: ProMP, the likelihood-ratio form).
        """
        new = log_prob(self.head(params, episodes.obs), episodes.u)
        ratio = jnp.exp(new - log_prob(episodes.head, episodes.u))
        return masked_mean(ratio * advantage, episodes.mask)

    def __call__(self, params: Any, episodes: Episodes) -> Any:
        """The parameters after one step."""
        advantage = self.advantages(episodes)
        grads = jax.grad(self.objective)(params, episodes, advantage)
        rate = self.config.maml.inner_lr
        return jax.tree.map(lambda x, grad: x + rate * grad, params, grads)
