"""What `plot --inspect` takes from a policy, beside plain accounts of it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from policy_fixtures import HORIZON, MovingEnv, random_policy, save_run, small_config

from cmrl_jax.analysis.inspection import DRAWS, GOALS, inspect_policy
from cmrl_jax.analysis.inspection_file import read_inspection
from cmrl_jax.cli.main import main
from cmrl_jax.config.files import to_yaml
from cmrl_jax.evaluation.evaluator import Evaluator
from cmrl_jax.evaluation.session import Policy, Session
from envs.tasks import task_id

RUNS = 4  # of a task: 2 goals, 2 draws each
PLAIN = {"encoder.goal_fusion": "none", "encoder.p_drop_goal": "0", "encoder.p_empty": "0"}
PLAIN |= {"collect.group_frac": "0.5,0,0.5", "encoder.aux": "none"}
TOLD = PLAIN | {"model.conditioning": "task_id", "tasks.test": "", "collect.group_frac": "1,0,0"}
TOLD |= {"eval.k": "0", "eval.final_k": "0"}


def make_session(**flags):
    session = Session(small_config(**flags))
    session.env = MovingEnv()
    return session


def inspect(session, params) -> Any:
    goals = dict(zip(session.eval_tasks, session.goals.vectors[:, 0], strict=True))
    policy = Policy(params, goals, {"iteration": 3, "env_steps": 300, "goals_sha256": ""})
    return inspect_policy(Path("runs/x"), session, policy, goals=2, draws=2)


@pytest.fixture(scope="module")
def session():
    return make_session()


@pytest.fixture(scope="module")
def policy(session):
    return random_policy(session, 1)


@pytest.fixture(scope="module")
def inspected(session, policy):
    return inspect(session, policy)


def played(session, params, zc):
    """Observations (time, lane, obs) and returns (lane,) of episodes with given conditionings."""
    placements = session.placements("heldout", 2)
    tasks, goals, _ = np.indices((len(placements), 2, 2)).reshape(3, -1)
    ids = np.array([task_id(name) for name in session.eval_tasks])[tasks]
    state = jax.vmap(session.env.reset_to)(ids, jnp.asarray(placements[tasks, goals], jnp.float32))
    step, seen, returns = jax.jit(jax.vmap(session.env.step)), [], 0.0
    for _ in range(HORIZON):
        seen.append(np.asarray(state.obs))
        action, _ = session.algorithm.parts.policy(
            params.actor_params, params.obs_stats, state.obs, zc, jax.random.key(0), True
        )
        state = step(state, action)
        returns = returns + np.asarray(state.reward)
    return np.stack(seen), returns


def usage_by_hand(params, obs, z):
    """docs/algorithm.md in float64, two layers of two: P_1 (target, ..., source) and p_o."""
    p = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), params.actor_params["params"])
    relu = lambda y: np.maximum(y, 0)
    linear = lambda name, y: y @ p[name]["kernel"] + p[name]["bias"]

    def normed(name, y):
        y = (y - y.mean(-1, keepdims=True)) / np.sqrt(y.var(-1, keepdims=True) + 1e-6)
        return y * p[name]["scale"] + p[name]["bias"]

    def softmax(y):
        y = np.exp(y - y.max(-1, keepdims=True))
        return y / y.sum(-1, keepdims=True)

    f = linear("trunk_1", relu(normed("trunk_norm", linear("trunk_0", np.clip(obs, -10, 10)))))
    e = relu(f * linear("embedding", z))
    e = linear("gating_1", relu(normed("gating_norm", linear("gating_0", e))))
    logits = linear("routing_1", relu(e))  # rows are targets: target 0 reads sources 0 and 1
    first = np.stack([softmax(logits[..., :2]), softmax(logits[..., 2:])])
    flat = np.concatenate(list(first), -1)
    final = softmax(linear("routing_final", relu(linear("routing_in_final", flat) * e)))
    return first, final


def check_usage(found, params, obs, zc):
    """Whether an inspection's routing is that of the parameters at observations (time, lane)."""
    tasks = len(found.tasks)
    by_task = lambda y: y.reshape(HORIZON, tasks, RUNS, 2).mean((0, 2))
    first, final = usage_by_hand(params, obs, zc)
    first, final = np.stack([by_task(target) for target in first]), by_task(final)
    for name, reduce in (("mean", np.mean), ("low", np.min), ("high", np.max)):
        wanted = np.stack([reduce(first, axis=0), final], 1)
        assert wanted.shape == (tasks, 2, 2)
        np.testing.assert_allclose(getattr(found.routing, name), wanted, atol=2e-5, err_msg=name)
    np.testing.assert_allclose(found.routing.mean.sum(-1), 1, atol=1e-6)
    assert np.ptp(found.routing.mean, axis=0).min() > 0.01  # tasks do differ, and readers too
    assert (found.routing.high - found.routing.low)[:, 0].min() > 0.05


def test_routing_is_the_parameters_own_along_the_reported_episode(session, policy, inspected):
    z = inspected.latents.z.reshape(-1, inspected.latents.z.shape[-1])
    obs, _ = played(session, policy, z)
    check_usage(inspected, policy, obs, z)


