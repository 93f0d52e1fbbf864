"""`train.py plot`: figures of runs from their metrics.csv. matplotlib is an extra (`viz`)."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from cmrl_jax.config import ConfigError
from cmrl_jax.config_io import read_yaml, resolve

Series = list[tuple[float, float]]


def read_metrics(run: Path) -> list[dict[str, str]]:
    """Rows of a run's metrics.csv, as text.

    Raises:
        ConfigError: there is no such file, or it has no row.
    """
    path = run / "metrics.csv"
    if not path.is_file():
        raise ConfigError(f"{path} does not exist", "give --run a directory that holds a run")
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    if not rows:
        raise ConfigError(f"{path} has no row yet", "let the run finish an iteration first")
    return rows


def series(rows: list[dict[str, str]], column: str) -> Series:
    """(env steps, figure) wherever the column was filled."""
    return [(float(row["env_steps"]), float(row[column])) for row in rows if row.get(column)]


def plot_success(run: Path, out: Path) -> None:
    """Success per task over env steps: one panel a task, training episodes and evaluations.

    Raises:
        ConfigError: matplotlib is not installed, or the run has no figures.
    """
    try:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot
    except ImportError as error:
        cure = "pip install 'cmrl-jax[viz]'"
        raise ConfigError("plot needs matplotlib, which is not installed", cure) from error
    rows = read_metrics(run)
    config = resolve(*read_yaml(run / "config.yaml"))
    tasks = config.tasks.train + config.tasks.test
    figure, axes = pyplot.subplots(1, len(tasks), figsize=(3.4 * len(tasks), 3.2), sharey=True)
    panels: list[Any] = [axes] if len(tasks) == 1 else list(axes)
    for task, axis in zip(tasks, panels, strict=True):
        for rule, color in (("any", "tab:blue"), ("last", "tab:orange")):
            points = series(rows, f"train/{task}/success_{rule}")
            if points:
                axis.plot(
                    *zip(*points, strict=True), color=color, lw=1, label=f"training, {rule} step"
                )
        for k, marker in zip(config.eval.k, "os^Dv", strict=False):
            points = series(rows, f"eval/{task}/k{k}/success_any")
            if points:
                label = f"evaluation k = {k}, any step"
                axis.plot(*zip(*points, strict=True), f"k{marker}", ms=4, mfc="none", label=label)
        axis.set_title(task + ("" if task in config.tasks.train else " (held out)"))
        axis.set_xlabel("env steps")
        axis.set_ylim(-0.03, 1.03)
    panels[0].set_ylabel("success rate")
    labelled = {}
    for axis in panels:
        handles, labels = axis.get_legend_handles_labels()
        labelled |= dict(zip(labels, handles, strict=True))
    figure.tight_layout(rect=(0, 0.08, 1, 1))
    figure.legend(labelled.values(), labelled.keys(), loc="lower center", ncols=5, fontsize=8)
    figure.savefig(out, dpi=110)
    pyplot.close(figure)
