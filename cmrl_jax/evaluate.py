"""The meta-test protocol: success after k adaptation episodes, trained on by nothing.

One adaptation run is a fixed goal and a belief that starts empty. Episode e acts with z drawn from
the posterior over all own transitions of episodes 0..e-1 (the first: from the text, or from the
prior without a goal factor), deterministically apart from that draw. So the score at k is the score
of episode k, and one run of max(k) + 1 episodes gives the whole curve (oyster evaluates the same
way: katerakelly/oyster: rlkit/core/rl_algorithm.py).

Lanes are task x goal, in batches of a fixed number of lanes, so that every evaluation of a process
runs one compiled program.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cmrl_jax.config import Config
from cmrl_jax.context import Belief, init_belief
from cmrl_jax.learner import Learner
from cmrl_jax.rollout import rollout
from envs.sawyer import Ml4Env
from envs.tasks import task_id


class PolicyParams(NamedTuple):
    """What acting needs: the policy checkpoint's arrays."""

    actor_params: Any
    encoder_params: Any  # None without a latent
    obs_stats: Any


class Episode(NamedTuple):
    """Scores of one episode of every lane, each (lane,)."""

    success_any: jax.Array  # at any step, Meta-World's rule
    success_last: jax.Array
    returns: jax.Array
    first_success: jax.Array  # control step, the horizon where there is none
    final_distance: jax.Array  # metres
    faults: jax.Array  # times the lane's physics was put back


EpisodeFn = Callable[..., tuple[Belief | None, Episode]]


