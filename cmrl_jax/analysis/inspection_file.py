"""`inspection.json` of a run: how its actor routes and what z it infers, as small arrays.

`inspection.py` takes the figures and `inspection_figures.py` draws them; this file is all that a
figure needs, so that one can be drawn again without the run's checkpoints.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cmrl_jax.config.schema import ConfigError
from cmrl_jax.registry import task_names
from cmrl_jax.storage.documents import is_there, read_json
from cmrl_jax.storage.run_dir import cannot_write, write_text

FILE = "inspection.json"
DECIMALS = 4


@dataclass(frozen=True)
class Latents:
    """What was inferred in adaptation runs, all after the same number of own episodes.

    Attributes:
        mean: of each run's posterior (task, run, latent).
        z: what each run's last episode drew from it (task, run, latent).
        kl: nats of a posterior over N(0, I), mean over a task's runs (task,); None without
            information bottleneck, where z is the mean and no KL is paid.
        text_mean: of the posterior given the text alone (task, latent); None where the text has no
            factor of its own.
        text_kl: its nats over N(0, I) (task,), or None.
    """

    mean: np.ndarray
    z: np.ndarray
    kl: np.ndarray | None
    text_mean: np.ndarray | None
    text_kl: np.ndarray | None


@dataclass(frozen=True)
class Usage:
    """With what weight modules are read, (task, layer, module) each; a mean over steps and runs.

    The readers of a layer's modules are the modules of the next, or the output: the mean over them,
    the least and the most that one of them gives. A mean of equal shares may hide that each reads
    from another module.
    """

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True)
class Inspection:
    """How a policy acts on some tasks.

    Attributes:
        tasks: task names.
        routing: of the actor; None for one without modules.
        latents: None for a policy without a latent.
        facts: what the figures were taken with (`settings.result_fields`).
    """

    tasks: tuple[str, ...]
    routing: Usage | None
    latents: Latents | None
    facts: dict[str, Any]

    def is_held_out(self, task: str) -> bool:
        """Whether the policy did not train on a task."""
        return task not in self.facts["train_tasks"]


def write_inspection(run: Path, inspection: Inspection) -> Path:
    """Writes a run's `inspection.json`, one line a field, numbers with `DECIMALS` decimals.

    Raises:
        ConfigError: the run directory refuses it.
    """
    fields = {
        "tasks": inspection.tasks,
        "routing": _plain(inspection.routing),
        "latents": _plain(inspection.latents),
        "facts": inspection.facts,
    }
    lines = [f'"{name}": {json.dumps(value)}' for name, value in fields.items()]
    path = run / FILE
    try:
        write_text(path, "{\n" + ",\n".join(lines) + "\n}\n")
    except OSError as error:
        raise cannot_write(run, error) from error
    return path


def read_inspection(run: Path) -> Inspection | None:
    """The inspection that lies in a run directory; None where there is none.

    Raises:
        ConfigError: the file cannot be read.
    """
    path, cure = run / FILE, "delete it, then make it again with plot --inspect"
    if not is_there(path):
        return None
    fields = read_json(path, cure)
    try:
        routing, latents = _arrays(fields["routing"]), _arrays(fields["latents"])
        found = Inspection(
            tasks=tuple(fields["tasks"]),
            routing=None if routing is None else Usage(**routing),
            latents=None if latents is None else Latents(**latents),
            facts=fields["facts"],
        )
        _check(found)
    except KeyError as error:
        raise ConfigError(f"{path} lacks the field {error}", cure) from error
    except (ValueError, TypeError, AttributeError) as error:
        raise ConfigError(f"{path} is no inspection: {error}", cure) from error
    return found


def _check(found: Inspection) -> None:
    """Raises ValueError, TypeError or KeyError where a figure could not be drawn."""
    tasks = found.tasks
    if not tasks or len(set(tasks)) < len(tasks) or not set(tasks) <= set(task_names()):
        raise ValueError(f"tasks are {tasks}")
    for name in ("env_steps", "k", "goals", "draws"):
        if type(found.facts[name]) is not int:
            raise ValueError(f"{name} is {found.facts[name]!r}")
    if not isinstance(found.facts["train_tasks"], list) or not found.facts["goal_set"]:
        raise ValueError("train_tasks is no list, or goal_set is empty")
    if (usage := found.routing) is not None:
        _check_shape("routing", usage.mean, (len(tasks), None, None))
        for array in (usage.low, usage.high):
            _check_shape("routing", array, usage.mean.shape)
    if (latents := found.latents) is not None:
        _check_shape("mean", latents.mean, (len(tasks), None, None))
        _check_shape("z", latents.z, latents.mean.shape)
        _check_shape("kl", latents.kl, (len(tasks),))
        _check_shape("text_mean", latents.text_mean, (len(tasks), latents.z.shape[-1]))
        _check_shape("text_kl", latents.text_kl, (len(tasks),))


def _check_shape(name: str, array: np.ndarray | None, shape: tuple[int | None, ...]) -> None:
    if array is None:
        if name in ("kl", "text_mean", "text_kl"):
            return
        raise ValueError(f"{name} is nothing")
    got = array.shape
    alike = len(got) == len(shape) and all(m in (None, n) for n, m in zip(got, shape, strict=True))
    if not alike or 0 in got:
        raise ValueError(f"{name} has the shape {got}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has a number that is not finite")


def _plain(record: Usage | Latents | None) -> dict[str, Any] | None:
    if record is None:
        return None
    rounded = lambda x: None if x is None else np.round(np.asarray(x, float), DECIMALS).tolist()
    return {name: rounded(array) for name, array in vars(record).items()}


def _arrays(fields: dict[str, Any] | None) -> dict[str, Any] | None:
    if fields is None:
        return None
    return {name: None if x is None else np.asarray(x, float) for name, x in fields.items()}
