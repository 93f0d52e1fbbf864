"""Adaptation by search: which z, and which reflection of the scene, earns most on the task at hand.

An arm is a z and a symmetry of the environment (`MetaEnv.symmetries`): the z of the task's own
sentence (the prior's mean without text) and that of every training task, each seen in every mirror.
Exploring episodes try arms by successive halving (Karnin et al. 2013: sequential halving): all of
them once, then fewer and fewer of the best. A counted episode takes the best arm so far and teaches
nothing. Arms are judged by rewards alone. Everything is data in the compiled episode, so one
program plays any budget.
"""

from __future__ import annotations

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
LATE_STEPS = 50.0  # over which late rewards are averaged, the last ones most

Rule = Literal["return", "late"]


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
        symmetries: signs of observations (symmetry, obs) and of actions (symmetry, act), the
            identity first.
        rule: what an episode is scored by: its return, or its late rewards, an exponential average
            over about `LATE_STEPS` steps that starts at 0 and is read where the episode ends.
    """

    learner: Learner
    chunk: int
    symmetries: tuple[np.ndarray, np.ndarray]
    rule: Rule = "return"

    adapts = True
    explores = True

    @property
    def mirrors(self) -> int:
        return len(self.symmetries[0])

    @property
    def arms(self) -> int:
        """Their number; arm a is z a div N, the task's own first, in mirror a mod N of N."""
        return (1 + self.learner.num_tasks) * self.mirrors

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
            score=jnp.zeros(lead),
            z=jnp.zeros((*lead, inference.latent_dim)),
        )

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
        memory, source = _credited(memory), _credited(source)
        order = self._order(source)
        tried = self._chosen(source, order, exploit)
        z = self._z_of(params, source, tried // self.mirrors)
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
        mirror = memory.arm % self.mirrors
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
        rate = 0.0 if self.rule == "return" else 1.0 / LATE_STEPS
        steps = jnp.cumsum(mask[:, ::-1], -1)[:, ::-1]  # that count, from each one on
        before = memory.score * (1.0 - rate) ** steps[:, 0]
        kept = jnp.where(mask > 0, (1.0 - rate) ** (steps - 1.0), 0.0)
        earned = jnp.sum(transitions.reward * kept, -1)
        return replace(memory, score=before + (earned if rate == 0 else rate * earned))

    def describe(self, memory: SearchMemory) -> list[str]:
        """The arm of each lane's episode: whose z, and which actions are mirrored."""
        names = ("own z", *(f"z of {task}" for task in self.learner.config.tasks.train))
        flipped = [np.flatnonzero(signs < 0) for signs in np.asarray(self.symmetries[1])]
        mirrors = [
            f", mirrored in action {' '.join(map(str, f))}" if len(f) else "" for f in flipped
        ]
        which = [divmod(int(arm), self.mirrors) for arm in np.asarray(memory.arm)]
        return [names[z] + mirrors[mirror] for z, mirror in which]

    def _chosen(self, memory: SearchMemory, order: jax.Array, exploit: jax.Array) -> jax.Array:
        """The arm (lane,) of the episode that begins."""
        return jnp.where(exploit, _best(memory), self._next(memory, order))

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

    def _z_of(self, params: PolicyParams, memory: SearchMemory, which: jax.Array) -> jax.Array:
        """The lane's own z where `which` (lane,) is 0, else the training task's before it."""
        inference = self._inference
        nothing = init_belief(which.shape, inference.latent_dim)
        own = inference.posterior_of_belief(
            params.encoder_params, nothing, memory.text, memory.text_mask
        ).mean
        return jnp.where((which == 0)[..., None], own, params.task_z[which - 1])


class ArmsInTurn(SearchAgent):
    """The arms one after another, whatever they earn: after k episodes comes arm k.

    A control: scored at every k it says what each arm is worth by itself, and so what the best one
    is, and one taken at random.
    """

    def _chosen(self, memory: SearchMemory, order: jax.Array, exploit: jax.Array) -> jax.Array:
        del order, exploit
        return jnp.sum(memory.plays, -1).astype(jnp.int32) % self.arms


def _credited(memory: SearchMemory) -> SearchMemory:
    """The memory with the episode that has ended credited to its arm, if it was to be."""
    played = jax.nn.one_hot(memory.arm, memory.plays.shape[-1]) * memory.learns[..., None]
    score = jnp.where(played > 0, memory.score[..., None], 0.0)
    return replace(
        memory,
        plays=memory.plays + played,
        credit=memory.credit + score,
        learns=jnp.zeros_like(memory.learns),
        score=jnp.zeros_like(memory.score),
    )


def _means(memory: SearchMemory) -> jax.Array:
    """Mean score of each arm (lane, arm); -inf for one that was never tried."""
    mean = memory.credit / jnp.maximum(memory.plays, 1.0)
    return jnp.where(memory.plays > 0, mean, -jnp.inf)


def _best(memory: SearchMemory) -> jax.Array:
    """The arm with the best mean; the task's own sentence, unmirrored, before any was tried."""
    return jnp.argmax(_means(memory), -1).astype(jnp.int32)
