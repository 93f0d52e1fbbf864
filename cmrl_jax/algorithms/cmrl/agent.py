"""CMRL's agent: z is drawn from the belief at the start of an episode, and kept for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from cmrl_jax.algorithms.base import RunState, Told
from cmrl_jax.algorithms.cmrl.learner import Learner
from cmrl_jax.algorithms.cmrl.train_state import TrainState
from cmrl_jax.algorithms.common.replay import ReplayState, Transition, sample_transitions
from cmrl_jax.nn.context import Belief, init_belief

CONTEXTS = 16  # of a training task, over which its z is averaged


class PolicyParams(NamedTuple):
    """What acting needs: the policy checkpoint's arrays.

    Attributes:
        encoder_params: None without a latent.
        task_z: (training task, latent), the mean of q(z | context, text) over recent contexts of
            each; what a search tries. None without a latent.
    """

    actor_params: Any
    encoder_params: Any
    obs_stats: Any
    task_z: Any


def make_policy_params(learner: Learner) -> Callable[[RunState], PolicyParams]:
    """RunState -> the part of it that acts."""
    inference = learner.inference
    tasks, n = learner.num_tasks, learner.config.encoder.context_max

    @jax.jit
    def mean_z(state: TrainState, ring: ReplayState) -> jax.Array:
        assert inference is not None
        row = jnp.repeat(jnp.arange(tasks), CONTEXTS)
        # The same draw each time: the state alone decides.
        context = sample_transitions(ring, jax.random.key(0), row, n)
        posterior = inference.posterior(
            state.acting.encoder,
            learner.normalized(state.obs_stats, context),
            jnp.broadcast_to(ring.size > 0, (len(row), n)),
            learner.goal_vectors[row, 0],
            jnp.ones(len(row)),
        )
        return jnp.mean(posterior.mean.reshape(tasks, CONTEXTS, -1), 1)

    def policy_params(run: RunState) -> PolicyParams:
        state = run.learner
        task_z = None if inference is None else mean_z(state, run.context)
        actor, encoder = state.acting
        return PolicyParams(actor, encoder, state.obs_stats, task_z)

    return policy_params


@struct.dataclass
class Memory:
    """What a lane has seen and been told, leading axis lane.

    Attributes:
        belief: over all transitions so far; None without a latent.
        text: (lane, G).
        text_mask: (lane,).
        conditioning: what the networks are told in this episode (lane, conditioning): z, or the
            task where there is no latent.
    """

    belief: Belief | None
    text: jax.Array
    text_mask: jax.Array
    conditioning: jax.Array


@dataclass(frozen=True)
class CmrlAgent:
    """An `Agent`; PEARL's, MTSAC's and SAC's too.

    Args:
        learner: of the configuration.
        chunk: control steps between two calls of `observe`.
    """

    learner: Learner
    chunk: int

    explores = False

    @property
    def adapts(self) -> bool:
        return self.learner.inference is not None

    def init(self, told: Told) -> Memory:
        inference, lead = self.learner.inference, told.task_row.shape
        if inference is None:
            belief, conditioning = None, self.learner.task_conditioning(told.task_row)
        else:
            belief = init_belief(lead, inference.latent_dim)
            conditioning = jnp.zeros((*lead, inference.latent_dim))
        return Memory(belief, told.text, told.text_mask, conditioning)

    def begin_episode(
        self,
        params: PolicyParams,
        memory: Memory,
        source: Memory,
        keys: jax.Array,
        exploit: jax.Array,
    ) -> Memory:
        del exploit  # every episode is acted on a draw from the belief
        inference = self.learner.inference
        if inference is None:
            return memory
        posterior = inference.posterior_of_belief(
            params.encoder_params, source.belief, source.text, source.text_mask
        )
        return replace(
            memory,
            conditioning=inference.z_of_noise(posterior, z_noise(keys, inference.latent_dim)),
        )

    def act(
        self,
        params: PolicyParams,
        memory: Memory,
        obs: jax.Array,
        noise: jax.Array,
        deterministic: Any,
    ) -> jax.Array:
        action, _ = self.learner.policy(
            params.actor_params,
            params.obs_stats,
            obs,
            memory.conditioning,
            None,
            deterministic,
            noise,
        )
        return action

    def observe(
        self, params: PolicyParams, memory: Memory, transitions: Transition, mask: jax.Array
    ) -> Memory:
        inference = self.learner.inference
        if inference is None:
            return memory
        normalized = self.learner.normalized(params.obs_stats, transitions)
        belief = inference.update_belief(
            params.encoder_params, memory.belief, normalized, mask, memory.text, memory.text_mask
        )
        return replace(memory, belief=belief)

    def describe(self, memory: Memory) -> list[str]:
        """The z of each lane's episode; nothing without a latent."""
        if self.learner.inference is None:
            return [""] * len(memory.conditioning)
        return ["z " + " ".join(f"{x:.1f}" for x in z) for z in np.asarray(memory.conditioning)]


def z_noise(keys: jax.Array, latent_dim: int) -> jax.Array:
    """Standard normal numbers (lane, latent), each lane's from its own key (lane,)."""
    return jax.vmap(lambda key: jax.random.normal(key, (latent_dim,)))(keys)
