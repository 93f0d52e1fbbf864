"""Each loss against a plain numpy loop over tasks, transitions and bins."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmrl_jax.algorithms.cmrl import losses

TASKS, BATCH, BINS = 3, 4, 7
RNG = np.random.default_rng(0)
Q = RNG.normal(size=(2, TASKS, BATCH))
LOG_PROB = RNG.normal(size=(TASKS, BATCH))
REWARD = RNG.normal(size=(TASKS, BATCH))
DISCOUNT = RNG.choice([0.0, 0.9], size=(TASKS, BATCH))
ALPHA = np.array([0.1, 1.0, 3.0])
q, log_prob, reward, discount, alpha = (
    jnp.asarray(x) for x in (Q, LOG_PROB, REWARD, DISCOUNT, ALPHA)
)


def test_target_and_losses_match_loops():
    value = losses.soft_value(q, log_prob, alpha)
    target = losses.td_target(reward, discount, value)
    got_critic = losses.critic_loss(q + 1, target)
    got_actor = losses.actor_loss(q, log_prob, alpha)
    got_value = losses.value_loss(reward, value)
    for i in range(TASKS):
        critic = actor = value_loss = 0.0
        for b in range(BATCH):
            v = min(Q[0, i, b], Q[1, i, b]) - ALPHA[i] * LOG_PROB[i, b]
            y = REWARD[i, b] + DISCOUNT[i, b] * v
            np.testing.assert_allclose(target[i, b], y, rtol=1e-5)
            critic += (Q[0, i, b] + 1 - y) ** 2 + (Q[1, i, b] + 1 - y) ** 2
            actor += ALPHA[i] * LOG_PROB[i, b] - min(Q[0, i, b], Q[1, i, b])
            value_loss += (REWARD[i, b] - v) ** 2
        np.testing.assert_allclose(got_critic[i], critic / BATCH, rtol=1e-5)
        np.testing.assert_allclose(got_actor[i], actor / BATCH, rtol=1e-5)
        np.testing.assert_allclose(got_value[i], value_loss / BATCH, rtol=1e-5)


def test_reconstruction_is_measured_in_standard_deviations():
    """A loop; and a constant prediction of the mean scores 1 whatever the units are."""
    rng = np.random.default_rng(1)
    rewards = rng.normal(5.0, 1e-3, (TASKS, BATCH))
    change = rng.normal(0.0, [1e-2, 3.0], (TASKS, BATCH, 2))
    predicted = rng.normal(size=(TASKS, BATCH, 3))
    got = losses.reconstruction_loss(*map(jnp.asarray, (predicted, rewards, change)))
    for i in range(TASKS):
        total = 0.0
        for b in range(BATCH):
            r = (rewards[i, b] - rewards.mean()) / rewards.std()
            d = [(change[i, b, k] - change[..., k].mean()) / change[..., k].std() for k in (0, 1)]
            errors = [(predicted[i, b, 1 + k] - d[k]) ** 2 for k in (0, 1)]
            total += 0.5 * ((predicted[i, b, 0] - r) ** 2 + sum(errors) / 2)
        np.testing.assert_allclose(got[i], total / BATCH, rtol=1e-2)  # rewards near 5, float32
    constant = losses.reconstruction_loss(
        jnp.zeros((TASKS, BATCH, 3)), jnp.asarray(1e3 * rewards), jnp.asarray(change)
    )
    np.testing.assert_allclose(jnp.mean(constant), 1.0, rtol=1e-2)
    still = losses.reconstruction_loss(
        jnp.zeros((TASKS, BATCH, 3)), jnp.ones((TASKS, BATCH)), jnp.zeros((TASKS, BATCH, 2))
    )
    assert np.all(still == 0.0)  # what never changes is predicted by nothing


def test_contrastive_loss_matches_a_loop_and_prefers_the_right_pairs():
    rng = np.random.default_rng(2)
    ids = np.array([0, 1, 0, 2])
    a, b = rng.normal(size=(2, 4, 3))
    got = losses.contrastive_loss(jnp.asarray(a), jnp.asarray(b), jnp.asarray(ids))
    total = 0.0
    for i in range(4):
        for scores in (b @ a[i], a @ b[i]):
            p = np.exp(scores) / np.exp(scores).sum()
            right = np.flatnonzero(ids == ids[i])
            total -= np.log(p[right]).mean() / (2 * 4)
    np.testing.assert_allclose(got, total, rtol=1e-5)
    told_apart = jnp.asarray(5.0 * np.eye(3))
    order = jnp.arange(3)
    assert losses.contrastive_loss(told_apart, told_apart, order) < 0.01
    assert losses.contrastive_loss(told_apart, jnp.roll(told_apart, 1, 0), order) > 10.0
    nothing = jnp.zeros((3, 2))
    np.testing.assert_allclose(
        losses.contrastive_loss(nothing, told_apart[:, :2], order), np.log(3)
    )


def test_targets_carry_no_gradient():
    def through_target(x):
        target = losses.td_target(x, x, x)
        bins, clipped = losses.categorical_target(
            x[None, :, :, None] * jnp.ones((2, 1, 1, BINS)), x, x, x, jnp.ones(TASKS),
            losses.critic_support(2.0, BINS), "mean",
        )  # fmt: skip
        return (
            jnp.sum(target)
            + jnp.sum(bins**2)
            + clipped
            + jnp.sum(losses.value_loss(jnp.zeros(()), x))
        )

    assert np.all(jax.grad(through_target)(reward) == 0.0)


def c51_by_loop(probabilities, values, support):
    out = np.zeros(len(support))
    width = support[1] - support[0]
    for p, v in zip(probabilities, values, strict=True):
        position = (min(max(v, support[0]), support[-1]) - support[0]) / width
        low = min(int(np.floor(position)), len(support) - 2)
        out[low] += p * (1 - (position - low))
        out[low + 1] += p * (position - low)
    return out


@pytest.mark.parametrize("aggregate", ["mean", "min"])
def test_categorical_target_matches_a_loop(aggregate):
    support = np.linspace(-2.0, 2.0, BINS)
    logits = RNG.normal(scale=2.0, size=(2, TASKS, BATCH, BINS))
    target, clipped = losses.categorical_target(
        jnp.asarray(logits), log_prob, reward, discount, alpha,
        losses.critic_support(2.0, BINS), aggregate,
    )  # fmt: skip
    probabilities = np.exp(logits) / np.exp(logits).sum(-1, keepdims=True)
    outside = 0.0
    for i in range(TASKS):
        for b in range(BATCH):
            twins = probabilities[:, i, b]
            chosen = twins.mean(0)
            if aggregate == "min":
                chosen = twins[int(np.argmin(twins @ support))]
            bonus = -ALPHA[i] * LOG_PROB[i, b]
            values = REWARD[i, b] + DISCOUNT[i, b] * (support + bonus)
            outside += np.sum(chosen[np.abs(values) > 2.0])
            expected = c51_by_loop(chosen, values, support)
            np.testing.assert_allclose(target[i, b], expected, atol=2e-6)
    assert 0.0 < outside / (TASKS * BATCH) < 1.0
    np.testing.assert_allclose(clipped, outside / (TASKS * BATCH), atol=1e-5)


def test_projection_keeps_mass_and_mean_inside_the_support():
    support = losses.critic_support(2.0, BINS)
    probabilities = jnp.asarray(RNG.dirichlet(np.ones(5), size=6), jnp.float32)
    values = jnp.asarray(RNG.uniform(-2, 2, size=(6, 5)), jnp.float32)
    projected = losses.project_categorical(probabilities, values, support)
    np.testing.assert_allclose(np.sum(projected, -1), 1.0, atol=1e-5)
    mean = np.sum(np.asarray(probabilities) * np.asarray(values), -1)
    np.testing.assert_allclose(projected @ support, mean, atol=1e-5)


def test_categorical_loss_is_least_at_the_target():
    target = jnp.asarray(RNG.dirichlet(np.ones(BINS), size=(TASKS, BATCH)), jnp.float32)
    at_target = jnp.stack([jnp.log(target)] * 2)
    gradient = jax.grad(lambda x: jnp.sum(losses.categorical_critic_loss(x, target)))(at_target)
    np.testing.assert_allclose(gradient, 0.0, atol=1e-6)
    entropy = -np.sum(np.asarray(target) * np.log(np.asarray(target)), -1).mean(-1)
    got = losses.categorical_critic_loss(at_target, target)
    np.testing.assert_allclose(got, 2 * entropy, rtol=1e-4)


def test_alpha_rises_where_entropy_is_below_its_target_and_falls_above():
    log_prob = jnp.array([[6.0, 8.0], [1.0, 1.0], [4.0, 4.0]])  # target entropy -4
    gradient = jax.grad(losses.alpha_loss)(jnp.zeros(3), log_prob, -4.0)
    np.testing.assert_allclose(gradient, [-1.0, 1.0, 0.0], atol=1e-6)


@pytest.mark.parametrize("free_bits", [0.0, 0.3])
def test_kl_reductions(free_bits):
    """Trap 4: both sum over dims; over tasks one takes the mean, oyster's the sum."""
    kl = np.array([[0.1, 0.9, 0.0], [0.2, 0.1, 0.0]])
    mean_tasks = sum_tasks = 0.0
    for d in range(3):
        mean_tasks += max(np.mean(kl[:, d]), free_bits)
        for i in range(2):
            sum_tasks += max(kl[i, d], free_bits)
    got = losses.kl_loss(jnp.asarray(kl), "mean_tasks", free_bits)
    np.testing.assert_allclose(got, mean_tasks, rtol=1e-6)
    got = losses.kl_loss(jnp.asarray(kl), "sum_tasks", free_bits)
    np.testing.assert_allclose(got, sum_tasks, rtol=1e-6)
    if free_bits == 0:
        np.testing.assert_allclose(sum_tasks, 2 * mean_tasks)


