"""Adaptation by search: which z, and which way of seeing the scene, earns most on the task at hand.

An arm is a z, a view (`MetaEnv.symmetries`) and a reach (`MetaEnv.reaches`): the z of the task's
own sentence (the prior's mean without text) or that of a training task, acting in the scene as it
is seen mirrored or turned, and with the object shown at a part of the way that it has moved, so
that the policy pushes on. Exploring episodes try the task's own z in every view, then the training
tasks' in the best of those, then the best arms again by successive halving (Karnin et al. 2013:
sequential halving), among them the best arm with every other reach. A counted episode takes the
best arm so far and teaches nothing. Arms are judged by rewards alone: the return, and as much again
for the best few steps, since waiting at an object can pay as much as moving it late. Everything is
data in the compiled episode, so one program plays any budget.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

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
        returns: (lane,) of the episode at hand so far.
        peak: (lane,) largest mean reward of `PEAK_STEPS` steps of it so far; windows lie end to end
            from each observed stretch's first step.
        z: (lane, latent), of the episode at hand.
    """

    text: jax.Array
    text_mask: jax.Array
    plays: jax.Array
    credit: jax.Array
    order: jax.Array
    arm: jax.Array
    learns: jax.Array
    returns: jax.Array
    peak: jax.Array
    z: jax.Array


class Rounds(NamedTuple):
    """How a search spends its exploring episodes.

    Attributes:
        views: of the best ones, in which the training tasks' z are tried.
        starts: after how many episodes each round begins, ascending from 0: the own z in every
            view; the training tasks' in `views` of them; then rounds of the best arms so far, each
            half of what is left and at most half of the arms tried, and after the first of them
            that of the reaches. The last is the end: of the budget, or of the second round where
            that is later.
        reaching: where the round of the best arm's other reaches begins; None where there are none,
            or no room for them.
    """

    views: int
    starts: tuple[int, ...]
    reaching: int | None = None


