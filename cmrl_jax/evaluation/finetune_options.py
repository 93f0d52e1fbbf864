"""How a policy is fine-tuned, and whether a run can be; read before jax is imported."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from cmrl_jax.config.schema import Config, ConfigError, require
from cmrl_jax.registry import environment
from envs.goal_names import GOALS

# What gradient steps may change; `posterior`: nothing, `scratch`: SAC that begins from nothing,
# `search`: all and z, after a search has found where to begin.
ADAPT = ("posterior", "z", "router", "all", "search", "scratch")
FREE_Z = ("z", "search")  # z is a parameter of its own, no encoder's output
PARTIAL = ("z", "router")  # gradient steps leave parts of the networks as they are

READ_OUTS = (0, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


@dataclass(frozen=True)
class FinetuneOptions:
    """What `finetune` was asked for.

    Attributes:
        task: the task to adapt to.
        adapt: ways to adapt, each from the same checkpoint.
        episodes: of own experience.
        updates: gradient steps a control step.
        goals: of a read-out, the first of `goal_set`.
        seed: of the own episodes, and of the read-outs' draws.
        physics: backend; None for the run's own.
    """

    task: str
    adapt: tuple[str, ...] = ADAPT
    episodes: int = 100
    updates: int = 1
    goals: int = GOALS
    goal_set: str = "heldout"
    seed: int = 0
    physics: Literal["mjx", "native"] | None = None

    @property
    def read_outs(self) -> tuple[int, ...]:
        """Episodes after which the policy is scored; the last always is."""
        early = [n for n in READ_OUTS if n < self.episodes]
        return (*early, self.episodes)


def check_run(config: Config, options: FinetuneOptions) -> None:
    """Whether a run can be adapted so.

    Raises:
        ConfigError: it was trained on the task, or lacks a part that a way to adapt needs.
    """
    cause = f"finetune with algorithm {config.algorithm}"
    require(config.algorithm == "cmrl", cause, "give a run of cmrl, whose learner it goes on with")
    tasks = environment(config.env.name).tasks
    if options.task in config.tasks.train or options.task not in tasks:
        held = [task for task in tasks if task not in config.tasks.train]
        was = "was trained on" if options.task in tasks else f"is of {config.env.name}, without"
        cause = f"the run {was} {options.task}"
        raise ConfigError(cause, f"give --task one of: {', '.join(held) or 'none is left'}")
    # Without z a network is told the training tasks' one-hot, or nothing: no part of it is made for
    # another task.
    has = {"z": config.model.conditioning == "z", "router": config.model.net == "soft"}
    needs = {
        "posterior": ("z",),
        "z": ("z",),
        "router": ("z", "router"),
        "all": ("z",),
        "search": ("z",),
    }
    lacks = {way: [part for part in needs.get(way, ()) if not has[part]] for way in ADAPT}
    if missing := [way for way in options.adapt if lacks[way]]:
        left = [way for way in options.adapt if not lacks[way]]
        left = left or [way for way in ADAPT if not lacks[way]]
        cause = f"--adapt {missing[0]}: the run has no {lacks[missing[0]][0]}"
        raise ConfigError(cause, f"use --adapt {','.join(left)}")
