"""The meta-test protocol: success after k adaptation episodes; no parameter changes.

One adaptation run is a memory that starts empty, on one goal or, by task, on goals of its own.
Episode e is acted on what episodes 0..e-1 have shown (CMRL: z from the posterior over all own
transitions; the first from the text, or from the prior without a goal factor), deterministically
apart from the agent's own draw. One run of max(k) episodes and those that count gives the whole
curve (oyster evaluates the same way: katerakelly/oyster: rlkit/core/rl_algorithm.py).

Lanes are task x goal x draw of each policy, in batches of a fixed number of lanes, so that every
evaluation of a process runs one compiled program, controls included.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import numpy as np

from cmrl_jax.algorithms.base import Agent, Told
from cmrl_jax.config.schema import Config
from cmrl_jax.evaluation.controls import sources, take_lanes
from cmrl_jax.evaluation.episode import Episode, Lanes, make_episode
from cmrl_jax.evaluation.options import MOST_DRAWS, ZSource
from cmrl_jax.jax_runtime import jit_repeated
from envs.base import MetaEnv

GOAL_IDS = 1000  # more than the goals of any set
LEARNER = 500  # stands for the goal in the name of a lane that learns for all goals of its task
TASK_IDS = 4  # names come in blocks of as many tasks, so that the first four keep their noise


@dataclass(frozen=True)
class Trial:
    """What policies are scored on.

    Attributes:
        tasks: task names.
        placements: goals (task, goal, goal_size).
        texts: text vector that a lane is given (policy, task, goal, G).
        first_goal: number of the first goal, by which its lanes' noise is named.
        draws: z draws a goal.
        z: what episodes are acted on, see `controls.sources`.
        adaptation: goals that are learned on (task, draw, episode, goal_size), where a draw of a
            task learns once for all its goals; None where each goal is adapted to by itself.
        deterministic: whether actions are the tanh of the mean.
    """

    tasks: tuple[str, ...]
    placements: np.ndarray
    texts: np.ndarray
    first_goal: int = 0
    draws: int = 1
    z: ZSource = "posterior"
    deterministic: bool = True
    adaptation: np.ndarray | None = None

    def learners(self) -> Trial:
        """One lane for each task and draw, which learns for all goals of the task."""
        first = replace(self, placements=self.placements[:, :1], texts=self.texts[:, :, :1])
        return replace(first, first_goal=LEARNER)

    def of_goal(self, goal: int) -> Trial:
        """One goal of every task, with the noise that it has among the others."""
        return replace(
            self,
            placements=self.placements[:, goal : goal + 1],
            texts=self.texts[:, :, goal : goal + 1],
            first_goal=self.first_goal + goal,
        )


class _Stage(NamedTuple):
    """What is the same for all episodes of an evaluation."""

    params: Any
    deterministic: np.bool_
    check: Callable[[], None]


class Played(NamedTuple):
    """One episode of an adaptation run, numpy.

    Attributes:
        number: of adaptation episodes before it.
        is_counted: whether it is scored on the trial's goals.
        before: memories of its lanes (policy, lane, ...) when it began, experience alone.
        after: the same when it had ended, with what it was acted on.
        score: Episode of (policy, task, goal, draw); of one goal a task where it is one that a
            trial's learners play.
    """

    number: int
    is_counted: bool
    before: Any
    after: Any
    score: Episode


class Evaluator:
    """Runs evaluations with one compiled episode of a fixed number of policies and lanes.

    Args:
        lanes: lanes of each policy in a batch; the last batch of an evaluation is padded.
        horizon: control steps an episode; the run's own by default.
        policies: policies of one configuration that are scored side by side.
    """

    def __init__(
        self,
        config: Config,
        env: MetaEnv,
        agent: Agent,
        lanes: int,
        horizon: int | None = None,
        policies: int = 1,
    ):
        self.lanes, self.policies = lanes, policies
        self.horizon = horizon or config.env.horizon
        self._train_tasks, self._env, self._agent = config.tasks.train, env, agent
        self._episode = jit_repeated(make_episode(env, agent, self.horizon))
        self._compiled: Any = None

    @property
    def is_compiled(self) -> bool:
        return self._compiled is not None

    def compile(self, params: Any, text_width: int, lowered: Any = None) -> None:
        """Compiles the episode for one policy's parameters, or their shapes; later calls do not.

        Args:
            lowered: `traced(...).lower()` of the same, where another thread has made it: jax's
                settings are each thread's own.
        """
        if self._compiled is None:
            lowered = lowered or self.traced(params, text_width).lower()
            self._compiled = lowered.compile()

    def traced(self, params: Any, text_width: int) -> Any:
        """The episode as jax traces it for one policy's parameters, or their shapes."""
        shape, zero = (self.policies, self.lanes), np.zeros(self.lanes, np.int32)
        text, ones = np.zeros((*shape, text_width), np.float32), np.ones(shape, np.float32)
        memory = self._blank(Told(text, ones, np.zeros(shape, np.int32)))
        lanes = Lanes(zero, zero, np.zeros((self.lanes, self._env.goal_size), np.float32))
        of_all = lambda x: jax.ShapeDtypeStruct((self.policies, *x.shape), x.dtype)
        stacked = jax.tree.map(of_all, params)
        yes = np.bool_(True)
        return self._episode.trace(stacked, memory, memory, lanes, yes, yes, jax.random.key(0))

    def memory_bytes(self) -> int:
        """Memory that the compiled episode needs beside its arguments, in bytes; 0: unknown."""
        stats = self._compiled.memory_analysis() if self._compiled else None
        return 0 if stats is None else stats.temp_size_in_bytes + stats.output_size_in_bytes

    def run(
        self,
        policies: Sequence[Any],
        trial: Trial,
        k: Sequence[int],
        seed: int,
        check: Callable[[], None] = lambda: None,
    ) -> dict[int, Episode]:
        """Scores at every k of `k`; other arguments as of `episodes`.

        Returns:
            k -> Episode of numpy arrays (policy, task, goal, draw). Its faults are those of the
            adaptation episodes, too.
        """
        played = self.episodes(policies, trial, max(k) + 1, seed, check, k)
        scores = {episode.number: episode.score for episode in played if episode.is_counted}
        return {n: scores[n] for n in k}

    def episodes(
        self,
        policies: Sequence[Any],
        trial: Trial,
        count: int,
        seed: int,
        check: Callable[[], None] = lambda: None,
        counted: Sequence[int] | None = None,
    ) -> Iterator[Played]:
        """Plays adaptation runs of `count` episodes, each acted on what those before it showed.

        An agent that does not explore learns from the episodes that count, where those are on its
        own goal; else an episode that counts is one more, which nothing is learned from.

        Args:
            policies: at most as many as the evaluator has place for.
            seed: seed of the draws; a draw depends on it, task, goal, draw and episode alone.
            check: is called before each batch; what it raises ends the evaluation.
            counted: episodes to score; all by default.

        Yields:
            Every episode that is played, in that order: one that counts comes before the one that
            is learned from in its place.
        """
        self.compile(policies[0], trial.texts.shape[-1])
        stage = _Stage(
            params=_stack([*policies, *[policies[-1]] * (self.policies - len(policies))]),
            deterministic=np.bool_(trial.deterministic),
            check=check,
        )
        lanes, told = self.lanes_of(trial), self.told_of(trial)
        source_of = sources(trial.z, lanes, told, self._blank)
        learners = trial if trial.adaptation is None else trial.learners()
        heirs = _heirs(trial)  # the learning lane of each lane that counts
        memories = self._blank(self.told_of(learners))
        faults = np.zeros((self.policies, len(self.lanes_of(learners).lane_id)), np.int32)
        is_apart = trial.adaptation is not None or self._agent.explores

        def played(number, is_counted, before, after, score, of: Trial) -> Played:
            shape = (len(policies), *of.placements.shape[:2], of.draws)
            own = lambda x: x[: shape[0]]
            by_goal = jax.tree.map(lambda x: own(x).reshape(shape), score)
            before, after = (jax.tree.map(own, x) for x in (before, after))
            return Played(number, is_counted, before, after, by_goal)

        for episode in range(count):
            key = jax.random.fold_in(jax.random.key(seed), episode)
            known, before = take_lanes(memories, heirs), faults[:, heirs]
            is_counted = counted is None or episode in counted
            if not is_apart or is_counted:
                after, score = self._play(stage, known, source_of, lanes, is_apart, key)
                score = score._replace(faults=before + score.faults)
                yield played(episode, is_counted, known, after, score, trial)
                if not is_apart:
                    memories, faults = after, score.faults
            if is_apart and episode + 1 < count:
                places = self.lanes_of(learners, episode)
                after, score = self._play(stage, memories, take_lanes, places, False, key)
                faults = faults + score.faults
                score = score._replace(faults=faults)
                yield played(episode, False, memories, after, score, learners)
                memories = after

    def _play(
        self,
        stage: _Stage,
        memories: Any,
        source_of: Callable[[Any, np.ndarray], Any],
        lanes: Lanes,
        exploit: bool,
        key: jax.Array,
    ) -> tuple[Any, Episode]:
        """One episode of all lanes, batch after batch: memories after it, scores (policy, lane)."""
        total, parts = len(lanes.lane_id), []
        after = jax.tree.map(np.copy, memories)
        for start in range(0, total, self.lanes):
            stage.check()
            index = np.minimum(np.arange(start, start + self.lanes), total - 1)
            # Every batch acts on what was known before the episode, its donors' lanes too.
            memory, part = self._compiled(
                stage.params,
                take_lanes(memories, index),
                source_of(memories, index),
                Lanes(*(x[index] for x in lanes)),
                stage.deterministic,
                np.bool_(exploit),
                key,
            )
            valid = min(self.lanes, total - start)
            for every, new in zip(*map(jax.tree.leaves, (after, memory)), strict=True):
                every[:, start : start + valid] = np.asarray(new)[:, :valid]
            parts.append(jax.tree.map(np.asarray, part))
        return after, jax.tree.map(lambda *x: np.concatenate(x, 1)[:, :total], *parts)

    def _blank(self, told: Told) -> Any:
        """Memories of lanes that have seen nothing, numpy (policy, lane, ...)."""
        return jax.tree.map(np.array, self._agent.init(told))

    def lanes_of(self, trial: Trial, episode: int | None = None) -> Lanes:
        """All lanes of a trial, in the order task, goal, draw.

        Args:
            episode: of `trial.adaptation`, whose goals the lanes then are on, if it has any.
        """
        task, goal, draw = _indices(trial)
        places = np.asarray(trial.placements, np.float32)[task, goal]
        if episode is not None and trial.adaptation is not None:
            places = np.asarray(trial.adaptation, np.float32)[task, draw, episode]
        return Lanes(
            env_task=self._task_ids(trial)[task],
            lane_id=lane_names(trial, self._env.tasks),
            goal=places,
        )

    def told_of(self, trial: Trial) -> Told:
        """What every lane is told (policy, lane, ...), for all places of the evaluator."""
        texts = np.repeat(np.asarray(trial.texts, np.float32), trial.draws, axis=2)
        texts = texts.reshape(len(texts), -1, texts.shape[-1])
        texts = texts[np.minimum(np.arange(self.policies), len(texts) - 1)]
        train = self._train_tasks
        rows = [train.index(name) if name in train else 0 for name in trial.tasks]
        row = np.array(rows, np.int32)[_indices(trial)[0]]
        shape = texts.shape[:2]
        return Told(texts, np.ones(shape, np.float32), np.broadcast_to(row, shape))

    def _task_ids(self, trial: Trial) -> np.ndarray:
        return np.array([self._env.tasks.index(name) for name in trial.tasks], np.int32)


