"""Which packaged configuration a run was made from, and in what it differs: its flags."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cmrl_jax.config.files import config_dirs, load_config
from cmrl_jax.config.schema import Config, leaves

NOT_A_FLAG = ("name", "runtime.compile_cache", "env.origin")


def preset_of(config: Config) -> tuple[str, dict[str, Any]]:
    """The packaged file nearest to a configuration, `ml4.yaml`, and what to set beside it.

    Nearest is the one with the fewest keys to set, and among several that of the same `name`.

    Returns:
        The file's name, and dotted key -> value as the configuration has it.
    """
    own = _values(config)
    found: dict[str, dict[str, Any]] = {}
    named: dict[str, bool] = {}
    for folder in config_dirs()[2:]:  # not where the user stands
        for path in sorted(folder.glob("*.yaml")):
            if path.name not in found:
                preset = load_config(path)
                found[path.name] = _differences(own, _values(preset))
                named[path.name] = preset.name == config.name
    nearest = min(found, key=lambda name: (len(found[name]), not named[name]))
    return nearest, found[nearest]


def _values(config: Config) -> dict[str, Any]:
    return {name: value for name, _, value in leaves(config) if name not in NOT_A_FLAG}


def _differences(own: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in own.items() if value != other[name]}
