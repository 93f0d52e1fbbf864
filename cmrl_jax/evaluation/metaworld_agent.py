"""A restored policy as the agent that Meta-World's meta-learning evaluation expects.

Interface: `MetaLearningAgent` of metaworld/evaluation.py (init, adapt_action, step, adapt,
eval_action, reset), for a batch of environments ("lanes").

NOTES
1. `step` is told no next observation: it is what the next `adapt_action` is asked about.
2. An episode that ends is started anew within the same step, so after its last step that
   observation is the next episode's first. The last transition of every episode is left out: H - 1
   of H transitions reach the belief.
3. The belief takes an episode's transitions in when it is truncated, inside `step`; z is then drawn
   for the next one. `adapt` only freezes the belief: evaluation episodes draw from it and add
   nothing.
4. A lane's z and the noise of its actions are those that `Evaluator` draws for the same lane name
   and episode number; evaluation episodes go on counting where adaptation stopped.
5. Canonical observations are seen from where the object stands, and an agent is shown nothing but
   observations: it adds to the reset's what that one lags behind, as `Ml4Env` does.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from cmrl_jax.algorithms.cmrl.learner import Learner
from cmrl_jax.algorithms.common.replay import Transition
from cmrl_jax.config.schema import Config
from cmrl_jax.evaluation.episode import (
    PolicyParams,
    action_noise,
    add_to_belief,
    chunk_keys,
    lane_noise,
    noise_key,
)
from cmrl_jax.nn.context import Belief, init_belief
from envs.sawyer import ACTION_SIZE, OBJECT, OBS_SIZE, canonical_obs


class Timestep(Protocol):
    """What `step` reads of Meta-World's record."""

    @property
    def action(self) -> np.ndarray: ...
    @property
    def reward(self) -> np.ndarray: ...
    @property
    def terminated(self) -> np.ndarray: ...
    @property
    def truncated(self) -> np.ndarray: ...


