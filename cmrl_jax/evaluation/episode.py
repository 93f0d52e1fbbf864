"""One evaluation episode of all lanes of several policies: the program that every evaluation runs.

Lanes are flat for the physics and (policy, lane) for the networks, so policies of one configuration
are scored side by side and share the physics' batch. Whose belief z is drawn from and what text a
lane is given are data (controls.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cmrl_jax.algorithms.cmrl.learner import Learner
from cmrl_jax.algorithms.common.replay import Transition
from cmrl_jax.algorithms.common.rollout import rollout
from cmrl_jax.config.schema import Config
from cmrl_jax.nn.context import Belief, ContextInference
from envs.sawyer import ACTION_SIZE, Ml4Env

Array = jax.Array | np.ndarray


class PolicyParams(NamedTuple):
    """What acting needs: the policy checkpoint's arrays."""

    actor_params: Any
    encoder_params: Any  # None without a latent
    obs_stats: Any


class Episode(NamedTuple):
    """Scores of one episode of every lane."""

    success_any: Array  # at any step, Meta-World's rule
    success_last: Array
    returns: Array
    first_success: Array  # control step, the horizon where there is none
    final_distance: Array  # metres
    faults: Array  # times the lane's physics was put back


class Lanes(NamedTuple):
    """What is the same for all policies, numpy or jax arrays with leading axis lane.

    Attributes:
        env_task: index into `envs.tasks.TASKS`.
        train_row: the task's row among the training tasks, read where the conditioning is a task
            id.
        lane_id: names task, goal and draw; a lane's noise depends on it, not on its place.
        placement: (lane, 3) fixture placements in metres.
    """

    env_task: Any
    train_row: Any
    lane_id: Any
    placement: Any


class ZSource(NamedTuple):
    """What z is drawn from, leading axes (policy, lane).

    Attributes:
        belief: None without a latent.
        text: (policy, lane, G).
        text_mask: 0 where the goal factor is left out.
    """

    belief: Belief | None
    text: np.ndarray
    text_mask: np.ndarray


EpisodeFn = Callable[..., tuple[Belief | None, Episode]]


def noise_key(key: jax.Array, lane_id: jax.Array) -> jax.Array:
    """The key of one lane's z in an episode, from the evaluation's key folded with the episode."""
    return jax.random.fold_in(jax.random.split(key)[0], lane_id)


def lane_noise(keys: jax.Array, latent_dim: int) -> jax.Array:
    """Standard normal numbers (lane, latent), each lane's from its own key (lane,)."""
    return jax.vmap(lambda key: jax.random.normal(key, (latent_dim,)))(keys)


def chunk_keys(config: Config, key: jax.Array, horizon: int) -> jax.Array:
    """A key (chunk,) for each chunk of an episode, from the same key as `noise_key`'s."""
    chunk = config.collect.chunk if horizon % config.collect.chunk == 0 else 1
    return jax.random.split(jax.random.split(key)[1], horizon // chunk)


def action_noise(key: jax.Array, lane_id: jax.Array, steps: int) -> jax.Array:
    """Noise of one lane's actions in a chunk of `steps` steps (time, act), from the chunk's key."""
    return jax.random.normal(jax.random.fold_in(key, lane_id), (steps, ACTION_SIZE))


def add_to_belief(
    learner: Learner,
    inference: ContextInference,
    params: PolicyParams,
    belief: Belief,
    transitions: Transition,
    mask: jax.Array,
    text: jax.Array,
) -> Belief:
    """One policy's beliefs with raw transitions (lane, time, ...) added where mask (lane, time).

    Args:
        text: text vector of every lane (lane, G).
    """
    normalized = replace(
        transitions,
        obs=learner.normalize_obs(params.obs_stats, transitions.obs),
        next_obs=learner.normalize_obs(params.obs_stats, transitions.next_obs),
    )
    ones = jnp.ones(mask.shape[:1])
    return inference.update_belief(params.encoder_params, belief, normalized, mask, text, ones)


def make_episode(config: Config, env: Ml4Env, learner: Learner, horizon: int) -> EpisodeFn:
    """Builds one evaluation episode of every lane of every policy, a jittable function.

    Returns:
        (params, belief, text, source, lanes, deterministic, key) -> belief with the episode added,
        Episode of (policy, lane). params, belief, text (policy, lane, G) and source have a leading
        policy axis; `deterministic` is () bool.
    """
    inference = learner.inference

    def episode(params, belief, text, source: ZSource, lanes: Lanes, deterministic, key):
        policies, per_policy = text.shape[:2]
        flat = lambda x: x.reshape(policies * per_policy, *x.shape[2:])
        by_policy = lambda x: x.reshape(policies, per_policy, *x.shape[1:])
        every = lambda x: jnp.broadcast_to(x, (policies, *x.shape))
        action_keys = chunk_keys(config, key, horizon)
        chunk = horizon // len(action_keys)

        if inference is None:
            zc = every(learner.task_conditioning(lanes.train_row))
        else:
            posterior = jax.vmap(inference.posterior_of_belief)(
                params.encoder_params, source.belief, source.text, source.text_mask
            )
            keys = jax.vmap(noise_key, in_axes=(None, 0))(key, lanes.lane_id)
            zc = inference.z_of_noise(posterior, lane_noise(keys, inference.latent_dim))

        def policy(actor_params, obs_stats, obs, zc, key, deterministic, noise):
            """The learner's policy for lanes of several policies."""
            act = jax.vmap(learner.policy, in_axes=(0, 0, 0, 0, None, None, 0))
            rows = (by_policy(x) for x in (obs, zc))
            action, _ = act(actor_params, obs_stats, *rows, key, deterministic, by_policy(noise))
            return flat(action), None

        actor = replace(learner, policy=policy)

        def lane_actions(key):
            """Noise of a chunk's actions (time, lane, act), each lane's its own."""
            draw = jax.vmap(action_noise, in_axes=(None, 0, None), out_axes=1)
            noise = draw(key, lanes.lane_id, chunk)
            return jnp.tile(noise, (1, policies, 1))

        def run_chunk(carry, key):
            state, belief = carry
            state, transitions, stats = rollout(
                env,
                actor,
                (params.actor_params, params.obs_stats),
                state,
                flat(zc),
                key,
                chunk,
                horizon,
                deterministic=deterministic,
                noise=lane_actions(key),
            )
            if inference is not None:
                by_lane = jax.tree.map(lambda x: by_policy(jnp.swapaxes(x, 0, 1)), transitions)
                mask = jnp.ones((per_policy, chunk))
                add = partial(add_to_belief, learner, inference)
                belief = jax.vmap(add, in_axes=(0, 0, 0, None, 0))(
                    params, belief, by_lane, mask, text
                )
            return (state, belief), (transitions.reward, stats.success, stats.distance)

        env_task, placement = flat(every(lanes.env_task)), flat(every(lanes.placement))
        state = jax.vmap(env.reset_to)(env_task, placement)
        (state, belief), scores = jax.lax.scan(run_chunk, (state, belief), action_keys)
        reward, success, distance = (x.reshape(horizon, -1) for x in scores)
        succeeded = jnp.any(success, 0)
        result = Episode(
            success_any=succeeded,
            success_last=success[-1],
            returns=jnp.sum(reward, 0),
            first_success=jnp.where(succeeded, jnp.argmax(success, 0), horizon),
            final_distance=distance[-1],
            faults=state.faults,
        )
        return belief, jax.tree.map(by_policy, result)

    return episode
