"""RL2's agent: what it has seen is the hidden state, which episodes of a trial hand on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from cmrl_jax.algorithms.base import Told
from cmrl_jax.algorithms.common.policy_gradient import PolicyParams
from cmrl_jax.algorithms.common.replay import Transition
from cmrl_jax.algorithms.common.rollout import select_lanes
from cmrl_jax.nn.gaussian_policy import action_of
from cmrl_jax.nn.normalizers import ObsStats, normalize_obs
from cmrl_jax.nn.recurrent import Output, RecurrentActorCritic


class Memory(struct.PyTreeNode):
    """What a lane has seen, leading axis lane.

    Attributes:
        hidden: (lane, width), after the last step that was seen.
        action: (lane, act), of that step; zeros before the first.
        reward: (lane,), of that step.
        start: (lane,) float32, 1 where an episode begins.
        exploit: (lane,) bool, whether the episode at hand counts.
    """

    hidden: jax.Array
    action: jax.Array
    reward: jax.Array
    start: jax.Array
    exploit: jax.Array

    def after(self, hidden: jax.Array, action: jax.Array, reward: jax.Array) -> Memory:
        """The memory after a step."""
        start = jnp.zeros_like(self.start)
        return self.replace(hidden=hidden, action=action, reward=reward, start=start)


@dataclass(frozen=True)
class Rl2Agent:
    """An `Agent`, and what acts in training.

    Its actions have noise in the episodes that it learns from, as in training; in those that count
    where they are asked for.

    Args:
        net: of the configuration.
        reward_scale: of the rewards that it sees.
    """

    net: RecurrentActorCritic
    reward_scale: float

    adapts = True
    explores = True
    chunk = 1  # it acts on what it has just seen

    def init(self, told: Told) -> Memory:
        return self.blank(told.task_row.shape)

    def blank(self, lead: tuple[int, ...]) -> Memory:
        """Memories of lanes that have seen nothing."""
        zeros = lambda *size: jnp.zeros((*lead, *size))
        exploit = jnp.zeros(lead, bool)
        return Memory(zeros(self.net.width), zeros(self.net.action_size), zeros(), zeros(), exploit)

    def begin_episode(
        self, params: Any, memory: Memory, source: Memory, keys: jax.Array, exploit: jax.Array
    ) -> Memory:
        del params, memory, keys
        exploit = jnp.broadcast_to(exploit, source.exploit.shape)
        return source.replace(start=jnp.ones_like(source.start), exploit=exploit)

    def act(
        self,
        params: PolicyParams,
        memory: Memory,
        obs: jax.Array,
        noise: jax.Array,
        deterministic: Any,
    ) -> jax.Array:
        _, (head, _) = self.step(params, memory, obs)
        quiet = (memory.exploit & deterministic)[:, None]
        return action_of(head, noise, quiet)

    def observe(
        self, params: PolicyParams, memory: Memory, transitions: Transition, mask: jax.Array
    ) -> Memory:
        def add(memory: Memory, inputs: Any):
            obs, action, reward, counts = inputs
            hidden, _ = self.step(params, memory, obs)
            seen = memory.after(hidden, action, reward)
            return select_lanes(counts > 0, seen, memory), None

        parts = transitions.obs, transitions.action, transitions.reward, mask
        by_time = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), parts)
        return jax.lax.scan(add, memory, by_time)[0]

    def step(
        self, params: PolicyParams, memory: Memory, obs: jax.Array
    ) -> tuple[jax.Array, Output]:
        """The hidden state with an observation (lane, obs) taken in, and what is said of it."""
        x = self.inputs(params.obs_stats, memory, obs)
        found: Any = self.net.apply(params.params, memory.hidden, x)
        return found

    def inputs(self, obs_stats: ObsStats, memory: Memory, obs: jax.Array) -> jax.Array:
        """What the network is shown at a step (lane, input)."""
        before = (
            memory.action,
            (self.reward_scale * memory.reward)[..., None],
            memory.start[..., None],
        )
        return jnp.concatenate([normalize_obs(obs_stats, obs), *before], -1)
