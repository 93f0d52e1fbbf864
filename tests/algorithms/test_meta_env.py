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
from cmrl_jax.algorithms.common.rollout import episode_figures, rollout
from cmrl_jax.evaluation.episode import Lanes, make_episode

HORIZON, LANES = 20, 16
TRUE = np.bool_(True)
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
    "train.env_steps": 25_600,
    "collect.updates_per_vector_step": 4,
    "eval.every": 1.0,
    "eval.wall_share": 1.0,
    "eval.goals": 1,
    "eval.final_goals": 10,
}
# z is to say no more than "left" or "right": a narrow posterior costs little of that.
ENCODER = {
    "encoder.hidden": [64, 64],
    "encoder.context_max": 32,
    "encoder.n_eff": 32,
    "kl.beta": 0.01,
}
BOTH = {"tasks.train": ["point-left", "point-right"], "eval.k": [0, 2], "eval.final_k": [0, 2]}
ONE = {"tasks.train": ["point-right"]}
METHODS = {
    "cmrl": ("smoke", BOTH | ENCODER),
    "pearl": ("pearl", BOTH),
    "sac": ("sac", ONE),
}


@pytest.fixture(scope="module", autouse=True)
def registered():
    cj.register_environment("point", point_env.TASKS, "point_env:make")
    cj.register_algorithm("linear", "linear_search:make", "linear_search:Rules")
    yield
    del registry.ENVIRONMENTS["point"]
    del registry.ALGORITHMS["linear"]


@pytest.mark.parametrize(
    "method", [*(pytest.param(name, marks=pytest.mark.slow) for name in ("cmrl", "pearl")), "sac"]
)
def test_it_is_learned(method, tmp_path):
    """Near its edge and not over it at the end, in (almost) every goal of every task."""
    config, overrides = METHODS[method]
    result = cj.train(cj.load_config(config, SMALL | overrides), tmp_path / "run", loggers=[])
    rows = cj.evaluate(result.agent, goals=10).rows()
    k = max(row["k"] for row in rows)
    last = [row["success_last"] for row in rows if row["k"] == k]
    assert len(last) == len(overrides["tasks.train"]) and min(last) >= 0.8


LINEAR = SMALL | ONE | {"algorithm": "linear", "collect.lanes": 64, "train.env_steps": 25_600}
LINEAR |= {"eval.k": [0], "eval.final_k": [0], "goals.table": "one-hot"}


def test_another_algorithm_trains_resumes_and_is_evaluated(tmp_path):
    """One that shares nothing with CMRL but the interfaces, from the registry to eval.json."""
    config = cj.load_config("smoke", LINEAR)
    whole = cj.train(config, tmp_path / "whole", loggers=[])
    assert whole.evaluation is not None and whole.iteration == 20
    # A fall at once is worth 4.4, staying on the plateau 9.4 (and a fall at the very end more).
    assert whole.evaluation["point-right"]["0"]["return"] >= 8.0
    stop = cj.Stop()

    class Stopper(cj.Logger):
        def row(self, row, progress):
            if row["iteration"] == 6:
                stop.request()

    half = cj.train(config, tmp_path / "half", loggers=[Stopper()], stop=stop)
    assert half.iteration == 7 and half.evaluation is None
    again = cj.train(config, tmp_path / "half", resume=True, loggers=[])
    shown = lambda rows: [{n: x for n, x in row.items() if "_s" not in n} for row in rows]
    assert shown(again.metrics) == shown(whole.metrics)
    scored = cj.evaluate(cj.load_agent(tmp_path / "half"), goals=10)
    assert scored.rows()[0]["return"] >= 8.0
    first, second = cj.train(config, tmp_path / "two", seeds=2, loggers=lambda config: [])
    for row, alone in zip(first.metrics, whole.metrics, strict=True):
        assert row["train/point-right/return"] == pytest.approx(
            alone["train/point-right/return"], rel=1e-4
        )
    assert first.metrics != second.metrics
    with pytest.raises(cj.ConfigError, match="--k 2 with algorithm linear"):
        cj.evaluate(again.agent, k=(2,))
    with pytest.raises(cj.ConfigError, match="--adapt search with algorithm linear"):
        cj.evaluate(again.agent, adapt="search")