def test_free_bits_stop_the_gradient_below_them():
    kl = jnp.array([[0.1, 0.9], [0.1, 0.7]])
    gradient = jax.grad(losses.kl_loss)(kl, "mean_tasks", 0.3)
    np.testing.assert_allclose(gradient, [[0.0, 0.5], [0.0, 0.5]])


def test_task_weights_are_normalised_inverse_temperatures():
    weights = losses.task_weights(jnp.log(jnp.asarray(ALPHA)), "sac_temp")
    np.testing.assert_allclose(weights, 3 * (1 / ALPHA) / np.sum(1 / ALPHA), rtol=1e-5)
    np.testing.assert_array_equal(losses.task_weights(jnp.zeros(3), "none"), np.ones(3))
    per_task, weights = jnp.array([1.0, 2.0, 3.0]), jnp.array([1.0, 0.5, 2.0])
    assert float(losses.over_tasks(per_task, weights, "sum")) == 8.0
    np.testing.assert_allclose(losses.over_tasks(per_task, weights, "mean"), 8.0 / 3, rtol=1e-6)


def test_policy_regulariser():
    mean, log_std = RNG.normal(size=(2, TASKS, BATCH, 2))
    got = losses.policy_regulariser(jnp.asarray(mean), jnp.asarray(log_std))
    expected = [np.mean(mean[i] ** 2) + np.mean(log_std[i] ** 2) for i in range(TASKS)]
    np.testing.assert_allclose(got, expected, rtol=1e-5)
