"""Values as text: numbers of tables, durations, and what a user would type."""

from __future__ import annotations

from typing import Any

import numpy as np


def format_figure(value: Any) -> str:
    """A number (Python, numpy or jax scalar) as CSV text; None is empty.

    Integers are exact, floats the shortest text that reads back to the same float32.
    """
    if value is None:
        return ""
    number = np.asarray(value)
    if number.shape != () or number.dtype.kind not in "biuf":
        raise TypeError(f"a figure is one number, got {value!r}")
    if number.dtype.kind == "f":
        with np.errstate(over="ignore"):
            return str(np.float32(number))
    return str(int(number))


def format_duration(seconds: float) -> str:
    """`42s`, `3m07s`, `2h05m`; `?` where it is not known."""
    if not np.isfinite(seconds):
        return "?"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours}h{minutes:02d}m"
    return f"{minutes}m{rest:02d}s" if minutes else f"{rest}s"
