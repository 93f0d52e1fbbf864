"""Figures of an iteration that need a pass of their own: taken once at its end, never trained on.

How much a context narrows the belief (posterior variance by context size), and whether one task
rules the critics (each task's share of the gradient norm, and how the tasks' gradients agree).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import Any

import jax
import jax.numpy as jnp

from cmrl_jax.algorithms.cmrl.learner import Learner
from cmrl_jax.algorithms.cmrl.train_state import TrainState
from cmrl_jax.algorithms.common import replay as rings
from cmrl_jax.config.schema import Config
from cmrl_jax.nn.optimizers import ravel

CONTEXT_SIZES = (1, 4, 16, 64)

Diagnose = Callable[[TrainState, Any, Any, jax.Array], dict[str, jax.Array]]


def make_diagnose(config: Config, learner: Learner, goal_vectors: jax.Array) -> Diagnose:
    """Builds the figures of a configuration.

    Args:
        goal_vectors: text vectors of the training tasks (task, paraphrase, G).

    Returns:
        (TrainState, replay_state, context_state, key) -> float32 figures, () or (task,):
        `posterior_variance_n<size>`: variance of z given `size` transitions and the text, mean
        over its dimensions; `gradient_share`: norm of a task's TD gradient by the critics, over
        the sum of all tasks' norms; `gradient_cosine`: mean over pairs of tasks.
    """
    num_tasks = len(config.tasks.train)
    inference = learner.inference

    def posterior_variance(state: TrainState, ring: Any, key: jax.Array) -> dict[str, jax.Array]:
        if inference is None:
            return {}
        largest, posterior = max(CONTEXT_SIZES), inference.posterior
        context = rings.sample_transitions(ring, key, jnp.arange(num_tasks), largest)
        context = learner.normalized(state.obs_stats, context)

        def variance(size: jax.Array) -> jax.Array:
            mask = jnp.broadcast_to(jnp.arange(largest) < size, (num_tasks, largest))
            text = goal_vectors[:, 0], jnp.ones(num_tasks)
            return jnp.mean(posterior(state.encoder_params, context, mask, *text).variance, -1)

        # One pass for all sizes: there is less to compile than in four.
        by_size = jax.vmap(variance)(jnp.array(CONTEXT_SIZES))
        names = [f"posterior_variance_n{size}" for size in CONTEXT_SIZES]
        return dict(zip(names, by_size, strict=True))

    def gradients(state: TrainState, replay_state: Any, ring: Any, key: jax.Array):
        task_loss = learner.task_losses(state, replay_state, ring, key)
        losses, pull_back = jax.vjp(task_loss, state.critic_params)
        (by_task,) = jax.vmap(pull_back)(jnp.eye(losses.shape[0]))
        flat = jax.vmap(lambda tree: ravel(tree, stacked=False))(by_task)  # (task, parameter)
        norm = jnp.linalg.norm(flat, axis=1)
        pairs = list(combinations(range(num_tasks), 2))
        unit = flat / jnp.maximum(norm, 1e-12)[:, None]
        cosine = [unit[i] @ unit[j] for i, j in pairs]
        figures = {"gradient_share": norm / jnp.maximum(jnp.sum(norm), 1e-12)}
        return figures | ({"gradient_cosine": jnp.mean(jnp.stack(cosine))} if pairs else {})

    def diagnose(state: TrainState, replay_state: Any, context_state: Any, key: jax.Array):
        k_context, k_gradient = jax.random.split(key)
        ring = replay_state if config.collect.context_source == "all" else context_state
        return posterior_variance(state, ring, k_context) | gradients(
            state, replay_state, context_state, k_gradient
        )

    return diagnose