def walk(env, steps, restart=None, begun=0):
    """All lanes run to the right; (transitions, stats) of `HORIZON`-step episodes."""
    state = jax.vmap(env.reset_to)(jnp.array([1, 1]), jnp.array([[0.0, 0.0], [0.5, 0.0]]))
    act = lambda obs, key, noise: jnp.broadcast_to(jnp.array([1.0, 0.0]), (len(obs), 2))
    key = jax.random.key(0)
    return rollout(env, act, state, key, steps, HORIZON, begun, restart=restart)[1:]


def test_a_fall_ends_the_episode_for_good_and_the_time_limit_does_not():
    """Steps of 0.15 from 0 and from 0.5 cross the edge at 1 in step 7 and in step 4."""
    transitions, _ = walk(PointEnv(), HORIZON)
    assert np.argmax(transitions.terminated, axis=0).tolist() == [6, 3]
    assert transitions.truncated.tolist() == [[False] * 2] * (HORIZON - 1) + [[True] * 2]
    ring = init_replay(1, 14, 2, 3, 2)
    by_task = jax.tree.map(lambda x: x[:7, None], transitions)
    drawn = sample(add(ring, by_task), jax.random.key(1), jnp.zeros(1, int), 200, 1, 0.9)
    fell = np.asarray(drawn.next_obs[0, :, 2]) < 0
    crossed = fell & (np.asarray(drawn.obs[0, :, 2]) >= 0)
    assert crossed.any() and (~fell).any()
    np.testing.assert_array_equal(drawn.discount[0, crossed], 0)
    np.testing.assert_allclose(drawn.discount[0, ~fell], 0.9)


def test_collection_begins_anew_after_a_fall():
    env = PointEnv()
    fresh = lambda key: jax.vmap(env.reset_to)(jnp.array([1, 1]), jnp.array([[0.1, 0.0]] * 2))
    transitions, _ = walk(env, HORIZON, fresh)
    first, fell = np.asarray(transitions.first), np.asarray(transitions.terminated)
    np.testing.assert_array_equal(first[1:], fell[:-1])
    assert fell.sum(0).tolist() == [2, 3]  # step 7, then every 7: 0.1 + 7 * 0.15 > 1
    np.testing.assert_allclose(transitions.obs[7, 0, :2], [0.1, 0.0])
    assert (transitions.next_obs[6, 0, 0] > 1) and transitions.truncated[-1].all()


def test_faults_are_counted_across_falls(monkeypatch):
    step = PointEnv.step
    faulty = lambda self, state, action: step(self, state, action).replace(faults=state.faults + 1)
    monkeypatch.setattr(PointEnv, "step", faulty)
    env = PointEnv()
    fresh = lambda key: jax.vmap(env.reset_to)(jnp.array([1, 1]), jnp.array([[0.1, 0.0]] * 2))
    _, stats = walk(env, HORIZON, fresh)
    assert stats.faults.sum(0).tolist() == [HORIZON, HORIZON]


def test_what_comes_after_a_fall_does_not_count():
    transitions, stats = walk(PointEnv(), HORIZON)
    figures = episode_figures(transitions.reward, stats, transitions.terminated)
    # Up to the plateau of 0.5, there, and the fall.
    np.testing.assert_allclose(figures.returns, [0.15 + 0.3 + 0.45 + 3 * 0.5 + 2, 3 * 0.5 + 2])
    assert figures.success_any.all() and not figures.success_last.any()
    np.testing.assert_allclose(figures.final_distance, [0.05, 0.1], atol=1e-6)


