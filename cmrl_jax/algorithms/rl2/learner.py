"""RL2's gradient steps: PPO over whole trials, back through all their steps."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from cmrl_jax.algorithms.common.policy_gradient import (
    clipped_surrogate,
    gae,
    learned,
    make_optimizer,
    masked_mean,
    normalized,
)
from cmrl_jax.config.schema import Config
from cmrl_jax.nn.gaussian_policy import entropy, log_prob
from cmrl_jax.nn.normalizers import ObsStats, ReturnStats
from cmrl_jax.nn.recurrent import Output, RecurrentActorCritic


class LearnerState(struct.PyTreeNode):
    """Everything that is learned or counted.

    Attributes:
        obs_stats, return_stats: running statistics (normalizers.py), updated by collection.
        gradient_steps: int32; exact below 2^31, where it stands still.
    """

    params: Any
    opt_state: Any
    obs_stats: ObsStats
    return_stats: ReturnStats
    gradient_steps: jax.Array


class Trials(NamedTuple):
    """Trials of all lanes, one after another in time, (time, lane, ...).

    Attributes:
        inputs: of the network (..., input).
        u: actions before tanh (..., act).
        log_prob: of u when it was drawn.
        value: of the state it was drawn in.
        reward: divided by the task's denominator.
        mask: bool, False after an episode's terminal.
        last_value: (lane,), of the state after the trial.
    """

    inputs: jax.Array
    u: jax.Array
    log_prob: jax.Array
    value: jax.Array
    reward: jax.Array
    mask: jax.Array
    last_value: jax.Array


class Batch(NamedTuple):
    """What a gradient step sees, (time, lane, ...)."""

    inputs: jax.Array
    u: jax.Array
    log_prob: jax.Array
    advantage: jax.Array
    target: jax.Array
    mask: jax.Array


def unroll(net: RecurrentActorCritic, params: Any, inputs: jax.Array, mask: jax.Array) -> Output:
    """Outputs (time, lane, ...) of trials from their beginning; masked steps leave no trace."""
    embedded: Any = net.apply(params, inputs, method="embed")

    def step(state: jax.Array, inputs: Any):
        y, counts = inputs
        new: Any = net.apply(params, state, y, method="remember")
        return jnp.where(counts[:, None], new, state), new

    start = jnp.zeros((inputs.shape[1], net.width))
    _, states = jax.lax.scan(step, start, (embedded, mask))
    found: Any = net.apply(params, states, embedded, method="heads")
    return found


class Learner:
    """PPO of a configuration.

    Args:
        lanes: of all training tasks, task after task.
    """

    def __init__(self, config: Config, net: RecurrentActorCritic):
        self.ppo, self.rl2, self.net = config.ppo, config.rl2, net
        self.tasks, self.lanes = len(config.tasks.train), config.collect.lanes
        self.optimizer = make_optimizer(config.ppo)

    def loss(self, params: Any, batch: Batch) -> tuple[jax.Array, dict[str, jax.Array]]:
        """PPO's loss (Schulman et al. 2017, equation 9, without clipping the value)."""
        head, value = unroll(self.net, params, batch.inputs, batch.mask)
        new = log_prob(head, batch.u)
        gain = clipped_surrogate(new, batch.log_prob, batch.advantage, self.ppo.clip)
        policy = -masked_mean(gain, batch.mask)
        error = 0.5 * masked_mean(jnp.square(value - batch.target), batch.mask)
        spread = entropy(head)
        log_ratio = new - batch.log_prob
        metrics = {
            "policy_loss": policy,
            "value_loss": error,
            "entropy": spread,
            # Schulman's estimate of KL(old || new): (r - 1) - log r.
            "approx_kl": masked_mean(jnp.expm1(log_ratio) - log_ratio, batch.mask),
            "clip_fraction": masked_mean(jnp.abs(jnp.expm1(log_ratio)) > self.ppo.clip, batch.mask),
        }
        return policy + self.rl2.value_weight * error - self.ppo.entropy * spread, metrics

    def batch_of(self, trials: Trials) -> Batch:
        """Advantages, normalised over each task's trials, and the value's targets."""
        advantage = gae(
            trials.reward,
            trials.value,
            trials.last_value,
            trials.mask,
            self.ppo.gamma,
            self.ppo.gae_lambda,
        )
        by_task = lambda x: x.reshape(len(x), self.tasks, -1)
        scaled = normalized(by_task(advantage), by_task(trials.mask), (0, 2))
        return Batch(
            trials.inputs,
            trials.u,
            trials.log_prob,
            scaled.reshape(advantage.shape),
            advantage + trials.value,
            trials.mask,
        )

    def update(
        self, state: LearnerState, trials: Trials, key: jax.Array
    ) -> tuple[LearnerState, dict[str, jax.Array]]:
        """`ppo.epochs` passes over the trials; metrics are means over the gradient steps, ()."""
        batch, parts = self.batch_of(trials), self.rl2.minibatches

        def step(state: LearnerState, lanes: jax.Array):
            part = jax.tree.map(lambda x: x[:, lanes], batch)
            grads, metrics = jax.grad(self.loss, has_aux=True)(state.params, part)
            state, figures = learned(self.optimizer, state, grads)
            return state, metrics | figures

        keys = jax.random.split(key, self.ppo.epochs)
        order = jax.vmap(lambda k: jax.random.permutation(k, self.lanes))(keys)
        state, metrics = jax.lax.scan(step, state, order.reshape(self.ppo.epochs * parts, -1))
        return state, jax.tree.map(jnp.nanmean, metrics)
