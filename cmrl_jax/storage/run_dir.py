"""Which directory a run writes to: a new `runs/<config>-<time>`, or the one that is resumed.

A directory holds a run from the moment one of `RUN_FILES` lies in it. One process at a time writes
to it: it holds a lock that the system releases when the process ends, however it ends.
"""

from __future__ import annotations

import contextlib
import datetime
import errno
import os
import re
import socket
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from cmrl_jax.commands import command, quoted
from cmrl_jax.config.files import check_resumable, read_yaml, to_yaml
from cmrl_jax.config.rules import validate
from cmrl_jax.config.schema import Config, ConfigError, call_envs, require
from cmrl_jax.storage.kept_policies import is_kept, kept_policies
from cmrl_jax.storage.locks import lock
from envs.command_line import brief, suggest, what_is

RUN_FILES = ("config.yaml", "metrics.csv", "ckpt")
ROOT = Path("runs")
LOCK = ".lock"
DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
REFUSED = (errno.EACCES, errno.EPERM, errno.EROFS, errno.EIO)
_TIME = r"\d{8}-\d{6}(-\d+)?"
_SEED = re.compile(r"seed(\d+)")  # of several in one directory


def holds_run(path: Path) -> bool:
    """Whether a run has begun to write into `path`; no, where that cannot be looked at."""
    return any(os.path.exists(path / name) for name in RUN_FILES)


def config_stem(path: Path) -> str:
    """What runs of a config file are called: `ml4` for configs/ml4.yaml.

    A run's own `runs/ml4-<time>/config.yaml`, or one of its seeds', belongs to `ml4` too.
    """
    if path.name == "config.yaml" and holds_run(path.parent):
        run = path.resolve().parent
        return re.sub(f"-{_TIME}$", "", (run.parent if _SEED.fullmatch(run.name) else run).name)
    return path.stem


def runs_of(stem: str, root: Path = ROOT) -> list[Path]:
    """Directories of a config's runs, or of several seeds of it, oldest first."""
    name = re.compile(f"{re.escape(stem)}-{_TIME}")
    named = [p for p in root.glob("*") if name.fullmatch(p.name)]
    found = [p for p in named if holds_run(p) or seed_dirs(p)]
    return sorted(found, key=_age)


def _age(path: Path) -> tuple[str, int]:
    """Sorts `x-20260102-030405-2` behind `x-20260102-030405`."""
    match = re.search(r"(\d{8}-\d{6})(?:-(\d+))?$", path.name)
    assert match is not None  # runs_of matched the name
    return match[1], int(match[2] or 0)


def find_run(path: Path) -> Path:
    """`path`, if it holds a run, or the policy of that name that comes with the project.

    Raises:
        ConfigError: naming the runs that are there, or why nothing can be said of `path`.
    """
    call_envs(lambda: what_is(path / RUN_FILES[0]))
    if holds_run(path):
        return path
    if (kept := kept_policies()).keys() & {str(path)}:
        return kept[str(path)]
    if group := seed_dirs(path):
        names = ", ".join(quoted(run) for run in group.values())
        raise ConfigError(f"{brief(path)} holds {len(group)} seeds", f"give --run one of: {names}")
    known = [quoted(p) for p in sorted(ROOT.glob("*")) if holds_run(p)][-5:]
    state = "holds no run" if path.is_dir() else "does not exist"
    train = f"train first: {command('--config', 'ml4.yaml')}"
    cure = f"give --run one of: {', '.join(known)}" if known else train
    raise ConfigError(f"run directory {brief(path)} {state}", suggest(str(path), kept) + cure)


def find_own_run(path: Path) -> Path:
    """`find_run`, for what writes into the run.

    Raises:
        ConfigError: also for a policy that comes with the project.
    """
    run = find_run(path)
    cause = f"{path} comes with the project: it is scored, not gone on with or written to"
    require(not is_kept(run), cause, f"train one of your own: {command('--config', 'ml4.yaml')}")
    return run


