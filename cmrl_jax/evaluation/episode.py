"""One evaluation episode of all lanes of several policies: the program that every evaluation runs.

Lanes are flat for the physics and (policy, lane) for the agent, so policies of one configuration
are scored side by side and share the physics' batch. What an episode is acted on (`source`) is
data, which an evaluation's controls exchange.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cmrl_jax.algorithms.base import Agent
from cmrl_jax.algorithms.common.rollout import (
    episode_figures,
    is_before_the_end,
    rollout,
)
from envs.base import MetaEnv


class Episode(NamedTuple):
    """Scores of one episode of every lane."""

    success_any: Any  # at any step, Meta-World's rule
    success_last: Any
    returns: Any
    first_success: Any  # control step, the horizon where there is none
    final_distance: Any  # metres
    faults: Any  # times the lane's physics was put back


class Lanes(NamedTuple):
    """What is the same for all policies, numpy or jax arrays with leading axis lane.

    Attributes:
        env_task: index into the environment's tasks.
        lane_id: names task, goal and draw; a lane's noise depends on it, not on its place.
        goal: (lane, goal_size), what the episode is reset to.
    """

    env_task: Any
    lane_id: Any
    goal: Any


EpisodeFn = Callable[..., tuple[Any, Episode]]


def agent_keys(key: jax.Array, lane_id: jax.Array) -> jax.Array:
    """The keys (lane,) of what an agent draws for an episode, from the episode's key."""
    return jax.vmap(lambda lane: jax.random.fold_in(jax.random.split(key)[0], lane))(lane_id)


def chunk_keys(chunk: int, key: jax.Array, horizon: int) -> jax.Array:
    """A key (chunk,) for each chunk of an episode, from the same key as `agent_keys`'."""
    steps = chunk if horizon % chunk == 0 else 1
    return jax.random.split(jax.random.split(key)[1], horizon // steps)


def action_noise(key: jax.Array, lane_id: jax.Array, steps: int, action_size: int) -> jax.Array:
    """Noise of one lane's actions in a chunk of `steps` steps (time, act), from the chunk's key."""
    return jax.random.normal(jax.random.fold_in(key, lane_id), (steps, action_size))


def make_episode(env: MetaEnv, agent: Agent, horizon: int) -> EpisodeFn:
    """Builds one evaluation episode of every lane of every policy, a jittable function.

    Returns:
        (params, memory, source, lanes, deterministic, exploit, key) -> memory with the episode
        observed, Episode of (policy, lane). params, memory and source have a leading policy axis;
        `deterministic` and `exploit` (see `Agent.begin_episode`) are () bool.
    """

    def episode(params, memory, source, lanes: Lanes, deterministic, exploit, key):
        policies, per_policy = jax.tree.leaves(memory)[0].shape[:2]
        flat = lambda x: x.reshape(policies * per_policy, *x.shape[2:])
        by_policy = lambda x: x.reshape(policies, per_policy, *x.shape[1:])
        every = lambda x: flat(jnp.broadcast_to(x, (policies, *x.shape)))
        action_keys = chunk_keys(agent.chunk, key, horizon)
        chunk = horizon // len(action_keys)
        begin = jax.vmap(agent.begin_episode, in_axes=(0, 0, 0, None, None))
        memory = begin(params, memory, source, agent_keys(key, lanes.lane_id), exploit)

        def lane_noise(key):
            """Noise of a chunk's actions (time, lane, act), each lane's its own."""
            draw = jax.vmap(action_noise, in_axes=(None, 0, None, None), out_axes=1)
            noise = draw(key, lanes.lane_id, chunk, env.action_size)
            return jnp.tile(noise, (1, policies, 1))

        def run_chunk(carry, key):
            state, memory, ended = carry

            def act(obs, _, noise):
                act = jax.vmap(agent.act, in_axes=(0, 0, 0, 0, None))
                return flat(act(params, memory, by_policy(obs), by_policy(noise), deterministic))

            state, transitions, stats = rollout(
                env, act, state, key, chunk, horizon, noise=lane_noise(key)
            )
            counts = jnp.ones((policies, per_policy, chunk))
            if env.can_terminate:  # what comes after a terminal is not the episode's
                counts = is_before_the_end(transitions.terminated) & ~ended
                counts = by_policy(counts.T.astype(jnp.float32))
                ended = ended | jnp.any(transitions.terminated, 0)
            by_lane = jax.tree.map(lambda x: by_policy(jnp.swapaxes(x, 0, 1)), transitions)
            memory = jax.vmap(agent.observe)(params, memory, by_lane, counts)
            return (state, memory, ended), (transitions.reward, transitions.terminated, stats)

        state = jax.vmap(env.reset_to)(every(lanes.env_task), every(lanes.goal))
        ended = jnp.zeros(policies * per_policy, bool)
        (state, memory, _), scores = jax.lax.scan(run_chunk, (state, memory, ended), action_keys)
        reward, terminated, stats = jax.tree.map(lambda x: x.reshape(horizon, -1), scores)
        figures = episode_figures(reward, stats, terminated if env.can_terminate else None)
        result = Episode(**figures._asdict(), faults=state.faults)
        return memory, jax.tree.map(by_policy, result)

    return episode