def make_episode(config: Config, env: Ml4Env, learner: Learner, horizon: int) -> EpisodeFn:
    """Builds one evaluation episode of every lane, a jittable function.

    Returns:
        (params, belief, env_task (lane,), train_row (lane,), lane_id (lane,), placement (lane, 3),
        goal (lane, G), key) -> belief with the episode added, Episode. `train_row` is the task's
        row among the training tasks, used where the conditioning is a task id. A lane's z depends
        on key and `lane_id`, not on its place in the batch.
    """
    inference = learner.inference
    chunk = config.collect.chunk if horizon % config.collect.chunk == 0 else 1

    def episode(params, belief, env_task, train_row, lane_id, placement, goal, key):
        lanes = env_task.shape[0]
        k_z, k_act = jax.random.split(key)
        ones = jnp.ones((lanes,))
        if inference is None:
            zc = learner.task_conditioning(train_row)
        else:
            posterior = inference.posterior_of_belief(params.encoder_params, belief, goal, ones)
            lane_key = jax.vmap(lambda lane: jax.random.fold_in(k_z, lane))(lane_id)
            zc = jax.vmap(inference.sample_z)(lane_key, posterior)

        def run_chunk(carry, key):
            state, belief = carry
            state, transitions, stats = rollout(
                env,
                learner,
                (params.actor_params, params.obs_stats),
                state,
                zc,
                key,
                chunk,
                horizon,
                deterministic=True,
            )
            if inference is not None:
                by_lane = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), transitions)
                by_lane = replace(
                    by_lane,
                    obs=learner.normalize_obs(params.obs_stats, by_lane.obs),
                    next_obs=learner.normalize_obs(params.obs_stats, by_lane.next_obs),
                )
                mask = jnp.ones((lanes, chunk))
                belief = inference.update_belief(
                    params.encoder_params, belief, by_lane, mask, goal, ones
                )
            return (state, belief), (transitions.reward, stats.success, stats.distance)

        state = jax.vmap(env.reset_to)(env_task, placement)
        keys = jax.random.split(k_act, horizon // chunk)
        (state, belief), scores = jax.lax.scan(run_chunk, (state, belief), keys)
        reward, success, distance = (x.reshape(horizon, lanes) for x in scores)
        succeeded = jnp.any(success, 0)
        return belief, Episode(
            success_any=succeeded,
            success_last=success[-1],
            returns=jnp.sum(reward, 0),
            first_success=jnp.where(succeeded, jnp.argmax(success, 0), horizon),
            final_distance=distance[-1],
            faults=state.faults,
        )

    return episode


class Evaluator:
    """Runs evaluations with one compiled episode of a fixed number of lanes.

    Args:
        tasks: names of the tasks to evaluate.
        goal_vectors: text vector of each of those tasks, the fixed paraphrase, (task, G).
        lanes: lanes of a batch; the last batch of an evaluation is padded.
        horizon: control steps an episode; the run's own by default.
    """

    def __init__(
        self,
        config: Config,
        env: Ml4Env,
        learner: Learner,
        tasks: Sequence[str],
        goal_vectors: np.ndarray,
        lanes: int,
        horizon: int | None = None,
    ):
        self.tasks = tuple(tasks)
        self.lanes = lanes
        self.horizon = horizon or config.env.horizon
        self._goal_vectors = np.asarray(goal_vectors, np.float32)
        train = config.tasks.train
        self._train_row = np.array([train.index(t) if t in train else 0 for t in tasks], np.int32)
        self._env_task = np.array([task_id(name) for name in tasks], np.int32)
        self._learner = learner
        self._episode = jax.jit(make_episode(config, env, learner, self.horizon))
        self._compiled: Callable[..., Any] | None = None

    def _empty_belief(self) -> Belief | None:
        inference = self._learner.inference
        return init_belief((self.lanes,), inference.latent_dim) if inference else None

    @property
    def is_compiled(self) -> bool:
        return self._compiled is not None

    def compile(self, params: PolicyParams) -> None:
        """Compiles the episode for these parameter shapes; later calls do not compile."""
        if self._compiled is None:
            task, goal = np.zeros(self.lanes, np.int32), np.zeros((self.lanes, 3), np.float32)
            text = np.zeros((self.lanes, self._goal_vectors.shape[-1]), np.float32)
            args = (params, self._empty_belief(), task, task, task, goal, text, jax.random.key(0))
            self._compiled = self._episode.lower(*args).compile()

    def run(
        self, params: PolicyParams, placements: np.ndarray, k: Sequence[int], seed: int
    ) -> dict[int, Episode]:
        """Scores at every k of `k`.

        Args:
            placements: goals, (task, goal, 3) fixture placements in metres.
            seed: seed of the z draws; a draw depends on it, task, goal and episode alone.

        Returns:
            k -> Episode of numpy arrays (task, goal).
        """
        self.compile(params)
        assert self._compiled is not None
        tasks, goals = placements.shape[:2]
        task = np.repeat(np.arange(tasks), goals)
        placement = np.asarray(placements, np.float32).reshape(-1, 3)
        lane_id = self._env_task[task] * np.int32(1000) + np.tile(
            np.arange(goals, dtype=np.int32), tasks
        )
        key = jax.random.key(seed)
        parts: dict[int, list[Episode]] = {n: [] for n in k}
        for start in range(0, len(task), self.lanes):
            index = np.minimum(np.arange(start, start + self.lanes), len(task) - 1)
            belief, row = self._empty_belief(), task[index]
            for episode in range(max(k) + 1):
                belief, scores = self._compiled(
                    params,
                    belief,
                    self._env_task[row],
                    self._train_row[row],
                    lane_id[index],
                    placement[index],
                    self._goal_vectors[row],
                    jax.random.fold_in(key, episode),
                )
                if episode in parts:
                    parts[episode].append(jax.tree.map(np.asarray, scores))
        join = lambda *x: np.concatenate(x)[: len(task)].reshape(tasks, goals)
        return {n: jax.tree.map(join, *episodes) for n, episodes in parts.items()}


def summarise(scores: dict[int, Episode], tasks: Sequence[str]) -> dict[str, Any]:
    """Means over goals: {task: {k: {"success_any": .., "success_last": .., "return": .., ...}}}."""
    return {
        task: {
            str(k): {
                "success_any": float(episode.success_any[row].mean()),
                "success_last": float(episode.success_last[row].mean()),
                "return": float(episode.returns[row].mean()),
                "first_success_step": float(episode.first_success[row].mean()),
                "final_distance": float(episode.final_distance[row].mean()),
            }
            for k, episode in scores.items()
        }
        for row, task in enumerate(tasks)
    }


def format_scores(summary: dict[str, Any]) -> str:
    """A table of an evaluation: success at any and last step and return, per task and k."""
    lines = [f"{'task':<14} {'k':>3} {'any step':>9} {'last step':>9} {'return':>8}"]
    for task, by_k in summary.items():
        for k, f in by_k.items():
            figures = f"{f['success_any']:>9.2f} {f['success_last']:>9.2f} {f['return']:>8.0f}"
            lines.append(f"{task:<14} {k:>3} {figures}")
    return "\n".join(lines)
