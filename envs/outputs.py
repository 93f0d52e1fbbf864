"""Output files that a user named: which may be written, and how. The standard library only.

A file says which command wrote it, in its JSON or in its picture's metadata (`written_by`). That
command may replace it; what another command, program or person wrote stays, unless the user adds
`--force`. Files appear whole: a kill leaves the old one or the new one, never a part.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import secrets
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from envs.command_line import brief

FORCE_HELP = "replace output files that this command did not write"
_SEARCHED = 2**16  # bytes at either end of a file in which its writer's name is looked for


def written_by(command: str) -> str:
    """What a file says that `command` wrote, as `written by cmrl_jax eval`."""
    return f"written by cmrl_jax {command}"


def check_output(path: Path, flag: str, mark: str, force: bool = False) -> None:
    """Whether a command may write a file; asked before its work rather than after an hour of it.

    Leaves nothing behind, so that a command which is refused has made no directory. What is no
    regular file (a pipe, /dev/null) holds nothing.

    Args:
        flag: what the user named the file with.
        mark: what the command's own files contain, as `written_by(command)`.
        force: replace any file.

    Raises:
        ValueError: it may not, or cannot (two lines: cause, cure).
    """
    try:
        target = Path(os.path.realpath(path))
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if target.exists() and not os.access(target, os.W_OK):  # a rename would not ask
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        if not _is_special(path):
            _try(target)
        is_foreign = path.is_file() and path.stat().st_size > 0 and not _contains(path, mark)
    except OSError as error:
        raise ValueError(_refusal(path, flag, error)) from error
    if is_foreign and not force:
        cause = f"{brief(path)} is there, and this command did not write it"
        raise ValueError(f"{cause}\ngive {flag} another place, or replace it with --force")


@contextlib.contextmanager
def replacing(path: Path, flag: str = "--out") -> Iterator[Path]:
    """A file to write to that takes the place of `path` at the end, unless there was an error.

    Raises:
        ValueError: the file cannot be written (two lines: cause, cure).
    """
    try:
        if _is_special(path):
            yield path
            return
        target = in_directory(path)
        part = _part_of(target)
        try:
            yield part
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise ValueError(_refusal(path, flag, error)) from error


def write_json(path: Path, command: str, result: Mapping[str, Any], flag: str = "--json") -> None:
    """Writes a command's figures as JSON that says who wrote it.

    Raises:
        ValueError: the file cannot be written (two lines: cause, cure).
    """
    text = json.dumps({"origin": written_by(command)} | dict(result), indent=2) + "\n"
    with replacing(path, flag) as part:
        part.write_text(text, encoding="utf-8")


def save_figure(figure: Any, path: Path, command: str, flag: str = "--out", **options: Any) -> None:
    """`figure.savefig` of matplotlib, with metadata that says which command drew it.

    Raises:
        ValueError: the file cannot be written (two lines: cause, cure).
    """
    key = "Software" if path.suffix.lower() == ".png" else "Creator"
    with replacing(path, flag) as part:
        figure.savefig(part, metadata={key: written_by(command)}, **options)


def in_directory(path: Path) -> Path:
    """`path` with its links followed and its directory made."""
    target = Path(os.path.realpath(path))
    target.parent.mkdir(parents=True, exist_ok=True)
    return target


def _try(target: Path) -> None:
    """Makes and removes a file beside the one to be, and the directories that it needs."""
    missing = [folder for folder in target.parents if not folder.exists()]
    try:
        part = _part_of(in_directory(target))
        part.touch()
        part.unlink()
        with contextlib.suppress(FileNotFoundError):
            os.stat(target)  # its own name may be too long
    finally:
        for folder in missing:
            with contextlib.suppress(OSError):
                folder.rmdir()


def _is_special(path: Path) -> bool:
    """A pipe, /dev/stdout: written to as it is."""
    return path.exists() and not path.is_file()


def _part_of(path: Path) -> Path:
    """Beside the file itself, not its link; as short as a long name needs, with its ending."""
    name = f".part-{secrets.token_hex(4)}{path.suffix}"  # no process number: containers share files
    return Path(os.path.realpath(path)).with_name(name)


def _contains(path: Path, mark: str) -> bool:
    with path.open("rb") as file:
        head = file.read(_SEARCHED)
        file.seek(max(0, path.stat().st_size - _SEARCHED))
        return mark.encode() in head or mark.encode() in file.read()


def _refusal(path: Path, flag: str, error: OSError) -> str:
    cause = f"cannot write {brief(path)}: {error.strerror or error}"
    return f"{cause}\ngive {flag} a place you may write to"
