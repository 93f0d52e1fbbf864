"""A request to end a run at the next border of an iteration."""

from __future__ import annotations


def is_interrupt(error: BaseException) -> bool:
    """Whether Ctrl-C is behind an error: in a host callback, as MuJoCo C has, jax wraps it."""
    return isinstance(error, KeyboardInterrupt) or KeyboardInterrupt.__name__ in str(error)


class Stop:
    """Set from any thread; the run saves, and can be resumed.

    Attributes:
        requested: whether it was.
    """

    def __init__(self) -> None:
        self.requested = False

    def request(self) -> None:
        """Asks for the stop."""
        self.requested = True