def test_an_evaluation_episode_ends_with_a_fall():
    """Scores and memory of a policy that runs to the right: nothing after the fall reaches them."""
    env, agent = PointEnv(), Runner()
    episode = jax.jit(make_episode(env, agent, HORIZON))
    lanes = Lanes(
        np.array([1, 0], np.int32), np.arange(2, dtype=np.int32), np.zeros((2, 2), np.float32)
    )
    memory = {"seen": jnp.zeros((1, 2))}
    memory, scores = episode(None, memory, memory, lanes, TRUE, TRUE, jax.random.key(0))
    np.testing.assert_array_equal(memory["seen"], [[7, 7]])
    np.testing.assert_allclose(scores.returns, [[4.4, -sum(0.15 * n for n in range(1, 8))]], 1e-5)
    assert scores.first_success.tolist() == [[3, HORIZON]]
    assert not scores.success_last.any()


class Runner:
    """An agent that runs to the right and counts the transitions it is shown."""

    adapts, explores, chunk = True, False, 5

    def init(self, told):
        return {"seen": jnp.zeros(told.task_row.shape)}

    def begin_episode(self, params, memory, source, keys, exploit):
        return memory

    def act(self, params, memory, obs, noise, deterministic):
        return jnp.broadcast_to(jnp.array([1.0, 0.0]), (len(obs), 2))

    def observe(self, params, memory, transitions, mask):
        return {"seen": memory["seen"] + jnp.sum(mask, -1)}


OWN = "; one of your own is known once it is registered in this process"


def test_what_an_environment_lacks_is_named_before_any_compile(monkeypatch):
    monkeypatch.delattr(PointEnv, "symmetries")
    with pytest.raises(cj.ConfigError, match=r"environment 'point' \(PointEnv\) has no symmetries"):
        cj.make_env(cj.load_config("smoke", SMALL | BOTH))


def test_a_policy_that_does_not_adapt_is_asked_for_nothing_else():
    """Whatever the algorithm: no test task, no adaptation episode, as many lanes as tasks."""
    for changed, cause in (
        ({"tasks.test": ["point-left"]}, "tasks.test is .* which does not adapt"),
        ({"eval.final_k": [0, 1]}, r"eval.final_k \[0, 1\] .* which does not adapt"),
        ({"tasks.train": ["point-left", "point-right"], "collect.lanes": 1}, "not divisible by"),
    ):
        with pytest.raises(cj.ConfigError, match=cause):
            cj.load_config("smoke", LINEAR | changed)


def test_a_logger_is_one(tmp_path):
    class Rows:
        def row(self, row, progress): ...

    with pytest.raises(cj.ConfigError, match="a logger is a Rows, which is no cmrl_jax.Logger"):
        cj.train(cj.load_config("smoke", LINEAR), tmp_path / "run", loggers=[Rows()])  # pyright: ignore
    assert not (tmp_path / "run").exists()


def test_an_environment_and_its_tasks_have_names_of_their_own():
    with pytest.raises(ValueError, match="environment 'point' is registered"):
        cj.register_environment("point", {"a": "a"}, point_env.make)
    with pytest.raises(ValueError, match="task 'window-open' is one of 'ml4'"):
        cj.register_environment("other", {"window-open": "window-open"}, point_env.make)
    with pytest.raises(ValueError, match="'up' is no task of 'other'"):
        cj.register_environment("other", {"down": "up"}, point_env.make)
    with pytest.raises(cj.ConfigError, match="unknown environment 'pont'") as error:
        cj.load_config("smoke", {"env.name": "pont"})
    assert (
        error.value.cure == f"did you mean 'point'? valid: {', '.join(registry.ENVIRONMENTS)}{OWN}"
    )
    with pytest.raises(cj.ConfigError, match="unknown task 'window-open' in tasks.train"):
        cj.load_config("smoke", SMALL | {"tasks.train": ["window-open"]})
    with pytest.raises(cj.ConfigError, match="unknown algorithm 'cmlr'") as error:
        cj.load_config("smoke", {"algorithm": "cmlr"})
    assert error.value.cure == f"did you mean 'cmrl'? valid: {', '.join(registry.ALGORITHMS)}{OWN}"