class MetaWorldAgent:
    """Acts for a fixed number of lanes with one policy on one task.

    Args:
        texts: text vectors (run, lane, G); adaptation run n takes row n modulo their number.
        lane_ids: names of the lanes' noise (run, lane), see `Evaluator`.
        train_row: the task's row among the training tasks, read where the policy is told the task.
        reset_lag: the task's `Ml4Env.reset_lag` (3,), metres (NOTE 5).
        horizon: control steps of an episode.
        seed: seed of the draws.
        z: posterior, or one of the controls prior and text.
        deterministic: whether actions are the tanh of the mean.
    """

    def __init__(
        self,
        config: Config,
        learner: Learner,
        params: PolicyParams,
        texts: np.ndarray,
        lane_ids: np.ndarray,
        train_row: int,
        reset_lag: np.ndarray,
        horizon: int,
        seed: int = 0,
        z: str = "posterior",
        deterministic: bool = True,
    ):
        self._texts, self._lane_ids, self._z = texts, lane_ids, z
        self._lanes, self._horizon = lane_ids.shape[1], horizon
        self._reset_lag = reset_lag
        self._inference = learner.inference
        self._key = jax.random.key(seed)
        self._run = -1
        self._frozen = False
        self._functions = _compile(
            config, learner, params, train_row, self._lanes, horizon, deterministic
        )

    @property
    def belief(self) -> Belief | None:
        """What the lanes have seen in this adaptation run; None without a latent."""
        return self._belief

    def init(self) -> None:
        """Forgets everything: a new adaptation run."""
        self._run += 1
        lanes, horizon = self._lanes, self._horizon
        self._text = self._texts[self._run % len(self._texts)].astype(np.float32)
        self._lane_id = self._lane_ids[self._run % len(self._lane_ids)].astype(np.int32)
        self._belief = None
        if self._inference is not None:
            self._belief = init_belief((lanes,), self._inference.latent_dim)
        self._frozen = False
        self._episode = np.zeros(lanes, np.int32)
        self._starts = np.ones(lanes, bool)  # the next observation is an episode's first
        self._acted = np.zeros(lanes, bool)  # in the episode at hand
        self._origin = np.zeros((lanes, 3), np.float32)
        self._zc = np.zeros((lanes, self._functions["width"]), np.float32)
        # Of the actions of the episode at hand.
        self._noise = np.zeros((lanes, horizon, ACTION_SIZE), np.float32)
        self._steps = np.zeros(lanes, int)  # acted in the episode at hand
        self._shown = np.zeros((lanes, OBS_SIZE), np.float32)
        self._count = np.zeros(lanes, int)  # transitions of the episode at hand, all whole
        self._pending = np.zeros(lanes, bool)  # one more that still lacks its next observation
        self._memory = {
            "obs": np.zeros((lanes, horizon, OBS_SIZE), np.float32),
            "action": np.zeros((lanes, horizon, ACTION_SIZE), np.float32),
            "reward": np.zeros((lanes, horizon), np.float32),
            "next_obs": np.zeros((lanes, horizon, OBS_SIZE), np.float32),
        }

    def adapt_action(self, observations: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Actions (lane, 4) in an adaptation episode; completes the last transitions (NOTE 1)."""
        actions = self._act(observations)
        lane = np.flatnonzero(self._pending)
        self._memory["next_obs"][lane, self._count[lane]] = self._shown[lane]
        self._count[lane] += 1
        self._pending[:] = False
        return actions, {}

    def step(self, timestep: Timestep) -> None:
        """Remembers the transitions just made; an episode that ended goes into the belief."""
        ended = np.logical_or(timestep.terminated, timestep.truncated)
        place = np.arange(self._lanes), self._count
        self._memory["obs"][place] = self._shown
        self._memory["action"][place] = timestep.action
        self._memory["reward"][place] = timestep.reward
        self._pending = ~ended  # NOTE 2
        if ended.any():
            self._observe(ended)
            self._begin(ended)

    def adapt(self) -> None:
        """Freezes the belief (NOTE 3)."""
        self._frozen = True

    def eval_action(self, observations: np.ndarray) -> np.ndarray:
        """Actions (lane, 4) in an evaluation episode."""
        return self._act(observations)

    def reset(self, env_mask: np.ndarray) -> None:
        """The masked lanes are at an episode's first observation; z is drawn again for them."""
        self._begin(np.asarray(env_mask, bool))

    def _begin(self, lanes: np.ndarray) -> None:
        self._episode[lanes & self._acted] += 1
        self._acted[lanes] = False
        self._starts |= lanes

    def _act(self, observations: np.ndarray) -> np.ndarray:
        obs = np.asarray(observations, np.float32)
        if self._starts.any():
            noise = self._functions["noise"](self._key, self._episode, self._lane_id)
            self._zc[self._starts] = np.asarray(self._draw())[self._starts]
            self._noise[self._starts] = np.asarray(noise)[self._starts]
            self._origin[self._starts] = obs[self._starts][:, OBJECT] + self._reset_lag
            self._steps[self._starts] = 0
            self._starts[:] = False
        noise = self._noise[np.arange(self._lanes), self._steps]
        actions, shown = self._functions["act"](obs, self._origin, self._zc, noise)
        self._steps += 1
        self._acted[:] = True
        self._shown = np.asarray(shown)
        return np.asarray(actions)

    def _draw(self) -> jax.Array:
        """Conditioning of every lane for the episode that it begins (lane, conditioning)."""
        belief = self._belief
        if belief is not None and self._z != "posterior":
            belief = jax.tree.map(jnp.zeros_like, belief)
        mask = np.full(self._lanes, self._z != "prior", np.float32)
        args = (belief, self._text, mask, self._key, self._episode, self._lane_id)
        return self._functions["draw"](*args)

    def _observe(self, ended: np.ndarray) -> None:
        """Adds the episodes of the lanes that ended to their beliefs, and forgets the steps."""
        if self._belief is not None and not self._frozen:
            steps = np.arange(self._horizon)[None] < self._count[:, None]
            mask = (steps & ended[:, None]).astype(np.float32)
            observe = self._functions["observe"]
            self._belief = observe(self._belief, self._memory, mask, self._text)
        self._count[ended] = 0


def _compile(
    config: Config,
    learner: Learner,
    params: PolicyParams,
    train_row: int,
    lanes: int,
    horizon: int,
    deterministic: bool,
) -> Mapping[str, Any]:
    """The agent's jitted parts: `act`, `noise`, `draw`, `observe`; `width` of the conditioning."""
    inference = learner.inference
    params = jax.device_put(params)

    @jax.jit
    def act(obs, origin, zc, noise):
        shown = obs
        if config.env.obs_mode == "canonical":
            shown = canonical_obs(obs, origin, config.env.goal_observable)
        unused = jax.random.key(0)  # noise is given
        action, _ = learner.policy(
            params.actor_params, params.obs_stats, shown, zc, unused, deterministic, noise
        )
        return action, shown

    @jax.jit
    def noise(key, episode, lane_id):
        """Noise of a whole episode's actions (lane, time, act)."""

        def of_lane(episode, lane_id):
            keys = chunk_keys(config, jax.random.fold_in(key, episode), horizon)
            draw = jax.vmap(action_noise, in_axes=(0, None, None))
            return draw(keys, lane_id, horizon // len(keys)).reshape(horizon, ACTION_SIZE)

        return jax.vmap(of_lane)(episode, lane_id)

    if inference is None:
        told = learner.task_conditioning(jnp.full((lanes,), train_row))
        return {"act": act, "noise": noise, "draw": lambda *args: told, "width": told.shape[-1]}

    @jax.jit
    def draw(belief, text, mask, key, episode, lane_id):
        posterior = inference.posterior_of_belief(params.encoder_params, belief, text, mask)
        episode_key = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, episode)
        keys = jax.vmap(noise_key)(episode_key, lane_id)
        return inference.z_of_noise(posterior, lane_noise(keys, inference.latent_dim))

    @jax.jit
    def observe(belief, memory, mask, text):
        flag = jnp.zeros(mask.shape, bool)
        transitions = Transition(terminated=flag, truncated=flag, first=flag, **memory)
        return add_to_belief(learner, inference, params, belief, transitions, mask, text)

    width = inference.latent_dim
    return {"act": act, "noise": noise, "draw": draw, "observe": observe, "width": width}
