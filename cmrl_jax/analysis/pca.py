"""Principal component analysis, for figures."""

from __future__ import annotations

import numpy as np


def principal_axes(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The two directions in which points vary most; `(x - centre) @ axes.T` projects a point.

    Args:
        rows: points (row, dim), at least two.

    Returns:
        The points' centre (dim,), the axes (2, dim), and their shares of the variance (2,). Where
        points lie on a line, or all in one place, what is missing has share 0.
    """
    centre = rows.mean(0)
    _, values, axes = np.linalg.svd(rows - centre, full_matrices=False)
    variance = values**2
    missing = max(0, 2 - len(axes))
    axes = np.pad(axes, ((0, missing), (0, 0)))[:2]
    variance = np.pad(variance, (0, missing))
    return centre, axes, variance[:2] / max(variance.sum(), np.finfo(float).tiny)
