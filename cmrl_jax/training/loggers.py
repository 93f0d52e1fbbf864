"""Which loggers a configuration asks for.

One more of your own is a class with the methods of `Logger` that it needs.
"""

from __future__ import annotations

from cmrl_jax.config.schema import Config
from cmrl_jax.training.console import Console
from cmrl_jax.training.films import Films
from cmrl_jax.training.logger import Logger
from cmrl_jax.training.tensorboard import TensorBoard
from cmrl_jax.training.weights_and_biases import WeightsAndBiases


def loggers_of(console: Console, config: Config) -> list[Logger]:
    """The console, and what `log` asks for beside it."""
    told: list[Logger] = [console]
    if config.log.tensorboard:
        told.append(TensorBoard())
    if config.log.wandb:
        told.append(WeightsAndBiases())
    # First, so that what it closes with reaches the others.
    return [*([Films(told)] if config.log.video_every else []), *told]
