"""A policy checkpoint as one file to keep and to share: `policy/<step>.zip` for `policy/<step>/`.

Orbax writes some thirty files a policy, and into some of them where on its machine they lie. A
packed policy has the same files less those places, so that copies of one checkpoint are one file.
"""

from __future__ import annotations

import io
import shutil
import tempfile
import zipfile
from pathlib import Path, PurePosixPath

from cmrl_jax.config.schema import ConfigError
from cmrl_jax.storage.manifest import NAME, find_damage, fingerprint_of, write_manifest

# What orbax checks is that the file is there; what it writes is a sentence with the path.
MARK, MARKED = "commit_success.txt", "Checkpoint commit was successful\n"
LONG_AGO, UNIX = (1980, 1, 1, 0, 0, 0), 3  # of every entry, whenever and wherever it is packed


def pack(step: Path, out: Path) -> None:
    """Writes the checkpoint `step`, a folder of a run's `policy`, as the file `out`.

    Raises:
        ConfigError: the checkpoint is damaged.
    """
    if reason := find_damage(step):
        raise ConfigError(f"checkpoint {step} is damaged: {reason}", "pack another one")
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / step.name
        shutil.copytree(step, copy)
        for mark in copy.rglob(MARK):
            mark.write_text(MARKED, encoding="utf-8")
        write_manifest(copy)
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w") as archive:  # stored as it is: orbax has compressed it
            for path in sorted(p for p in copy.rglob("*") if p.is_file()):
                entry = zipfile.ZipInfo(path.relative_to(copy).as_posix(), LONG_AGO)
                entry.create_system = UNIX
                archive.writestr(entry, path.read_bytes())
    out.parent.mkdir(parents=True, exist_ok=True)
    part = out.with_name(f".{out.name}.part")
    part.write_bytes(packed.getvalue())
    part.replace(out)


def packed_steps(directory: Path) -> dict[int, Path]:
    """The packed checkpoints in a run's `policy`, by iteration; none where a folder is one."""
    if any(path.is_dir() and path.name.isdigit() for path in directory.glob("*")):
        return {}
    return {int(path.stem): path for path in directory.glob("*.zip") if path.stem.isdigit()}


def read_packed(file: Path) -> dict[str, bytes]:
    """The files in a packed checkpoint, by their path in it.

    Raises:
        BadZipFile: it is damaged, or was not packed by `pack`.
    """
    data = file.read_bytes()
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            files = {name: archive.read(name) for name in archive.namelist()}
    except Exception as error:  # of the file, read already: every decoder has its own classes
        raise zipfile.BadZipFile(f"{type(error).__name__}: {error}") from error
    if NAME not in files:
        raise zipfile.BadZipFile(f"it has no {NAME}")
    for name in files:
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts:
            raise zipfile.BadZipFile(f"{name} lies outside it")
    return files


def unpack(file: Path, into: Path) -> None:
    """Puts the files of a packed checkpoint into the folder `into`.

    Raises:
        BadZipFile: see `read_packed`.
    """
    for name, data in read_packed(file).items():
        path = into / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def packed_fingerprint(file: Path) -> str:
    """`manifest.fingerprint` of what is packed.

    Raises:
        BadZipFile: see `read_packed`.
    """
    return fingerprint_of(read_packed(file)[NAME])
