"""Adaptation by search: which z, and which reflection of the scene, earns most on the task at hand.

An arm is a z and a symmetry of the environment (`MetaEnv.symmetries`): the z of the task's own
sentence and of every training task's, each seen in every mirror. Exploring episodes try arms by
successive halving (Karnin et al. 2013: sequential halving): all of them once, then fewer and fewer
of the best. A counted episode takes the best arm so far and teaches nothing. Arms are judged by
rewards alone. Everything is data in the compiled episode, so one program plays any budget.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from cmrl_jax.algorithms.base import Told
from cmrl_jax.algorithms.cmrl.agent import PolicyParams
from cmrl_jax.algorithms.cmrl.learner import Learner
from cmrl_jax.algorithms.common.replay import Transition
from cmrl_jax.nn.context import init_belief

BUDGET = 20  # exploring episodes that the rounds are laid out for
PEAK_STEPS = 5  # consecutive steps whose mean reward is an episode's peak

Rule = Literal["return", "peak"]


@struct.dataclass
class SearchMemory:
    """What a lane has tried, leading axis lane.

    Attributes:
        text: (lane, G).
        text_mask: (lane,).
        plays: (lane, arm) float32, exploring episodes of each arm.
        credit: (lane, arm) sum of their scores.
        order: (lane, arm) int32, arms in the order in which the round at hand tries them.
        arm: (lane,) int32, of the episode at hand.
        learns: (lane,) float32, 1 where the episode at hand is to be credited.
        score: (lane,) of the episode at hand so far.
        z: (lane, latent), of the episode at hand.
    """

    text: jax.Array
    text_mask: jax.Array
    plays: jax.Array
    credit: jax.Array
    order: jax.Array
    arm: jax.Array
    learns: jax.Array
    score: jax.Array
    z: jax.Array


def round_starts(arms: int, budget: int = BUDGET) -> tuple[int, ...]:
    """After how many exploring episodes each round of the halving begins.

    The first tries every arm; each later one spends half of what is left on at most half of the
    arms, at least one episode.

    Returns:
        Ascending numbers from 0; the last is the end of the last round.
    """
    starts, left = [0], max(budget - arms, 0)
    done = arms
    while left > 0:
        starts.append(done)
        size = max(1, min(left // 2, arms // 2))
        done, left = done + size, left - size
    return (*starts, done)


@dataclass(frozen=True)
class SearchAgent:
    """An `Agent`.

    Args:
        learner: with a latent.
        chunk: control steps between two calls of `observe`.
        sentences: text vectors of the training tasks (task, G).
        symmetries: signs of observations (symmetry, obs) and of actions (symmetry, act), the
            identity first.
        rule: what an episode is scored by: its return, or the largest mean reward of a window of
            `PEAK_STEPS` steps; windows lie end to end from each observed stretch's first step.
    """

    learner: Learner
    chunk: int
    sentences: jax.Array
    symmetries: tuple[np.ndarray, np.ndarray]
    rule: Rule = "peak"

    adapts = True
    explores = True

    @property
    def choices(self) -> int:
        """Sentences of a lane: its task's own and those of the training tasks."""
        return 1 + len(self.sentences)

    @property
    def arms(self) -> int:
        """Their number; arm a is sentence a mod N of N, the task's own first, in mirror a div N."""
        return self.choices * len(self.symmetries[0])

    def init(self, told: Told) -> SearchMemory:
        lead, inference = told.task_row.shape, self._inference
        by_arm = jnp.zeros((*lead, self.arms))
        return SearchMemory(
            text=told.text,
            text_mask=told.text_mask,
            plays=by_arm,
            credit=by_arm,
            order=jnp.broadcast_to(jnp.arange(self.arms), by_arm.shape),
            arm=jnp.zeros(lead, jnp.int32),
            learns=jnp.zeros(lead),
            score=jnp.full(lead, self._no_score),
            z=jnp.zeros((*lead, inference.latent_dim)),
        )

    @property
    def _no_score(self) -> float:
        return 0.0 if self.rule == "return" else -jnp.inf

    @property
    def _inference(self) -> Any:
        assert self.learner.inference is not None
        return self.learner.inference

    def begin_episode(
        self,
        params: PolicyParams,
        memory: SearchMemory,
        source: SearchMemory,
        keys: jax.Array,
        exploit: jax.Array,
    ) -> SearchMemory:
        del keys  # nothing is drawn
        memory, source = _credited(memory, self._no_score), _credited(source, self._no_score)
        order = self._order(source)
        tried = jnp.where(exploit, _best(source), self._next(source, order))
        z = self._z_of(params, source, tried % self.choices)
        learns = jnp.where(exploit, jnp.zeros_like(memory.learns), 1.0)
        return replace(memory, order=order, arm=tried, learns=learns, z=z)

    def act(
        self,
        params: PolicyParams,
        memory: SearchMemory,
        obs: jax.Array,
        noise: jax.Array,
        deterministic: Any,
    ) -> jax.Array:
        of_obs, of_action = (jnp.asarray(signs) for signs in self.symmetries)
        mirror = memory.arm // self.choices
        action, _ = self.learner.policy(
            params.actor_params,
            params.obs_stats,
            obs * of_obs[mirror],
            memory.z,
            None,
            deterministic,
            noise,
        )
        return action * of_action[mirror]

    def observe(
        self, params: PolicyParams, memory: SearchMemory, transitions: Transition, mask: jax.Array
    ) -> SearchMemory:
        reward, counts = transitions.reward, mask > 0
        if self.rule == "return":
            return replace(memory, score=memory.score + jnp.sum(reward, -1, where=counts))
        steps = min(PEAK_STEPS, self.chunk)
        short = -reward.shape[1] % steps  # steps that the last window lacks, and that spoil it
        window = lambda x: jnp.pad(x, ((0, 0), (0, short))).reshape(len(x), -1, steps)
        whole = jnp.all(window(counts), -1)
        peak = jnp.max(jnp.where(whole, jnp.mean(window(reward), -1), -jnp.inf), -1)
        return replace(memory, score=jnp.maximum(memory.score, peak))

    def _order(self, memory: SearchMemory) -> jax.Array:
        """The order of the round at hand: anew from what is known where a round begins."""
        done = jnp.sum(memory.plays, -1)
        starts = jnp.array(round_starts(self.arms)[1:])
        begins = jnp.any(done[..., None] == starts, -1) | (done > starts[-1])
        ranked = jnp.argsort(-_means(memory), axis=-1).astype(jnp.int32)
        return jnp.where(begins[..., None], ranked, memory.order)

    def _next(self, memory: SearchMemory, order: jax.Array) -> jax.Array:
        """The arm that the round at hand tries next; after the last round the best one."""
        done = jnp.sum(memory.plays, -1)
        starts = jnp.array(round_starts(self.arms))
        begun = jnp.max(jnp.where(starts <= done[..., None], starts, 0), -1)
        place = jnp.where(done >= starts[-1], 0, done - begun).astype(jnp.int32)
        return jnp.take_along_axis(order, place[..., None], -1)[..., 0]

    def _z_of(self, params: PolicyParams, memory: SearchMemory, sentence: jax.Array) -> jax.Array:
        """Mean of the belief over a sentence alone, 0 for the lane's own (lane, latent)."""
        posterior: Callable[..., Any] = self._inference.posterior_of_belief
        count, latent = len(self.sentences), self._inference.latent_dim
        trained = posterior(
            params.encoder_params, init_belief((count,), latent), self.sentences, jnp.ones(count)
        ).mean
        nothing = init_belief(sentence.shape, latent)
        own = posterior(params.encoder_params, nothing, memory.text, memory.text_mask).mean
        return jnp.where((sentence == 0)[..., None], own, trained[sentence - 1])


def _credited(memory: SearchMemory, no_score: float) -> SearchMemory:
    """The memory with the episode that has ended credited to its arm, if it was to be."""
    played = jax.nn.one_hot(memory.arm, memory.plays.shape[-1]) * memory.learns[..., None]
    score = jnp.where(played > 0, memory.score[..., None], 0.0)
    return replace(
        memory,
        plays=memory.plays + played,
        credit=memory.credit + score,
        learns=jnp.zeros_like(memory.learns),
        score=jnp.full_like(memory.score, no_score),
    )


def _means(memory: SearchMemory) -> jax.Array:
    """Mean score of each arm (lane, arm); -inf for one that was never tried."""
    mean = memory.credit / jnp.maximum(memory.plays, 1.0)
    return jnp.where(memory.plays > 0, mean, -jnp.inf)


def _best(memory: SearchMemory) -> jax.Array:
    """The arm with the best mean; the task's own sentence, unmirrored, before any was tried."""
    return jnp.argmax(_means(memory), -1).astype(jnp.int32)
