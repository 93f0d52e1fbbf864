"""The mirrors of the scene: what an agent sees and does in them."""

import jax.numpy as jnp
import numpy as np
import pytest

from envs.sawyer import ACTION_SIZE, OBS_SIZE, Ml4Env, canonical_obs


def test_only_canonical_observations_have_mirrors():
    of_obs, of_action = Ml4Env(physics="native").symmetries
    assert of_obs.shape == (1, OBS_SIZE) and of_action.shape == (1, ACTION_SIZE)
    assert (of_obs == 1).all() and (of_action == 1).all()


MIRRORS = [(1, 1), (-1, 1), (1, -1), (-1, -1)]


@pytest.mark.parametrize(("mirror", "signs"), list(enumerate(MIRRORS)))
def test_a_mirrored_scene_is_seen_as_its_own_signs_say(mirror, signs):
    """Hand, object and goal on the other side of where the object stood: the same numbers."""
    of_obs, of_action = Ml4Env(physics="native", obs_mode="canonical").symmetries
    rng = np.random.default_rng(0)
    obs, origin = rng.normal(size=OBS_SIZE), rng.normal(size=3)
    obs[11:18] = obs[29:36] = 0
    there = obs.copy()
    for start in (0, 4, 18, 22, 36):
        for axis, sign in enumerate(signs):
            place = start + axis
            there[place] = origin[axis] + sign * (obs[place] - origin[axis])
    seen = np.asarray(canonical_obs(jnp.asarray(obs), jnp.asarray(origin), True))
    mirrored = np.asarray(canonical_obs(jnp.asarray(there), jnp.asarray(origin), True))
    np.testing.assert_allclose(mirrored, of_obs[mirror] * seen, atol=1e-5)
    assert of_action[mirror].tolist() == [*signs, 1, 1]
