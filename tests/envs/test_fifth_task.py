"""A task is one file and one line: a fifth one, which leaves the others as they were."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
LINE = '    "drawer-half": Entry("envs.tasks.drawer_half", "drawer-open", is_metaworlds=False),\n'
FILE = '''"""The drawer, pulled half open."""

import jax.numpy as jnp

from envs.rewards import long_tail, norm
from envs.tasks.base import RewardInputs
from envs.tasks.drawer import TASKS as DRAWER


def drawer_half(x: RewardInputs):
    distance = jnp.abs(x.slide + 0.08)
    near = long_tail(norm(x.handle - x.hand), 0.01, 0.3)
    return 5.0 * (long_tail(distance, 0.02, 0.1) + near), distance, distance <= 0.02


TASKS = {"drawer-half": DRAWER["drawer-open"]._replace(reward=drawer_half)}
'''
# What must not move: goals, text control, names of lanes, one-hot goals, and every figure.
FIGURES = """
import json, sys
import numpy as np
sys.path.insert(0, "tests")
from cmrl_jax.config.files import load_config
from cmrl_jax.evaluation.evaluator import Evaluator, lane_names
from cmrl_jax.evaluation.session import Session
from cmrl_jax.registry import other_task
from cmrl_jax.text.goals import load_goals
from envs.tasks import TASKS
from policy_fixtures import random_policy
from dataclasses import replace
four = TASKS[:4]
small = {"env.physics": "native", "env.horizon": "10", "collect.chunk": "10", "model.net": "mlp"}
session = Session(load_config("smoke.yaml", small))
trial = replace(session.trial("heldout", 2), draws=2)
evaluator = Evaluator(session.config, session.env, session.agent, 16)
scores = evaluator.run([random_policy(session, 1)], trial, (0, 1), seed=3)
print(json.dumps({
    "text control": [other_task(task) for task in four],
    "names": lane_names(trial, session.env.tasks).tolist(),
    "goals": trial.placements.tolist(),
    "one-hot": load_goals("one-hot", four).vectors.tolist(),
    "scores": {k: [np.float64(x).tolist() for x in episode] for k, episode in scores.items()},
}))
"""
# The new one: it is trained on, evaluated, and solved by a hand that pulls.
FIFTH = """
import json
import jax, jax.numpy as jnp
import numpy as np
from cmrl_jax.config.files import load_config
from cmrl_jax.evaluation.evaluator import lane_names
from cmrl_jax.evaluation.session import Session
flags = {"env.physics": "native", "goals.table": "one-hot", "tasks.test": "drawer-half"}
session = Session(load_config("smoke.yaml", flags))
trial = session.trial("fresh:7", 3)
env, goal = session.env, jnp.asarray(trial.placements[-1, 0], jnp.float32)
step, state, found = jax.jit(env.step), env.reset_to(jnp.int32(4), goal), []
for n in range(200):
    hand, handle = state.obs[:3], state.obs[4:7]
    aim = handle + jnp.array([0.0, 0.0, 0.02])
    if n < 40:
        aim = aim + jnp.array([0.0, 0.0, 0.1])
    pull = n > 70 and float(state.distance) > 0.01
    target = hand - jnp.array([0.0, 0.03, 0.0]) if pull else (hand if n > 70 else aim)
    action = jnp.append(jnp.clip(25 * (target - hand), -1, 1), -1.0)
    state = step(state, action)
    found.append(bool(state.success))
print(json.dumps({"success": found, "names": lane_names(trial, env.tasks).tolist(),
                  "width": session.goals.vectors.shape[-1],
                  "goals": trial.placements[-1].tolist()}))
"""


def run(code, root):
    """What a program prints as JSON, with the packages of a copy of the repository."""
    result = subprocess.run(
        [sys.executable, "-c", code],
        cwd=root,
        env=os.environ | {"PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def extended(tmp_path_factory):
    """The repository with one file and one line more."""
    root = tmp_path_factory.mktemp("extended")
    for folder in ("cmrl_jax", "envs", "configs", "tests"):
        shutil.copytree(ROOT / folder, root / folder, ignore=shutil.ignore_patterns("__pycache__"))
    (root / "envs/tasks/drawer_half.py").write_text(FILE)
    registry = root / "envs/tasks/__init__.py"
    last = '    "window-close": Entry("envs.tasks.window", other="drawer-open"),\n'
    assert last in registry.read_text()
    registry.write_text(registry.read_text().replace(last, last + LINE))
    return root


@pytest.mark.slow
def test_the_other_tasks_stay_as_they_were(extended):
    assert run(FIGURES, extended) == run(FIGURES, ROOT)


@pytest.mark.slow
def test_it_is_a_task_like_the_others(extended):
    found = run(FIFTH, extended)
    assert any(found["success"]) and not found["success"][0]
    assert found["width"] == 5
    assert len(set(found["names"])) == len(found["names"])
    low, high = np.min(found["goals"], 0), np.max(found["goals"], 0)
    assert low[0] >= -0.1 and high[0] <= 0.1 and low[1] == high[1] == 0.9
