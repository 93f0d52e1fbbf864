"""The Gymnasium view: against Gymnasium's own checker and vector environment, and Meta-World."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import cmrl_jax  # noqa: F401  # registers the ids
from envs.adapters import lanes
from envs.adapters.gymnasium_envs import TaskEnv, TaskVectorEnv
from envs.adapters.gymnasium_ids import env_id
from envs.goal_sets import load_goal_set
from envs.parity.reference import ReferenceEnv
from envs.sawyer import Ml4Env
from envs.tasks import METAWORLD_TASKS as TASKS
from envs.tasks.specs import SPECS

ROOT = Path(__file__).parents[2]
WINDOW, LANES, HORIZON, SEED = "cmrl_jax/window-open-v0", 3, 3, 5


def random_actions(steps, *lead):
    return np.random.default_rng(0).uniform(-1, 1, (steps, *lead, 4)).astype(np.float32)


def vector_env(**options):
    return gymnasium.make_vec(WINDOW, num_envs=LANES, horizon=HORIZON, **options)


def assert_same(ours, theirs):
    """Numbers, types and keys; infos are dicts of arrays."""
    assert type(ours) is type(theirs)
    if isinstance(ours, dict):
        assert ours.keys() == theirs.keys()
        for name in ours:
            assert_same(ours[name], theirs[name])
    else:
        assert ours.dtype == theirs.dtype
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)


@pytest.fixture(scope="module", params=["native", "mjx"])
def single(request):
    """One environment a backend: each compiles its program once."""
    return gymnasium.make(WINDOW, physics=request.param, horizon=HORIZON)


def episode(env, seed=None):
    """Observations of an episode, the start first, and rewards."""
    observations, rewards = [env.reset(seed=seed)[0]], []
    for action in random_actions(HORIZON):
        obs, reward, *_ = env.step(action)
        observations.append(obs)
        rewards.append(reward)
    return np.stack(observations), rewards


def test_gymnasiums_checker_finds_nothing(single):
    """Its warnings are errors here. Pictures have a test of their own."""
    check_env(single.unwrapped, skip_render_check=True)
    assert single.unwrapped.metadata["render_fps"] == pytest.approx(1 / 0.0125)


def test_a_seed_names_its_episodes_and_without_one_they_go_on(single):
    runs = [[episode(single, seed)[0], episode(single)[0]] for seed in (SEED, SEED, SEED + 1)]
    np.testing.assert_array_equal(runs[0], runs[1])
    starts = [run[0] for pair in (runs[0], runs[2]) for run in pair]
    assert len(np.unique(starts, axis=0)) == 4


def test_an_episode_is_truncated_at_its_horizon_and_never_terminated(single):
    single.reset(seed=SEED)
    ends = [single.step(action)[2:4] for action in random_actions(HORIZON)]
    assert ends == [(False, False), (False, False), (False, True)]
    single.reset()
    assert single.step(random_actions(1)[0])[2:4] == (False, False)


@pytest.mark.parametrize("task", TASKS)
def test_each_id_is_its_own_task_of_metaworld(task):
    """Bit for bit but for float32, on a goal that the reset is given, success and all."""
    goal = load_goal_set("heldout", (task,))[0, 7]
    env, reference = gymnasium.make(env_id(task), goal_observable=True), ReferenceEnv(task, True)
    obs, info = env.reset(options={"goal": goal})
    np.testing.assert_allclose(obs, reference.reset(goal), atol=1e-6)
    np.testing.assert_allclose(info["goal"], goal, atol=1e-7)
    for action in random_actions(5):
        obs, reward, _, _, info = env.step(action)
        theirs, their_reward, success, their_info = reference.step(action)
        np.testing.assert_allclose(obs, theirs, atol=2e-6)
        assert reward == pytest.approx(their_reward, abs=1e-4) and info["success"] is success
        assert info["distance"] == pytest.approx(float(their_info["obj_to_target"]), abs=1e-6)


def test_lanes_are_what_gymnasium_makes_of_single_environments():
    """Same seeds, same actions: numbers, types and infos of SyncVectorEnv, over several resets.

    What is returned is the caller's own, to be written to.
    """
    ours, theirs = vector_env(), vector_env(vectorization_mode="sync")
    assert isinstance(ours, TaskVectorEnv) and not isinstance(theirs, TaskVectorEnv)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.metadata["autoreset_mode"] is theirs.metadata["autoreset_mode"]
    mask = np.array([False, True, False])
    seeds = [None, 11, 12]
    # Lane 1 alone between two steps of all; lane 0 alone when its episode and lane 2's are over.
    resets = {
        0: {"seed": SEED},
        6: {},
        8: {"seed": seeds, "options": {"reset_mask": mask}},
        11: {"options": {"reset_mask": np.roll(mask, -1)}},
    }
    for step, actions in enumerate(random_actions(16, LANES)):
        if step in resets:
            options = resets[step].pop("options", None)
            given = [dict(options) if options else None for _ in "12"]  # theirs takes from it
            pairs: list[Any] = [
                env.reset(options=given.pop(), **resets[step])  # type: ignore[arg-type]
                for env in (ours, theirs)
            ]
        else:
            pairs = [env.step(actions) for env in (ours, theirs)]
        if step == 10:
            assert pairs[0][3].tolist() == [True, False, True]
        for mine, other in zip(*pairs, strict=True):
            assert_same(mine, other)
        assert ours.np_random_seed == theirs.np_random_seed
        for mine in pairs[0][:-1]:
            mine[:] = 1
        for mine in pairs[0][-1].values():
            mine[:] = 1
    generators = zip(ours.np_random, theirs.np_random, strict=True)  # type: ignore[arg-type]
    assert all(g.bit_generator.state == h.bit_generator.state for g, h in generators)
    ours.close()


def test_the_step_after_the_last_begins_the_next_episode():
    env = vector_env()
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    first, begun = env.reset(seed=SEED)
    assert begun.keys() == {"goal", "_goal"} and begun["_goal"].all()
    actions = random_actions(HORIZON + 1, LANES)
    for number, action in enumerate(actions[:HORIZON], 1):
        _, reward, terminated, truncated, infos = env.step(action)
        told = ("success", "distance", "faults")
        assert infos.keys() == {*told, *(f"_{name}" for name in told)}
        assert infos["_success"].all() and infos["_distance"].all() and reward.all()
        assert not terminated.any() and truncated.tolist() == [number == HORIZON] * LANES
    obs, reward, _, truncated, infos = env.step(actions[HORIZON])
    assert infos.keys() == {"goal", "_goal"} and not reward.any() and not truncated.any()
    assert not np.isclose(infos["goal"][:, :2], begun["goal"][:, :2]).any()
    again, _ = env.reset(options={"goal": infos["goal"]})
    np.testing.assert_array_equal(obs, again)  # a start, untouched by the action


def test_one_program_for_all_tasks_and_episodes(monkeypatch):
    traces, original = [], Ml4Env.step
    count = lambda env, *args: (traces.append(args), original(env, *args))[1]
    monkeypatch.setattr(Ml4Env, "step", count)
    lanes._programs.cache_clear()
    for task in TASKS[:2]:
        env = gymnasium.make_vec(env_id(task), num_envs=2, horizon=2)
        env.reset(seed=0)
        for actions in random_actions(4, 2):
            env.step(actions)
        env.reset()
        env.step(random_actions(1, 2)[0])
    assert len(traces) == 1
    lanes._programs.cache_clear()  # it holds what was counted


def test_goals_come_from_the_reset_box_or_from_a_named_set():
    spec = SPECS[TASKS.index("window-open")]
    box = TaskEnv("window-open", horizon=1)
    drawn = np.stack([box.reset(seed=seed)[1]["goal"] for seed in range(20)])
    low, high = np.array([spec.placement_low, spec.placement_high], np.float32)
    assert ((low <= drawn) & (drawn <= high)).all()
    assert (np.ptp(drawn, 0) > 0.5 * (high - low)).tolist() == (high > low).tolist()
    named = TaskEnv("window-open", horizon=1, goals="heldout")
    drawn = np.stack([named.reset(seed=seed)[1]["goal"] for seed in range(20)])
    known = load_goal_set("heldout", ("window-open",))[0].astype(np.float32)
    places = [np.flatnonzero((known == goal).all(1)) for goal in drawn]
    assert all(len(place) == 1 for place in places) and len({int(p[0]) for p in places}) > 10


def test_options_of_the_environment_reach_it():
    shown = TaskEnv("window-open", goal_observable=True).reset(seed=SEED)
    target = np.array(SPECS[TASKS.index("window-open")].target, np.float32)
    np.testing.assert_allclose(shown[0][36:], shown[1]["goal"] + target, atol=1e-6)
    hidden = TaskEnv("window-open", obs_mode="canonical").reset(seed=SEED)[0]
    assert not hidden[36:].any() and np.abs(hidden[4:7]).max() < 1e-6  # the object is the origin
    env = TaskVectorEnv("window-open", horizon=3, max_episode_steps=1)
    env.reset(seed=SEED)
    assert env.step(random_actions(1, 1)[0])[3].all()


@pytest.mark.parametrize(
    ("make", "cause", "cure"),
    [
        (lambda: TaskEnv("window-opne"), "unknown task 'window-opne'", "mean 'window-open'"),
        (lambda: TaskEnv("window-open", 0), "an episode of 0 steps", "of 1 or more"),
        (lambda: TaskVectorEnv("window-open", horizon=0), "an episode of 0 steps", "of 1 or"),
        (lambda: TaskVectorEnv("window-open", num_envs=0), "num_envs is 0", "1 lane or more"),
        (lambda: TaskEnv("window-open", physics="mjc"), "unknown physics", "valid: mjx, native"),
        (lambda: TaskEnv("window-open", obs_mode="mine"), "unknown observation mode", "canonical"),
        (lambda: TaskEnv("window-open", goals="heldot"), "is no goal set", "mean 'heldout'"),
        (lambda: TaskEnv("window-open", render_mode="human"), "unknown render mode", "rgb_array"),
    ],
)
def test_values_that_there_are_not(make, cause, cure):
    with pytest.raises(ValueError) as error:
        make()
    first, second = str(error.value).splitlines()
    assert cause in first and cure in second


@pytest.mark.parametrize(
    ("call", "cause", "cure"),
    [
        (lambda env: env.reset(options={"gaol": 0}), "unknown option 'gaol'", "mean 'goal'"),
        (lambda env: env.reset(options={"goal": [0, 0.8, 0]}), "of shape (3,)", "shape (3, 3)"),
        (lambda env: env.reset(options={"goal": np.full((3, 3), np.nan)}), "no goal", "1 m from"),
        (lambda env: env.reset(options={"reset_mask": [1, 0, 0]}), "int64 (3,)", "booleans"),
        (lambda env: env.reset(options={"reset_mask": np.zeros(3, bool)}), "no lanes", "True"),
        (lambda env: env.reset(seed=[1, 2]), "2 seeds for 3 lanes", "one a lane"),
        (lambda env: env.step(np.zeros(4)), "an action of shape (4,)", "shape (3, 4)"),
        (lambda env: env.step(np.full((3, 4), np.nan)), "an action is NaN", "give numbers"),
        (lambda env: env.step(np.full((3, 4), np.inf)), "an action is NaN or infinite", "numbers"),
    ],
)
def test_mistakes_of_a_call(call, cause, cure):
    env = vector_env()
    env.reset(seed=SEED)
    with pytest.raises(ValueError) as error:
        call(env)
    first, second = str(error.value).splitlines()
    assert cause in first and cure in second


def test_an_unknown_keyword_is_named():
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(TypeError, match="unexpected keyword argument 'horizn'"):
            make(WINDOW, horizn=3)


def test_there_is_no_step_before_a_reset():
    mask = {"reset_mask": np.array([True, False, False])}
    env = vector_env()
    for call in (
        lambda: TaskEnv("window-open").step(np.zeros(4)),
        lambda: env.step(np.zeros((LANES, 4))),
        lambda: env.reset(options=mask),
    ):
        with pytest.raises(gymnasium.error.ResetNeeded, match=r"no episode yet\ncall reset\(\)"):
            call()


def python(code, **environment):
    """Words that code prints in a process of its own, which has imported nothing."""
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.parametrize(
    "begin",
    [
        "import cmrl_jax, gymnasium",
        "import gymnasium, cmrl_jax",
        "import cmrl_jax, gymnasium, importlib; importlib.reload(cmrl_jax)",
    ],
)
def test_the_ids_are_known_whatever_is_imported_first(begin):
    show = "import sys; assert 'jax' not in sys.modules and 'mujoco' not in sys.modules\n"
    show += "print(*(name for name in gymnasium.registry if 'cmrl' in name))"
    assert python(f"{begin}\n{show}") == [env_id(task) for task in TASKS]
    assert env_id("window-open") == WINDOW


def test_an_id_may_name_the_library_that_registers_it():
    code = f"import gymnasium; print(gymnasium.make('cmrl_jax:{WINDOW}').spec.id)"
    assert python(code) == [WINDOW]


PICTURES = f"""
import warnings
import cmrl_jax, gymnasium
import numpy as np
from gymnasium.utils.env_checker import check_env
from envs.render.frames import Renderer, camera_of, metaworld_scene
env = gymnasium.make("{WINDOW}", render_mode="rgb_array", physics="native")
check_env(env.unwrapped)
for seed in (1, 2):
    _, info = env.reset(seed=seed)
    goal = info["goal"].copy()
    info["goal"][:] = 0  # the caller's own
    env.step(np.ones(4, np.float32))
    picture = env.render()
    qpos = env.unwrapped._lanes.qpos()[0]
    with Renderer(metaworld_scene("window-open", goal), 480, 480) as renderer:
        assert (picture == renderer.draw(qpos, camera_of("window-open", goal))).all()
lanes = gymnasium.make_vec("{WINDOW}", num_envs=2, render_mode="rgb_array")
_, infos = lanes.reset(seed=[2, 1])
infos["goal"][:] = 0
lanes.step(np.ones((2, 4), np.float32))
pair = lanes.render()
assert (pair[0] == picture).all() and (pair[1] != picture).any()
for each in (env, lanes):
    each.close()
    each.close()
print(picture.std() > 10)
"""


def test_pictures_are_metaworlds_scene_as_it_stands(gl):
    """Of either view; and of a MuJoCo that was imported before anybody asked for pictures."""
    assert python(PICTURES, MUJOCO_GL="") == ["True"]


def test_joint_positions_are_those_of_the_backend(single):
    single.reset(seed=SEED)
    start = single.unwrapped._lanes.qpos()
    for action in random_actions(HORIZON):
        single.step(action)
    moved = single.unwrapped._lanes.qpos()
    states = single.unwrapped._lanes._states.physics
    assert start.shape == moved.shape == (1, 10) and np.abs(moved - start).max() > 1e-3
    if hasattr(states, "qpos"):
        np.testing.assert_array_equal(moved, jax.device_get(states.qpos))
