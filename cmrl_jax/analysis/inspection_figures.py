"""Figures of `inspection.json`: modules by task as a heat map, and z by principal components.

Both keep to a scale on which nothing looks like nothing: weights are coloured from 0 to 1 with the
equal share in white, and z is drawn beside the prior's 95 % circle, so that a posterior that
collapsed to N(0, I) fills it and reads so.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cmrl_jax.analysis.inspection_file import Inspection, Latents
from cmrl_jax.analysis.pca import principal_axes
from cmrl_jax.registry import task_names
from envs.outputs import save_figure

COLLAPSED = 0.1  # nats; below it on every task z is called N(0, I)
CIRCLE = np.sqrt(-2 * np.log(0.05))  # radius that holds 95 % of a plane's standard normal
COLUMNS = 3  # panels of z in a row
DPI = 150

Panels = Sequence[tuple[str, Inspection]]  # name of a run, and what it was found to do


def _title(name: str, inspection: Inspection, shared: str) -> str:
    """A panel's title, with the episodes that it shows where they are not those of all panels."""
    title = f"{name}, {inspection.facts['env_steps']:,} env steps"
    return title if shared else f"{title}\n{_episodes_of(inspection)}"


def row_name(inspection: Inspection, task: str) -> str:
    return task + (" (held out)" if inspection.is_held_out(task) else "")


def _episodes_of(inspection: Inspection) -> str:
    facts = inspection.facts
    count = facts["goals"] * facts["draws"]
    return f"evaluation episodes, k = {facts['k']}, {count} a task on '{facts['goal_set']}' goals"


def _episodes(panels: Panels) -> str:
    """The episodes that all panels show; nothing where they differ."""
    found = {_episodes_of(inspection) for _, inspection in panels}
    return found.pop() if len(found) == 1 else ""


def plot_routing(pyplot: Any, panels: Panels, out: Path) -> Path:
    """Mean routing weights of the actor, task x (layer, module), a panel a run.

    Args:
        panels: all with routing.
    """
    shapes = [x.routing.mean.shape for _, x in panels if x.routing is not None]
    width = 3.6 + 0.75 * max(layers * modules for _, layers, modules in shapes)
    height = 1.05 + sum(1.15 + 0.42 * tasks for tasks, _, _ in shapes)
    figure, axes = pyplot.subplots(
        len(shapes), 1, figsize=(width, height), squeeze=False, layout="constrained"
    )
    episodes = _episodes(panels)
    for axis, (name, inspection) in zip(axes[:, 0], panels, strict=True):
        _heat_map(figure, axis, inspection)
        axis.set_title(_title(name, inspection, episodes), fontsize=10, pad=20)
    what = "mean weight with which each module of the actor is read (least to most of its readers)"
    figure.suptitle(f"{what}\n{episodes}".strip(), fontsize=9)
    save_figure(figure, out, "plot", dpi=DPI)
    pyplot.close(figure)
    return out


def _heat_map(figure: Any, axis: Any, inspection: Inspection) -> None:
    from matplotlib.colors import TwoSlopeNorm

    usage, gap = inspection.routing, 0.25
    assert usage is not None  # the caller has looked
    tasks, layers, modules = usage.mean.shape
    # Of one module the equal share is 1, and white is still within the scale.
    norm, mesh, ticks = TwoSlopeNorm(1 / modules, 0, max(1, 2 / modules)), None, []
    for layer in range(layers):
        left = layer * (modules + gap)
        edges = left + np.arange(modules + 1), np.arange(tasks + 1)
        shown = usage.mean[:, layer]
        mesh = axis.pcolormesh(*edges, shown, cmap="PuOr", norm=norm, ec="white", lw=1.5)
        for task, module in np.ndindex(tasks, modules):
            cell, value = (task, layer, module), shown[task, module]
            style: dict[str, Any] = {"ha": "center", "va": "center"}
            style["color"] = "white" if abs(norm(value) - 0.5) > 0.27 else "black"
            x, y, several = left + module + 0.5, task + 0.5, layer + 1 < layers
            axis.text(x, y - 0.14 * several, f"{value:.2f}", fontsize=9, **style)
            if several:
                spread = f"{usage.low[cell]:.2f} to {usage.high[cell]:.2f}"
                axis.text(x, y + 0.26, spread, fontsize=6.5, **style)
        reader = f"layer {layer + 2}" if layer + 1 < layers else "the output"
        head = f"layer {layer + 1}, read by {reader}"
        axis.text(left + modules / 2, -0.1, head, ha="center", va="bottom", fontsize=8)
        ticks += list(left + np.arange(modules) + 0.5)
    axis.set_xlim(0, layers * (modules + gap) - gap)
    axis.set_ylim(tasks, 0)
    axis.set_xticks(ticks, [f"{n % modules + 1}" for n in range(len(ticks))], fontsize=8)
    axis.set_xlabel("module", fontsize=8)
    names = [row_name(inspection, task) for task in inspection.tasks]
    axis.set_yticks(np.arange(tasks) + 0.5, names, fontsize=9)
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)
    bar = figure.colorbar(mesh, ax=axis, pad=0.02, aspect=14)
    bar.set_ticks([0, 1 / modules, 1], labels=["0", f"1/{modules} (equal)", "1"], fontsize=8)
    bar.outline.set_visible(False)


