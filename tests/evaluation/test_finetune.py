"""Fine-tuning: what gradient steps may change, where it starts, and one short run of it."""

import json
import sys
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learner_fixtures import GOALS, TASKS, VARIANTS, build, filled_ring, spread, tiny_config

from cmrl_jax.algorithms.cmrl.agent import PolicyParams
from cmrl_jax.algorithms.cmrl.learner import Learner
from cmrl_jax.algorithms.common.replay import ContextBatch
from cmrl_jax.cli import finetune as finetune_cli
from cmrl_jax.cli.main import main
from cmrl_jax.config.files import load_config
from cmrl_jax.config.rules import validate
from cmrl_jax.config.schema import Config, ConfigError
from cmrl_jax.evaluation import finetune
from cmrl_jax.evaluation.evaluator import Evaluator, Trial
from cmrl_jax.evaluation.finetune import (
    FineTuning,
    RestrictedLearner,
    Winner,
    adaptation_curve,
    finetune_config,
    free_latent,
    own_belief,
    start_state,
)
from cmrl_jax.evaluation.finetune_options import ADAPT, FinetuneOptions, check_run
from cmrl_jax.evaluation.session import Session
from cmrl_jax.jax_runtime import jit_once
from cmrl_jax.nn.context import init_belief
from cmrl_jax.text.goals import load_goals
from envs.physics.native import NativePhysics

NETWORKS = ("actor_params", "critic_params", "target_critic_params", "encoder_params")


def changed(before, after, networks=NETWORKS):
    """Paths of the leaves of these networks that differ."""
    found = set()
    for name in networks:
        old = jax.tree_util.tree_leaves_with_path(getattr(before, name))
        new = jax.tree.leaves(getattr(after, name))
        for (path, a), b in zip(old, new, strict=True):
            if not np.array_equal(a, b):
                found.add(f"{name}/{jax.tree_util.keystr(path, simple=True, separator='/')}")
    return found


@pytest.fixture(scope="module")
def made():
    return build(tiny_config())


@pytest.fixture(scope="module")
def ring():
    return filled_ring()


@pytest.mark.parametrize(
    "adapt", ["posterior", pytest.param("router", marks=pytest.mark.slow), "all"]
)
def test_gradient_steps_change_what_is_adapted_and_nothing_else(made, ring, adapt):
    learner = RestrictedLearner(adapt, tiny_config(), GOALS, 3, 2)
    update = jax.jit(learner.update)
    state = made.state
    for step in range(3):  # heads start small: a few steps until every leaf has a gradient
        state, _ = update(state, ring, ring, jax.random.key(step))
    moved = changed(made.state, state)
    is_router = lambda path: any(part in path for part in ("embedding", "gating", "routing"))
    if adapt == "posterior":
        assert not moved
    elif adapt == "router":
        assert moved and all(map(is_router, moved))
        assert {path.split("/")[0] for path in moved} == set(NETWORKS[:3])
    else:
        assert {path.split("/")[0] for path in moved} == set(NETWORKS)
        assert not all(map(is_router, moved))


def test_a_free_latent_is_one_point_and_learns(ring):
    """Whatever was seen z is the parameter; the critics' loss moves it, and it alone."""
    config = tiny_config(encoder={"information_bottleneck": False}, sac={"policy_average": 0.0})
    latent = free_latent(config.encoder.latent_dim)
    learner = RestrictedLearner("z", config, GOALS, 3, 2, inference=latent)
    state = jit_once(learner.init)(jax.random.key(0))
    z = jnp.array([0.3, -0.2])
    params = {"z": z}
    state = replace(state, encoder_params=params, encoder_opt_state=finetune.init_adam(params))
    belief = init_belief((4,), 2)
    np.testing.assert_array_equal(
        latent.posterior_of_belief(params, belief).mean, np.tile(z, (4, 1))
    )
    drawn = latent.sample_z(jax.random.key(1), latent.posterior_of_belief(params, belief))
    np.testing.assert_array_equal(drawn, np.tile(z, (4, 1)))
    update = jax.jit(learner.update)
    after = state
    for step in range(3):
        after, _ = update(after, ring, ring, jax.random.key(step))
    assert changed(state, after) == {"encoder_params/z"}


