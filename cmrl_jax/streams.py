"""Standard output and error as a process may find them: closed, a pipe nobody reads, a full disk.

A command whose reader has left ends as quietly as any tool of the shell; training saves first
(`metrics.Console`). Light: the streams are put in order before anything else is imported.
"""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import sys
from collections.abc import Callable
from typing import IO, Any

READER_LEFT = (errno.EPIPE, errno.EIO)  # a pipe without a reader, a terminal that was closed


def open_streams() -> None:
    """Puts /dev/null where a standard stream is closed (`>&-`).

    Else the next file that is opened gets its number, and whatever a library prints to descriptor
    2 is written into metrics.csv.
    """
    for number, name in ((0, "stdin"), (1, "stdout"), (2, "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r+" if number == 0 else "w", encoding="utf-8"))


def failure(stream: IO[str]) -> OSError | None:
    """What keeps a stream from being written; the stream is then let go of (`let_go`)."""
    try:
        stream.flush()
    except OSError as error:
        let_go(stream)
        return error
    return None


def let_go(stream: Any) -> None:
    """Sends the rest of a stream nowhere: what Python still holds of it fails at its exit, too."""
    with contextlib.suppress(OSError, ValueError, AttributeError):  # not every stream is a file
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def to_stderr(*lines: str) -> None:
    """Lines on standard error, if it can be written."""
    with contextlib.suppress(OSError):
        print("\n".join(lines), file=sys.stderr, flush=True)
    failure(sys.stderr)


def exit_code(error: OSError) -> int:
    """The exit code of a command whose output failed.

    128 + SIGPIPE for a reader that left, which is what the shell shows of `cat` there; else 2,
    after a line of cause and one of cure.
    """
    if error.errno in READER_LEFT:
        return 128 + signal.SIGPIPE
    to_stderr(
        f"error: cannot write the output: {error.strerror}",
        "fix: send the output to a file or a terminal that can be written",
    )
    return 2


class Output:
    """A text stream that remembers in `error` what first kept it from being written.

    Args:
        on_error: is called at the first failure, and nothing is raised, then or later; without it
            every failure is raised.
    """

    def __init__(self, stream: IO[str], on_error: Callable[[], None] | None = None):
        self.error: OSError | None = None
        self._stream, self._on_error = stream, on_error

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        self._try(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        self._try(self._stream.flush)

    def _try(self, action: Callable[[], object]) -> None:
        if self.error is not None and self._on_error is not None:
            return
        try:
            action()
        except OSError as error:
            self.error = self.error or error
            if self._on_error is None:
                raise
            let_go(self._stream)
            self._on_error()
