"""Exploration noise: each step's distribution is the policy's own, lanes keep to a direction."""

import jax
import numpy as np
import pytest

from cmrl_jax.algorithms.common.rollout import correlated_noise


@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_noise_is_standard_normal_and_correlates_as_told(correlation):
    noise = np.asarray(correlated_noise(jax.random.key(0), 60, (4000, 2), correlation))
    assert noise.shape == (60, 4000, 2)
    np.testing.assert_allclose(noise.mean((1, 2)), 0, atol=0.06)
    np.testing.assert_allclose(noise.std((1, 2)), 1, atol=0.04)  # from the first step on
    for lag in (1, 5, 20):
        measured = (noise[lag:] * noise[:-lag]).mean()
        assert abs(measured - correlation**lag) < 0.02
    across = (noise[:, :, 0] * noise[:, :, 1]).mean()
    assert abs(across) < 0.02
