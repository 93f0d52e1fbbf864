"""A recurrent policy with its value: what RL2 learns with.

A network of three parts: only the GRU runs step by step, the layers before and after it take all
steps of a trial at once.
"""

from __future__ import annotations

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from cmrl_jax.nn.gaussian_policy import Head, small


class Output(NamedTuple):
    """Of a step: the policy's `Head`, and its value (...)."""

    head: Head
    value: jax.Array


class RecurrentActorCritic(nn.Module):
    """tanh layer, GRU, then policy and value, each from the GRU's output and its input."""

    width: int
    hidden: int
    action_size: int
    std_init: float

    def setup(self) -> None:
        self.before = nn.Dense(self.hidden)
        self.gru = nn.GRUCell(self.width)
        self.policy = nn.Dense(self.hidden)
        self.mean = nn.Dense(self.action_size, kernel_init=small())
        self.critic = nn.Dense(self.hidden)
        self.value = nn.Dense(1)
        init = nn.initializers.constant(jnp.log(self.std_init))
        self.log_std = self.param("log_std", init, (self.action_size,))

    def __call__(self, state: jax.Array, x: jax.Array) -> tuple[jax.Array, Output]:
        """One step: hidden state (lane, width) and input (lane, input) -> the new state, Output."""
        y = self.embed(x)
        state = self.remember(state, y)
        return state, self.heads(state, y)

    def embed(self, x: jax.Array) -> jax.Array:
        """Inputs (..., input) -> (..., hidden)."""
        return nn.tanh(self.before(x))

    def remember(self, state: jax.Array, y: jax.Array) -> jax.Array:
        """The hidden state after a step."""
        return self.gru(state, y)[0]

    def heads(self, state: jax.Array, y: jax.Array) -> Output:
        """Of hidden states (..., width) and embedded inputs (..., hidden)."""
        features = jnp.concatenate([state, y], -1)
        mean = self.mean(nn.tanh(self.policy(features)))
        value = self.value(nn.tanh(self.critic(features)))[..., 0]
        return Output(Head(mean, self.log_std), value)
