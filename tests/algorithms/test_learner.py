"""Gradient routing, bootstrapping, the skipped step and the optimizer, on tiny networks."""

from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from learner_fixtures import (
    ACT,
    BATCH,
    CONTEXT,
    GOAL,
    GOALS,
    LATENT,
    OBS,
    TASKS,
    VARIANTS,
    build,
    filled_ring,
    spread,
    tiny_config,
)

from cmrl_jax.algorithms.cmrl.agent import make_policy_params
from cmrl_jax.algorithms.cmrl.learner import Learner, per_task
from cmrl_jax.algorithms.cmrl.objectives import ActorSide, CriticSide, Minibatch, routing_health
from cmrl_jax.algorithms.cmrl.train_state import PACKED, STACKED, Acting, pack, unpack
from cmrl_jax.algorithms.common import replay
from cmrl_jax.jax_runtime import jit_once
from cmrl_jax.nn.distributions import kl_to_standard_normal, sample_tanh_gaussian
from cmrl_jax.nn.networks import Routing
from cmrl_jax.nn.optimizers import adam_step, clip_by_norm, init_adam, ravel, unravel


@pytest.fixture(scope="module")
def cmrl():
    return build(tiny_config())


@pytest.fixture(scope="module")
def ring():
    return filled_ring()


