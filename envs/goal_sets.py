"""Named goal sets: where the fixture stands at the start of an episode, 50 places per task.

They are drawn by Meta-World's own task maker, so goal i of set s is a goal other people have too.
`train` and `heldout` are packaged; reading them needs neither metaworld nor a simulator.

NOTES
1. One call of the maker per task, each with its own seed: all classes of one call share one random
   stream, so in a joint call a task's goals would change with its neighbours.
2. The maker keeps the second of the two draws each reset makes, as `reset_model` runs twice; that
   is why the sets cannot be had from a plain uniform draw.

`python -m envs.goal_sets` writes the packaged file again.
"""

from __future__ import annotations

import importlib
import os
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from envs.command_line import Parser, run, typed_path
from envs.goal_names import GOALS, SEEDS, seed_of
from envs.npz import write_npz
from envs.outputs import FORCE_HELP, check_output
from envs.places import DATA
from envs.tasks import METAWORLD_TASKS, REGISTRY, TASKS, task_id

_PACKAGED = DATA / "goal_sets.npz"
_CACHE_VARIABLE = "CMRL_JAX_CACHE"


def load_goal_set(
    name: str, tasks: Sequence[str] = TASKS, cache: str | Path | None = None
) -> np.ndarray:
    """Returns the goals of a named set.

    Args:
        name: `train`, `heldout` or `fresh:<seed>`. A fresh set is drawn with metaworld on first
            use (about a second a task) and then read from the cache.
        tasks: task names; the order of the result's first axis.
        cache: directory for fresh sets. Default: the environment variable CMRL_JAX_CACHE, else
            `~/.cache/cmrl_jax`.

    Returns:
        float64 (task, 50, 3): fixture positions in metres, in the order Meta-World drew them.

    Raises:
        ValueError: unknown set or task, a set under another than its one name, unreadable file,
            metaworld missing for a fresh set. The message is two lines: cause, cure.
    """
    for task in tasks:
        task_id(task)
    seed, packaged = seed_of(name), {}
    if name in SEEDS:
        packaged = _read(_PACKAGED, "python -m envs.goal_sets writes the packaged file again")
    found = []
    for task in tasks:
        if not REGISTRY[task].is_metaworlds:
            found.append(_from_reset_box(task, seed))
        elif name in SEEDS:
            found.append(_goals(packaged, f"{name}/{task}", _PACKAGED))
        else:
            found.append(_fresh(task, seed, _cache_directory(cache)))
    return np.stack(found)


def _from_reset_box(task: str, seed: int) -> np.ndarray:
    """Goals of a task that Meta-World does not know: uniform in its reset box."""
    spec = importlib.import_module(REGISTRY[task].module).TASKS[task]
    box = spec.placement_low, spec.placement_high
    return np.random.default_rng(seed).uniform(*box, (GOALS, 3))


def draw_goals(task: str, seed: int) -> np.ndarray:
    """Draws the 50 goals of one task with Meta-World's task maker; needs metaworld.

    Args:
        task: one of `METAWORLD_TASKS`.
        seed: the maker's seed, up to `goal_names.LARGEST_SEED`. The global numpy stream is left as
            it was.

    Returns:
        float64 (50, 3): fixture positions in metres.

    Raises:
        ValueError: metaworld is not installed.
    """
    try:
        import envs.engine  # noqa: F401  # isort: skip, metaworld imports MuJoCo
        import metaworld
        from metaworld.env_dict import ALL_V3_ENVIRONMENTS, ML1_args_kwargs
    except ImportError as error:
        raise ValueError(
            f"goal sets are drawn with the metaworld package: {error}\n"
            "pip install metaworld==3.0.0, or use the packaged sets train and heldout"
        ) from None
    name = f"{task}-v3"
    made: list[Any] = metaworld._make_tasks(
        OrderedDict({name: ALL_V3_ENVIRONMENTS[name]}),
        OrderedDict({name: ML1_args_kwargs[name]}),
        {"partially_observable": True},
        seed=seed,
    )
    return np.array([pickle.loads(task.data)["rand_vec"] for task in made], np.float64)


def write_packaged(path: Path = _PACKAGED) -> None:
    """Draws `train` and `heldout` for every task and writes them to `path`, byte for byte the
    same each time."""
    sets = [(name, seed, task) for name, seed in SEEDS.items() for task in METAWORLD_TASKS]
    write_npz(path, {f"{name}/{task}": draw_goals(task, seed) for name, seed, task in sets})


def _fresh(task: str, seed: int, cache: Path | None) -> np.ndarray:
    if cache is None:
        return draw_goals(task, seed)
    path = cache / "goals" / f"{task}-{seed}.npz"
    if not os.path.isfile(path):  # nor is one that cannot be looked at
        goals = draw_goals(task, seed)
        try:
            write_npz(path, {"goals": goals})
        except (OSError, ValueError):
            # The cache saves a second at the next start; a read-only home must not stop a run.
            return goals
    return _goals(_read(path, f"delete {path} and start again"), "goals", path)


def _cache_directory(cache: str | Path | None) -> Path | None:
    directory = Path(cache or os.environ.get(_CACHE_VARIABLE) or "~/.cache/cmrl_jax")
    try:
        return directory.expanduser()
    except RuntimeError:  # a user without a home has no cache
        return None


def _read(path: Path, cure: str) -> dict[str, np.ndarray]:
    try:
        # The file is opened here since np.load leaves its own handle open when the zip is broken.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            return {key: data[key] for key in data.files}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise ValueError(f"the goal set file {path} cannot be read: {error}\n{cure}") from None


def _goals(arrays: dict[str, np.ndarray], key: str, path: Path) -> np.ndarray:
    goals = arrays.get(key)
    if goals is None or goals.shape != (GOALS, 3) or goals.dtype != np.float64:
        got = "nothing" if goals is None else f"{goals.dtype} {goals.shape}"
        raise ValueError(
            f"the goal set file {path} holds {got} under {key!r}, not float64 ({GOALS}, 3)\n"
            "python -m envs.goal_sets writes the packaged file again; delete a cached one"
        )
    return goals


def main(argv: Sequence[str] | None = None) -> int:
    """Writes the packaged goal sets and prints the range of each; returns the exit code."""
    return run(lambda: _write_and_show(argv))


def _write_and_show(argv: Sequence[str] | None) -> None:
    parser = Parser(
        prog="python -m envs.goal_sets",
        description="Writes the packaged goal sets and prints the range of each.",
        allow_abbrev=False,
    )
    parser.add_argument("--out", type=typed_path, default=_PACKAGED, metavar="F", help="[packaged]")
    parser.add_argument("--force", action="store_true", help=FORCE_HELP)
    args = parser.parse_args(argv)
    # Its bytes depend on the goals alone, so it is known by the names of its sets.
    check_output(args.out, "--out", f"heldout/{TASKS[0]}.npy", args.force)
    write_packaged(args.out)
    for key, goals in _read(args.out, "run the command again").items():
        print(f"{key:22s} {len(goals)} goals from {goals.min(0)} to {goals.max(0)} m")


if __name__ == "__main__":
    raise SystemExit(main())
