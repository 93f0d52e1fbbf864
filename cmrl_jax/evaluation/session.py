"""What a run is made of, built from its configuration: environment, goals, algorithm.

Shared by training, evaluation and benchmarks.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cmrl_jax.algorithms.base import Agent, Algorithm
from cmrl_jax.config.schema import Config, call_envs
from cmrl_jax.evaluation.controls import text_per_goal
from cmrl_jax.evaluation.evaluator import Evaluator, Trial
from cmrl_jax.jax_runtime import cache_directory, check_switches, first_device
from cmrl_jax.registry import make_algorithm, make_environment
from cmrl_jax.storage.checkpoint import policy_store
from cmrl_jax.storage.versions import package_versions
from cmrl_jax.text.goals import GoalTable, load_goals
from envs.base import MetaEnv


def prepare_jax(config: Config) -> str:
    """Applies the `runtime` section, whatever was applied before; returns the device in words.

    An environment that already names a compilation cache (JAX_COMPILATION_CACHE_DIR) keeps it, and
    its own precision (JAX_DEFAULT_MATMUL_PRECISION) is the default one.

    Raises:
        ConfigError: jax is set to what this program cannot work with, or finds no device.
    """
    check_switches()
    default = os.environ.get("JAX_DEFAULT_MATMUL_PRECISION")
    highest = config.runtime.matmul_precision == "highest"
    jax.config.update("jax_default_matmul_precision", "highest" if highest else default)
    cache = config.runtime.compile_cache
    if cache and not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_compilation_cache_dir", cache_directory(cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
    device = first_device()
    return f"{device.platform} ({device.device_kind}), {jax.device_count()} device(s)"


class Session:
    """Environment, goal vectors and algorithm of one configuration.

    Attributes:
        eval_tasks: training tasks, then test tasks.
    """

    def __init__(self, config: Config):
        self.config = config
        self.eval_tasks = config.tasks.train + config.tasks.test
        self.goals: GoalTable = load_goals(config.goals.table, self.eval_tasks)
        self.env: MetaEnv = call_envs(lambda: make_environment(config.env))
        self.train_goals = jnp.asarray(self.goals.select(config.tasks.train).vectors)
        self.algorithm: Algorithm = call_envs(
            lambda: make_algorithm(config, self.env, self.train_goals)
        )

    @property
    def agent(self) -> Agent:
        return self.algorithm.agent

    def placements(
        self, goal_set: str, goals: int, tasks: Sequence[str] | None = None
    ) -> np.ndarray:
        """The first `goals` goals of a named set (task, goal, goal_size), by default for all."""
        return call_envs(lambda: self.env.goals(goal_set, tasks or self.eval_tasks))[:, :goals]

    def train_placements(self) -> jax.Array | None:
        """Goals that training draws from; None where it draws by the environment's resets."""
        if self.config.env.variation == "episode_random":
            return None
        train = call_envs(lambda: self.env.goals("train", self.config.tasks.train))
        return jnp.asarray(train, jnp.float32)

    def trial(self, goal_set: str, goals: int) -> Trial:
        """The protocol's own trial: every evaluated task, its first sentence, one draw a goal."""
        texts = text_per_goal(list(self.goals.vectors[:, :1]), goals)
        return Trial(self.eval_tasks, self.placements(goal_set, goals), texts[None])

    def evaluator(self) -> Evaluator:
        """The evaluator of a training run; a batch of it is one periodic evaluation."""
        return Evaluator(
            self.config,
            self.env,
            self.agent,
            lanes=self.config.eval.goals * len(self.eval_tasks),
        )


@dataclass(frozen=True)
class Policy:
    """A policy checkpoint.

    Attributes:
        params: what acts.
        goal_vectors: the text vectors that the run evaluates with, {task: (G,)}.
        meta: the checkpoint's record (`checkpoint.META_FIELDS`).
    """

    params: Any
    goal_vectors: dict[str, np.ndarray]
    meta: dict[str, Any]


def load_policy(
    run: Path, session: Session, checkpoint: int | None = None, tasks: Sequence[str] | None = None
) -> Policy:
    """Reads a policy checkpoint of a run.

    Args:
        session: of the run's configuration, or of one with the same policy.
        checkpoint: iteration; None for the newest.
        tasks: the run's training, then test tasks, where the session's are others.

    Raises:
        ConfigError: no such checkpoint, or it does not fit the session.
    """
    tasks = tuple(tasks or session.eval_tasks)
    state = jax.eval_shape(session.algorithm.init, jax.random.key(0))
    shape = (len(tasks), session.goals.vectors.shape[-1])
    vectors = jax.ShapeDtypeStruct(shape, np.float32)
    abstract = {"params": session.algorithm.policy_params(state), "goal_vectors": vectors}
    with policy_store(run, read_only=True) as store:
        trees, meta = store.restore(
            {"policy": abstract}, step=checkpoint, versions=package_versions()
        )
    found = np.asarray(trees["policy"]["goal_vectors"])
    return Policy(trees["policy"]["params"], dict(zip(tasks, found, strict=True)), meta)