def test_own_belief_is_the_posterior_of_every_stored_transition(made):
    """All slots that are filled, each once, against the encoder on the transitions themselves."""
    ring = filled_ring()
    single = replace(ring, rows=ring.rows[:1], size=jnp.asarray(10, jnp.int32))
    inference = made.learner.inference
    belief = own_belief(made.learner, made.state, single, GOALS[0, 0])
    assert belief.sums.count.tolist() == [10]
    rows = np.asarray(single.rows[0, :10])
    lead = lambda a, b: jnp.asarray(rows[None, :, a:b])
    context = ContextBatch(
        obs=lead(0, 3), action=lead(3, 5), reward=lead(5, 6)[..., 0], next_obs=lead(9, 12)
    )
    expected = inference.posterior(
        made.state.encoder_params, context, jnp.ones((1, 10)), GOALS[:1, 0], jnp.ones(1)
    )
    got = inference.posterior_of_belief(
        made.state.encoder_params, belief, GOALS[:1, 0], jnp.ones(1)
    )
    np.testing.assert_allclose(got.mean, expected.mean, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(got.variance, expected.variance, rtol=1e-4)


def test_a_new_task_starts_from_the_trained_parts(made):
    config = tiny_config()
    config = replace(
        config,
        tasks=replace(config.tasks, train=("window-close",), test=()),
        collect=replace(config.collect, lanes=1),
    )
    learner = Learner(config, GOALS[:1], 3, 2)
    trained = replace(
        made.state,
        actor_params=spread(made.state.actor_params),
        critic_params=spread(made.state.critic_params),
        log_alpha=jnp.array([-1.0, -2.0, -6.0]),
        averaged=spread(made.state.averaged, seed=2),
    )
    fresh = jit_once(learner.init)(jax.random.key(5))
    state = start_state("all", config, learner, fresh, trained, GOALS[0, 0])
    actor, encoder = trained.averaged  # it begins as what acts, and goes on without an average
    acting = replace(trained, actor_params=actor, encoder_params=encoder, averaged=None)
    assert changed(trained, state) and not changed(acting, state)
    np.testing.assert_allclose(state.log_alpha, [-3.0])  # the mean of the training tasks'
    assert not changed(fresh, start_state("scratch", config, learner, fresh, trained, GOALS[0, 0]))
    assert trained.log_alpha.shape == (TASKS,)


@pytest.mark.parametrize(
    ("words", "cause", "cure"),
    [
        (["--task", "window"], "unknown task 'window'", "window-close"),
        (["--task", "drawer-open"], "was trained on drawer-open", "window-close"),
        (["--task", "window-close", "--adapt", "rooter"], "'rooter' is no way", "router"),
        (["--task", "window-close", "--episodes", "0"], "0 is no whole number", "range"),
        (["--task", "window-close", "--goals", "51"], "from 1 to 50", "has 50 goals"),
        (["--task", "window-close", "--adapt", "z,all,z"], "--adapt names z twice", "once"),
    ],
)
def test_mistakes_are_refused(undisturbed, refused, words, cause, cure):
    got = refused("finetune", "--run", str(undisturbed), *words)
    assert cause in got[0] and cure in got[1]


def test_a_network_without_router_has_none_to_adapt():
    config = tiny_config(**VARIANTS["pearl"])
    options = FinetuneOptions("window-close", adapt=ADAPT)
    with pytest.raises(ValueError, match="no router\nuse --adapt posterior,z,all,search,scratch$"):
        check_run(config, options)


@pytest.mark.parametrize("variant", ["mtsac", "sac"])
@pytest.mark.parametrize("adapt", ["posterior", "z", "router", "all"])
def test_a_run_without_z_adapts_from_scratch_alone(variant, adapt):
    config = tiny_config(**VARIANTS[variant])
    with pytest.raises(ConfigError, match="no z\nuse --adapt scratch$"):
        check_run(config, FinetuneOptions("window-close", adapt=(adapt,)))
    check_run(config, FinetuneOptions("window-close", adapt=("scratch",)))


@pytest.mark.parametrize("adapt", ADAPT)
def test_every_way_sees_what_the_run_saw(adapt):
    """The same observations, the goal's position with them where the run had it."""
    config = replace(tiny_config(), env=replace(Config().env, goal_observable=True))
    assert finetune_config(config, "window-close", adapt, 2, 1, 1.0).env == config.env


@pytest.mark.parametrize("adapt", ADAPT)
def test_every_way_is_a_valid_configuration(adapt):
    """Also with a horizon that sac.yaml's chunk does not divide, and less experience than a batch.

    A combination that cannot be is refused.
    """
    config = tiny_config(collect={"lanes": 12, "chunk": 5}, sac={"batch": 64})
    config = replace(config, env=replace(config.env, horizon=25))
    validate(config)
    tuned = finetune_config(config, "window-close", adapt, 2, 1, 1.0)
    validate(tuned)
    assert tuned.env.horizon == 25 and tuned.collect.chunk == 5
    with pytest.raises(ConfigError, match="collect.updates_per_vector_step is -1"):
        finetune_config(config, "window-close", adapt, 2, -1, 1.0)


@pytest.mark.parametrize("adapt", ADAPT)
def test_what_a_run_could_be_trained_with_can_be_adapted(adapt):
    """No rule of sac.yaml's own sizes is met, which no flag of `finetune` could mend."""
    config = tiny_config(sac={"batch": 200_000, "n_step": 2}, collect={"lanes": 12, "chunk": 1})
    config = replace(
        config,
        env=replace(config.env, horizon=2),
        train=replace(config.train, capacity=400_000),
    )
    validate(config)
    tuned = finetune_config(config, "window-close", adapt, 2, 1, 1.0)
    assert (tuned.env.horizon, tuned.sac.n_step, tuned.sac.batch) == (2, 2, 200_000)


@pytest.mark.parametrize(
    ("figure", "cause", "cure"),
    [
        ("/dev/null/f.png", "cannot write /dev/null/f.png", "--figure"),
        ("f.txt", "f.txt has no ending of a picture", "png"),
        ("f.png", "needs matplotlib", "pip install"),
    ],
)
def test_a_figure_that_cannot_be_drawn_is_refused_first(
    undisturbed, refused, tmp_path, monkeypatch, figure, cause, cure
):
    if "matplotlib" in cause:
        monkeypatch.setitem(sys.modules, "matplotlib", None)
        monkeypatch.setitem(sys.modules, "matplotlib.backend_bases", None)
    monkeypatch.setattr(finetune_cli, "finetune_run", lambda *_: pytest.fail("it went on"))
    words = ["--task", "window-close", "--adapt", "z", "--figure", str(tmp_path / figure)]
    got = refused("finetune", "--run", str(undisturbed), *words)
    assert cause in got[0] and cure in got[1]
    assert not any(tmp_path.glob("f.*"))


def test_another_goal_table_is_refused(undisturbed, monkeypatch):
    """Before any way to adapt is built."""
    changed = lambda *words: replace(load_goals(*words), sha256="0" * 64)
    monkeypatch.setattr(finetune_cli, "load_goals", changed)
    monkeypatch.setattr(finetune_cli, "FineTuning", lambda *_: pytest.fail("it went on"))
    options = FinetuneOptions("window-close", adapt=("posterior",))
    with pytest.raises(ConfigError, match="another goal table .*\nput that table back"):
        finetune_cli.finetune_run(undisturbed, options, None, None)


@pytest.mark.slow
def test_a_short_run_writes_its_curves(undisturbed_modular, tmp_path, capsys):
    """Before any experience every way to adapt scores the trained policy; scratch does not."""
    out = tmp_path / "curves.json"
    words = ["--task", "window-close", "--episodes", "2", "--goals", "2", "--json", str(out)]
    ways = ["--adapt", "posterior,router"]
    assert main(["finetune", "--run", str(undisturbed_modular), *words, *ways]) == 0
    result = json.loads(out.read_text())
    curves = result["curves"]
    assert set(curves) == {"posterior", "router"} and list(curves["router"]) == ["0", "1", "2"]
    assert curves["posterior"]["0"] == curves["router"]["0"]
    assert result["task"] == "window-close" and result["episodes"] == 2
    assert result["physics"] == "native"  # of the run: none was asked for
    out = capsys.readouterr().out
    assert "router" in out and "warning" not in out


@pytest.mark.slow
def test_physics_faults_are_counted_and_told(undisturbed_modular, tmp_path, capsys, monkeypatch):
    """Of read-outs as a mean over lanes, of own episodes as a sum so far."""
    calls = iter(range(10**9))
    original = NativePhysics._simulate
    # A read-out of 50 steps, an own episode, a read-out: 3 steps, 1 step and none are broken.
    broken = {7, 8, 9, 50 + 5}

    def simulate(self, words, placement, action, scene_id):
        if next(calls) in broken:
            action = np.full_like(action, np.nan)
        return original(self, words, placement, action, scene_id)

    monkeypatch.setattr(NativePhysics, "_simulate", simulate)
    out = tmp_path / "curves.json"
    words = ["--episodes", "1", "--goals", "2", "--adapt", "posterior", "--json", str(out)]
    assert (
        main(["finetune", "--run", str(undisturbed_modular), "--task", "window-close", *words]) == 0
    )
    curve = json.loads(out.read_text())["curves"]["posterior"]
    assert [(curve[n]["faults"], curve[n]["own_faults"]) for n in "01"] == [(3.0, 0), (0.0, 1)]
    assert (
        "warning: physics became non-finite and was put back: posterior (read-outs) 3 times a "
        "lane, posterior (own episodes) 1 times a lane\n"
    ) in capsys.readouterr().out


def test_dropped_gradient_steps_are_told():
    score = finetune.Score(0.0, 0.0, 0.0, faults=0.0)
    curve = {0: score, 1: score._replace(skipped=7)}
    [line] = finetune_cli.warnings_of("all", curve)
    assert line == "warning: all: 7 gradients were non-finite and were skipped"
    figures = finetune_cli.as_json({"all": curve})["curves"]["all"]
    assert [figures[n]["skipped_updates"] for n in "01"] == [0, 7]


@pytest.fixture(scope="module")
def restored(undisturbed_modular):
    """The run's configuration, its learner's state, a text vector and two placements."""
    config = load_config(str(undisturbed_modular / "config.yaml"))
    session = Session(config)
    state, _ = finetune_cli.load_state(undisturbed_modular, config, session)
    trained = state.learner
    text = load_goals(config.goals.table, ("window-close",)).vectors[0, 0]
    placements = session.placements("heldout", 2, ("window-close",))[0]
    return config, trained, text, np.asarray(placements, np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("adapt", ["z", "all", "scratch"])
def test_own_episodes_change_what_is_adapted(restored, adapt):
    """The first as every other: gradient steps of each episode have been made at its read-out."""
    config, trained, text, placements = restored
    options = FinetuneOptions("window-close", episodes=2, updates=1)
    tuned = finetune_config(config, options.task, adapt, options.episodes, options.updates, 1.0)
    tuning = FineTuning(tuned, adapt, trained, text, options)
    states = []

    def say(episode, score):
        states.append(jax.device_get(tuning.run.learner))  # a copy: the run's own is donated
        assert np.isfinite(score).all()

    adaptation_curve(tuning, options, placements, say)
    assert tuning.run.replay.size == 2 * config.env.horizon
    assert [state.gradient_steps for state in states] == [0, 50, 100]
    for before, after in zip(states, states[1:], strict=False):
        moved = changed(before, after)
        if adapt == "z":
            assert moved == {"encoder_params/z"}
        else:
            networks = NETWORKS if adapt == "all" else NETWORKS[:3]
            assert {path.split("/")[0] for path in moved} == set(networks)


@pytest.mark.slow
@pytest.mark.parametrize("arm", [16, 53])  # the first task's z as it is; a quarter turn, reach 1
def test_after_a_search_it_begins_where_the_winner_plays(restored, arm):
    """Before any gradient its read-out is the arm's own score in the evaluation of every arm."""
    config, trained, text, placements = restored
    session = Session(config)
    learner = session.algorithm.parts
    shape = learner.num_tasks, learner.inference.latent_dim
    task_z = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    actor, encoder = trained.acting
    params = PolicyParams(actor, encoder, trained.obs_stats, task_z)
    agent: Any = session.agent_of("arms")
    reach, z, view = agent.parts(arm)
    assert (z, agent.views) == (2, 8) and (reach, view) in ((0, 0), (1, 5))
    shown = np.broadcast_to(text, (1, 1, len(placements), len(text)))
    trial = Trial(("window-close",), placements[None], shown)
    evaluator = Evaluator(config, session.env, agent, len(placements))
    wanted = evaluator.run([params], trial, (arm,), seed=0)[arm]
    options = FinetuneOptions("window-close", episodes=21)
    tuned = finetune_config(config, options.task, "search", options.episodes, 1, 1.0)
    winner = Winner(jnp.asarray(task_z[1]), *agent.matrices(arm))
    tuning = FineTuning(tuned, "search", trained, text, options, winner)
    found = tuning.read_out(placements, seed=0)
    np.testing.assert_allclose(found.returns, wanted.returns.mean(), rtol=1e-4)
    said = []
    adaptation_curve(tuning, options, placements, lambda n, _: said.append(n), searched=20)
    assert said == [21]
    of_old = changed(trained, tuning.run.learner, NETWORKS[:3])  # its encoder is another: z alone
    assert {path.split("/")[0] for path in of_old} == set(NETWORKS[:3])


@pytest.mark.slow
def test_the_seed_is_that_of_the_networks_that_begin_from_nothing(restored):
    config, trained, text, _ = restored
    first = {}
    for adapt, seed in (("all", 0), ("all", 1), ("scratch", 0), ("scratch", 1)):
        tuned = finetune_config(config, "window-close", adapt, 1, 1, 1.0)
        options = FinetuneOptions("window-close", episodes=1, seed=seed)
        first[adapt, seed] = FineTuning(tuned, adapt, trained, text, options).run.learner
    assert not changed(first["all", 0], first["all", 1])
    begun = {path.split("/")[0] for path in changed(first["scratch", 0], first["scratch", 1])}
    assert begun == set(NETWORKS[:3])
