"""Compositional meta-RL (CMRL) on Meta-World scenes, end to end in JAX.

    import cmrl_jax as cj

    config = cj.load_config("ml4", {"train.env_steps": 200_000, "env.physics": "native"}, seed=1)
    result = cj.train(config, run_dir="runs/notebook")
    print(cj.evaluate(result.agent, tasks=["window-close"], k=(0, 2, 10)).table())

What it offers is described in `cmrl_jax.api`, and imported when it is first used. Importing it
makes the tasks known to Gymnasium: `gymnasium.make("cmrl_jax/window-open-v0")`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from envs.adapters.gymnasium_ids import register

if TYPE_CHECKING:
    from cmrl_jax.api import (
        Agent,
        Algorithm,
        Config,
        ConfigError,
        Evaluation,
        Logger,
        MetaEnv,
        Stop,
        TrainedAgent,
        TrainResult,
        evaluate,
        load_agent,
        load_config,
        make_env,
        register_algorithm,
        register_environment,
        train,
    )

__version__ = "0.1.0"
__all__ = [
    "Agent",
    "Algorithm",
    "Config",
    "ConfigError",
    "Evaluation",
    "Logger",
    "MetaEnv",
    "Stop",
    "TrainResult",
    "TrainedAgent",
    "evaluate",
    "load_agent",
    "load_config",
    "make_env",
    "register_algorithm",
    "register_environment",
    "train",
]

register()


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'cmrl_jax' has no attribute '{name}'")
    return getattr(importlib.import_module("cmrl_jax.api"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
