"""matplotlib, which is an extra, asked for in one place."""

from __future__ import annotations

import sys
from typing import Any


def pyplot_for(what: str) -> Any:
    """matplotlib's pyplot, drawing to files alone.

    Args:
        what: needs it, in words.

    Raises:
        ValueError: it is not installed (two lines: cause, cure).
    """
    try:
        import matplotlib

        # What a notebook, say, has chosen for its own figures stays as it is.
        if "matplotlib.pyplot" not in sys.modules:
            matplotlib.use("Agg")
        from matplotlib import pyplot
    except ImportError as error:
        cause = f"{what} needs matplotlib, which is not installed"
        raise ValueError(f"{cause}\npip install 'cmrl-jax[viz]'") from error
    return pyplot
