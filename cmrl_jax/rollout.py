"""Control steps of many lanes: the piece that collection and evaluation share.

A lane is one parallel environment; z stays fixed for the episode, so a rollout is a plain scan of
policy and physics. Lanes of different tasks mix freely.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from cmrl_jax.learner import Learner
from cmrl_jax.replay import Transition
from envs.sawyer import ACTION_SIZE, Ml4Env, State


class StepStats(NamedTuple):
    """What a control step reports beside its transition, each (time, lane)."""

    success: jax.Array  # bool, at that very step
    distance: jax.Array  # metres from object to target


def rollout(
    env: Ml4Env,
    learner: Learner,
    policy: tuple[object, object],
    state: State,
    zc: jax.Array,
    key: jax.Array,
    steps: int,
    horizon: int,
    deterministic: bool = False,
    random_actions: jax.Array | bool = False,
) -> tuple[State, Transition, StepStats]:
    """Runs `steps` control steps of every lane.

    Args:
        policy: actor_params and obs_stats.
        state: environment states, leading axis lane.
        zc: conditioning (lane, conditioning), fixed for these steps.
        horizon: control steps of an episode; the transition that ends it is truncated.
        random_actions: () bool; uniform actions in place of the policy's.

    Returns:
        The new states, and transitions and statistics with leading axes (time, lane).
    """
    actor_params, obs_stats = policy
    lanes = state.obs.shape[0]

    def step(state: State, key: jax.Array):
        k_act, k_uniform = jax.random.split(key)
        action, _ = learner.policy(actor_params, obs_stats, state.obs, zc, k_act, deterministic)
        uniform = jax.random.uniform(k_uniform, (lanes, ACTION_SIZE), minval=-1.0, maxval=1.0)
        action = jnp.where(random_actions, uniform, action)
        new = jax.vmap(env.step)(state, action)
        transition = Transition(
            obs=state.obs,
            action=action,
            reward=new.reward,
            terminated=jnp.zeros((lanes,), bool),  # Meta-World has no terminal states
            truncated=new.steps >= horizon,
            first=state.steps == 0,
            next_obs=new.obs,
        )
        return new, (transition, StepStats(new.success, new.distance))

    state, (transitions, stats) = jax.lax.scan(step, state, jax.random.split(key, steps))
    return state, transitions, stats
