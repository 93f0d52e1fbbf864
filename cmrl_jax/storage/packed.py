"""A policy checkpoint as one file to keep and to share: `policy/<step>.zip` for `policy/<step>/`.

Orbax writes some thirty files a policy, and into some of them where on its machine they lie. A
packed policy has the same files less those places, and is the same file wherever it is packed.
"""

from __future__ import annotations

import hashlib
import shutil
import tempfile
import zipfile
import zlib
from pathlib import Path

from cmrl_jax.storage.manifest import NAME, write_manifest

# What orbax checks is that the file is there; what it writes is a sentence with the path.
MARK, MARKED = "commit_success.txt", "Checkpoint commit was successful\n"
LONG_AGO = (1980, 1, 1, 0, 0, 0)  # so that equal policies are equal files


def pack(step: Path, out: Path) -> None:
    """Writes the checkpoint `step`, a folder of a run's `policy`, as the file `out`."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / step.name
        shutil.copytree(step, copy)
        for mark in copy.rglob(MARK):
            mark.write_text(MARKED, encoding="utf-8")
        write_manifest(copy)
        out.parent.mkdir(parents=True, exist_ok=True)
        part = out.with_name(f".{out.name}.part")
        with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
            for path in sorted(p for p in copy.rglob("*") if p.is_file()):
                entry = zipfile.ZipInfo(path.relative_to(copy).as_posix(), LONG_AGO)
                entry.compress_type = zipfile.ZIP_DEFLATED
                archive.writestr(entry, path.read_bytes())
        part.replace(out)


def packed_steps(directory: Path) -> dict[int, Path]:
    """The packed checkpoints in a run's `policy`, by iteration; none where a folder is one."""
    if any(path.is_dir() and path.name.isdigit() for path in directory.glob("*")):
        return {}
    return {int(path.stem): path for path in directory.glob("*.zip") if path.stem.isdigit()}


def packed_fingerprint(file: Path) -> str:
    """`manifest.fingerprint` of what is packed."""
    with zipfile.ZipFile(file) as archive:
        return hashlib.sha256(archive.read(NAME)).hexdigest()[:12]


def unpack(file: Path, into: Path) -> str | None:
    """Puts a packed checkpoint into the folder `into`; what is wrong with the file, or None."""
    try:
        with zipfile.ZipFile(file) as archive:
            archive.extractall(into)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, ValueError) as error:
        return f"{type(error).__name__}: {error}"
    return None
