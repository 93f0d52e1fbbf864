"""A meta-task that only z can solve: two tasks on a line, the reward's direction has either sign.

The right losses solve it in seconds; each broken line must fail to. What a learning run is too
forgiving to show (a sign inside the entropy term, a missing detach) has a direct test in
test_losses.py and test_learner.py.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmrl_jax.algorithms.cmrl import losses
from cmrl_jax.algorithms.cmrl.learner import Learner
from cmrl_jax.algorithms.cmrl.objectives import Objectives
from cmrl_jax.algorithms.common import replay
from cmrl_jax.config.schema import Config

TASKS, LANES, HORIZON, CONTEXT, ITERATIONS, UPDATES = 2, 8, 10, 16, 60, 16
SIGN = jnp.array([1.0, -1.0])
SOLVED = 0.8


def toy_config():
    cfg = Config()
    return replace(
        cfg,
        tasks=replace(cfg.tasks, train=("drawer-open", "drawer-close")),  # only their number counts
        model=replace(cfg.model, net="mlp", mlp_hidden=(32, 32), norm="none"),
        encoder=replace(
            cfg.encoder, hidden=(32,), latent_dim=2, norm="none", goal_fusion="none",
            context_max=CONTEXT, context_reward_scale=1.0,
        ),
        kl=replace(cfg.kl, beta=0.01),
        sac=replace(
            cfg.sac, gamma=0.9, n_step=1, batch=32, lr=3e-3, tau=0.02, normalize_obs=False,
            reward_norm="none",
        ),
        collect=replace(cfg.collect, lanes=TASKS * LANES),
    )  # fmt: skip


def episode(key, act):
    """One episode of all lanes; `act` maps obs (task, lane, 1) and a key to actions."""

    def step(obs, inputs):
        time, key = inputs
        action = act(obs, key)
        next_obs = jnp.clip(obs + 0.25 * action, -1.0, 1.0)
        lead = obs.shape[:-1]
        return next_obs, replay.Transition(
            obs=obs,
            action=action,
            reward=SIGN[:, None] * next_obs[..., 0],
            terminated=jnp.zeros(lead, bool),
            truncated=jnp.broadcast_to(time == HORIZON - 1, lead),
            first=jnp.broadcast_to(time == 0, lead),
            next_obs=next_obs,
        )

    k_start, k_steps = jax.random.split(key)
    start = jax.random.uniform(k_start, (TASKS, LANES, 1), minval=-0.3, maxval=0.3)
    times = jnp.arange(HORIZON), jax.random.split(k_steps, HORIZON)
    return jax.lax.scan(step, start, times)[1]  # (time, task, lane, ...)


def random_act(obs, key):
    return jax.random.uniform(key, obs.shape, minval=-1.0, maxval=1.0)


def train_and_evaluate():
    """Mean of sign * (last position) per task, (control, task).

    The controls: z from random transitions of the task, the same with the reward's sign flipped,
    and z from the prior.
    """
    cfg = toy_config()
    learner = Learner(cfg, jnp.zeros((TASKS, 1, 3)), obs_size=1, action_size=1)
    inference = learner.inference
    assert inference is not None

    def policy_of(state, z, deterministic):
        def act(obs, key):
            return learner.policy(state.actor_params, state.obs_stats, obs, z, key, deterministic)[
                0
            ]

        return act

    def posterior_z(state, ring, key, reward_sign=1.0):
        k_context, k_z = jax.random.split(key)
        context = replay.sample_transitions(ring, k_context, jnp.arange(TASKS), CONTEXT)
        context = replace(context, reward=reward_sign * context.reward)
        posterior = inference.posterior(state.encoder_params, context, jnp.ones((TASKS, CONTEXT)))
        lanes = jax.tree.map(lambda x: jnp.repeat(x[:, None], LANES, axis=1), posterior)
        return inference.sample_z(k_z, lanes)  # (task, lane, latent)

    def iteration(carry, key):
        state, rings = carry
        k_random, k_z, k_episode, k_update = jax.random.split(key, 4)
        buffer, context = rings
        # Only random actions enter the context: else where a task's own policy went would give
        # the task away, and the reward would not be needed.
        context = replay.add(context, episode(k_random, random_act))
        z = posterior_z(state, context, k_z)
        buffer = replay.add(buffer, episode(k_episode, policy_of(state, z, False)))
        rings = buffer, context
        keys = jax.random.split(k_update, UPDATES)
        state, metrics = learner.updates(state, *rings, keys)
        return (state, rings), jnp.sum(metrics["skipped"])

    @jax.jit
    def run(key):
        k_init, k_first, k_train, k_eval = jax.random.split(key, 4)
        capacity = ITERATIONS * HORIZON * LANES
        buffer = replay.init_replay(TASKS, capacity, LANES, 1, 1)
        buffer = replay.add(buffer, episode(k_first, random_act))
        context = replay.init_context(TASKS, 2, HORIZON, LANES, 1, 1)
        carry = (learner.init(k_init), (buffer, context))
        (state, _), skipped = jax.lax.scan(iteration, carry, jax.random.split(k_train, ITERATIONS))

        k_context, k_z, k_run = jax.random.split(k_eval, 3)
        fresh = replay.init_context(TASKS, 1, HORIZON, LANES, 1, 1)
        fresh = replay.add(fresh, episode(k_context, random_act))
        controls = (
            posterior_z(state, fresh, k_z),
            posterior_z(state, fresh, k_z, reward_sign=-1.0),
            jax.random.normal(k_z, (TASKS, LANES, 2)),
        )
        last = [episode(k_run, policy_of(state, z, True)).next_obs[-1, ..., 0] for z in controls]
        return jnp.mean(SIGN[:, None] * jnp.stack(last), axis=-1), jnp.sum(skipped)

    scores, skipped = run(jax.random.key(0))
    assert float(skipped) == 0
    return np.asarray(scores)


def test_the_right_losses_solve_both_tasks_and_only_by_z():
    posterior, flipped, prior = train_and_evaluate()
    assert np.all(posterior > SOLVED)
    assert np.all(flipped < -SOLVED), "the reward of the context decides the direction"
    assert np.mean(prior) < 0.6, "without a context nobody can know the direction"


def frozen_encoder(monkeypatch):
    """The critic loss sees z without its gradient: the encoder is left with the KL."""
    right = Objectives.critic

    def without_gradient(self, trained, *rest):
        stopped = jax.lax.stop_gradient(trained.encoder)
        return right(self, trained._replace(encoder=stopped), *rest)

    monkeypatch.setattr(Objectives, "critic", without_gradient)


def flipped_actor_loss(monkeypatch):
    """The actor descends where it should climb."""
    right = losses.actor_loss
    monkeypatch.setattr(losses, "actor_loss", lambda *args: -right(*args))


def ignored_reward(monkeypatch):
    """The target bootstraps but forgets the reward."""
    right = losses.td_target
    monkeypatch.setattr(losses, "td_target", lambda r, d, v: right(0.0 * r, d, v))


@pytest.mark.slow
@pytest.mark.parametrize(
    "mutate",
    [flipped_actor_loss, frozen_encoder, ignored_reward],
)
def test_a_broken_loss_does_not_solve_them(mutate, monkeypatch):
    mutate(monkeypatch)
    assert np.min(train_and_evaluate()[0]) < SOLVED
