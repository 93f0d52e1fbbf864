"""Signals that ask a run to stop: at the next border of an iteration, or at once if asked twice.

Imports nothing heavy: the handlers are in place before jax is imported, so that a signal at any
moment leaves a run that `--resume` can go on with.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading

from cmrl_jax.stop import Stop

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopSignal(Stop):
    """Installed handlers; `requested` is set by the first signal.

    Python runs a handler only when its main thread comes back from a call, and a compile or an
    iteration is one call of up to a minute. So the signal's number goes down a pipe, which Python
    does at once, and a thread of our own reads it.

    A signal that was ignored when the process began stays so: that is what `nohup` asks for.
    SIGHUP never counts as the second request: a terminal that closes sends more than one.
    """

    def __init__(self) -> None:
        super().__init__()
        self._was_asked = False  # by SIGINT or SIGTERM
        self._read, self._write = os.pipe()
        os.set_blocking(self._write, False)
        wanted = [n for n in SIGNALS if signal.getsignal(n) is not signal.SIG_IGN]
        self._old = {number: signal.signal(number, lambda *_: None) for number in wanted}
        self._old_pipe = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        self._thread = threading.Thread(target=self._watch, name="stop-signal", daemon=True)
        self._thread.start()

    def restore(self) -> None:
        """Puts the handlers back that were there before."""
        for number, handler in self._old.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._old_pipe)
        os.close(self._write)
        self._thread.join()
        os.close(self._read)

    def _watch(self) -> None:
        while number := os.read(self._read, 1):
            if number[0] not in self._old:
                continue
            if self._was_asked and number[0] != signal.SIGHUP:
                os._exit(128 + number[0])  # what a shell reports of a process that a signal ended
            self._was_asked = self._was_asked or number[0] != signal.SIGHUP
            if self.requested:
                continue
            self.requested = True
            # Past Python's buffered streams, which the main thread may be in the middle of. The
            # terminal may be gone, and with it who would read this.
            with contextlib.suppress(OSError):
                os.write(2, b"stopping at the end of this iteration; once more stops at once\n")
