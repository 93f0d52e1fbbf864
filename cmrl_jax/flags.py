"""Command-line parsing shared by all commands: two-line errors, kinds of values, output files.

Imports neither jax nor numpy, so that `--help` and a user's mistake are answered at once.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from cmrl_jax.config import ConfigError, suggest


class Parser(argparse.ArgumentParser):
    """argparse with our two-line errors in place of its usage text."""

    def error(self, message: str) -> NoReturn:
        raise ConfigError(message, f"see: {self.prog} --help")


def parse(parser: argparse.ArgumentParser, words: Sequence[str]) -> argparse.Namespace:
    """Parses all of `words`; the first that means nothing is an error with a suggestion."""
    args, unknown = parser.parse_known_args(words)
    if unknown:
        word = unknown[0].partition("=")[0]
        flags = [flag for flag in parser._option_string_actions if flag.startswith("--")]
        cure = f"{suggest(word, flags)}see: {parser.prog} --help"
        raise ConfigError(f"unknown argument '{word}'", cure)
    return args


def natural(text: str) -> int:
    """A whole number from 0, as an argparse type."""
    number = int(text)
    if number < 0:
        raise ValueError(text)
    return number


def counts(text: str) -> tuple[int, ...]:
    """Whole numbers from 0, comma separated, as an argparse type."""
    return tuple(natural(item) for item in text.split(","))


def names(text: str) -> tuple[str, ...]:
    """Words, comma separated, as an argparse type."""
    return tuple(item.strip() for item in text.split(",") if item.strip())


natural.__name__, counts.__name__, names.__name__ = "whole number", "list of counts", "list"


def shown(value: Any) -> str:
    """A value as a user would type it."""
    if isinstance(value, tuple):
        return ",".join(str(item) for item in value)
    return str(value).lower() if isinstance(value, bool) else str(value)


def writable(path: Path | None, flag: str = "--json") -> None:
    """Fails now rather than after an hour of figures.

    Raises:
        ConfigError: the file cannot be written.
    """
    if path is None:
        return
    try:
        existed = path.exists()
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("a", encoding="utf-8").close()
        if not existed:
            path.unlink()
    except OSError as error:
        cause = f"cannot write {path}: {error.strerror}"
        raise ConfigError(cause, f"give {flag} a file you may write to") from error
