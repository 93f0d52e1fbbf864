"""The list of a directory's files with their SHA-256, so that damage is found before it is read.

Only the standard library, and a format that `sha256sum -c sha256.txt` understands.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

NAME = "sha256.txt"


def write_manifest(directory: Path) -> None:
    """Lists all files below `directory`; the list appears as a whole or not at all."""
    part = directory / f".{NAME}.part"
    part.write_text(_list_of(directory), encoding="utf-8")
    part.replace(directory / NAME)


def is_listed(directory: Path) -> bool:
    """Whether there is a list. There is none if the writer was killed just before it."""
    return (directory / NAME).exists()


def fingerprint(directory: Path) -> str:
    """Twelve digits that tell this content from other content: of the list there is or would be."""
    if is_listed(directory):
        return fingerprint_of((directory / NAME).read_bytes())
    return fingerprint_of(_list_of(directory).encode())


def fingerprint_of(manifest: bytes) -> str:
    """`fingerprint` of the content that a list names."""
    return hashlib.sha256(manifest).hexdigest()[:12]


def find_damage(directory: Path) -> str | None:
    """What is wrong with the first file not as listed; None if all are, or without a list."""
    if not is_listed(directory):
        return None
    try:
        lines = (directory / NAME).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return f"{NAME} cannot be read"
    listed = {name: digest for digest, _, name in (line.partition("  ") for line in lines)}
    there = {str(path.relative_to(directory)): path for path in _files(directory)}
    for name, digest in listed.items():
        if name not in there:
            return f"{name} is missing"
        if _digest(there[name]) != digest:
            return f"{name} is not what was written"
    unlisted = there.keys() - listed.keys()
    return f"{min(unlisted)} is not in {NAME}" if unlisted else None


def _list_of(directory: Path) -> str:
    return "".join(
        f"{_digest(path)}  {path.relative_to(directory)}\n" for path in _files(directory)
    )


def _files(directory: Path) -> list[Path]:
    own = (directory / NAME, directory / f".{NAME}.part")
    return sorted(p for p in directory.rglob("*") if p.is_file() and p not in own)


def _digest(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
