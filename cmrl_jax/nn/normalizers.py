"""Running statistics: of observations (pooled over training tasks) and of returns (per task).

Feed both from training tasks only; nothing of a test task may reach them. How they keep their
accuracy over a run of any length is in `moments.py`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from cmrl_jax.config.schema import SacConfig
from cmrl_jax.nn.moments import Moments, add_values, init_moments, rounded

OBS_CLIP = 10.0
CONSTANT_STD = 1e-3  # below it a dimension carries no signal in training and is switched off
SMALLEST_STD = 1e-6
SMALLEST_DENOMINATOR = 1e-8


@struct.dataclass
class ObsStats:
    """Statistics of observations.

    Attributes:
        moments: (obs,) of all observations so far.
        std: (obs,) what they are divided by; 1 before the first.
    """

    moments: Moments
    std: jax.Array

    @property
    def mean(self) -> jax.Array:
        return self.moments.mean.value


def init_obs_stats(obs_size: int) -> ObsStats:
    """Statistics of no observation at all: normalising with them only clips."""
    return ObsStats(init_moments((obs_size,)), jnp.ones((obs_size,), jnp.float32))


def update_obs_stats(stats: ObsStats, obs: jax.Array) -> ObsStats:
    """Add observations (..., obs); every leading axis is pooled."""
    from_mean = (obs - stats.mean).reshape(-1, obs.shape[-1])
    shift = from_mean.mean(0)
    variance = jnp.square(from_mean - shift).mean(0)
    moments = add_values(stats.moments, len(from_mean), shift, variance)
    std = jnp.sqrt(moments.variance.value)
    return ObsStats(moments, jnp.maximum(std, SMALLEST_STD))


def normalize_obs(stats: ObsStats, obs: jax.Array) -> jax.Array:
    """(obs - mean) / std, clipped to +-10; dimensions that were constant in training become 0.

    Without the last rule a dimension that never moved in training but differs in a test task
    would arrive as +-10 in a network that has never seen anything but 0 there.

    Args:
        stats: observation statistics.
        obs: (..., obs).
    """
    normalized = jnp.clip((obs - stats.mean) / stats.std, -OBS_CLIP, OBS_CLIP)
    return jnp.where(stats.std < CONSTANT_STD, 0.0, normalized)


@struct.dataclass
class ReturnStats:
    """Statistics of running discounted returns G.

    Attributes:
        returns: (task, lane) G of each lane.
        moments: (task,) of G.
        largest: (task,) running maximum of |G|.
    """

    returns: jax.Array
    moments: Moments
    largest: jax.Array


def init_return_stats(num_tasks: int, lanes_per_task: int) -> ReturnStats:
    """Statistics of no return at all."""
    return ReturnStats(
        returns=jnp.zeros((num_tasks, lanes_per_task), jnp.float32),
        moments=init_moments((num_tasks,)),
        largest=jnp.zeros((num_tasks,), jnp.float32),
    )


def update_return_stats(
    stats: ReturnStats, reward: jax.Array, first: jax.Array, gamma: float
) -> ReturnStats:
    """Add vector steps: G <- r + gamma G (1 - first), then the Chan merge over lanes.

    FastTD3's formula (younggyoseo/FastTD3: fast_td3/fast_td3_utils.py), with G kept per lane: its
    code keeps one G per task, which mixes lanes. Merging step by step makes the result the same
    bit for bit however the steps are cut into chunks.

    Args:
        stats: the statistics so far.
        reward: (time, task, lane) raw rewards.
        first: (time, task, lane) bool, first step of an episode.
        gamma: discount of a control step.
    """
    lanes = stats.returns.shape[1]

    def add_step(stats: ReturnStats, step: tuple[jax.Array, jax.Array]):
        reward, first = step  # (task, lane)
        returns = reward + gamma * jnp.where(first, 0.0, stats.returns)
        from_mean = returns - stats.moments.mean.value[:, None]
        shift = from_mean.mean(1)
        variance = rounded(jnp.square(from_mean - shift[:, None])).mean(1)
        return ReturnStats(
            returns=returns,
            moments=add_values(stats.moments, lanes, shift, variance),
            largest=jnp.maximum(stats.largest, jnp.abs(returns).max(1)),
        ), None

    return jax.lax.scan(add_step, stats, (reward, first))[0]


def reward_denominator(stats: ReturnStats, sac: SacConfig) -> jax.Array:
    """What sampled rewards are divided by, (task,): max(std, largest |G| / G_max, 1e-8).

    `reward_norm: none` gives ones, `global` the same with all tasks pooled.
    """
    mean, variance = stats.moments.mean.value, stats.moments.variance.value
    largest = stats.largest
    if sac.reward_norm == "none":
        return jnp.ones_like(mean)
    if sac.reward_norm == "global":  # every task has equally many values
        pooled = variance.mean() + jnp.square(mean - mean.mean()).mean()
        variance = jnp.full_like(variance, pooled)
        largest = jnp.full_like(largest, largest.max())
    bound = largest / sac.return_max
    return jnp.maximum(jnp.maximum(jnp.sqrt(variance), bound), SMALLEST_DENOMINATOR)
