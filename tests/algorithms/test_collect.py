"""Exploration: how much wider than the policy's own a lane's noise is; actions that are imposed."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from cmrl_jax.algorithms.cmrl.collect import imposed_actions, make_noise_scale
from cmrl_jax.config.schema import Config


def config_of(lanes):
    config = Config()  # three tasks, noise up to 6 times as wide
    return replace(config, collect=replace(config.collect, lanes=lanes))


def test_several_lanes_of_a_task_cover_the_range_in_every_episode():
    scale = make_noise_scale(config_of(12))
    first, second = (np.asarray(scale(jax.random.key(seed))) for seed in (0, 1))
    np.testing.assert_array_equal(first, second)
    expected = [6.0 ** (i / 3) for i in range(4)]
    np.testing.assert_allclose(np.sort(first.reshape(3, 4)), [expected] * 3, rtol=1e-6)


def test_a_single_lane_of_a_task_covers_it_over_episodes():
    scale = jax.jit(jax.vmap(make_noise_scale(config_of(3))))
    drawn = np.asarray(scale(jax.random.split(jax.random.key(0), 4000)))  # (episode, lane)
    assert drawn.min() >= 1.0 and drawn.max() <= 6.0
    # As evenly over the logarithm as many lanes are.
    for quantile in (0.01, 0.25, 0.5, 0.75, 0.99):
        expected = 6.0**quantile
        np.testing.assert_allclose(np.quantile(drawn, quantile, axis=0), expected, rtol=0.1)
    assert np.abs(np.corrcoef(np.log(drawn).T) - np.eye(3)).max() < 0.1


def imposed(scatter, is_first):
    config = config_of(96)
    config = replace(config, collect=replace(config.collect, scatter=scatter))
    return map(np.asarray, imposed_actions(config, 4, jax.random.key(0), jnp.bool_(is_first)))


def test_an_episode_begins_with_up_to_so_many_steps_of_one_random_action():
    push, where = imposed(8, is_first=False)
    lengths = where.sum(0)
    assert lengths.min() == 0 and lengths.max() == 8  # of 96 lanes
    np.testing.assert_array_equal(where, np.arange(len(where))[:, None] < lengths)
    np.testing.assert_array_equal(push, np.broadcast_to(push[:1], push.shape))
    assert np.abs(np.corrcoef(push[0].T) - np.eye(4)).max() < 0.4
    assert push.min() < -0.95 and push.max() > 0.95


def test_half_of_an_episode_is_left_to_the_policy():
    _, where = imposed(10_000, is_first=False)
    assert 90 < where.sum(0).max() <= 100  # of 200 steps


def test_only_iteration_0_is_uniform_throughout():
    actions, where = imposed(0, is_first=True)
    assert where.all() and len(np.unique(actions)) > 0.99 * actions.size
    _, later = imposed(0, is_first=False)
    assert not later.any()
