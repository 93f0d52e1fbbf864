"""Whether the files that a command will write may be written; asked before it computes anything."""

from __future__ import annotations

import os
from pathlib import Path

from cmrl_jax.config.schema import ConfigError, call_envs
from envs.outputs import check_output


def writable(path: Path | None, flag: str, mark: str, force: bool) -> None:
    """Whether an output file may be written; see `envs.outputs.check_output`.

    Raises:
        ConfigError: it may not, or cannot.
    """
    if path is not None:
        call_envs(lambda: check_output(path, flag, mark, force))


def distinct(**paths: Path | None) -> None:
    """Whether output files are different ones, by the names of their flags.

    Raises:
        ConfigError: two are one file, of which the second would take the place of the first.
    """
    seen: dict[str, str] = {}
    for name, path in paths.items():
        if path is None:
            continue
        other = seen.setdefault(os.path.realpath(path), name)
        if other != name:
            cause = f"--{other} and --{name} are one file, {path}"
            raise ConfigError(cause, f"give --{name} a file of its own")
