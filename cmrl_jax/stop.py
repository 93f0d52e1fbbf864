"""SIGINT and SIGTERM: stop at the next border of an iteration, or at once if asked twice.

Imports nothing heavy: the handlers are in place before jax is imported, so that a signal at any
moment leaves a run that `--resume` can go on with.
"""

from __future__ import annotations

import os
import signal
from types import FrameType


class StopSignal:
    """Installed handlers; `requested` is set by the first signal."""

    def __init__(self) -> None:
        self.requested = False
        self._old = {s: signal.signal(s, self._handle) for s in (signal.SIGINT, signal.SIGTERM)}

    def restore(self) -> None:
        """Puts the handlers back that were there before."""
        for number, handler in self._old.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        self.requested = True
        # A handler may interrupt a print: write past Python's buffered streams.
        os.write(2, b"stopping at the end of this iteration; once more stops at once\n")
