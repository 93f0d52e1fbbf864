"""The native backend against Meta-World's own environments, and what a host callback must not do:
depend on processes, on the order of lanes or on what it was called with before. The fault test runs
on both backends.
"""

import json
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env_fixtures import LANE_GOALS, LANE_TASKS, LANES

from cmrl_jax.cli.main import main
from cmrl_jax.config.files import load_config
from cmrl_jax.evaluation.session import Session
from cmrl_jax.jax_runtime import jit_once
from envs.parity.reference import ReferenceEnv, scripted_policy
from envs.physics.native import NativePhysics, unpack
from envs.sawyer import OBS_MODES, Ml4Env, State
from envs.tasks import METAWORLD_TASKS as TASKS
from envs.tasks.specs import SCENE_ID, SPECS

STEPS = 150


@pytest.fixture(scope="module")
def env() -> Any:
    return Ml4Env(physics="native")


@pytest.fixture(scope="module")
def replay(env):
    """Jitted (state, actions (step, lane, 4)) -> the states after every step."""

    def run(state, actions):
        def step(state, action):
            state = jax.vmap(env.step)(state, action)
            return state, state

        return jax.lax.scan(step, state, actions)[1]

    return jax.jit(run)


def reset(env, tasks: Any = LANE_TASKS, goals: Any = LANE_GOALS) -> State:
    return jax.jit(jax.vmap(env.reset_to))(tasks, goals)


def random_actions(steps, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, LANES, 4)).astype(np.float32)