def place_beside(run: Path) -> Path:
    """Where files about a run go that nobody gave a place: into it; `runs/NAME` if it is kept."""
    return ROOT / run.name if is_kept(run) else run


def resumed_run(stem: str, run: Path | None) -> Path:
    """The directory to resume: `run`, or the newest one of the config; also one of several seeds.

    Raises:
        ConfigError: where there is none.
    """
    if run is not None:
        return run if seed_dirs(run) else find_own_run(run)
    runs = runs_of(stem)
    if not runs:
        cause = f"--resume found no run of '{stem}' in {ROOT}/"
        raise ConfigError(cause, "name it with --run DIR, or start one without --resume")
    return runs[-1]


def seed_dirs(base: Path) -> dict[int, Path]:
    """The runs of several seeds that lie in one directory, by seed: `base/seed<n>`.

    All are made before one begins, so that a start that was cut short leaves none out.
    """
    found = {path: _SEED.fullmatch(path.name) for path in base.glob("seed*") if path.is_dir()}
    seeds = {int(match[1]): path for path, match in found.items() if match}
    return dict(sorted(seeds.items())) if any(map(holds_run, found)) else {}


def runs_at(
    config: Config, stem: str, place: Path | None, seeds: int | None, resume: bool
) -> tuple[Path, list[tuple[Config, Path]]]:
    """What is to be trained: a run, or one for each of several seeds, with its directory.

    Args:
        stem: what new runs are called, or which are looked for.
        place: directory of the run, or of all seeds.
        seeds: how many, from `config.seed` on; with `resume` None for those that are there.

    Returns:
        The directory of all, and the runs.

    Raises:
        ConfigError: as `new_run` and `resumed_run`; or other seeds are there.
    """
    if resume:
        place = resumed_run(stem, place)
        group = {} if holds_run(place) else seed_dirs(place)
        there = f"{place} holds {len(group)} seeds" if group else f"{place} holds a single run"
        cure = f"leave seeds away, or give {len(group)}" if group else "leave seeds away"
        require(seeds in (None, len(group) or None), f"{there}, not {seeds}", cure)
        runs = [(replace(config, seed=seed), run) for seed, run in group.items()]
        return place, runs or [(config, place)]
    if seeds is None:
        place = new_run(stem, place)
        return place, [(config, place)]
    configs = [replace(config, seed=config.seed + i) for i in range(seeds)]
    validate(configs[-1])  # the largest seed
    require(config.checkpoint.keep > 1, "several seeds with checkpoint.keep 1", "keep 2 or more")
    place = new_run(stem, place)
    runs = [(one, place / f"seed{one.seed}") for one in configs]
    for _, run in runs:
        new_run(run.name, run)
    return place, runs


def new_run(stem: str, run: Path | None, now: datetime.datetime | None = None) -> Path:
    """Makes the directory of a new run: `run`, or `runs/<stem>-<time>`.

    Raises:
        ConfigError: where it holds a run already, or cannot be made.
    """
    try:
        if run is None:
            time = (now or datetime.datetime.now()).strftime("%Y%m%d-%H%M%S")
            run = ROOT / f"{stem}-{time}"
            return _made(run)
        check_unused(run)
        run.mkdir(parents=True, exist_ok=True)
        return run
    except OSError as error:
        assert run is not None
        raise cannot_write(run, error) from error


def _made(base: Path) -> Path:
    """A directory that was not there before: `base`, or `base-<n>`.

    Who makes it has it, so that of many starts in one second each gets its own.
    """
    base.parent.mkdir(parents=True, exist_ok=True)
    run, copy = base, 0
    while True:
        try:
            run.mkdir()
            return run
        except FileExistsError:
            copy += 1
            run = base.with_name(f"{base.name}-{copy}")


