"""Another environment than Meta-World's: registered, trained on and evaluated by the public API."""

import jax
import jax.numpy as jnp
import numpy as np
import point_env
import pytest
from point_env import PointEnv

import cmrl_jax as cj
from cmrl_jax import registry
from cmrl_jax.algorithms.common.replay import add, init_replay, sample
from cmrl_jax.algorithms.common.rollout import rollout

HORIZON, LANES = 20, 16
SMALL = {
    "env.name": "point",
    "env.horizon": HORIZON,
    "tasks.test": [],
    "goals.table": "one-hot",
    "collect.lanes": LANES,
    "collect.noise_scale": 2.0,
    "collect.chunk": 10,
    "sac.batch": 64,
    "sac.gamma": 0.9,
    "sac.lr": 1e-3,
    "train.capacity": 16_000,
    "eval.every": 1.0,
    "eval.wall_share": 1.0,
    "eval.goals": 1,
    "eval.final_goals": 10,
}
BOTH = {"tasks.train": ["point-left", "point-right"], "eval.k": [0, 2], "eval.final_k": [0, 2]}
ONE = {"tasks.train": ["point-right"]}
METHODS = {
    "cmrl": ("smoke", BOTH | {"train.env_steps": 25_600, "collect.updates_per_vector_step": 4}),
    "pearl": ("pearl", BOTH | {"train.env_steps": 25_600, "collect.updates_per_vector_step": 4}),
    "sac": ("sac", ONE | {"train.env_steps": 25_600, "collect.updates_per_vector_step": 4}),
}


@pytest.fixture(scope="module", autouse=True)
def registered():
    cj.register_environment("point", point_env.TASKS, "point_env:make")
    yield
    del registry.ENVIRONMENTS["point"]


@pytest.mark.parametrize("method", METHODS)
def test_it_is_learned(method, tmp_path):
    """Near its edge and not over it at the end, in (almost) every goal of every task."""
    config, overrides = METHODS[method]
    result = cj.train(cj.load_config(config, SMALL | overrides), tmp_path / "run", loggers=[])
    figures = cj.evaluate(result.agent).rows()
    k = max(row["k"] for row in figures)
    last = [row["success_last"] for row in figures if row["k"] == k]
    assert len(last) == 10 * len(overrides["tasks.train"]) and np.mean(last) >= 0.9
