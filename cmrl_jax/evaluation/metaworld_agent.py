"""An agent as Meta-World's meta-learning evaluation expects one.

Interface: `MetaLearningAgent` of metaworld/evaluation.py (init, adapt_action, step, adapt,
eval_action, reset), for a batch of environments ("lanes").

NOTES
1. `step` is told no next observation: it is what the next `adapt_action` is asked about.
2. An episode that ends is started anew within the same step, so after its last step that
   observation is the next episode's first. The last transition of every episode is left out: H - 1
   of H transitions reach the memory.
3. The memory takes an episode's transitions in when it is truncated, inside `step`; the next one is
   acted on them. `adapt` only freezes the memory: evaluation episodes act on it and add nothing.
   A recurrent agent takes in each step with the next observation, which has its action and reward
   in it (`make_vector_env`); after `adapt`, every episode begins with what it then knew.
4. What the agent draws for an episode and the noise of its actions are what `Evaluator` draws for
   the same lane name and episode number; evaluation episodes go on counting where adaptation
   stopped.
5. Canonical observations are seen from where the object stands, and an agent is shown nothing but
   observations: it adds to the reset's what that one lags behind, as `Ml4Env` does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from cmrl_jax.algorithms.base import Agent, Told
from cmrl_jax.algorithms.common.replay import Transition
from cmrl_jax.algorithms.common.rollout import select_lanes
from cmrl_jax.config.schema import EnvConfig
from cmrl_jax.evaluation.controls import without_experience
from cmrl_jax.evaluation.episode import action_noise, agent_keys, chunk_keys
from cmrl_jax.jax_runtime import jit_repeated
from envs.sawyer import OBJECT, Ml4Env, canonical_obs

OBS_SIZE, ACTION_SIZE = Ml4Env.observation_size, Ml4Env.action_size


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


def is_recurrent(agent: Agent) -> bool:
    """Whether an agent acts on what it has just seen."""
    return agent.adapts and agent.chunk == 1


class MetaWorldAgent:
    """Acts for a fixed number of lanes with one policy on one task.

    Args:
        env: the configuration's `env` section.
        agent, params: what acts.
        texts: text vectors (run, lane, G); adaptation run n takes row n modulo their number.
        lane_ids: names of the lanes' noise (run, lane), see `Evaluator`.
        train_row: the task's row among the training tasks, read where the policy is told the task.
        reset_lag: the task's `Ml4Env.reset_lag` (3,), metres (NOTE 5).
        horizon: control steps of an episode.
        seed: seed of the draws.
        z: posterior, or one of the controls prior and text.
        deterministic: whether the actions' noise is left out.
    """

    def __init__(
        self,
        env: EnvConfig,
        agent: Agent,
        params: Any,
        texts: np.ndarray,
        lane_ids: np.ndarray,
        train_row: int,
        reset_lag: np.ndarray,
        horizon: int,
        seed: int = 0,
        z: Literal["posterior", "text", "prior"] = "posterior",
        deterministic: bool = True,
    ):
        self._agent, self._texts, self._lane_ids = agent, texts, lane_ids
        self._z: Literal["posterior", "text", "prior"] = z
        self._lanes, self._horizon = lane_ids.shape[1], horizon
        self._row = np.full(self._lanes, train_row, np.int32)
        self._reset_lag = reset_lag
        self._key = jax.random.key(seed)
        self._run = -1
        self._frozen = False
        self._is_recurrent = is_recurrent(agent)
        self._programs = _compile(env, agent, params, horizon, deterministic)

    @property
    def explores(self) -> bool:
        """Whether an episode that it learns from differs from one that counts."""
        return self._agent.explores

    @property
    def memory(self) -> Any:
        """What the lanes have seen in this adaptation run."""
        return self._memory

    def init(self) -> None:
        """Forgets everything: a new adaptation run."""
        self._run += 1
        lanes, horizon = self._lanes, self._horizon
        text = self._texts[self._run % len(self._texts)].astype(np.float32)
        self._lane_id = self._lane_ids[self._run % len(self._lane_ids)].astype(np.int32)
        told = Told(text, np.ones(lanes, np.float32), self._row)
        self._memory = self._adapted = self._agent.init(told)
        if self._z != "posterior":
            self._control = without_experience(self._z, told, self._agent.init)
        self._frozen = False
        self._episode = np.zeros(lanes, np.int32)
        self._starts = np.ones(lanes, bool)  # the next observation is an episode's first
        self._acted = np.zeros(lanes, bool)  # in the episode at hand
        self._origin = np.zeros((lanes, 3), np.float32)
        # Of the actions of the episode at hand.
        self._noise = np.zeros((lanes, horizon, ACTION_SIZE), np.float32)
        self._steps = np.zeros(lanes, int)  # acted in the episode at hand
        self._shown = np.zeros((lanes, OBS_SIZE), np.float32)
        self._count = np.zeros(lanes, int)  # transitions of the episode at hand, all whole
        self._pending = np.zeros(lanes, bool)  # one more that still lacks its next observation
        self._transitions = {
            "obs": np.zeros((lanes, horizon, OBS_SIZE), np.float32),
            "action": np.zeros((lanes, horizon, ACTION_SIZE), np.float32),
            "reward": np.zeros((lanes, horizon), np.float32),
            "next_obs": np.zeros((lanes, horizon, OBS_SIZE), np.float32),
        }

    def adapt_action(self, observations: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Actions (lane, 4) in an adaptation episode; completes the last transitions (NOTE 1)."""
        actions = self._act(observations)
        lane = np.flatnonzero(self._pending)
        self._transitions["next_obs"][lane, self._count[lane]] = self._shown[lane]
        self._count[lane] += 1
        self._pending[:] = False
        return actions, {}

    def step(self, timestep: Timestep) -> None:
        """Remembers the transitions just made; an episode that ended goes into the memory."""
        ended = np.logical_or(timestep.terminated, timestep.truncated)
        if not self._is_recurrent:
            place = np.arange(self._lanes), self._count
            self._transitions["obs"][place] = self._shown
            self._transitions["action"][place] = timestep.action
            self._transitions["reward"][place] = timestep.reward
            self._pending = ~ended  # NOTE 2
            self._observe(ended)
        self._begin(ended)

    def adapt(self) -> None:
        """Freezes the memory (NOTE 3)."""
        self._frozen, self._adapted = True, self._memory

    def go_on_learning(self) -> None:
        """Ends the freeze after one episode, which shares its number with the next (NOTE 4); no
        part of Meta-World's interface."""
        self._frozen = False
        if self._is_recurrent:
            self._memory = self._adapted
        self._episode -= 1

    def eval_action(self, observations: np.ndarray) -> np.ndarray:
        """Actions (lane, 4) in an evaluation episode."""
        return self._act(observations)

    def reset(self, env_mask: np.ndarray) -> None:
        """The masked lanes are at an episode's first observation, and begin one."""
        self._begin(np.asarray(env_mask, bool))

    def _begin(self, lanes: np.ndarray) -> None:
        self._episode[lanes & self._acted] += 1
        self._acted[lanes] = False
        self._starts |= lanes

    def _act(self, observations: np.ndarray) -> np.ndarray:
        obs, last = np.split(np.asarray(observations, np.float32), [OBS_SIZE], axis=-1)
        goes_on = ~self._starts
        if self._starts.any():
            is_kept = self._frozen and self._is_recurrent
            known = self._adapted if is_kept else self._memory
            source = known if self._z == "posterior" else self._control
            self._memory, noise = self._programs.begin(
                self._memory,
                source,
                self._starts,
                self._key,
                self._episode,
                self._lane_id,
                np.bool_(self._frozen),
            )
            self._noise[self._starts] = np.asarray(noise)[self._starts]
            self._origin[self._starts] = obs[self._starts][:, OBJECT] + self._reset_lag
            self._steps[self._starts] = 0
            self._starts[:] = False
        noise = self._noise[np.arange(self._lanes), self._steps]
        shown = self._programs.shown(obs, self._origin)
        if self._is_recurrent and goes_on.any():
            action, reward = last[:, None, :ACTION_SIZE], last[:, ACTION_SIZE : ACTION_SIZE + 1]
            step = {"obs": self._shown[:, None], "action": action, "reward": reward}
            step["next_obs"] = np.asarray(shown)[:, None]
            mask = goes_on[:, None].astype(np.float32)
            self._memory = self._programs.observe(self._memory, step, mask)
        actions = self._programs.act(self._memory, shown, noise)
        self._steps += 1
        self._acted[:] = True
        self._shown = np.asarray(shown)
        return np.asarray(actions)

    def _observe(self, ended: np.ndarray) -> None:
        """Adds the episodes of the lanes that ended to their memories, and forgets the steps."""
        if ended.any() and not self._frozen:
            steps = np.arange(self._horizon)[None] < self._count[:, None]
            mask = (steps & ended[:, None]).astype(np.float32)
            self._memory = self._programs.observe(self._memory, self._transitions, mask)
        self._count[ended] = 0


