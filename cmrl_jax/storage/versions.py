"""What a result was made with: packages, commit, device; versions.json of a run."""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import jax

from cmrl_jax.places import ROOT
from cmrl_jax.storage.run_dir import write_text

PACKAGES = (
    "jax",
    "jaxlib",
    "flax",
    "optax",
    "orbax-checkpoint",
    "brax",
    "mujoco",
    "mujoco-mjx",
    "metaworld",
    "numpy",
)


def package_versions() -> dict[str, str | None]:
    """Versions that a checkpoint's or a result's numbers may depend on; None: not installed."""
    versions: dict[str, str | None] = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None
    return versions


def git_commit(root: Path | None = None) -> str | None:
    """The commit of the source tree, marked `-dirty` if tracked files changed; None without git."""
    root = root or ROOT
    if not (root / ".git").exists():  # an installed wheel must not report the repository around it
        return None
    options = ["--always", "--dirty", "--abbrev=40", "--exclude=*"]  # the hash, never a tag
    command = ["git", "-C", str(root), "describe", *options]
    try:
        found = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return found.stdout.strip() or None


def write_versions(path: Path) -> dict[str, Any]:
    """Write versions.json: packages, commit, device, processors and date; returns what it holds."""
    device = jax.devices()[0]
    versions = package_versions() | {
        "commit": git_commit(),
        "device": f"{device.platform}: {device.device_kind}",
        "device_count": jax.device_count(),
        "cpu_count": os.cpu_count(),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    write_text(path, json.dumps(versions, indent=2) + "\n")
    return versions
