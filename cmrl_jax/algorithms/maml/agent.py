"""MAML's agent: own episodes are remembered, and inner steps are taken on them.

A lane's parameters are kept as what they differ by from those that training found. Every
`maml.episodes` episodes an inner step is taken for good, as in training; an episode that counts is
acted on one more step, on the episodes since.
"""

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
from cmrl_jax.algorithms.maml.inner import Episodes, InnerStep
from cmrl_jax.nn.gaussian_policy import Head, action_of, pre_tanh
from cmrl_jax.nn.normalizers import normalize_obs


class Memory(struct.PyTreeNode):
    """What a lane has seen, leading axis lane.

    Attributes:
        moved: by how much inner steps have moved its parameters (lane, ...).
        acting: the same of the episode at hand.
        obs, action, reward: of the episodes since the last inner step (lane, episode, time, ...).
        steps: (lane, episode) int32, control steps of each.
        episodes: (lane,) int32, how many there are.
        exploit: (lane,) bool, whether the episode at hand counts.
    """

    moved: Any
    acting: Any
    obs: jax.Array
    action: jax.Array
    reward: jax.Array
    steps: jax.Array
    episodes: jax.Array
    exploit: jax.Array


@dataclass(frozen=True)
class MamlAgent:
    """An `Agent`.

    Args:
        inner: the step of the configuration.
        shapes: of the policy's parameters.
        obs_size, action_size: of the environment.
    """

    inner: InnerStep
    shapes: Any
    obs_size: int
    action_size: int

    adapts = True
    explores = True

    @property
    def chunk(self) -> int:
        """An episode: nothing is learned within one."""
        return self.inner.config.env.horizon

    def init(self, told: Told) -> Memory:
        lead, config = told.task_row.shape, self.inner.config
        unmoved = jax.tree.map(lambda x: jnp.zeros((*lead, *x.shape)), self.shapes)
        places = *lead, config.maml.episodes, config.env.horizon
        return Memory(
            moved=unmoved,
            acting=unmoved,
            obs=jnp.zeros((*places, self.obs_size)),
            action=jnp.zeros((*places, self.action_size)),
            reward=jnp.zeros(places),
            steps=jnp.zeros(places[:-1], jnp.int32),
            episodes=jnp.zeros(lead, jnp.int32),
            exploit=jnp.zeros(lead, bool),
        )

    def begin_episode(
        self,
        params: PolicyParams,
        memory: Memory,
        source: Memory,
        keys: jax.Array,
        exploit: jax.Array,
    ) -> Memory:
        del keys
        own, other = self.at_a_border(params, memory), self.at_a_border(params, source)
        stepped = self.stepped(params, other)
        acting = jax.tree.map(lambda x, y: jnp.where(exploit, x, y), stepped, other.moved)
        return own.replace(
            acting=acting,
            episodes=own.episodes + jnp.where(exploit, 0, 1),
            exploit=jnp.broadcast_to(exploit, own.exploit.shape),
        )

    def at_a_border(self, params: PolicyParams, memory: Memory) -> Memory:
        """The memory with the inner step taken for which there are enough episodes."""
        is_full = memory.episodes >= self.inner.config.maml.episodes
        none = jnp.zeros_like(memory.episodes)
        emptied = memory.replace(
            moved=self.stepped(params, memory), episodes=none, steps=jnp.zeros_like(memory.steps)
        )
        return select_lanes(is_full, emptied, memory)

    def stepped(self, params: PolicyParams, memory: Memory) -> Any:
        """`moved` after one more inner step, on the episodes there are; as it is without any."""

        def of_lane(lane: Memory) -> Any:
            old = jax.tree.map(jnp.add, params.params, lane.moved)
            obs = normalize_obs(params.obs_stats, lane.obs)
            mask = jnp.arange(obs.shape[1]) < lane.steps[:, None]
            head = self.inner.head(old, obs)
            mean, log_std = head.mean, jnp.broadcast_to(head.log_std, head.mean.shape)
            found = Episodes(obs, pre_tanh(lane.action), lane.reward, mask, Head(mean, log_std))
            new = self.inner(old, found)
            return jax.tree.map(lambda new, start: new - start, new, params.params)

        has_any = jnp.sum(memory.steps, -1) > 0
        return select_lanes(has_any, jax.vmap(of_lane)(memory), memory.moved)

    def act(
        self,
        params: PolicyParams,
        memory: Memory,
        obs: jax.Array,
        noise: jax.Array,
        deterministic: Any,
    ) -> jax.Array:
        def of_lane(moved: Any, obs: jax.Array) -> Head:
            return self.inner.head(jax.tree.map(jnp.add, params.params, moved), obs)

        head = jax.vmap(of_lane)(memory.acting, normalize_obs(params.obs_stats, obs))
        # An episode that is learned from has its noise: there is no gradient without.
        quiet = (memory.exploit & deterministic)[:, None]
        return action_of(head, noise, quiet)

    def observe(
        self, params: PolicyParams, memory: Memory, transitions: Transition, mask: jax.Array
    ) -> Memory:
        del params

        def of_lane(lane: Memory, transitions: Transition, mask: jax.Array) -> Memory:
            episode = lane.episodes - 1
            before = lane.steps[episode]
            time = before + jnp.cumsum(mask > 0) - 1
            time = jnp.where(
                mask > 0, time, lane.reward.shape[1]
            )  # dropped: there is no such place
            put = lambda kept, new: kept.at[episode, time].set(new, mode="drop")
            return lane.replace(
                obs=put(lane.obs, transitions.obs),
                action=put(lane.action, transitions.action),
                reward=put(lane.reward, transitions.reward),
                steps=lane.steps.at[episode].add(jnp.sum(mask > 0, dtype=jnp.int32)),
            )

        return jax.vmap(of_lane)(memory, transitions, mask)