class _Programs(NamedTuple):
    """The agent's jitted parts, parameters bound."""

    shown: Callable[..., Any]
    act: Callable[..., Any]
    begin: Callable[..., Any]
    observe: Callable[..., Any]


def _compile(
    env: EnvConfig, agent: Agent, params: Any, horizon: int, deterministic: bool
) -> _Programs:
    params = jax.device_put(params)

    @jit_repeated
    def shown(obs, origin):
        is_canonical = env.obs_mode == "canonical"
        return canonical_obs(obs, origin, env.goal_observable) if is_canonical else obs

    @jit_repeated
    def act(memory, obs, noise):
        return agent.act(params, memory, obs, noise, deterministic)

    @jit_repeated
    def begin(memory, source, starts, key, episode, lane_id, exploit):
        """The memory with an episode begun where it starts, and all its noise (lane, time, act)."""

        def of_lane(episode, lane_id):
            episode_key = jax.random.fold_in(key, episode)
            keys = chunk_keys(agent.chunk, episode_key, horizon)
            draw = jax.vmap(action_noise, in_axes=(0, None, None, None))
            noise = draw(keys, lane_id, horizon // len(keys), ACTION_SIZE)
            return agent_keys(episode_key, lane_id[None])[0], noise.reshape(horizon, ACTION_SIZE)

        keys, noise = jax.vmap(of_lane)(episode, lane_id)
        begun = agent.begin_episode(params, memory, source, keys, exploit)
        return select_lanes(starts, begun, memory), noise

    @jit_repeated
    def observe(memory, transitions, mask):
        flag = jnp.zeros(mask.shape, bool)
        whole = Transition(terminated=flag, truncated=flag, first=flag, **transitions)
        return agent.observe(params, memory, whole, mask)

    return _Programs(shown, act, begin, observe)
