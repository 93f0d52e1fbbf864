"""Checkpoints: `DIR/ckpt/` to resume a run exactly, `DIR/policy/` to act. Only importer of orbax.

Trees are stored flat, {path: array}, and rebuilt from an abstract tree: so None nodes, empty tuples
and optax's named tuples survive, and a difference is reported by the name of the array. Saves are
atomic (orbax writes a temporary directory and renames it): a kill leaves the previous step intact.
Each step holds a list of its files with their checksums, which is verified before it is read.
"""

from __future__ import annotations

import json
import logging
import os
import re
import sys
import tempfile
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

from cmrl_jax.config.files import check_origin, check_resumable
from cmrl_jax.config.schema import Config, ConfigError
from cmrl_jax.storage.manifest import find_damage, fingerprint, is_listed, write_manifest
from cmrl_jax.storage.named_arrays import describe, flatten, not_finite, placed, unflatten
from cmrl_jax.storage.older_forms import as_stored, brought_up
from cmrl_jax.storage.packed import packed_fingerprint, packed_steps, unpack
from cmrl_jax.streams import to_stderr

FULL_ITEMS = ("learner", "replay", "context")
POLICY_ITEMS = ("policy",)
META_FIELDS = (
    "config",
    "iteration",
    "env_steps",
    "wall_s",
    "csv_offset",
    "versions",
    "goals_sha256",
)


class DamagedCheckpoint(ConfigError):
    """A checkpoint that cannot be read, or that is not what was saved."""