def between_tasks(z: np.ndarray) -> tuple[float, float]:
    """The share of the variance of z (task, run, latent) that lies between tasks, and by chance.

    Chance is what draws from one distribution for all tasks have on average: the means of finitely
    many differ too.
    """
    tasks, runs, _ = z.shape
    centre = z.mean((0, 1))
    total = np.square(z - centre).sum()
    between = runs * np.square(z.mean(1) - centre).sum()
    return float(between / max(total, np.finfo(float).tiny)), (tasks - 1) / (tasks * runs - 1)


def verdict(latents: Latents) -> str:
    """How far z is from the prior, and how much of it tells tasks apart."""
    share, chance = between_tasks(latents.z)
    if latents.kl is None:
        distance = "z is the posterior's mean, without information bottleneck"
    elif latents.kl.max() < COLLAPSED:
        distance = f"collapsed: at most {latents.kl.max():.1g} nats from N(0, I) on every task"
    else:
        distance = f"{latents.kl.min():.2f} to {latents.kl.max():.2f} nats from N(0, I)"
    return f"{distance}\n{share:.0%} of z's variance lies between tasks (by chance {chance:.0%})"


def plot_latents(pyplot: Any, panels: Panels, out: Path) -> Path:
    """z by its first two principal components, coloured by task, a panel a run.

    Args:
        panels: all with latents.
    """
    rows, columns = -(-len(panels) // COLUMNS), min(COLUMNS, len(panels))
    cell, side = np.array([4.7, 5.9]), 3.7  # inches: legends lie outside the axes, below them
    size, episodes = cell * (columns, rows) + (0, 0.3), _episodes(panels)
    figure = pyplot.figure(figsize=size)
    for index, (name, inspection) in enumerate(panels):
        row, column = divmod(index, COLUMNS)
        corner = cell * (column, rows - 1 - row) + (0.7, 1.35)
        axis = figure.add_axes((*(corner / size), *(side / size)))
        _latent_panel(axis, inspection)
        title = _title(name, inspection, episodes)
        axis.set_title(title, fontsize=10, fontweight="bold", pad=34)
    of = f"latent z of {episodes}" if episodes else "latent z"
    figure.suptitle(of, fontsize=9, y=1 - 0.1 / size[1], va="top")
    save_figure(figure, out, "plot", dpi=DPI)
    pyplot.close(figure)
    return out


def _latent_panel(axis: Any, inspection: Inspection) -> None:
    latents, k = inspection.latents, inspection.facts["k"]
    assert latents is not None  # the caller has looked
    centre, axes, shares = principal_axes(latents.z.reshape(-1, latents.z.shape[-1]))
    project = lambda x: ((x - centre) @ axes.T).T
    for row, task in enumerate(inspection.tasks):
        color, label = f"C{task_names().index(task)}", row_name(inspection, task)
        if latents.kl is not None:
            label += f": {latents.kl[row]:.2f}"
        if latents.text_kl is not None:
            label += f" ({latents.text_kl[row]:.2f})"
        axis.scatter(*project(latents.z[row]), s=10, color=color, alpha=0.5, lw=0)
        axis.scatter(*project(latents.mean[row]), s=32, color=color, ec="k", lw=0.5, label=label)
        if latents.text_mean is not None:
            text = project(latents.text_mean[row])
            nested = 70 + 45 * (len(inspection.tasks) - row)  # all are seen where they coincide
            axis.scatter(*text, s=nested, marker="D", fc="none", ec=color, lw=1.6, zorder=3)
    gray = {"color": "0.7", "ls": ""}
    axis.plot([], [], ".", ms=5, label="z drawn", **gray)
    axis.plot([], [], "o", ms=6, mec="k", mew=0.5, label=f"posterior's mean, k = {k}", **gray)
    if latents.text_mean is not None:
        axis.plot([], [], "D", ms=8, mfc="none", label="text alone, k = 0", **gray)
    if latents.kl is not None:  # without information bottleneck no prior is in force
        angle = np.linspace(0, 2 * np.pi, 200)
        origin = project(np.zeros(len(centre)))
        circle = origin + CIRCLE * np.stack([np.cos(angle), np.sin(angle)], 1)
        axis.plot(*circle.T, color="0.4", lw=1, ls="--", label="95 % of N(0, I)")

    low, high = np.array([axis.dataLim.min, axis.dataLim.max])
    middle, half = (low + high) / 2, 0.55 * (high - low).max()
    axis.set_xlim(middle[0] - half, middle[0] + half)
    axis.set_ylim(middle[1] - half, middle[1] + half)
    axis.set_aspect("equal")
    axis.set_xlabel(f"first component ({shares[0]:.0%} of z's variance)", fontsize=9)
    axis.set_ylabel(f"second component ({shares[1]:.0%})", fontsize=9)
    axis.tick_params(labelsize=8)
    axis.text(
        0.5, 1.015, verdict(latents), transform=axis.transAxes, ha="center", va="bottom", fontsize=9
    )
    nats = "" if latents.kl is None else "nats of the posterior over N(0, I)"
    axis.legend(
        title=nats + (" (of the text alone)" if latents.text_kl is not None else ""),
        title_fontsize=8,
        fontsize=7.5,
        ncols=2,
        columnspacing=1.2,
        loc="upper center",
        bbox_to_anchor=(0.5, -0.13),
        frameon=False,
    )
