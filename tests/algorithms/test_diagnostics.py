"""Diagnostics of an iteration, against gradients and posteriors taken the long way round."""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learner_fixtures import GOALS, TASKS, VARIANTS, build, filled_ring, spread, tiny_config

from cmrl_jax.algorithms.cmrl.diagnostics import CONTEXT_SIZES, make_diagnose
from cmrl_jax.algorithms.common.replay import sample_transitions
from cmrl_jax.jax_runtime import jit_once

KEY = jax.random.key(7)


def diagnosed(variant):
    cfg = tiny_config(**VARIANTS[variant])
    made, ring = build(cfg), filled_ring()
    state = made.state.replace(critic_params=spread(made.state.critic_params))
    diagnose = make_diagnose(cfg, made.learner, GOALS)
    return made.learner, state, ring, jit_once(diagnose)(state, ring, ring, KEY)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["cmrl", "pearl", "mtsac"])
def test_gradient_shares_are_those_of_single_tasks(variant):
    learner, state, ring, figures = diagnosed(variant)
    losses = learner.task_losses(state, ring, ring, jax.random.split(KEY)[1])
    flat = []
    for task in range(TASKS):
        grad = jax.grad(lambda params, task=task: losses(params)[task])(state.critic_params)
        flat.append(np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(grad)]))
    norms = np.linalg.norm(flat, axis=1)
    np.testing.assert_allclose(figures["gradient_share"], norms / norms.sum(), rtol=1e-4)
    cosine = [
        flat[i] @ flat[j] / max(norms[i] * norms[j], 1e-12)
        for i, j in combinations(range(TASKS), 2)
    ]
    np.testing.assert_allclose(figures["gradient_cosine"], np.mean(cosine), atol=1e-4)
    assert norms.min() > 0 or variant == "pearl"  # which draws its tasks, here five rows


@pytest.mark.slow
def test_posterior_variance_is_that_of_the_first_transitions():
    learner, state, ring, figures = diagnosed("cmrl")
    inference = learner.inference
    assert inference is not None
    key = jax.random.split(KEY)[0]
    context = sample_transitions(ring, key, jnp.arange(TASKS), max(CONTEXT_SIZES))
    for size in CONTEXT_SIZES:
        first = jax.tree.map(lambda x, size=size: x[:, :size], context)
        posterior = jit_once(inference.posterior)(
            state.encoder_params, first, jnp.ones((TASKS, size)), GOALS[:, 0], jnp.ones(TASKS)
        )
        expected = posterior.variance.mean(-1)
        np.testing.assert_allclose(figures[f"posterior_variance_n{size}"], expected, rtol=1e-5)
    assert (figures["posterior_variance_n64"] < figures["posterior_variance_n1"]).all()


def test_without_a_latent_there_is_no_posterior():
    assert set(diagnosed("mtsac")[3]) == {"gradient_share", "gradient_cosine"}
