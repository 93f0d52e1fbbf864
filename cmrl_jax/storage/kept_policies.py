"""Policies that come with the project, by name: those behind its tables.

A source tree has all of them in results/; an installed package has seed 0 of each fold. Each is a
run directory without its training: a configuration and one packed policy (packed.py), whose own
manifest is checked whenever it is read.
"""

from __future__ import annotations

import fnmatch
from pathlib import Path

from cmrl_jax.places import PACKAGE, ROOT

FOLDERS = (ROOT / "results" / "adaptation" / "policies", PACKAGE / "policies")


def kept_policies(pattern: str = "*") -> dict[str, Path]:
    """Name -> directory of the policies whose names match, by name."""
    found: dict[str, Path] = {}
    for folder in reversed(FOLDERS):
        found |= {path.parent.name: path.parent for path in folder.glob("*/config.yaml")}
    return {name: found[name] for name in sorted(fnmatch.filter(found, pattern))}


def is_kept(path: Path) -> bool:
    """Whether a directory is that of a policy that comes with the project, which is only read."""
    return any(path.resolve().parent == folder.resolve() for folder in FOLDERS)