def rounds_of(views: int, tasks: int, reaches: int = 1, budget: int = BUDGET) -> Rounds:
    """The rounds for a number of views, training tasks and reaches.

    The training tasks' z get half of the episodes that the own z leaves, but one view at least.
    """
    kept = max(1, min(views, (budget - views) // 2 // tasks))
    tried = views + kept * tasks

    def after_next(done: int) -> int:
        return done + max(1, min((budget - done) // 2, tried // 2))

    starts, reaching = [0, views, tried], None
    if tried < budget and 1 < reaches <= budget - after_next(tried) + 1:
        reaching = after_next(tried)
        starts += [reaching, reaching + reaches - 1]
    while starts[-1] < budget:
        starts.append(after_next(starts[-1]))
    return Rounds(kept, tuple(starts), reaching)


@dataclass(frozen=True)
class SearchAgent:
    """An `Agent`.

    Args:
        learner: with a latent.
        chunk: control steps between two calls of `observe`.
        symmetries, reaches: of the environment, the identity first.
    """

    learner: Learner
    chunk: int
    symmetries: tuple[np.ndarray, np.ndarray]
    reaches: np.ndarray

    adapts = True
    explores = True

    @property
    def views(self) -> int:
        return len(self.symmetries[0])

    @property
    def rounds(self) -> Rounds:
        return rounds_of(self.views, self.learner.num_tasks, len(self.reaches))

    @property
    def arms(self) -> int:
        """Their number: reach by reach, in each z by z, the task's own first, and view by view."""
        return len(self.reaches) * self._of_reach

    @property
    def _of_reach(self) -> int:
        return (1 + self.learner.num_tasks) * self.views

    def parts(self, arm: Any) -> tuple[Any, Any, Any]:
        """Reach, z and view of an arm."""
        return arm // self._of_reach, arm % self._of_reach // self.views, arm % self.views

    def matrices(self, arm: int) -> tuple[np.ndarray, np.ndarray]:
        """What an arm multiplies observations by, and what undoes it for actions (transposed)."""
        of_obs, of_action = self._seen
        reach, _, view = self.parts(arm)
        return of_obs[reach, view], of_action[view]

    @property
    def _seen(self) -> tuple[np.ndarray, np.ndarray]:
        """Matrices of observations (reach, view, ...) and of actions (view, ...)."""
        of_obs, of_action = self.symmetries
        return self.reaches[:, None] @ of_obs, of_action

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
            returns=jnp.zeros(lead),
            peak=jnp.full(lead, -jnp.inf),
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
        horizon = self.learner.config.env.horizon
        memory, source = _credited(memory, horizon), _credited(source, horizon)
        order = self._order(source)
        tried = self._chosen(source, order, exploit)
        z = self._z_of(params, source, self.parts(tried)[1])
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
        reach, _, view = self.parts(memory.arm)
        of_obs, of_action = map(jnp.asarray, self._seen)
        of_obs, of_action = of_obs[reach, view], of_action[view]
        seen, _ = self.learner.policy(
            params.actor_params,
            params.obs_stats,
            jnp.einsum("...ij,...j->...i", of_obs, obs),
            memory.z,
            None,
            deterministic,
            noise,
        )
        return jnp.einsum("...ij,...i->...j", of_action, seen)  # back: the inverse is the transpose

    def observe(
        self, params: PolicyParams, memory: SearchMemory, transitions: Transition, mask: jax.Array
    ) -> SearchMemory:
        reward, counts = transitions.reward, mask > 0
        steps = min(PEAK_STEPS, self.chunk)
        short = -reward.shape[1] % steps  # steps that the last window lacks, and that spoil it
        window = lambda x: jnp.pad(x, ((0, 0), (0, short))).reshape(len(x), -1, steps)
        whole = jnp.all(window(counts), -1)
        peak = jnp.max(jnp.where(whole, jnp.mean(window(reward), -1), -jnp.inf), -1)
        return replace(
            memory,
            returns=memory.returns + jnp.sum(reward, -1, where=counts),
            peak=jnp.maximum(memory.peak, peak),
        )

    def describe(self, memory: SearchMemory) -> list[str]:
        """The arm of each lane's episode: whose z, in which view and reach but the identity."""
        names = ("own z", *(f"z of {task}" for task in self.learner.config.tasks.train))
        words = []
        for arm in np.asarray(memory.arm):
            reach, z, view = self.parts(int(arm))
            seen = f", view {view} of {self.views - 1}" if view else ""
            seen += f", reach {reach}" if reach else ""
            words.append(names[z] + seen)
        return words

    def _chosen(self, memory: SearchMemory, order: jax.Array, exploit: jax.Array) -> jax.Array:
        """The arm (lane,) of the episode that begins."""
        return jnp.where(exploit, _best(memory), self._next(memory, order))

    def _order(self, memory: SearchMemory) -> jax.Array:
        """The order of the round at hand: anew from what is known where a round begins."""
        done, (_, second, *later) = jnp.sum(memory.plays, -1)[..., None], self.rounds.starts
        ranked = jnp.argsort(-_means(memory), axis=-1).astype(jnp.int32)
        begins = jnp.any(done == jnp.array(later), -1, keepdims=True) | (done > later[-1])
        order = jnp.where(begins, ranked, memory.order)
        if self.rounds.reaching is not None:
            order = jnp.where(done == self.rounds.reaching, self._other_reaches(ranked), order)
        return jnp.where(done == second, self._trained_in_best_views(memory), order)

    def _trained_in_best_views(self, memory: SearchMemory) -> jax.Array:
        """Arms of the training tasks' z in the best views of the own z; the rest is not tried."""
        tasks, kept = self.learner.num_tasks, self.rounds.views
        views = jnp.argsort(-_means(memory)[..., : self.views], axis=-1)[..., :kept]
        z = 1 + np.arange(tasks)
        arms = z * self.views + views[..., None]  # (lane, view, z)
        return self._padded(arms.reshape(*arms.shape[:-2], -1))

    def _other_reaches(self, ranked: jax.Array) -> jax.Array:
        """The best arm, which has the first reach as all before, with each other one."""
        return self._padded(ranked[..., :1] + self._of_reach * np.arange(1, len(self.reaches)))

    def _padded(self, arms: Any) -> jax.Array:
        rest = [(0, 0)] * (arms.ndim - 1) + [(0, self.arms - arms.shape[-1])]
        return jnp.pad(arms.astype(jnp.int32), rest)

    def _next(self, memory: SearchMemory, order: jax.Array) -> jax.Array:
        """The arm that the round at hand tries next; after the last round the best one."""
        done = jnp.sum(memory.plays, -1)
        starts = jnp.array(self.rounds.starts)
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


def _credited(memory: SearchMemory, horizon: int) -> SearchMemory:
    """The memory with the episode that has ended credited to its arm, if it was to be."""
    # Of no whole window the episode's mean: it was shorter than one.
    peak = jnp.where(jnp.isfinite(memory.peak), memory.peak, memory.returns / horizon)
    score = memory.returns + horizon * peak
    played = jax.nn.one_hot(memory.arm, memory.plays.shape[-1]) * memory.learns[..., None]
    return replace(
        memory,
        plays=memory.plays + played,
        credit=memory.credit + played * score[..., None],
        learns=jnp.zeros_like(memory.learns),
        returns=jnp.zeros_like(memory.returns),
        peak=jnp.full_like(memory.peak, -jnp.inf),
    )


def _means(memory: SearchMemory) -> jax.Array:
    """Mean score of each arm (lane, arm); -inf for one that was never tried."""
    mean = memory.credit / jnp.maximum(memory.plays, 1.0)
    return jnp.where(memory.plays > 0, mean, -jnp.inf)


def _best(memory: SearchMemory) -> jax.Array:
    """The arm with the best mean; the task's own sentence, unmirrored, before any was tried."""
    return jnp.argmax(_means(memory), -1).astype(jnp.int32)
