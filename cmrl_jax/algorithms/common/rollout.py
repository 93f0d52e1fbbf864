"""Control steps of many lanes: the piece that collection and evaluation share.

A lane is one parallel environment; z stays fixed for the episode, so a rollout is a plain scan of
policy and physics. Lanes of different tasks mix freely.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from cmrl_jax import parallel
from cmrl_jax.algorithms.cmrl.learner import Learner
from cmrl_jax.algorithms.common.replay import Transition
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
    noise: jax.Array | None = None,
) -> tuple[State, Transition, StepStats]:
    """Runs `steps` control steps of every lane.

    Args:
        policy: actor_params and obs_stats.
        state: environment states, leading axis lane.
        zc: conditioning (lane, conditioning), fixed for these steps.
        horizon: control steps of an episode; the transition that ends it is truncated.
        random_actions: () bool; uniform actions in place of the policy's.
        noise: (steps, lane, act) standard normal, in place of independent draws.

    Returns:
        The new states, and transitions and statistics with leading axes (time, lane).
    """
    actor_params, obs_stats = policy
    lanes = state.obs.shape[0]

    def step(state: State, inputs: tuple[jax.Array, jax.Array | None]):
        key, step_noise = inputs
        k_act, k_uniform = jax.random.split(key)
        given = () if step_noise is None else (step_noise,)
        action, _ = learner.policy(
            actor_params, obs_stats, state.obs, zc, k_act, deterministic, *given
        )
        uniform = jax.random.uniform(k_uniform, (lanes, ACTION_SIZE), minval=-1.0, maxval=1.0)
        action = jnp.where(random_actions, uniform, action)
        new = parallel.by_part(jax.vmap(env.step))(state, action)
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

    inputs = (jax.random.split(key, steps), noise)
    state, (transitions, stats) = jax.lax.scan(step, state, inputs)
    return state, transitions, stats


def correlated_noise(
    key: jax.Array, steps: int, shape: tuple[int, ...], correlation: float
) -> jax.Array:
    """Standard normal noise (steps, *shape) whose successive steps correlate; 0 is white noise.

    A first-order autoregressive process: each step's density is the policy's own, but a lane keeps
    to a direction for about 1 / (1 - correlation) steps, where white noise cancels itself out.
    """
    fresh = jax.random.normal(key, (steps, *shape))
    scale = (1.0 - correlation**2) ** 0.5

    def step(noise: jax.Array, fresh: jax.Array):
        noise = correlation * noise + scale * fresh
        return noise, noise

    _, later = jax.lax.scan(step, fresh[0], fresh[1:])
    return jnp.concatenate([fresh[:1], later])
