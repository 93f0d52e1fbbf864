"""An environment seen as an arm of a search sees it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_env import PointEnv

from envs.turned import TurnedEnv

TURN = np.array([[0, 1], [-1, 0]], np.float32)


@pytest.mark.parametrize("seen", [1.0, 0.5])
def test_actions_are_turned_back_and_observations_forth(seen):
    """In the view, the same walk: right is what the original calls up, or down."""
    env, size = PointEnv(), PointEnv.observation_size
    of_obs = np.eye(size, dtype=np.float32)
    of_obs[:2, :2] = seen * TURN
    turned = TurnedEnv(env, of_obs, TURN)
    goal = jnp.array([0.3, -0.2])
    original, seen = env.reset_to(jnp.asarray(1), goal), turned.reset_to(jnp.asarray(1), goal)
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 2)).astype(np.float32)
    for action in actions:
        np.testing.assert_allclose(seen.obs, of_obs @ original.obs, atol=1e-6)
        assert seen.reward == original.reward and seen.success == original.success
        original, seen = env.step(original, action), turned.step(seen, TURN @ action)
    assert np.abs(np.asarray(seen.obs - original.obs)).max() > 0.1
    fresh = env.reset(jax.random.key(0), jnp.asarray(0))
    again = turned.reset(jax.random.key(0), jnp.asarray(0))
    np.testing.assert_allclose(again.obs, of_obs @ fresh.obs, atol=1e-6)
    np.testing.assert_array_equal(turned.goals("train", env.tasks), env.goals("train", env.tasks))
