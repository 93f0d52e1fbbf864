"""Packages that only some commands and options need: whether they are installed, and what to do."""

from __future__ import annotations

import importlib.util

from cmrl_jax.config.schema import Config, ConfigError

_FILMS = ("viz", {"imageio_ffmpeg": "imageio-ffmpeg", "PIL": "pillow"})
# What needs them -> the extra of pyproject.toml, and module -> package.
NEEDS = {
    "log.tensorboard": ("viz", {"tensorboardX": "tensorboardX"}),
    "log.wandb": ("wandb", {"wandb": "wandb"}),
    "log.video_every": _FILMS,
    "render": _FILMS,
    "report": ("viz", {"plotly": "plotly"}),
}


def require_extra(needed_by: str) -> None:
    """Raises ConfigError where a package is missing that something in `NEEDS` needs."""
    if missing := _missing(needed_by):
        extra, _ = NEEDS[needed_by]
        cure = f"pip install 'cmrl-jax[{extra}]'"
        if needed_by.startswith("log."):
            cure += f", or leave {needed_by} out"
        cause = f"{needed_by} needs the package {missing[0]}, which is not installed"
        raise ConfigError(cause, cure)


def require_extras_of(config: Config) -> None:
    """Raises ConfigError where a package is missing that `log` asks for."""
    for name in ("tensorboard", "wandb", "video_every"):
        if getattr(config.log, name):
            require_extra(f"log.{name}")


def _missing(needed_by: str) -> list[str]:
    _, modules = NEEDS[needed_by]
    return [package for name, package in modules.items() if importlib.util.find_spec(name) is None]