@pytest.fixture(scope="module")
def routed():
    """A minibatch and well-spread parameters; soft critics, a plain actor (to compile faster)."""
    rng = np.random.default_rng(2)
    learner = Learner(tiny_config(model={"modular_actor": False}), GOALS, OBS, ACT)
    shapes = jax.eval_shape(learner.init, jax.random.key(0))

    def normal(*shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    data = Minibatch(
        task_ids=jnp.arange(TASKS),
        obs=normal(TASKS, BATCH, OBS),
        action=jnp.tanh(normal(TASKS, BATCH, ACT)),
        reward=normal(TASKS, BATCH),
        discount=jnp.full((TASKS, BATCH), 0.9),
        next_obs=normal(TASKS, BATCH, OBS),
        next_noise=normal(TASKS, BATCH, ACT),
        action_noise=normal(TASKS, BATCH, ACT),
        context=replay.ContextBatch(
            obs=normal(TASKS, CONTEXT, OBS),
            action=normal(TASKS, CONTEXT, ACT),
            reward=normal(TASKS, CONTEXT),
            next_obs=normal(TASKS, CONTEXT, OBS),
        ),
        context_mask=jnp.ones((TASKS, CONTEXT)),
        goal=normal(TASKS, GOAL),
        goal_mask=jnp.ones((TASKS,)),
        z_noise=normal(TASKS, LATENT),
    )
    return SimpleNamespace(
        data=data,
        objectives=learner.objectives,
        networks=learner.networks,
        actor=spread(shapes.actor_params),
        critic=spread(shapes.critic_params),
        target=spread(shapes.critic_params, seed=5),
        encoder=spread(shapes.encoder_params),
        log_alpha=jnp.log(jnp.array([0.1, 0.2, 0.4])),
    )


def largest(tree):
    return max(float(jnp.max(jnp.abs(x))) for x in jax.tree.leaves(tree))


def test_encoder_gets_exactly_no_gradient_from_actor_and_alpha(routed):
    r = routed

    def actor_of(encoder):
        zc = r.objectives.infer(encoder, r.data).zc
        return r.objectives.actor(ActorSide(r.actor, None), r.critic, zc, r.log_alpha, r.data)

    def alpha_loss(encoder):
        _, (log_prob, _) = actor_of(encoder)
        return r.objectives.alpha(r.log_alpha, log_prob, r.data.task_ids)

    def critic_loss(encoder):
        trained = CriticSide(r.critic, encoder)
        return r.objectives.critic(trained, r.actor, r.target, r.log_alpha, r.data)[0]

    def gradients(encoder):
        actor = jax.grad(lambda e: actor_of(e)[0])(encoder)
        return actor, jax.grad(alpha_loss)(encoder), jax.grad(critic_loss)(encoder)

    actor, alpha, critic = jax.jit(gradients)(r.encoder)
    assert largest(actor) == 0.0 and largest(alpha) == 0.0
    assert all(largest(leaf) > 0.0 for leaf in jax.tree.leaves(critic))


def test_target_is_a_constant_to_critics_and_encoder(routed):
    """Bootstrapped loss and gradient equal those of plain regression on y, y made here."""
    r = routed

    @jax.jit
    def target(zc):
        mean, log_std, _ = r.networks.actor(r.actor, r.data.next_obs, zc[:, None])
        action, log_prob = sample_tanh_gaussian(mean, log_std, r.data.next_noise)
        q = r.networks.critic(r.target, r.data.next_obs, action, zc[:, None])
        alpha = jnp.array([0.1, 0.2, 0.4])[:, None]
        return r.data.reward + 0.9 * (jnp.minimum(q[0], q[1]) - alpha * log_prob)

    @jax.jit
    def loss_and_grad(data):
        def loss(trained):
            return r.objectives.critic(trained, r.actor, r.target, r.log_alpha, data)

        return jax.value_and_grad(loss, has_aux=True)(CriticSide(r.critic, r.encoder))

    (loss, (zc, _)), grads = loss_and_grad(r.data)
    regression = r.data._replace(reward=target(zc), discount=jnp.zeros((TASKS, BATCH)))
    (expected, _), expected_grads = loss_and_grad(regression)
    np.testing.assert_allclose(loss, expected, rtol=1e-4)
    scale = largest(expected_grads)
    for got, want in zip(jax.tree.leaves(grads), jax.tree.leaves(expected_grads), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-4 * scale)


@pytest.mark.parametrize("variant", VARIANTS)
def test_update_keeps_the_structure_of_the_state(variant, ring):
    """Same tree, shapes, dtypes and weak types in and out, so that scanning never retraces."""
    learner = Learner(tiny_config(**VARIANTS[variant]), GOALS, OBS, ACT)
    before = jax.eval_shape(learner.init, jax.random.key(0))
    after, metrics = jax.eval_shape(learner.update, before, ring, ring, jax.random.key(0))
    assert jax.tree.structure(before) == jax.tree.structure(after)
    for old, new in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        assert (old.shape, old.dtype, old.weak_type) == (new.shape, new.dtype, new.weak_type)
    for name, value in metrics.items():
        assert value.dtype == jnp.float32 and value.shape in ((), (TASKS,)), name


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_packed_state_holds_every_parameter_once_and_is_unpacked_again(variant):
    learner = Learner(tiny_config(**VARIANTS[variant]), GOALS, OBS, ACT)
    state = spread(jax.eval_shape(learner.init, jax.random.key(0)))
    flat = pack(state)
    for got, want in zip(*map(jax.tree.leaves, (unpack(flat, state), state)), strict=True):
        np.testing.assert_array_equal(got, want)
    for name in PACKED:
        tree, vector = getattr(state, name), getattr(flat, name)
        assert (tree is None) == (vector is None), name
        if tree is not None:
            assert vector.ndim == 1 + (name in STACKED) and vector.size == sum(
                leaf.size for leaf in jax.tree.leaves(tree)
            )


@pytest.mark.parametrize(
    "variant", ["cmrl", *(pytest.param(name, marks=pytest.mark.slow) for name in ("c51", "pearl"))]
)
def test_one_step_moves_every_network_and_the_targets_by_tau(variant, ring, cmrl):
    cfg = tiny_config(**VARIANTS[variant])
    built = cmrl if variant == "cmrl" else build(cfg)
    state = built.state
    new, metrics = built.update(state, ring, ring, jax.random.key(1))
    assert int(new.gradient_steps) == 1 and int(new.skipped_updates) == 0
    full = replace(state, gradient_steps=jnp.int32(2**31 - 1))  # it stands still, and never wraps
    assert built.update(full, ring, ring, jax.random.key(1))[0].gradient_steps == 2**31 - 1
    assert all(bool(np.isfinite(np.asarray(v)).any()) for v in metrics.values())
    for f in fields(state):
        old, moved = getattr(state, f.name), getattr(new, f.name)
        is_learned = f.name.endswith(("_params", "opt_state")) and old is not None
        if is_learned:
            changes = jax.tree.map(lambda a, b: float(jnp.max(jnp.abs(a - b))), old, moved)
            assert max(jax.tree.leaves(changes)) > 0, f.name
    network = "value" if cfg.sac.variant == "v" else "critic"
    old = getattr(state, f"target_{network}_params")
    for target, online, before in zip(
        jax.tree.leaves(getattr(new, f"target_{network}_params")),
        jax.tree.leaves(getattr(new, f"{network}_params")),
        jax.tree.leaves(old),
        strict=True,
    ):
        np.testing.assert_allclose(target, 0.995 * before + 0.005 * online, atol=1e-6)
    moved_alpha = np.asarray(new.log_alpha - state.log_alpha)
    if cfg.sac.alpha == "fixed":
        assert np.all(moved_alpha == 0.0)
    else:
        assert np.all(moved_alpha != 0.0)
        moments = np.unique(np.asarray(new.alpha_opt_state[0].mu))  # Adam's first step is a sign
        assert (len(moments) == 1) == (cfg.sac.alpha == "shared")


def test_what_acts_is_the_average_of_the_steps_so_far(cmrl, ring):
    share, state, mean = 0.1, cmrl.state, None
    for n in range(4):
        state, _ = cmrl.update(state, ring, ring, jax.random.key(n))
        newest, rate = Acting(state.actor_params, state.encoder_params), 1 / (1 + share * n)
        blend = lambda old, new, rate=rate: old + rate * (np.asarray(new) - old)
        mean = newest if mean is None else jax.tree.map(blend, mean, newest)
    for got, want in zip(jax.tree.leaves(state.acting), jax.tree.leaves(mean), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-6)


def test_a_policy_is_the_average_and_its_z_is_of_the_averaged_encoder(cmrl, ring):
    params_of: Any = make_policy_params(cmrl.learner)
    averaged = spread(cmrl.state.averaged)
    run = SimpleNamespace(learner=replace(cmrl.state, averaged=averaged), context=ring)
    alone = replace(cmrl.state, averaged=None)
    own = replace(alone, actor_params=averaged.actor, encoder_params=averaged.encoder)
    wanted = params_of(SimpleNamespace(learner=own, context=ring))
    for got, want in zip(*map(jax.tree.leaves, (params_of(run), wanted)), strict=True):
        np.testing.assert_array_equal(got, want)
    other = params_of(SimpleNamespace(learner=alone, context=ring))
    assert float(np.abs(other.task_z - wanted.task_z).max()) > 1e-3


def test_without_averaging_the_networks_themselves_act(ring):
    state = jit_once(Learner(tiny_config(sac={"policy_average": 0.0}), GOALS, OBS, ACT).init)(
        jax.random.key(0)
    )
    assert state.averaged is None
    assert state.acting == (state.actor_params, state.encoder_params)


def test_non_finite_gradient_changes_nothing_but_its_counter(cmrl):
    poisoned = filled_ring(reward=np.nan)
    new, metrics = cmrl.update(cmrl.state, poisoned, poisoned, jax.random.key(1))
    assert int(new.skipped_updates) == 1 and float(metrics["skipped"]) == 1.0
    restored = replace(new, skipped_updates=cmrl.state.skipped_updates)
    for old, kept in zip(jax.tree.leaves(cmrl.state), jax.tree.leaves(restored), strict=True):
        assert np.asarray(old).tobytes() == np.asarray(kept).tobytes()


def test_deterministic_policy_ignores_its_key(cmrl):
    state, zc, obs = cmrl.state, jnp.ones((5, LATENT)), jnp.ones((5, OBS))
    policy = jax.jit(cmrl.learner.policy)
    (first, routing), (second, _), (noisy, _), (other, _) = (
        policy(state.actor_params, state.obs_stats, obs, zc, jax.random.key(seed), fixed)
        for seed, fixed in [(0, True), (1, True), (0, False), (1, False)]
    )
    np.testing.assert_array_equal(first, second)
    assert np.all(noisy != other) and routing.final.shape == (5, 2)
    mean, _, _ = cmrl.learner.networks.actor(state.actor_params, obs, zc)
    np.testing.assert_allclose(first, np.tanh(mean), rtol=1e-6)


@pytest.fixture(scope="module")
def bootstrapping():
    """2000 steps of a tiny critic, gamma 0.9, on per-task normalised rewards."""
    model = {"net": "mlp", "conditioning": "task_id", "norm": "none"}
    sac = {"gamma": 0.9, "alpha": "fixed", "alpha_init": 1e-6, "lr": 3e-3, "tau": 0.05,
           "reward_norm": "per_task", "batch": 16}  # fmt: skip
    learner = Learner(tiny_config(model=model, sac=sac), GOALS, OBS, ACT)

    @jax.jit
    def train(ring):
        state = learner.init(jax.random.key(0))
        scales = jnp.array([1.0, 5.0, 0.2])  # std of the returns: what rewards are divided by
        moments = state.return_stats.moments
        variance = replace(moments.variance, value=scales**2)
        moments = replace(moments, variance=variance)
        state = replace(state, return_stats=replace(state.return_stats, moments=moments))
        keys = jax.random.split(jax.random.key(1), 2000)
        metrics = learner.updates(state, ring, ring, keys)[1]
        return jnp.mean(metrics["q_mean"][-100:], axis=0)  # (task,)

    return train


def test_time_limit_is_bootstrapped_and_a_terminal_is_not(bootstrapping):
    """Normalised reward 1 everywhere: Q -> 1 / (1 - gamma), or 1 where every step is terminal."""
    reward = np.array([1.0, 5.0, 0.2])[:, None]
    np.testing.assert_allclose(
        bootstrapping(filled_ring(reward=reward, capacity=240)), 10.0, rtol=0.1
    )
    ended = filled_ring(reward=reward, terminated=True, capacity=240)
    np.testing.assert_allclose(bootstrapping(ended), 1.0, rtol=0.1)


def test_adam_on_the_flat_vector_equals_adam_on_the_tree():
    rng = np.random.default_rng(4)
    params, grads = (
        {"a": jnp.asarray(rng.normal(size=(2, 3, 2))), "b": jnp.asarray(rng.normal(size=(2, 4)))}
        for _ in range(2)
    )
    for stacked in (False, True):
        np.testing.assert_array_equal(unravel(ravel(params, stacked), params)["a"], params["a"])
    state, plain = init_adam(params, stacked=True), optax.adam(0.1).init(params)
    got: Any = params
    expected: Any = params
    for _ in range(3):
        flat = [ravel(tree, stacked=True) for tree in (grads, got)]
        new, state, norm = adam_step(flat[0], state, flat[1], 0.1, max_norm=0.0)
        got = unravel(new, params)
        updates, plain = optax.adam(0.1).update(grads, plain)
        expected = optax.apply_updates(expected, updates)
    for name in params:
        np.testing.assert_allclose(got[name], expected[name], rtol=1e-5)
    for k in range(2):
        squares = np.sum(grads["a"][k] ** 2) + np.sum(grads["b"][k] ** 2)
        np.testing.assert_allclose(norm[k], np.sqrt(squares), rtol=1e-5)


def test_clipping_is_for_each_network_on_its_own():
    clipped, norm = clip_by_norm(jnp.array([[3.0, 4.0], [0.3, 0.4]]), 1.0)
    np.testing.assert_allclose(norm, [5.0, 0.5], rtol=1e-6)
    np.testing.assert_allclose(clipped, [[0.6, 0.8], [0.3, 0.4]], rtol=1e-6)


def test_routing_health_matches_loops():
    rng = np.random.default_rng(5)
    matrices, final = rng.dirichlet(np.ones(2), (3, 4, 1, 2)), rng.dirichlet(np.ones(2), (3, 4))
    ids = np.array([0, 0, 2])
    entropy, distance = routing_health(
        Routing(jnp.asarray(matrices), jnp.asarray(final)), jnp.asarray(ids)
    )
    rows = np.concatenate([matrices[:, :, 0], final[:, :, None]], axis=2)  # (task, batch, 3, 2)
    total, pairs = 0.0, 0
    for i in range(3):
        np.testing.assert_allclose(
            entropy[i], np.mean(-np.sum(rows[i] * np.log(rows[i]), -1)) / np.log(2), rtol=1e-4
        )
        for j in range(3):
            if ids[i] != ids[j]:
                gap = np.abs(rows[i].mean(0) - rows[j].mean(0))
                total, pairs = total + np.mean(0.5 * np.sum(gap, -1)), pairs + 1
    np.testing.assert_allclose(distance, total / pairs, rtol=1e-4)


@pytest.mark.parametrize(
    "encoder",
    [{"goal_fusion": "factor"}, {"goal_fusion": "both"}, {"information_bottleneck": False}],
)
def test_both_posteriors_of_a_step_come_of_one_pass(ring, encoder):
    """What is acted on, and the whole experience without its sentence: as each by itself."""
    made = build(tiny_config(encoder={"aux": "contrastive", **encoder}))
    learner, state = made.learner, made.state
    data = learner.draw_minibatch(state, ring, ring, jax.random.key(3))
    partial = jnp.ones_like(data.context_mask).at[0, 1:].set(0).at[1].set(0)
    data = data._replace(context_mask=partial, goal_mask=jnp.array([1.0, 1.0, 0.0]))
    params = spread(state.encoder_params)
    found = jax.jit(learner.objectives.infer)(params, data)
    posterior = jax.jit(learner.inference.posterior)
    own = posterior(params, data.context, partial, data.goal, data.goal_mask)
    np.testing.assert_allclose(
        found.zc, learner.inference.z_of_noise(own, data.z_noise), rtol=1e-4, atol=1e-6
    )
    if found.kl is not None:
        np.testing.assert_allclose(found.kl, kl_to_standard_normal(own), rtol=1e-4, atol=1e-6)
    alone = posterior(params, data.context, jnp.ones_like(partial), data.goal, jnp.zeros(TASKS))
    np.testing.assert_allclose(found.experience, alone.mean, rtol=1e-4, atol=1e-6)
    assert np.abs(np.asarray(found.experience - own.mean)).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("aux", "part", "first_loss"),
    [("recon", "decoder", 1.0), ("contrastive", "goal_net", np.log(TASKS))],
)
def test_the_auxiliary_loss_reaches_the_encoder_side_alone(ring, aux, part, first_loss):
    """Beside the same step without it: actor and critics move alike, the encoder does not."""
    made = build(tiny_config(encoder={"aux": aux}))
    silent = build(tiny_config(encoder={"aux": aux, "aux_weight": 0.0}))
    after, metrics = jax.jit(made.learner.update)(made.state, ring, ring, jax.random.key(5))
    other, _ = jax.jit(silent.learner.update)(silent.state, ring, ring, jax.random.key(5))
    for name in ("critic_params", "actor_params"):
        for a, b in zip(
            jax.tree.leaves(getattr(after, name)),
            jax.tree.leaves(getattr(other, name)),
            strict=True,
        ):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7)
    moved = {
        path[1].key
        for (path, a), b in zip(
            jax.tree_util.tree_leaves_with_path(after.encoder_params),
            jax.tree.leaves(other.encoder_params),
            strict=True,
        )
        if not np.allclose(a, b, rtol=1e-4, atol=1e-6)
    }
    assert {part, "transition_net"} <= moved  # heads start near zero: nothing is told apart yet
    assert float(metrics["aux_loss"]) == pytest.approx(first_loss, abs=0.05)


def test_rows_are_averaged_per_task():
    rows, tasks = jnp.array([1.0, 3.0, 7.0]), jnp.array([2, 2, 0])
    np.testing.assert_array_equal(per_task(rows, tasks, 3), [7.0, np.nan, 2.0])


def test_goal_table_must_fit_the_training_tasks():
    with pytest.raises(ValueError, match="expected \\(3 training tasks"):
        Learner(tiny_config(), GOALS[:2], OBS, ACT)