def assert_same(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_150_steps_open_loop_are_meta_worlds(env, replay, rollouts):
    """From our own resets: scripted, perturbed and random episodes of every task."""
    actions = np.stack([rollout.action[:STEPS] for rollout in rollouts], 1)
    out = replay(reset(env), actions)
    qpos = unpack(out.physics)["qpos"]
    for i, rollout in enumerate(rollouts):
        rows = slice(1, STEPS + 1)
        np.testing.assert_allclose(qpos[:, i], rollout.qpos[rows], rtol=0, atol=1e-5)
        np.testing.assert_allclose(out.obs[:, i], rollout.obs[rows], rtol=0, atol=1e-5)
        np.testing.assert_allclose(out.reward[:, i], rollout.reward[:STEPS], rtol=0, atol=1e-4)
        np.testing.assert_array_equal(out.success[:, i], rollout.success[:STEPS])
    solved = out.success.any(0).reshape(len(TASKS), -1)
    assert solved[:, 0].all()  # the scripted episodes reach the fixture and move it
    assert not out.faults.any()


def test_from_meta_worlds_own_state_every_bit_is_meta_worlds(env, replay):
    states, actions = [], []
    for task, goal in zip(TASKS, LANE_GOALS[:: LANES // len(TASKS)], strict=True):
        reference, policy = ReferenceEnv(task), scripted_policy(task)
        obs = reference.reset(goal.astype(np.float64))
        states.append([reference.get_state()])
        actions.append([])
        for _ in range(STEPS):
            actions[-1].append(np.clip(policy.get_action(obs), -1, 1).astype(np.float32))
            obs = reference.step(actions[-1][-1].astype(np.float64))[0]
            states[-1].append(reference.get_state())
    first = lambda name: np.stack([getattr(path[0], name) for path in states])
    names = {"qpos": "qpos", "qvel": "qvel", "warm_start": "warmstart", "mocap": "mocap_pos"}
    begin = {ours: first(theirs) for ours, theirs in names.items()}
    physics = env.physics.host_state(SCENE_ID, **begin, placement=first("fixture_pos"))
    state = reset(env, np.arange(len(TASKS)), physics.placement).replace(physics=physics)
    got = unpack(replay(state, np.array(actions).swapaxes(0, 1)).physics)
    for i, path in enumerate(states):
        for ours, theirs in names.items():
            expected = np.stack([getattr(s, theirs) for s in path[1:]])
            np.testing.assert_array_equal(got[ours][:, i], expected, err_msg=f"{TASKS[i]} {ours}")


def test_workers_order_and_history_do_not_change_a_bit(env, replay):
    state, actions = reset(env), random_actions(12)
    expected = replay(state, actions)
    replay(reset(env, LANE_TASKS[::-1], LANE_GOALS[::-1] + 0.02), random_actions(3, seed=1))
    assert_same(replay(state, actions), expected)

    order = np.random.default_rng(2).permutation(LANES)
    shuffled = replay(jax.tree.map(lambda x: x[order], state), actions[:, order])
    assert_same(shuffled, jax.tree.map(lambda x: x[:, order], expected))

    alone = jax.jit(env.step)(jax.tree.map(lambda x: x[5], state), actions[0, 5])
    assert_same(alone, jax.tree.map(lambda x: x[0, 5], expected))

    for workers in (1, 2, 4):
        other = Ml4Env(physics="native")
        other.physics = NativePhysics(workers)
        step = jax.jit(jax.vmap(other.step))
        last = state
        for action in actions:
            last = step(last, action)
        assert_same(last, jax.tree.map(lambda x: x[-1], expected))


def test_each_lane_has_its_own_fixture(env, replay):
    """One task, one action sequence, placements all different: fixtures stand where they should."""
    goals = np.linspace((-0.1, 0.7, 0.16), (0.1, 0.9, 0.16), LANES, dtype=np.float32)
    state = reset(env, np.full(LANES, TASKS.index("window-open")), goals)
    out = replay(state, np.zeros((2, LANES, 4), np.float32))
    offset = np.asarray(out.physics.positions.fixture)[-1] - goals
    np.testing.assert_allclose(offset, np.broadcast_to(offset[0], offset.shape), atol=1e-6)
    assert np.abs(offset[0]).max() < 0.3


def test_one_callback_a_control_step_for_the_whole_batch(monkeypatch):
    env, sizes = Ml4Env(physics="native"), []
    physics: Any = env.physics
    original = physics._simulate

    def counted(*args):
        sizes.append(np.shape(args[0]))
        return original(*args)

    monkeypatch.setattr(physics, "_simulate", counted)

    @jax.jit
    def run(key):
        state = jax.vmap(env.reset)(jax.random.split(key, LANES), jnp.asarray(LANE_TASKS))
        step = lambda state, action: (jax.vmap(env.step)(state, action), None)
        return jax.lax.scan(step, state, random_actions(7))[0]

    assert run(jax.random.key(0)).steps.tolist() == [7] * LANES
    assert sizes == [(LANES, 66)] * 7
    run(jax.random.key(1))
    assert len(sizes) == 14


def poison_mjx(physics, lane):
    return physics.replace(qpos=jnp.asarray(physics.qpos).at[lane].set(jnp.nan))


def poison_native(physics, lane, number=np.nan):
    words = np.array(physics.words)
    words.view(np.float64)[lane, 12] = number  # a joint velocity
    return physics.replace(words=jnp.asarray(words))


@pytest.mark.parametrize("backend", ["mjx", "native"])
def test_a_lane_forced_to_nan_is_reset_counted_and_harmless(
    backend, env, port, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    step = port.step if backend == "mjx" else jax.jit(jax.vmap(env.step))
    poison = poison_mjx if backend == "mjx" else poison_native
    begin = (port.reset if backend == "mjx" else lambda t, g: reset(env, t, g))(
        LANE_TASKS, LANE_GOALS
    )
    lane, actions = 4, random_actions(6)
    healthy = step(begin, actions[0])
    sick = healthy.replace(physics=poison(healthy.physics, lane))
    others = np.arange(LANES) != lane
    for number, action in enumerate(actions[1:]):
        healthy, sick = step(healthy, action), step(sick, action)
        pick = lambda tree: jax.tree.map(lambda x: np.asarray(x)[others], tree)
        assert_same(pick(sick), pick(healthy))
        assert sick.faults.tolist() == [int(i == lane) for i in range(LANES)]
        assert np.isfinite(sick.obs).all() and np.isfinite(sick.reward).all()
        if number == 0:  # put back to the settled start, with its own goal
            restarted = jax.tree.map(lambda x: np.asarray(x)[lane], sick.physics)
            assert_same(restarted, jax.tree.map(lambda x: np.asarray(x)[lane], begin.physics))
    assert not healthy.faults.any() and not list(tmp_path.iterdir())  # no MUJOCO_LOG.TXT


@pytest.mark.parametrize("number", [1e11, 1e7], ids=["at the start", "within the step"])
def test_a_lane_that_mujoco_itself_gave_up_is_a_fault(env, number, tmp_path, monkeypatch):
    """MuJoCo resets such a lane to its zero pose, which is finite: the warning gives it away."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT
    begin = reset(env)
    state = begin.replace(physics=poison_native(begin.physics, 3, number))
    state = jax.jit(jax.vmap(env.step))(state, random_actions(1)[0])
    assert state.faults.tolist() == [0, 0, 0, 1] + [0] * (LANES - 4)
    assert_same(unpack(state.physics)["qpos"][3], unpack(begin.physics)["qpos"][3])


def test_a_start_is_the_settled_state_with_its_slide(env):
    qpos = unpack(reset(env).physics)["qpos"].reshape(len(TASKS), -1, 10)
    assert qpos[:, :, 9].tolist() == [[spec.start_slide] * qpos.shape[1] for spec in SPECS]


def test_an_unknown_backend_is_refused_by_name():
    with pytest.raises(ValueError, match=r"backend 'mjc'\nvalid: mjx, native"):
        Ml4Env(physics="mjc")


@pytest.mark.slow
def test_two_training_iterations_are_finite_and_repeat():
    config = load_config("smoke.yaml")
    config = replace(config, env=replace(config.env, physics="native", horizon=20))
    session = Session(config)
    iteration = session.algorithm.make_iteration(session.train_placements())
    program = jax.jit(iteration)
    init = jit_once(session.algorithm.init)
    runs = []
    for _ in range(2):
        state, _ = program(init(jax.random.key(config.seed)))
        runs.append(program(state))
    assert_same(runs[0][1], runs[1][1])
    assert_same(runs[0][0].learner.actor_params, runs[1][0].learner.actor_params)
    for name, value in runs[0][1].items():
        assert np.isfinite(value).all(), name
    assert runs[0][1]["physics_faults"] == 0


@pytest.mark.slow
def test_a_native_run_is_scored_in_either_simulator(tmp_path):
    run, scores = tmp_path / "run", {}
    words = ["--config", "smoke.yaml", "--env.physics", "native", "--train.env_steps", "600"]
    assert main([*words, "--run", str(run)]) == 0
    for name, flags in (("own", []), ("other", ["--physics", "mjx"])):
        out = tmp_path / f"{name}.json"
        words = ["eval", "--run", str(run), "--k", "0,1", "--goals", "2", "--json", str(out)]
        assert main([*words, *flags]) == 0
        scores[name] = json.loads(out.read_text())
    assert (scores["own"]["physics"], scores["other"]["physics"]) == ("native", "mjx")
    own = json.loads((run / "eval.json").read_text())
    assert scores["own"]["tasks"] == own["tasks"] != scores["other"]["tasks"]
    returns = [score["tasks"]["drawer-open"]["0"]["return"] for score in scores.values()]
    assert returns[0] == pytest.approx(returns[1], rel=0.2)


def test_canonical_observations_are_seen_from_where_the_object_stands():
    """The same episode in both modes: numbers shifted by the origin, no quaternion."""
    plain, canonical = (Ml4Env(physics="native", obs_mode=mode) for mode in OBS_MODES)
    actions = np.random.default_rng(5).uniform(-1, 1, (3, len(TASKS), 4)).astype(np.float32)
    key = jax.random.split(jax.random.key(3), len(TASKS))
    task = jnp.arange(len(TASKS))
    states = [jax.vmap(env.reset)(key, task) for env in (plain, canonical)]
    origin = np.asarray(states[0].origin)
    for step in range(len(actions) + 1):
        raw, seen = (np.asarray(state.obs) for state in states)
        expected = raw.copy()
        for first in (0, 18):  # both frames: hand, gripper, object, quaternion
            expected[:, first : first + 3] -= origin
            expected[:, first + 4 : first + 7] -= origin
            expected[:, first + 7 : first + 11] = 0
        np.testing.assert_allclose(seen, expected, atol=1e-6)
        np.testing.assert_array_equal(states[0].reward, states[1].reward)
        if step == 1:
            np.testing.assert_allclose(seen[:, 4:7], 0, atol=1e-3)
        if step < len(actions):
            pairs = zip((plain, canonical), states, strict=True)
            states = [jax.vmap(env.step)(state, actions[step]) for env, state in pairs]
    np.testing.assert_array_equal(states[1].origin, origin)
