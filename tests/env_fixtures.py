"""Shared by the environment's tests: one compiled step for all of them, and recorded episodes."""

import numpy as np
import pytest

from envs.goal_sets import load_goal_set
from envs.parity.parts import Port
from envs.parity.reference import Rollout, record_rollout
from envs.sawyer import Ml4Env
from envs.tasks import METAWORLD_TASKS as TASKS

GOALS_A_TASK = 3
LANES = GOALS_A_TASK * len(TASKS)
GOALS = load_goal_set("heldout", TASKS)[:, :GOALS_A_TASK]  # (task, goal, 3)
LANE_TASKS = np.repeat(np.arange(len(TASKS), dtype=np.int32), GOALS_A_TASK)
LANE_GOALS = GOALS.reshape(-1, 3).astype(np.float32)


class CountedPort(Port):
    """The port of `LANES` lanes; `traces` counts how often its step was traced."""

    def __init__(self):
        self.traces = 0
        original = Ml4Env.step

        def counted(env, state, action):
            self.traces += 1
            return original(env, state, action)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Ml4Env, "step", counted)
            super().__init__(LANES)


def record() -> list[Rollout]:
    """A scripted, a perturbed and a random episode of each task, on different goals."""
    kinds = ("scripted", "perturbed", "random")
    return [
        record_rollout(task, goal, kind, steps=160, seed=7)
        for task, goals in zip(TASKS, GOALS, strict=True)
        for goal, kind in zip(goals, kinds, strict=True)
    ]
