"""Which runs are seeds of one, and what a figure calls each group of them.

A mean over seeds is one only if nothing but the seed differs. So runs are one group where their
directories are named alike (but for `-seed<N>`), their configurations are equal in all that a
figure may depend on, and no seed is there twice: the same computation twice is no second sample.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cmrl_jax.config.schema import Config, leaves

# What seeds of one run may differ in: names, what is kept and shown, and where evaluations lie on
# an axis, since figures are drawn where all runs have one. Not the length of a run, though it may
# change on resume: what is final after 600,000 steps is not after 1,200,000.
FREE_AMONG_SEEDS = (
    "name",
    "seed",
    "runtime.compile_cache",
    "eval.every",
    "eval.wall_share",
    "eval.final_k",
    "log.",
    "checkpoint.",
)

_SEED = re.compile(r"seed\d+")
Settings = tuple[tuple[str, Any], ...]


def group_name(run: Path) -> str:
    """What runs of several seeds have in common: `cmrl` for runs/cmrl-seed1 and runs/cmrl/seed1."""
    run = run.resolve()
    return run.parent.name if _SEED.fullmatch(run.name) else re.sub(r"-seed\d+$", "", run.name)


def shown_names(runs: Sequence[Path]) -> list[str]:
    """A run's directory without where it lies, unless another's is called the same."""
    names = [run.resolve().name for run in runs]
    return [
        str(run) if names.count(name) > 1 else name for run, name in zip(runs, names, strict=True)
    ]


def settings_of(config: Config) -> dict[str, Any]:
    """Dotted name -> value, of all fields."""
    return {name: value for name, _, value in leaves(config)}


def group_runs(settings: Mapping[Path, Mapping[str, Any]]) -> dict[str, list[Path]]:
    """Label -> runs that are seeds of one; every label says in what its group differs.

    Args:
        settings: of each run, what it was made with, by dotted name; all have the same names.
    """
    named: dict[str, dict[Settings, list[Path]]] = {}
    for run, own in settings.items():
        part = tuple((n, value) for n, value in own.items() if not n.startswith(FREE_AMONG_SEEDS))
        named.setdefault(group_name(run), {}).setdefault(part, []).append(run)
    groups: dict[str, list[Path]] = {}
    for name, alike in named.items():
        for apart, runs in zip(_told_apart(list(alike)), alike.values(), strict=True):
            label = ", ".join([name, *apart])
            seeds = [settings[run]["seed"] for run in runs]
            if len(set(seeds)) == len(seeds):
                groups[label] = runs
            else:
                groups |= {f"{label}, seed {settings[run]['seed']} ({run})": [run] for run in runs}
    return groups


def _told_apart(parts: Sequence[Settings]) -> list[list[str]]:
    """For each of some different settings, its values of few fields that tell all of them apart."""
    told: list[list[str]] = [[] for _ in parts]
    for field in zip(*parts, strict=True):
        values = [f"{name} {_shown(value)}" for name, value in field]
        more = [[*old, value] for old, value in zip(told, values, strict=True)]
        if len({tuple(new) for new in more}) > len({tuple(old) for old in told}):
            told = more
    return told


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return "+".join(str(item) for item in value) or "none"
    return str(value).lower() if isinstance(value, bool) else str(value)
