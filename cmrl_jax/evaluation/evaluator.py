"""The meta-test protocol: success after k adaptation episodes, trained on by nothing.

One adaptation run is a fixed goal and a belief that starts empty. Episode e acts with z drawn from
the posterior over all own transitions of episodes 0..e-1 (the first: from the text, or from the
prior without a goal factor), deterministically apart from that draw. So the score at k is the score
of episode k, and one run of max(k) + 1 episodes gives the whole curve (oyster evaluates the same
way: katerakelly/oyster: rlkit/core/rl_algorithm.py).

Lanes are task x goal x draw of each policy, in batches of a fixed number of lanes, so that every
evaluation of a process runs one compiled program, controls included.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from cmrl_jax.algorithms.cmrl.learner import Learner
from cmrl_jax.config.schema import Config
from cmrl_jax.evaluation.controls import donors
from cmrl_jax.evaluation.episode import Episode, Lanes, PolicyParams, ZSource, make_episode
from cmrl_jax.nn.context import init_belief
from envs.sawyer import Ml4Env
from envs.tasks import TASKS, task_id

GOAL_IDS = 1000  # more than the goals of any set


@dataclass(frozen=True)
class Trial:
    """What policies are scored on.

    Attributes:
        tasks: task names.
        placements: goals (task, goal, 3), fixture placements in metres.
        texts: text vector that a lane is given (policy, task, goal, G).
        first_goal: number of the first goal, by which its lanes' noise is named.
        draws: z draws a goal.
        z: one of `options.Z_SOURCES`.
        deterministic: whether actions are the tanh of the mean.
    """

    tasks: tuple[str, ...]
    placements: np.ndarray
    texts: np.ndarray
    first_goal: int = 0
    draws: int = 1
    z: str = "posterior"
    deterministic: bool = True

    def of_goal(self, goal: int) -> Trial:
        """One goal of every task, with the noise that it has among the others."""
        return replace(
            self,
            placements=self.placements[:, goal : goal + 1],
            texts=self.texts[:, :, goal : goal + 1],
            first_goal=self.first_goal + goal,
        )


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
        env: Ml4Env,
        learner: Learner,
        lanes: int,
        horizon: int | None = None,
        policies: int = 1,
    ):
        self.lanes, self.policies = lanes, policies
        self.horizon = horizon or config.env.horizon
        self._train_tasks = config.tasks.train
        self._inference = learner.inference
        self._episode = jax.jit(make_episode(config, env, learner, self.horizon))
        self._compiled: Any = None

    @property
    def is_compiled(self) -> bool:
        return self._compiled is not None

    def compile(self, params: PolicyParams, text_width: int) -> None:
        """Compiles the episode for one policy's parameter shapes; later calls do not compile."""
        if self._compiled is None:
            self._compiled = self.traced(params, text_width).lower().compile()

    def traced(self, params: PolicyParams, text_width: int) -> Any:
        """The episode as jax traces it for one policy's parameter shapes."""
        shape = (self.policies, self.lanes)
        text, zero = np.zeros((*shape, text_width), np.float32), np.zeros(self.lanes, np.int32)
        lanes = Lanes(zero, zero, zero, np.zeros((self.lanes, 3), np.float32))
        source = ZSource(self._empty(self.lanes), text, np.zeros(shape, np.float32))
        stacked = _stack([params] * self.policies)
        args = (stacked, source.belief, text, source, lanes, np.bool_(True), jax.random.key(0))
        return self._episode.trace(*args)

    def memory_bytes(self) -> int:
        """Memory that the compiled episode needs beside its arguments, in bytes; 0: unknown."""
        stats = self._compiled.memory_analysis() if self._compiled else None
        return 0 if stats is None else stats.temp_size_in_bytes + stats.output_size_in_bytes

    def run(
        self,
        policies: Sequence[PolicyParams],
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
        scores, faults = [], 0
        for _, score in self.episodes(policies, trial, max(k) + 1, seed, check):
            faults = faults + score.faults
            scores.append(score._replace(faults=faults))
        return {n: scores[n] for n in k}

    def episodes(
        self,
        policies: Sequence[PolicyParams],
        trial: Trial,
        count: int,
        seed: int,
        check: Callable[[], None] = lambda: None,
    ) -> Iterator[tuple[Any, Episode]]:
        """Plays `count` episodes of every adaptation run, each from what those before it showed.

        Args:
            policies: at most as many as the evaluator has place for.
            seed: seed of the draws; a draw depends on it, task, goal, draw and episode alone.
            check: is called before each batch; what it raises ends the evaluation.

        Yields:
            For each episode the beliefs of all lanes before it, numpy (policy, lane, ...) or None
            without a latent, and its Episode of numpy arrays (policy, task, goal, draw).
        """
        self.compile(policies[0], trial.texts.shape[-1])
        params = _stack([*policies, *[policies[-1]] * (self.policies - len(policies))])
        shape = (len(policies), *trial.placements.shape[:2], trial.draws)
        lanes, texts = self.lanes_of(trial), self.texts_of(trial)
        total = len(lanes.lane_id)
        donor = donors(trial.z, lanes.lane_id, lanes.env_task)
        uses_belief = trial.z not in ("prior", "text")
        text_mask = np.full((self.policies, self.lanes), trial.z != "prior", np.float32)
        key, beliefs = jax.random.key(seed), self._empty(total)
        for episode in range(count):
            # Every batch draws from what was known before the episode, its donors' lanes too.
            before = jax.tree.map(np.copy, beliefs)
            parts = []
            for start in range(0, total, self.lanes):
                check()
                index = np.minimum(np.arange(start, start + self.lanes), total - 1)
                giver = donor[index]
                belief = jax.tree.map(lambda x: x[:, giver], before) if uses_belief else None
                belief, part = self._compiled(
                    params,
                    jax.tree.map(lambda x: x[:, index], before),
                    texts[:, index],
                    ZSource(belief or self._empty(self.lanes), texts[:, giver], text_mask),
                    Lanes(*(x[index] for x in lanes)),
                    np.bool_(trial.deterministic),
                    jax.random.fold_in(key, episode),
                )
                valid = min(self.lanes, total - start)
                for all_lanes, new in zip(*map(jax.tree.leaves, (beliefs, belief)), strict=True):
                    all_lanes[:, start : start + valid] = np.asarray(new)[:, :valid]
                parts.append(jax.tree.map(np.asarray, part))
            joined = jax.tree.map(lambda *x: np.concatenate(x, 1)[:, :total], *parts)
            known = jax.tree.map(lambda x: x[: shape[0]], before)
            yield known, jax.tree.map(lambda x: x[: shape[0]].reshape(shape), joined)

    def _empty(self, lanes: int) -> Any:
        """Empty beliefs of all policies, numpy (policy, lane, ...); None without a latent."""
        if self._inference is None:
            return None
        belief = init_belief((self.policies, lanes), self._inference.latent_dim)
        return jax.tree.map(np.array, belief)

    def lanes_of(self, trial: Trial) -> Lanes:
        """All lanes of a trial, in the order task, goal, draw."""
        task, goal, _ = _indices(trial)
        train = self._train_tasks
        rows = [train.index(name) if name in train else 0 for name in trial.tasks]
        return Lanes(
            env_task=_task_ids(trial)[task],
            train_row=np.array(rows, np.int32)[task],
            lane_id=lane_names(trial),
            placement=np.asarray(trial.placements, np.float32)[task, goal],
        )

    def texts_of(self, trial: Trial) -> np.ndarray:
        """The text of every lane (policy, lane, G), for all places of the evaluator."""
        texts = np.repeat(np.asarray(trial.texts, np.float32), trial.draws, axis=2)
        texts = texts.reshape(len(texts), -1, texts.shape[-1])
        return texts[np.minimum(np.arange(self.policies), len(texts) - 1)]


def lane_names(trial: Trial) -> np.ndarray:
    """What a lane's noise depends on: a number for each (task, goal, draw), int32 (lane,)."""
    task, goal, draw = _indices(trial)
    name = draw * np.int32(len(TASKS)) + _task_ids(trial)[task]
    return name * np.int32(GOAL_IDS) + (goal + np.int32(trial.first_goal))


def _indices(trial: Trial) -> np.ndarray:
    """Task, goal and draw of each lane, (3, lane)."""
    shape = (len(trial.tasks), trial.placements.shape[1], trial.draws)
    return np.indices(shape, np.int32).reshape(3, -1)


def _task_ids(trial: Trial) -> np.ndarray:
    return np.array([task_id(name) for name in trial.tasks], np.int32)


def _stack(policies: Sequence[PolicyParams]) -> PolicyParams:
    """Policies with a leading policy axis, on the host: nothing to compile."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(x) for x in leaves]), *policies)
