"""Running statistics against numpy in float64."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmrl_jax.config.schema import SacConfig
from cmrl_jax.nn import normalizers
from cmrl_jax.nn.moments import Count, Moments

TASKS, LANES, GAMMA = 3, 4, 0.9


def test_observation_statistics_pool_all_leading_axes():
    rng = np.random.default_rng(0)
    data = rng.normal([0.6, -2.0], [0.01, 3.0], size=(5, 10, TASKS, LANES, 2)).astype(np.float32)
    stats = normalizers.init_obs_stats(2)
    update = jax.jit(normalizers.update_obs_stats)
    for chunk in data:
        stats = update(stats, jnp.asarray(chunk))
    flat = data.reshape(-1, 2).astype(np.float64)
    np.testing.assert_allclose(np.asarray(stats.mean), flat.mean(0), rtol=1e-5)
    np.testing.assert_allclose(np.asarray(stats.std), flat.std(0), rtol=1e-4)
    probe = np.array([0.61, 1.0])
    np.testing.assert_allclose(
        normalizers.normalize_obs(stats, jnp.asarray(probe, jnp.float32)),
        (probe - flat.mean(0)) / flat.std(0),
        rtol=1e-3,
    )


def test_a_dimension_constant_in_training_becomes_zero_at_test():
    rng = np.random.default_rng(1)
    train = rng.normal(size=(19_200, 3)).astype(np.float32)
    train[:, 1] = 0.7
    train[:, 2] = 0.7 + 5e-4 * train[:, 2]
    stats = normalizers.update_obs_stats(normalizers.init_obs_stats(3), jnp.asarray(train))
    normalized = normalizers.normalize_obs(stats, jnp.array([50.0, 0.2, 0.2]))
    np.testing.assert_array_equal(normalized, [normalizers.OBS_CLIP, 0.0, 0.0])


def test_statistics_keep_their_accuracy_over_a_hundred_million_samples():
    """A small spread around a large mean is what single precision would lose first."""

    def add(stats: normalizers.ObsStats, key: jax.Array):
        noise = jax.random.normal(key, (1000, 2)) * jnp.array([2e-3, 1.0])
        # A thousand copies of each draw: the count grows to 1e8 without as many random numbers.
        obs = jnp.broadcast_to(noise + jnp.array([5.0, 0.0]), (1000, 1000, 2))
        return normalizers.update_obs_stats(stats, obs), None

    stats, _ = jax.jit(lambda s, k: jax.lax.scan(add, s, k))(
        normalizers.init_obs_stats(2), jax.random.split(jax.random.key(0), 100)
    )
    assert int(stats.moments.count) == 100_000_000
    np.testing.assert_allclose(stats.mean, [5.0, 0.0], atol=1e-2)
    np.testing.assert_allclose(stats.std, [2e-3, 1.0], rtol=2e-2)


def returns_by_loop(reward: np.ndarray, first: np.ndarray) -> np.ndarray:
    """All values of G, (time, task, lane)."""
    values = np.zeros(reward.shape)
    for task in range(reward.shape[1]):
        for lane in range(reward.shape[2]):
            value = 0.0
            for time in range(reward.shape[0]):
                if first[time, task, lane]:
                    value = 0.0
                value = float(reward[time, task, lane]) + GAMMA * value
                values[time, task, lane] = value
    return values


def make_rewards() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    # Task 0 is flat (the bound decides), task 2 has a wide spread around 0.
    reward = rng.normal([[0.5], [1.0], [-3.0]], [[1e-3], [0.5], [4.0]], size=(60, TASKS, LANES))
    first = rng.random((60, TASKS, LANES)) < 0.05  # lanes restart at different times
    first[0] = True
    return reward.astype(np.float32), first


def test_return_statistics_equal_a_loop_per_lane():
    reward, first = make_rewards()
    stats = normalizers.update_return_stats(
        normalizers.init_return_stats(TASKS, LANES), jnp.asarray(reward), jnp.asarray(first), GAMMA
    )
    values = returns_by_loop(reward, first)
    per_task = values.transpose(1, 0, 2).reshape(TASKS, -1)
    np.testing.assert_allclose(stats.returns, values[-1], rtol=1e-4)
    assert int(stats.moments.count) == 60 * LANES
    np.testing.assert_allclose(stats.moments.mean.value, per_task.mean(1), rtol=1e-4)
    np.testing.assert_allclose(stats.moments.variance.value, per_task.var(1), rtol=1e-3)
    np.testing.assert_allclose(stats.largest, np.abs(per_task).max(1), rtol=1e-5)

    sac = SacConfig(return_max=10.0)
    bound = np.abs(per_task).max(1) / 10.0
    np.testing.assert_allclose(
        normalizers.reward_denominator(stats, sac), np.maximum(per_task.std(1), bound), rtol=1e-4
    )
    np.testing.assert_allclose(
        normalizers.reward_denominator(stats, dataclasses.replace(sac, reward_norm="global")),
        np.full(TASKS, max(values.std(), bound.max())),
        rtol=1e-4,
    )
    np.testing.assert_array_equal(
        normalizers.reward_denominator(stats, dataclasses.replace(sac, reward_norm="none")),
        np.ones(TASKS),
    )


def test_the_largest_return_bounds_a_task_without_spread():
    reward = jnp.full((1, 1, 2), -20.0)
    stats = normalizers.update_return_stats(
        normalizers.init_return_stats(1, 2), reward, jnp.ones((1, 1, 2), bool), GAMMA
    )
    assert float(stats.moments.variance.value[0]) == 0.0
    np.testing.assert_allclose(normalizers.reward_denominator(stats, SacConfig()), [2.0])


def test_a_task_without_reward_is_divided_by_a_tiny_number_not_by_zero():
    stats = normalizers.init_return_stats(2, LANES)
    for norm in ("per_task", "global"):
        np.testing.assert_allclose(
            normalizers.reward_denominator(stats, SacConfig(reward_norm=norm)), [1e-8, 1e-8]
        )


@pytest.mark.parametrize("cuts", [[60], [1] * 60, [7, 20, 33]])
def test_return_statistics_do_not_depend_on_the_chunks(cuts: list[int]):
    reward, first = make_rewards()
    update = jax.jit(normalizers.update_return_stats, static_argnums=3)
    whole = update(normalizers.init_return_stats(TASKS, LANES), reward, first, GAMMA)
    stats, start = normalizers.init_return_stats(TASKS, LANES), 0
    for length in cuts:
        stop = start + length
        stats = update(stats, reward[start:stop], first[start:stop], GAMMA)
        start = stop
    for cut, uncut in zip(jax.tree.leaves(stats), jax.tree.leaves(whole), strict=True):
        np.testing.assert_array_equal(cut, uncut)


def after_many(count: int, mean: float, variance: float, size: int) -> Moments:
    """The moments of `count` values, too many to be added here."""
    started = normalizers.init_obs_stats(size).moments
    return dataclasses.replace(
        started,
        count=Count.of(count),
        mean=dataclasses.replace(started.mean, value=jnp.full(size, mean)),
        variance=dataclasses.replace(started.variance, value=jnp.full(size, variance)),
    )


def assert_moments(moments: Moments, before: Moments, values: np.ndarray) -> None:
    """Count and change of the moments by values (value, size), against numpy in float64."""
    count, new = int(before.count), len(values)
    mean, variance = float(before.mean.value[0]), float(before.variance.value[0])
    values = values.astype(np.float64)
    share = new / (count + new)
    shift = values.mean(0) - mean
    spread = values.var(0) + np.square(shift) * (1 - share)
    assert int(moments.count) == count + new
    pairs = (
        (moments.mean, mean, share * shift),
        (moments.variance, variance, share * (spread - variance)),
    )
    for found, start, change in pairs:
        exact = np.asarray(found.value, np.float64) + np.asarray(found.rest, np.float64)
        np.testing.assert_allclose(exact - start, change, rtol=1e-2)
        np.testing.assert_allclose(found.value, start + change, rtol=2e-7)


# What float32 counts to exactly, where it has lost most of a step, and beyond 32 bits.
LONG = (2**24 - 1000, 2**28, 2**33)


def rare_values(steps: int, seed: int) -> np.ndarray:
    """(value, 2), few of them large: mean 2, variance 196.

    Rounded into a single float32, only the large ones would count after 2^24 steps.
    """
    large = np.random.default_rng(seed).random((steps, 2)) < 0.02
    return np.where(large, 100.0, 0.0).astype(np.float32)


@pytest.mark.parametrize("count", LONG)
def test_returns_of_one_lane_are_right_however_long_the_run(count: int):
    values = rare_values(2**16, seed=3)
    stats = normalizers.init_return_stats(2, 1)
    stats = dataclasses.replace(stats, moments=after_many(count, 2.0, 196.0, 2))
    reward = jnp.asarray(values)[..., None]  # (time, task, lane)
    first = jnp.ones(reward.shape, bool)  # a step's return is its reward
    after = jax.jit(normalizers.update_return_stats)(stats, reward, first, GAMMA)
    assert_moments(after.moments, stats.moments, values)
    np.testing.assert_allclose(
        normalizers.reward_denominator(after, SacConfig(return_max=1e9)), 14.0, rtol=1e-3
    )


@pytest.mark.parametrize("count", LONG)
def test_observations_of_one_lane_are_right_however_long_the_run(count: int):
    values = rare_values(2**16, seed=4)
    moments = after_many(count, 2.0, 196.0, 2)
    stats = dataclasses.replace(normalizers.init_obs_stats(2), moments=moments)
    add = lambda stats, obs: (normalizers.update_obs_stats(stats, obs), None)
    after, _ = jax.jit(lambda s, x: jax.lax.scan(add, s, x))(stats, jnp.asarray(values)[:, None])
    assert_moments(after.moments, moments, values)
    np.testing.assert_allclose(after.std, 14.0, rtol=1e-3)


def test_updates_keep_types_so_that_a_scan_can_carry_them():
    obs_stats = normalizers.init_obs_stats(5)
    after = jax.eval_shape(normalizers.update_obs_stats, obs_stats, jnp.zeros((7, 5)))
    assert after == jax.eval_shape(lambda: obs_stats)
    assert not any(leaf.weak_type for leaf in jax.tree.leaves(after))
    stats = normalizers.init_return_stats(TASKS, LANES)
    reward = jnp.zeros((2, TASKS, LANES))
    after = jax.eval_shape(
        lambda s: normalizers.update_return_stats(s, reward, reward > 0, 0.9), stats
    )
    assert after == jax.eval_shape(lambda: stats)
    assert not any(leaf.weak_type for leaf in jax.tree.leaves(after))
