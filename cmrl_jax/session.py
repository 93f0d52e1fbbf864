"""What a run is made of, built from its configuration: env, goals, learner, compiled programs.

Shared by training, evaluation and benchmarks.
"""

from __future__ import annotations

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from cmrl_jax.config import Config, ConfigError
from cmrl_jax.evaluate import Evaluator, PolicyParams
from cmrl_jax.goals import GoalTable, load_goals
from cmrl_jax.learner import Learner, TrainState, make_learner
from envs.goal_sets import load_goal_set
from envs.sawyer import Ml4Env


def prepare_jax(config: Config) -> str:
    """Applies the `runtime` section; returns the device in words.

    An environment that already names a compilation cache (JAX_COMPILATION_CACHE_DIR) keeps it.
    """
    if config.runtime.matmul_precision == "highest":
        jax.config.update("jax_default_matmul_precision", "highest")
    cache = config.runtime.compile_cache
    if cache and not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_compilation_cache_dir", str(Path(cache).expanduser()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
    device = jax.devices()[0]
    return f"{device.platform} ({device.device_kind}), {jax.device_count()} device(s)"


class Session:
    """Env, goal vectors and learner of one configuration.

    Attributes:
        eval_tasks: training tasks, then test tasks.
    """

    def __init__(self, config: Config):
        self.config = config
        self.eval_tasks = config.tasks.train + config.tasks.test
        self.goals: GoalTable = load_goals(config.goals.table, self.eval_tasks)
        env = config.env
        self.env = call_envs(lambda: Ml4Env(env.goal_observable, env.physics, env.obs_mode))
        self.train_goals = jnp.asarray(self.goals.select(config.tasks.train).vectors)
        self.learner: Learner = make_learner(config, self.train_goals)

    def placements(self, goal_set: str, goals: int) -> np.ndarray:
        """The first `goals` placements of a named set for the evaluated tasks (task, goal, 3)."""
        return call_envs(lambda: load_goal_set(goal_set, self.eval_tasks))[:, :goals]

    def train_placements(self) -> jax.Array | None:
        """Placements that training draws from; None where it draws from the reset box."""
        if self.config.env.variation == "episode_random":
            return None
        train = call_envs(lambda: load_goal_set("train", self.config.tasks.train))
        return jnp.asarray(train, jnp.float32)

    def evaluator(
        self, horizon: int | None = None, goal_vectors: np.ndarray | None = None
    ) -> Evaluator:
        """The evaluator of the run; a batch of it is one periodic evaluation.

        Args:
            horizon: control steps an episode; None for the run's own.
            goal_vectors: (task, G); None for the first paraphrase of the table.
        """
        return Evaluator(
            self.config,
            self.env,
            self.learner,
            self.eval_tasks,
            self.goals.vectors[:, 0] if goal_vectors is None else goal_vectors,
            lanes=self.config.eval.goals * len(self.eval_tasks),
            horizon=horizon,
        )


def policy_params(state: TrainState) -> PolicyParams:
    """The part of the learner's state that acts."""
    return PolicyParams(state.actor_params, state.encoder_params, state.obs_stats)


def call_envs(build):
    """Calls into `envs`, whose ValueErrors carry cause and cure on two lines."""
    try:
        return build()
    except ValueError as error:
        cause, _, cure = str(error).partition("\n")
        if not cure:
            raise
        raise ConfigError(cause, cure) from error