def check_unused(run: Path) -> None:
    """Raises ConfigError where a directory holds a run already."""
    call_envs(lambda: what_is(run / RUN_FILES[0]))
    if holds_run(run) or seed_dirs(run):
        cause = f"run directory {run} already holds a run"
        cure = "go on with it (--resume, in a program resume=True), or give another --run DIR"
        raise ConfigError(cause, cure)


def forget_unbegun(run: Path) -> None:
    """Takes `config.yaml` back from a run that was refused before it wrote anything else.

    So the same command can be given again, once what it was refused for is mended.
    """
    if not any((run / name).exists() for name in RUN_FILES if name != "config.yaml"):
        (run / "config.yaml").unlink(missing_ok=True)


def check_same_config(config: Config, run: Path) -> None:
    """`check_resumable` against the run's own config.yaml, where it has one."""
    if (run / "config.yaml").is_file():
        check_resumable(read_yaml(run / "config.yaml")[0], config, run)


@contextlib.contextmanager
def begun(run: Path, config_yaml: str, resume: bool, place: Path | None = None) -> Iterator[None]:
    """Holds a run directory whose `config.yaml` is written: from then on it can be resumed.

    A new run that is refused (ValueError) before it wrote anything else is forgotten.

    Args:
        place: what to resume instead, where it is one of several seeds.

    Raises:
        ConfigError: another process writes to it, a write failed, or it holds a run already.
    """
    with writing_to(run, place or run):
        if not resume:
            check_unused(run)  # once more: another process may have come and gone
        write_text(run / "config.yaml", config_yaml)
        try:
            yield
        except ValueError:
            if not resume:
                forget_unbegun(run)
            raise


@contextlib.contextmanager
def all_begun(runs: Sequence[tuple[Config, Path]], resume: bool, place: Path) -> Iterator[None]:
    """Holds the directories of several runs, each with the configuration that is its own.

    Args:
        place: the directory of all.

    Raises:
        ConfigError: as `begun`; or one is to be resumed with another configuration.
    """
    if resume:
        for config, run in runs:
            check_same_config(config, run)
    with contextlib.ExitStack() as held:
        for config, run in runs:
            held.enter_context(begun(run, to_yaml(config), resume, place))
        yield


def cannot_write(run: Path, error: OSError, place: Path | None = None) -> ConfigError:
    """What to tell a user whose run directory refuses a write; `place` is what to resume."""
    cause = f"cannot write to run directory {run}: {error.strerror}"
    if error.errno in DISK_FULL:
        resume = command("--run", place or run, "--resume")
        return ConfigError(cause, f"make room, then go on from the last checkpoint: {resume}")
    return ConfigError(cause, "give a directory you may write to: --run DIR")


@contextlib.contextmanager
def writing_to(run: Path, place: Path | None = None) -> Iterator[None]:
    """Keeps every other process from writing to `run`, and reports what its disk refuses.

    Raises:
        ConfigError: another process writes to it, or a write failed.
    """
    with contextlib.ExitStack() as stack:
        try:
            file = stack.enter_context(open(run / LOCK, "a+", encoding="utf-8"))
            lock(file, f"run directory {run}")
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}")
            file.flush()
        except BlockingIOError as error:
            file.seek(0)
            cause = f"{file.read() or 'another process'} is writing to run directory {run}"
            raise ConfigError(cause, "stop it first, or give another --run DIR") from error
        except OSError as error:
            raise cannot_write(run, error) from error
        try:
            yield
        except OSError as error:
            if error.errno in (*DISK_FULL, *REFUSED) and _is_inside(error.filename, run):
                raise cannot_write(run, error, place) from error
            raise


def _is_inside(name: str | bytes | None, run: Path) -> bool:
    """Whether an error is about a file of `run`; one without a name came from a write to it."""
    return name is None or Path(os.fsdecode(name)).resolve().is_relative_to(run.resolve())


def write_text(path: Path, text: str) -> None:
    """Replaces a file as a whole: a kill leaves the old one or the new one, never a part."""
    part = path.with_name(f".{path.name}.part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)