class CheckpointStore:
    """The checkpoints in one directory, by iteration.

    A writer keeps the newest `keep` steps and removes what a killed save left behind; a reader
    changes nothing, so it may look at a run that is still going on. Use as a context manager.
    """

    def __init__(
        self,
        directory: Path,
        items: tuple[str, ...],
        keep: int | None = None,
        read_only: bool = False,
        packed: Mapping[int, Path] | None = None,
    ):
        """Open a store; the functions `full_store` and `policy_store` name the two of a run.

        Args:
            packed: its steps as files (packed.py), each unpacked when it is read.

        Raises:
            ConfigError: the directory cannot be made.
        """
        self.directory = directory.absolute()  # orbax refuses relative paths
        self.items = items
        self._packed = packed or {}
        self._unpacked = tempfile.TemporaryDirectory() if packed else None
        # Where orbax finds the steps.
        self._place = Path(self._unpacked.name) if self._unpacked else self.directory
        self.keep = keep
        if not read_only:
            try:
                self.directory.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                cause = f"cannot write checkpoints to {directory}: {error.strerror}"
                cure = "give a run directory you may write to: --run DIR"
                raise ConfigError(cause, cure) from error
        _hush_orbax()
        options = ocp.CheckpointManagerOptions(
            cleanup_tmp_directories=not read_only,
            read_only=read_only,
            create=False,
            save_interval_steps=0 if read_only else 1,
            # The next iteration donates the buffers that a background thread would still read.
            enable_async_checkpointing=False,
        )
        self._manager = ocp.CheckpointManager(
            self._place, item_names=(*items, "meta"), options=options
        )

    def steps(self) -> list[int]:
        """Iterations that can be restored, oldest first."""
        return sorted(self._packed or self._manager.all_steps())

    def save(self, trees: Mapping[str, Any], meta: Mapping[str, Any]) -> bool:
        """Store the trees as step `meta["iteration"]`; False if that step is stored already.

        Returns when the step is on disk, and only then are older ones deleted.

        Args:
            trees: one pytree of arrays for each item of the store; None for none.
            meta: exactly `META_FIELDS`, plain JSON data.

        Raises:
            ConfigError: an array is not finite; nothing is written.
            OSError: the disk is full, or refuses for another reason.
            ValueError: other items or fields than the store's, or an iteration before the last.
        """
        if set(trees) != set(self.items) or set(meta) != set(META_FIELDS):
            raise ValueError(f"got {sorted(trees)} and {sorted(meta)}, not the store's fields")
        step, saved = meta["iteration"], self.steps()
        if saved and step <= saved[-1]:
            if step in saved:
                return False
            raise ValueError(f"iteration {step} comes after {saved[-1]} was saved")
        flat = {name: flatten(tree) for name, tree in trees.items()}
        for name, leaves in flat.items():
            if bad := not_finite(leaves):
                cause = f"iteration {step} is not saved: {name}/{bad} is not finite"
                cure = f"start a new run with a lower sac.lr; {self.directory} keeps the one before"
                raise ConfigError(cause, cure)
        args: dict[str, Any] = {
            name: ocp.args.StandardSave(leaves) for name, leaves in flat.items() if leaves
        }
        args["meta"] = ocp.args.JsonSave(json.loads(json.dumps(meta)))
        try:
            self._manager.save(step, args=ocp.args.Composite(**args))
            write_manifest(self._place / str(step))
            self._prune()
        except ValueError as error:  # what tensorstore makes of an error of the file system
            if code := re.search(r"os_error_code='(\d+)'", str(error)):
                number = int(code[1])
                path = str(self._place / str(step))
                raise OSError(number, os.strerror(number), path) from error
            raise
        return True

    def read_meta(self, step: int | None = None) -> dict[str, Any]:
        """The meta record of a step, the newest by default.

        Raises:
            ConfigError: no such step, or it cannot be read.
        """
        step = self._choose(step)
        meta = self._read(step, {"meta": ocp.args.JsonRestore()})["meta"]
        if not isinstance(meta, dict) or set(meta) != set(META_FIELDS):
            raise self._damaged(step, "its meta record has other fields")
        return meta

    def restore(
        self,
        abstract: Mapping[str, Any],
        config: Config | None = None,
        step: int | None = None,
        versions: Mapping[str, str | None] | None = None,
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """The trees and the meta record of a step, the newest by default.

        Args:
            abstract: for each item a pytree like the saved one, of `jax.ShapeDtypeStruct` (from
                `jax.eval_shape`) or arrays. A sharding given there is used, else the first device.
            config: what the run goes on with; compared with the saved one first.
            step: iteration.
            versions: this process's `package_versions()`; a difference prints one warning line.

        Raises:
            ConfigError: no such step, it cannot be read, its policy saw observations from another
                origin, the config differs in a field that matters, or the arrays differ from
                `abstract`. Each names what and a cure.
        """
        step = self._choose(step)
        if reason := find_damage(self._place / str(step)):
            raise self._damaged(step, reason)
        meta = self.read_meta(step)
        check_origin(meta["config"], self.directory.parent)
        if config is not None:
            check_resumable(meta["config"], config, self.directory.parent)
        if versions is not None:
            _warn_of_versions(self._shown(step), meta["versions"], versions)
        wanted = {name: flatten(abstract[name]) for name in self.items}
        args = {
            name: ocp.args.StandardRestore({path: placed(leaf) for path, leaf in leaves.items()})
            for name, leaves in self._stored_arrays(step, wanted).items()
            if leaves
        }
        found = self._read(step, args) if args else {}
        leaves = {name: brought_up(found.get(name) or {}, wanted[name]) for name in self.items}
        return {name: unflatten(abstract[name], leaves[name]) for name in self.items}, meta

    def resume(
        self, abstract: Mapping[str, Any], config: Config, versions: Mapping[str, str | None]
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """`restore` of the newest step that is sound, for a writer to go on from.

        Steps after it are damaged: each is renamed to `damaged-<step>`, with one line of warning,
        because the run will save that iteration again.

        Raises:
            ConfigError: as `restore`; about the newest step if all are damaged.
        """
        bad: list[tuple[int, DamagedCheckpoint]] = []
        for step in reversed(self.steps()):
            try:
                found = self.restore(abstract, config, step, versions)
            except DamagedCheckpoint as error:
                bad.append((step, error))
                continue
            for damaged_step, error in bad:
                kept = self._set_aside(damaged_step)
                tail = f"; kept as {kept}, going on from {step}"
                to_stderr(f"warning: {error.cause}{tail}")
            if not is_listed(self._place / str(step)):
                write_manifest(self._place / str(step))
            self._prune()  # what a kill left of a step that was being deleted
            return found
        if not bad:
            raise _nothing_saved(self.directory)
        cure = f"put {self.directory} back from a copy, or start a new run"
        raise DamagedCheckpoint(bad[0][1].cause, cure)

    def _set_aside(self, step: int) -> str:
        """Renames a step, so that it is none any more; returns its new name."""
        name, copy = f"damaged-{step}", 1
        while (self.directory / name).exists():
            name, copy = f"damaged-{step}-{copy}", copy + 1
        (self.directory / str(step)).rename(self.directory / name)
        self._manager.reload()
        return name

    def _prune(self) -> None:
        for step in self.steps()[: -self.keep] if self.keep else ():
            self._manager.delete(step)

    def drop_after(self, step: int) -> None:
        """Deletes all later steps: the run goes on from `step` and will save them again."""
        for later in self.steps():
            if later > step:
                self._manager.delete(later)

    def close(self) -> None:
        self._manager.close()
        if self._unpacked is not None:
            self._unpacked.cleanup()

    def __enter__(self) -> CheckpointStore:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _choose(self, step: int | None) -> int:
        steps = self.steps()
        if not steps:
            raise _nothing_saved(self.directory)
        if step is None:
            return steps[-1]
        if step not in steps:
            there = ", ".join(map(str, steps))
            raise ConfigError(f"no checkpoint {step} in {self.directory}", f"there are: {there}")
        self._unpack(step)
        return step

    def _unpack(self, step: int) -> None:
        """Puts a packed step where orbax finds it."""
        place = self._place / str(step)
        if step not in self._packed or place.exists():
            return
        try:
            unpack(self._packed[step], place)
        except zipfile.BadZipFile as error:
            raise self._damaged(step, str(error)) from error
        self._manager.reload()

    def _shown(self, step: int) -> Path:
        """What a user knows a step by."""
        return self._packed.get(step, self.directory / str(step))

    def _read(self, step: int, args: Mapping[str, Any]) -> Any:
        try:
            return self._manager.restore(step, args=ocp.args.Composite(**args))
        except Exception as error:  # orbax, tensorstore and json each have their own classes
            path = self._place / str(step)
            is_sound = is_listed(path) and find_damage(path) is None
            if is_sound and isinstance(error, (MemoryError, OSError, jax.errors.JaxRuntimeError)):
                raise  # of the machine, not of the checkpoint
            raise self._damaged(step, f"{type(error).__name__}: {error}") from error

    def _damaged(self, step: int, reason: str) -> DamagedCheckpoint:
        path = self._shown(step)
        older = [other for other in self.steps() if other < step]
        cure = "start a new run"
        if older and self.items == POLICY_ITEMS:
            cure = f"use an older one: --checkpoint {older[-1]}"
        elif older:
            cure = f"resume the run, which goes on from {older[-1]} then"
        lines = reason.strip().splitlines() or ["unknown reason"]
        return DamagedCheckpoint(f"checkpoint {path} is damaged: {lines[0][:200]}", cure)

    def _stored_arrays(
        self, step: int, wanted: Mapping[str, Mapping[str, Any]]
    ) -> dict[str, dict[str, Any]]:
        """What to read for the arrays `wanted`; names the first one that the checkpoint lacks."""
        stored = {}
        for item, leaves in wanted.items():
            path = self._place / str(step) / item
            saved = {}
            if path.exists():
                try:
                    with ocp.StandardCheckpointer() as reader:
                        metadata = reader.metadata(path).item_metadata
                except Exception as error:
                    raise self._damaged(step, f"{type(error).__name__}: {error}") from error
                if metadata is None:
                    raise self._damaged(step, f"{item} does not say what it holds")
                saved = metadata.tree
            elif leaves:
                raise self._damaged(step, f"{item} is missing")
            leaves = stored[item] = as_stored(leaves, saved)
            for name in sorted(leaves.keys() | saved.keys()):
                old = describe(saved[name]) if name in saved else "absent"
                new = describe(leaves[name]) if name in leaves else "absent"
                if old != new:
                    place = self._shown(step) / item
                    raise ConfigError(
                        f"checkpoint {place} does not fit: {name} is {old} there, {new} here",
                        "use the configuration and version that wrote it (versions.json)",
                    )
        return stored


def full_store(run: Path, keep: int | None = None, read_only: bool = False) -> CheckpointStore:
    """`DIR/ckpt`: learner (with the key and counters), replay and context rings, newest `keep`."""
    return CheckpointStore(run / "ckpt", FULL_ITEMS, keep, read_only)


def policy_store(run: Path, read_only: bool = False) -> CheckpointStore:
    """`DIR/policy`: what acting needs (actor, encoder, observation statistics, goals); all kept.

    To be read, they may all be packed (packed.py).
    """
    directory = run / "policy"
    packed = packed_steps(directory) if read_only else None
    return CheckpointStore(directory, POLICY_ITEMS, None, read_only, packed)


def policy_digest(run: Path, step: int) -> str:
    """What tells a policy checkpoint from another of its name.

    Raises:
        ConfigError: it is packed, and damaged.
    """
    file = packed_steps(run / "policy").get(step)
    if file is None:
        return fingerprint(run / "policy" / str(step))
    try:
        return packed_fingerprint(file)
    except zipfile.BadZipFile as error:
        cure = "put it back from a copy"
        raise DamagedCheckpoint(f"checkpoint {file} is damaged: {error}", cure) from error


def split_run(run: Any) -> dict[str, Any]:
    """The items of `full_store` that hold a `RunState`, or the shapes of one."""
    learner = {"state": run.learner, "key": run.key, "iteration": run.iteration}
    return {"learner": learner, "replay": run.replay, "context": run.context}


def join_run(run: Any, items: Mapping[str, Any]) -> Any:
    """The inverse of `split_run`, with the type of `run`."""
    learner = items["learner"]
    return run.replace(
        learner=learner["state"],
        key=learner["key"],
        iteration=learner["iteration"],
        replay=items["replay"],
        context=items["context"],
    )


def _nothing_saved(directory: Path) -> ConfigError:
    cure = "name a run that has saved one with --run DIR, or train without --resume"
    return ConfigError(f"no checkpoint in {directory}", cure)


def _warn_of_versions(path: Path, saved: Mapping[str, Any], here: Mapping[str, Any]) -> None:
    names = sorted(name for name in saved.keys() | here.keys() if saved.get(name) != here.get(name))
    if names:
        shown = ", ".join(f"{n} {saved.get(n)} (here {here.get(n)})" for n in names)
        to_stderr(f"warning: {path} was written with {shown}")


def _hush_orbax() -> None:
    """Drops orbax's own log lines (routine steps as warnings) and its stray complaints.

    Failures are raised besides being logged. When one array fails, orbax closes its event loop
    under the others, and each of them complains of that from a thread, where nobody can catch it,
    or that it was never awaited.
    """
    unawaited = "coroutine 'async_serialize.* was never awaited"
    warnings.filterwarnings("ignore", unawaited, RuntimeWarning)
    logging.getLogger("absl").addFilter(_is_not_from_orbax)  # the same one is added once
    report = sys.unraisablehook
    if getattr(report, "__name__", "") == "drop_stragglers":
        return

    def drop_stragglers(unraisable: Any) -> None:
        if str(unraisable.exc_value) != "Event loop is closed":
            report(unraisable)

    sys.unraisablehook = drop_stragglers


def _is_not_from_orbax(record: logging.LogRecord) -> bool:
    return "orbax" not in Path(record.pathname).parts
