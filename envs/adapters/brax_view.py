"""One ML4 task behind brax's `Env` interface, for people who bring their own trainer.

The one thing to know: at the time limit `done` is 1 and `info["truncation"]` is 1, and the state is
already a fresh episode with another goal; `info["last_obs"]` is the observation to bootstrap from.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import warnings

import jax
import jax.numpy as jnp

from envs.physics.mjx.backend import SUBSTEPS
from envs.sawyer import Ml4Env
from envs.tasks import TASKS, task_id

with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
    # brax pulls in jaxopt, which announces its end; mjx prints that warp is not installed.
    warnings.filterwarnings("ignore", message="JAXopt is no longer maintained")
    from brax.envs.base import Env, State


class SingleTaskEnv(Env):
    """A task of `TASKS`; `reset` and `step` are pure functions of one lane, to be vmapped.

    A state holds obs (39,), reward () in [0, 10], done () and, as float32 scalars, the metrics
    `success` (at this very step) and `distance` (metres, what success is judged by). Its info:
    `truncation` (), `last_obs` (39,) the observation that the step led to, before any reset, `key`
    and `episode` (), from which goals are drawn.

    Args:
        task: one of `TASKS`.
        horizon: control steps (12.5 ms) of an episode.
        goal_observable: show the target in the last three observation numbers.
        auto_reset: begin a fresh episode, with a fresh goal, in the step that ends one.

    Raises:
        ValueError: unknown task, or a horizon below one step.
    """

    def __init__(
        self,
        task: str,
        horizon: int = 200,
        goal_observable: bool = False,
        auto_reset: bool = True,
    ):
        self._task_id = jnp.asarray(task_id(task), jnp.int32)
        if horizon < 1:
            raise ValueError(
                f"an episode of {horizon} steps has no end\nuse a horizon of 1 or more"
            )
        self.horizon = horizon
        self.auto_reset = auto_reset
        self._env = Ml4Env(goal_observable)

    def reset(self, rng: jax.Array) -> State:
        """The first state of an episode; its goal and those of later episodes come from `rng`."""
        episode = jnp.zeros((), jnp.int32)
        inner = self._start(rng, episode)
        zero = jnp.zeros(())
        return State(
            pipeline_state=inner,  # type: ignore[arg-type]  # brax puts its own states here
            obs=inner.obs,
            reward=zero,
            done=zero,
            metrics={"success": zero, "distance": zero},
            info={"truncation": zero, "last_obs": inner.obs, "key": rng, "episode": episode},
        )

    def step(self, state: State, action: jax.Array) -> State:
        """One control step; `action` (4,) in [-1, 1]: hand displacement / 0.01 m, finger effort."""
        before = state.pipeline_state
        after = self._env.step(before, action)  # type: ignore[arg-type]
        is_over = after.steps >= self.horizon
        done = is_over.astype(jnp.float32)
        episode, inner = state.info["episode"], after
        if self.auto_reset:
            episode = episode + is_over.astype(jnp.int32)
            fresh = self._start(state.info["key"], episode)
            inner = jax.tree.map(lambda new, old: jnp.where(is_over, new, old), fresh, after)
        success = after.success.astype(jnp.float32)
        return dataclasses.replace(
            state,  # type: ignore[type-var]
            pipeline_state=inner,
            obs=inner.obs,
            reward=after.reward,
            done=done,
            metrics=state.metrics | {"success": success, "distance": after.distance},
            info=state.info | {"truncation": done, "last_obs": after.obs, "episode": episode},
        )

    def _start(self, key: jax.Array, episode: jax.Array):
        return self._env.reset(jax.random.fold_in(key, episode), self._task_id)

    @property
    def observation_size(self) -> int:
        return self._env.observation_size

    @property
    def action_size(self) -> int:
        return self._env.action_size

    @property
    def backend(self) -> str:
        return "mjx"

    @property
    def dt(self) -> float:
        """Seconds of a control step."""
        return self._env.physics.timestep * SUBSTEPS


__all__ = ["TASKS", "SingleTaskEnv"]