def lane_names(trial: Trial, tasks: Sequence[str]) -> np.ndarray:
    """What a lane's noise depends on: a number for each (task, goal, draw), int32 (lane,).

    Args:
        tasks: the environment's. A name depends on a task's place alone, not on how many follow.
    """
    task, goal, draw = _indices(trial)
    place = np.array([tasks.index(name) for name in trial.tasks], np.int32)[task]
    block, within = place // TASK_IDS, place % TASK_IDS
    name = (block * np.int32(MOST_DRAWS) + draw) * np.int32(TASK_IDS) + within
    return name * np.int32(GOAL_IDS) + (goal + np.int32(trial.first_goal))


def _heirs(trial: Trial) -> np.ndarray:
    """For each lane the one that learns for it (lane,): itself, or its task's of the same draw."""
    task, _, draw = _indices(trial)
    return np.arange(len(task)) if trial.adaptation is None else task * trial.draws + draw


def _indices(trial: Trial) -> np.ndarray:
    """Task, goal and draw of each lane, (3, lane)."""
    shape = (len(trial.tasks), trial.placements.shape[1], trial.draws)
    return np.indices(shape, np.int32).reshape(3, -1)


def _stack(policies: Sequence[Any]) -> Any:
    """Policies with a leading policy axis, on the host: nothing to compile."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(x) for x in leaves]), *policies)