def test_z_is_what_the_evaluation_acts_on(session, policy, inspected):
    z = inspected.latents.z.reshape(-1, inspected.latents.z.shape[-1])
    _, returns = played(session, policy, z)
    trial = replace(session.trial("heldout", 2), draws=2)
    evaluator = Evaluator(session.config, session.env, session.agent, 16)
    scores = evaluator.run([policy], trial, (1, 2), seed=0)
    np.testing.assert_allclose(returns, scores[2].returns.ravel(), atol=5e-4)
    assert np.median(np.abs(scores[1].returns - scores[2].returns)) > 0.05  # episodes do differ


def with_constant_factors(params, transition, goal):
    """Encoder parameters that give every transition, and every text, one (mean, variance)."""
    tree = jax.tree.map(np.array, params.encoder_params)
    for name, (mean, variance) in (("transition_net", transition), ("goal_net", goal)):
        layers = tree["params"][name]
        last = layers[max(layer for layer in layers if layer.startswith("Linear_"))]
        last["kernel"][:] = 0
        last["bias"][:] = np.concatenate([mean, np.log(np.expm1(variance))])  # softplus undone
    return params._replace(encoder_params=tree)


def test_posteriors_are_the_known_products(session, policy):
    """12 transitions tempered to n_eff = 8, the text's factor, and the prior N(0, I)."""
    size = session.config.encoder.latent_dim
    assert session.config.encoder.n_eff == 8
    m, s2 = np.linspace(-1, 2, size), np.linspace(2, 5, size)
    m_g, s2_g = np.linspace(1, 0, size), np.linspace(0.5, 1, size)
    found = inspect(session, with_constant_factors(policy, (m, s2), (m_g, s2_g))).latents
    for mean, kl, transitions in ((found.mean, found.kl, 8), (found.text_mean, found.text_kl, 0)):
        precision = 1 + 1 / s2_g + transitions / s2
        wanted = (m_g / s2_g + transitions * m / s2) / precision
        np.testing.assert_allclose(mean - wanted, 0, atol=1e-5)
        nats = 0.5 * (wanted**2 + 1 / precision - 1 + np.log(precision)).sum()
        np.testing.assert_allclose(kl, np.full(4, nats), rtol=1e-5)
    noise = (found.z - found.mean) * np.sqrt(1 + 1 / s2_g + 8 / s2)
    assert found.z.shape == (4, RUNS, size) and len(np.unique(noise)) == noise.size
    assert abs(noise.mean()) < 0.25 and abs(noise.std() - 1) < 0.2  # 128 standard normal numbers


def test_a_policy_without_modules_text_and_bottleneck():
    session = make_session(
        **PLAIN, **{"model.net": "mlp", "encoder.information_bottleneck": "false"}
    )
    found = inspect(session, random_policy(session, 2))
    assert found.routing is None and found.latents is not None
    np.testing.assert_array_equal(found.latents.z, found.latents.mean)
    parts = found.latents
    assert (parts.kl, parts.text_mean, parts.text_kl) == (None, None, None)
    assert np.ptp(parts.mean, axis=(0, 1)).min() > 0


def test_a_policy_that_is_told_the_task():
    session = make_session(**TOLD)
    params = random_policy(session, 3)
    found = inspect(session, params)
    assert found.latents is None and (found.facts["k"], found.tasks) == (0, session.eval_tasks)
    zc = np.repeat(np.eye(3, dtype=np.float32), RUNS, axis=0)
    obs, _ = played(session, params, zc)
    check_usage(found, params, obs, zc)


@pytest.fixture
def run(session, tmp_path):
    run = save_run(tmp_path / "cmrl-seed0", session, seeds=[1, 2])
    (run / "metrics.csv").write_text("iteration,env_steps,train/window-open/return\n0,100,1.0\n")
    return run


def test_plot_inspect_writes_the_file_and_draws_it(run, session, capsys):
    assert main(["plot", "--run", str(run), "--inspect"]) == 0
    written = capsys.readouterr().out.split()
    assert str(run / "inspection.json") in written
    assert [path.rpartition("/")[2] for path in written[-2:]] == ["routing.png", "z.png"]
    found = read_inspection(run)
    assert found is not None and found.latents is not None and found.routing is not None
    assert found.tasks == session.eval_tasks and found.routing.mean.shape == (4, 2, 2)
    assert found.latents.z.shape == (4, GOALS * DRAWS, session.config.encoder.latent_dim)
    facts = {"k": 2, "iteration": 2, "env_steps": 200, "horizon": HORIZON, "physics": "native"}
    assert facts.items() <= found.facts.items()
    assert (run / "inspection.json").stat().st_size < 25_000


def test_inspecting_needs_a_policy_checkpoint(run, refused):
    (run / "policy").rename(run / "gone")
    cause, cure = refused("plot", "--run", str(run), "--inspect")
    assert "policy does not exist" in cause and "leave --inspect out" in cure
    assert not (run / "inspection.json").exists() and not (run / "plots").exists()
    assert "does not exist" in refused("plot", "--run", str(run / "no"), "--inspect")[0]


def test_a_policy_with_nothing_inside_is_said_to_have_nothing(run, capsys):
    config = small_config(**TOLD, **{"model.net": "mlp"})
    (run / "config.yaml").write_text(to_yaml(config))
    assert main(["plot", "--run", str(run), "--inspect"]) == 0
    assert "has neither z nor modules to inspect" in capsys.readouterr().out
    assert not (run / "inspection.json").exists()
