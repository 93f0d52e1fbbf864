"""The symmetries of the scene, and its reaches: what an agent sees and does in each."""

import jax.numpy as jnp
import numpy as np
import pytest

from envs.sawyer import ACTION_SIZE, OBS_SIZE, PLANE_SYMMETRIES, REACHES, Ml4Env, canonical_obs


def test_only_canonical_observations_can_be_turned():
    of_obs, of_action = Ml4Env(physics="native").symmetries
    np.testing.assert_array_equal(of_obs, np.eye(OBS_SIZE)[None])
    np.testing.assert_array_equal(of_action, np.eye(ACTION_SIZE)[None])
    np.testing.assert_array_equal(Ml4Env(physics="native").reaches, np.eye(OBS_SIZE)[None])


@pytest.mark.parametrize("reach", range(len(REACHES)))
def test_with_a_reach_the_object_has_moved_so_much_of_its_way_and_the_hand_went_along(reach):
    matrix = Ml4Env(physics="native", obs_mode="canonical").reaches[reach]
    rng = np.random.default_rng(0)
    obs = rng.normal(size=OBS_SIZE)  # canonical: the object's place is how far it has moved
    seen = matrix @ obs
    for start in (0, 18):
        hand, moved = slice(start, start + 3), slice(start + 4, start + 7)
        np.testing.assert_allclose(seen[moved], REACHES[reach] * obs[moved], rtol=1e-6)
        np.testing.assert_allclose(seen[hand] - seen[moved], obs[hand] - obs[moved], atol=1e-6)
    others = [3, *range(7, 18), 21, *range(25, 39)]
    np.testing.assert_array_equal(seen[others], obs[others])


def test_they_are_the_eight_of_a_square():
    found = {tuple(matrix.ravel()) for matrix in PLANE_SYMMETRIES}
    assert len(found) == 8 and (PLANE_SYMMETRIES[0] == np.eye(2)).all()
    for first in PLANE_SYMMETRIES:
        np.testing.assert_array_equal(first @ first.T, np.eye(2))
        for second in PLANE_SYMMETRIES:
            assert tuple((first @ second).ravel()) in found


@pytest.mark.parametrize("view", range(8))
def test_a_turned_scene_is_seen_as_its_own_matrix_says(view):
    """Hand, object and goal turned about where the object stood: the same numbers."""
    of_obs, of_action = Ml4Env(physics="native", obs_mode="canonical").symmetries
    rng = np.random.default_rng(0)
    obs, origin = rng.normal(size=OBS_SIZE), rng.normal(size=3)
    obs[11:18] = obs[29:36] = 0
    there = obs.copy()
    for start in (0, 4, 18, 22, 36):
        place = slice(start, start + 2)
        there[place] = origin[:2] + PLANE_SYMMETRIES[view] @ (obs[place] - origin[:2])
    seen = np.asarray(canonical_obs(jnp.asarray(obs), jnp.asarray(origin), True))
    turned = np.asarray(canonical_obs(jnp.asarray(there), jnp.asarray(origin), True))
    np.testing.assert_allclose(turned, of_obs[view] @ seen, atol=1e-5)
    np.testing.assert_array_equal(of_action[view][:2, :2], PLANE_SYMMETRIES[view])
    np.testing.assert_array_equal(of_action[view][2:, 2:], np.eye(2))
    assert not of_action[view][:2, 2:].any() and not of_action[view][2:, :2].any()
