"""Control steps of many lanes: the piece that collection and evaluation share.

A lane is one parallel environment, and lanes of different tasks mix freely. An episode ends in a
true terminal, where the environment has any, or is cut by the time limit: the first lets no later
reward count, the second must not.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cmrl_jax import parallel
from cmrl_jax.algorithms.common.replay import Transition
from cmrl_jax.config.schema import Config
from envs.base import MetaEnv

Act = Callable[[jax.Array, jax.Array, jax.Array | None], jax.Array]
"""(obs (lane, obs), key, noise (lane, act) or None) -> actions (lane, act)."""


class StepStats(NamedTuple):
    """What a control step reports beside its transition, each (time, lane)."""

    success: jax.Array  # bool, at that very step
    distance: jax.Array  # the quantity success is judged by
    faults: jax.Array  # int32, times the simulation was put back in that step


def rollout(
    env: MetaEnv,
    act: Act,
    state: Any,
    key: jax.Array,
    steps: int,
    horizon: int,
    begun: jax.Array | int = 0,
    imposed: tuple[jax.Array, jax.Array] | None = None,
    noise: jax.Array | None = None,
    restart: Callable[[jax.Array], Any] | None = None,
) -> tuple[Any, Transition, StepStats]:
    """Runs `steps` control steps of every lane.

    Args:
        state: environment states, leading axis lane.
        horizon: control steps after which whatever episode a lane is in is cut.
        begun: how many of those have passed.
        imposed: actions (steps, lane, act) in place of the policy's, and where (steps, lane) bool.
        noise: (steps, lane, act) standard normal, for `act`.
        restart: key -> fresh states of all lanes, which those take whose episode has ended in a
            terminal; None leaves them where they are, and their later steps mean nothing.

    Returns:
        The new states, and transitions and statistics with leading axes (time, lane).
    """
    lanes = state.obs.shape[0]

    def step(state: Any, inputs: Any):
        time, key, step_noise, in_place = inputs
        k_act, k_restart = jax.random.split(key)
        action = act(state.obs, k_act, step_noise)
        if in_place is not None:
            action = jnp.where(in_place[1][:, None], in_place[0], action)
        new = parallel.by_part(jax.vmap(env.step))(state, action)
        terminated = new.terminated if env.can_terminate else jnp.zeros((lanes,), bool)
        transition = Transition(
            obs=state.obs,
            action=action,
            reward=new.reward,
            terminated=terminated,
            truncated=jnp.broadcast_to(time + 1 >= horizon, (lanes,)),
            first=state.steps == 0,
            next_obs=new.obs,
        )
        stats = StepStats(new.success, new.distance, new.faults - state.faults)
        if env.can_terminate and restart is not None:
            new = select_lanes(terminated, restart(k_restart), new)
        return new, (transition, stats)

    inputs = (begun + jnp.arange(steps), jax.random.split(key, steps), noise, imposed)
    state, (transitions, stats) = jax.lax.scan(step, state, inputs)
    return state, transitions, stats


def keys_of(key: jax.Array, count: int) -> jax.Array:
    """Keys (count,), each its own number's, however many there are."""
    return jax.vmap(lambda number: jax.random.fold_in(key, number))(jnp.arange(count))


def make_reset(
    config: Config, env: MetaEnv, goals: jax.Array | None, train_task: jax.Array
) -> Callable[[jax.Array], Any]:
    """Keys (lane,) -> fresh episodes of all lanes; equal keys of a task have equal goals.

    Args:
        goals: goals (training task, goal, goal_size) to draw from; None: the environment's resets.
        train_task: (lane,) rows of the training tasks.
    """
    ids = jnp.array([env.tasks.index(name) for name in config.tasks.train])[train_task]

    def reset(keys: jax.Array) -> Any:
        if goals is None:
            return parallel.by_part(jax.vmap(env.reset))(keys, ids)
        count = goals.shape[1]
        goal = jax.vmap(lambda k: jax.random.randint(k, (), 0, count))(keys)
        return parallel.by_part(jax.vmap(env.reset_to))(ids, goals[train_task, goal])

    return reset


def select_lanes(chosen: jax.Array, new: Any, old: Any) -> Any:
    """`new` for the lanes that are chosen (lane,), `old` for the others; pytrees of lanes."""
    broadcast = lambda leaf: chosen.reshape(chosen.shape + (1,) * (leaf.ndim - 1))
    return jax.tree.map(lambda x, y: jnp.where(broadcast(y), x, y), new, old)


class EpisodeFigures(NamedTuple):
    """Figures of each lane's first episode in a stretch of steps, each (...)."""

    success_any: jax.Array  # at any step
    success_last: jax.Array  # at its last step
    returns: jax.Array
    first_success: jax.Array  # step, the number of steps where there is none
    final_distance: jax.Array  # at its last step


def episode_figures(
    reward: jax.Array, stats: StepStats, terminated: jax.Array | None
) -> EpisodeFigures:
    """Figures of lanes that begin an episode at the first of these steps.

    Args:
        reward: (time, ...), as are the others, any axes of lanes.
        terminated: what comes after the first True does not count; None: nothing terminates.
    """
    success, distance, _ = stats
    if terminated is None:
        last = lambda x: x[-1]
    else:
        counts = is_before_the_end(terminated)
        reward, success = jnp.where(counts, reward, 0.0), success & counts
        end = jnp.sum(counts, 0, dtype=jnp.int32) - 1
        last = lambda x: jnp.take_along_axis(x, end[None], 0)[0]
    success_any = jnp.any(success, 0)
    return EpisodeFigures(
        success_any=success_any,
        success_last=last(success),
        returns=jnp.sum(reward, 0),
        first_success=jnp.where(success_any, jnp.argmax(success, 0), len(reward)),
        final_distance=last(distance),
    )


def is_before_the_end(terminated: jax.Array) -> jax.Array:
    """Which steps (time, ...) belong to each lane's first episode: up to and with its terminal."""
    ends = jnp.cumsum(terminated, 0)
    return ends - terminated == 0


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
