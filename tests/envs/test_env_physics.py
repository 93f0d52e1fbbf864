"""The MJX backend against MuJoCo C: single steps, and what stops the hand."""

import numpy as np
import pytest
from env_fixtures import GOALS, LANE_GOALS, LANE_TASKS, LANES

from envs.parity import parts as parity_parts
from envs.parity.reference import ReferenceEnv
from envs.tasks import METAWORLD_TASKS as TASKS
from envs.tasks.base import HAND_HIGH, HAND_LOW

# Hand targets (m; x, y, z from the fixture unless the third row says table) and finger effort, by
# lane: first the way there, then into something solid, a few centimetres deep.
PATHS = {
    "drawer-open": [
        ("case top", (0.0, 0.0, 0.35), (0.0, 0.0, 0.13)),
        ("case side", (0.25, 0.0, 0.10), (0.15, 0.0, 0.10)),
        ("table", (0.30, -0.35, 0.15), (0.30, -0.35, 0.0)),
    ],
    "drawer-close": [
        ("inside of the drawer", (0.0, -0.15, 0.35), (0.0, -0.15, 0.05)),
        ("case top", (0.0, 0.02, 0.35), (0.0, 0.02, 0.13)),
        ("table", (-0.35, -0.30, 0.20), (-0.35, -0.30, 0.0)),
    ],
    "window-open": [
        ("frame", (0.10, -0.01, 0.30), (0.10, -0.01, 0.12)),
        ("handle", (0.0, -0.20, -0.01), (0.0, -0.10, -0.01)),
        ("table", (0.35, -0.20, 0.05), (0.35, -0.20, -0.15)),
    ],
    "window-close": [
        ("frame", (0.0, 0.0, 0.28), (0.0, 0.0, 0.10)),
        ("wall", (0.35, 0.0, 0.05), (0.35, 0.2, -0.10)),
        ("table", (-0.40, -0.20, 0.05), (-0.40, -0.20, -0.15)),
    ],
}
WAY, PUSH, REST = 60, 60, 15  # control steps; in the last of them the hand rests


@pytest.mark.slow
def test_single_steps_are_mujocos(port, rollouts):
    """Without contact to float32; with contact up to the gripper's shape (see README)."""
    for task, result in zip(TASKS, parity_parts.measure_injected(port, rollouts), strict=True):
        free, touching = result["one_step"]["no_contact"], result["one_step"]["contact"]
        assert free["states"] > 30 and touching["states"] > 10, task
        assert free["hand"]["p50"] < 5e-7 and free["fingers"]["p50"] < 1e-7, task
        assert free["fixture"]["p50"] < 1e-7, task
        assert touching["hand"]["p50"] < 3e-4 and touching["hand"]["max"] < 4e-3, task
        assert touching["fixture"]["p50"] < 2e-6 and touching["fixture"]["max"] < 3e-3, task


def test_recorded_actions_without_contact_lead_to_the_same_place(port, rollouts):
    chosen = [r for r in rollouts if r.task != "drawer-close"]  # which starts in contact
    scripted = chosen[::3]
    results = parity_parts.measure_open_loop(port, scripted, tuple(r.task for r in scripted))
    for result in results:
        assert result["open_loop"]["50"] < 2e-6  # the hand reaches the handle after about 60


def hand_paths(port):
    """Names, both sides' hands (step, lane, 3) along `PATHS`, whether theirs ends in contact."""
    names = [(task, *path) for task in TASKS for path in PATHS[task]]
    actions = np.zeros((WAY + PUSH, LANES, 4), np.float32)
    theirs, is_barred = np.zeros((WAY + PUSH, LANES, 3)), np.zeros(LANES, bool)
    for lane, (task, _, way, push) in enumerate(names):
        env, place = ReferenceEnv(task), GOALS.reshape(-1, 3)[lane]
        env.reset(place)
        mocap = env.get_state().mocap_pos
        for step in range(WAY + PUSH):
            target = place + (way if step < WAY else push)
            move = np.clip((target - mocap) * 100, -1, 1)
            actions[step, lane] = *move, -1
            mocap = np.clip(mocap + actions[step, lane, :3] / 100, HAND_LOW, HAND_HIGH)
            env.step(actions[step, lane])
            theirs[step, lane] = env.positions().hand
        is_barred[lane] = parity_parts.is_touching(env)
    state, ours = port.reset(LANE_TASKS, LANE_GOALS), []
    for action in actions:
        state = port.step(state, action)
        ours.append(np.asarray(state.frame)[:, :3])
    return [(task, what) for task, what, *_ in names], np.array(ours), theirs, is_barred


def test_solid_things_stop_the_hand_where_meta_world_does(port):
    """Within 1 cm, so that a policy cannot reach into the case or through a frame.

    The mocap box keeps open fingers 9 mm above the table and off the wall: there nothing touches.
    """
    names, ours, theirs, is_barred = hand_paths(port)
    gap = np.linalg.norm(ours - theirs, axis=-1)[-REST:].max(0)  # (lane,)
    assert gap.max() < 0.01, sorted(zip(gap.round(4).tolist(), names, strict=True))
    free = {what for (_, what), barred in zip(names, is_barred, strict=True) if not barred}
    assert free == {"table", "wall"}
