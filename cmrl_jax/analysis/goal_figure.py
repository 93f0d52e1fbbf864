"""The figure of `train.py goals --figure`: cosines between sentences, and their PCA."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cmrl_jax.analysis.pca import principal_axes
from cmrl_jax.config.schema import ConfigError, as_config_error, call_envs
from cmrl_jax.text.goal_builder import all_vectors, task_cosines
from cmrl_jax.text.goals import GoalTable
from envs.figures import pyplot_for
from envs.outputs import save_figure


def draw(table: GoalTable, out: Path) -> None:
    """Draws a table as a picture: the heat map of all sentences by task, and a PCA.

    Raises:
        ConfigError: matplotlib is not installed, or `out` cannot be written.
    """
    pyplot = call_envs(lambda: pyplot_for("--figure"))
    every = all_vectors(table)
    tasks, count, _ = every.shape
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(12.5, 5.4), layout="constrained")

    flat = every.reshape(tasks * count, -1)
    image = left.imshow(flat @ flat.T, cmap="viridis", vmin=0, vmax=1)
    centres = count * np.arange(tasks) + (count - 1) / 2
    for edge in count * np.arange(1, tasks) - 0.5:
        left.axhline(edge, color="white", lw=1.5)
        left.axvline(edge, color="white", lw=1.5)
    for row, values in zip(centres, task_cosines(every), strict=True):
        for column, value in zip(centres, values, strict=True):
            box = {"facecolor": "white", "edgecolor": "none", "pad": 1.5}
            left.text(column, row, f"{value:.2f}", ha="center", va="center", bbox=box)
    left.set_xticks(centres, table.tasks)
    left.set_yticks(centres, table.tasks, rotation=90, va="center")
    left.tick_params(length=0)
    left.set_title(f"cosines of {count} sentences a task; numbers: mean over pairs")
    figure.colorbar(image, ax=left, shrink=0.85)

    centre, axes, shares = principal_axes(flat)
    points = ((flat - centre) @ axes.T).reshape(tasks, count, 2)
    trained = table.vectors.shape[1]
    for index, task in enumerate(table.tasks):
        color = f"C{index}"
        right.scatter(*points[index, :trained].T, color=color, s=36, label=task)
        right.scatter(*points[index, trained:].T, s=36, facecolors="none", edgecolors=color)
    right.scatter([], [], s=36, facecolors="none", edgecolors="k", label="held-out sentence")
    right.set_xlabel(f"first component ({shares[0]:.0%} of the variance)")
    right.set_ylabel(f"second component ({shares[1]:.0%})")
    right.set_title(f"PCA of {table.encoder}")
    right.legend(fontsize=9)
    try:
        with as_config_error():
            save_figure(figure, out, "goals", "--figure", dpi=110)
    except ConfigError:
        raise
    except ValueError as error:  # an ending that is no picture's
        raise ConfigError(f"cannot write {out}: {error}", "give --figure a .png") from error
    finally:
        pyplot.close(figure)
