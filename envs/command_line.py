"""What every command line shares: errors of two lines, whole numbers in bounds, paths.

A path or a number that a user typed is judged here and nowhere else. `cmrl_jax` uses it too; it
imports nothing heavy, so that a mistake is answered at once. Every mistake is a ValueError of two
lines, cause and cure.
"""

from __future__ import annotations

import argparse
import difflib
import os
import stat
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Literal, NoReturn

LARGEST = 2**31 - 1
"""Whole numbers reach the device as int32: a larger one would come out as another."""

_CURE = "give one of names up to 255 bytes, without a loop of links, in folders that you may search"


class Parser(argparse.ArgumentParser):
    """argparse with a ValueError (cause, cure) in place of its usage text."""

    def error(self, message: str) -> NoReturn:
        """Raises the mistake; its second line is the cure, where a type of ours wrote one."""
        cause, _, cure = message.partition("\n")
        raise ValueError(f"{cause}\n{cure or f'see: {self.prog} --help'}")


def run(command: Callable[[], None]) -> int:
    """Runs a command; a mistake of the user is printed and exit code 2, other errors go on."""
    try:
        command()
    except ValueError as error:
        cause, _, cure = str(error).partition("\n")
        if not cure:  # not one of ours
            raise
        print(f"error: {cause}\nfix: {cure}", file=sys.stderr)
        return 2
    return 0


def suggest(word: str, valid: Iterable[str]) -> str:
    """`did you mean 'x'? ` where something is close, else nothing."""
    close = difflib.get_close_matches(word, list(valid), n=1)
    return f"did you mean '{close[0]}'? " if close else ""


def brief(text: str | Path) -> str:
    """What a user typed, on one line, printable and not longer than can be read."""
    text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in str(text))
    return text if len(text) <= 100 else f"{text[:60]} ... {text[-20:]} ({len(text)} letters)"


def whole(
    low: int = 0, high: int = LARGEST, reason: str = "it is kept in 32 bits"
) -> Callable[[str], int]:
    """An argparse type: whole numbers with low <= number <= high; `reason` explains the bounds."""

    def number_of(text: str) -> int:
        try:
            number = int(text)
        except ValueError:
            number = None
        if number is None or not low <= number <= high:
            raise argparse.ArgumentTypeError(
                f"{brief(text) or "''"} is no whole number from {low} to {high}\n"
                f"give one in this range: {reason}"
            )
        return number

    return number_of


def typed_path(text: str) -> Path:
    """A path as an argparse type; whether something lies there is another question."""
    try:
        what_is(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return Path(text)


def what_is(path: str | Path) -> Literal["file", "directory", "nothing"]:
    """What lies at a path, links followed; `file` is whatever is no directory.

    Raises:
        ValueError: the system cannot follow it, as a name too long or a folder it may not search.
    """
    try:
        mode = os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return "nothing"
    except (OSError, ValueError) as error:  # ValueError: a NUL character
        reason = error.strerror if isinstance(error, OSError) else error
        cause = f"the path {brief(path)} cannot be followed: {reason}"
        raise ValueError(f"{cause}\n{_CURE}") from error
    return "directory" if stat.S_ISDIR(mode) else "file"


def make_directory(path: Path, flag: str) -> None:
    """Makes a directory that is to be written to.

    Raises:
        ValueError: it cannot be made, or not be written to.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        reason = None if os.access(path, os.W_OK | os.X_OK) else "Permission denied"
    except OSError as error:
        reason = error.strerror
    if reason:
        cause = f"cannot write to {brief(path)}: {reason}"
        raise ValueError(f"{cause}\ngive {flag} another directory")
