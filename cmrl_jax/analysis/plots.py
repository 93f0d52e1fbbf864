"""`train.py plot`: figures of one or more runs. matplotlib is an extra (`viz`).

From metrics.csv: success and return over env steps. From eval.json: the paper's bars and success
by adaptation episodes. From inspection.json, which `--inspect` takes from the last policy
checkpoint (inspection.py): routing and latents.
Seeds of one run are one group (run_set.py).
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cmrl_jax.analysis.inspection_figures import plot_latents, plot_routing
from cmrl_jax.analysis.inspection_file import read_inspection
from cmrl_jax.analysis.run_set import Runs, Series, band
from cmrl_jax.config.schema import ConfigError, as_config_error, call_envs
from cmrl_jax.evaluation.statistics import interquartile_mean
from cmrl_jax.storage.output_files import writable
from cmrl_jax.storage.run_groups import shown_names
from envs.figures import pyplot_for
from envs.outputs import save_figure, written_by


def _pyplot(needed_by: str = "plot") -> Any:
    return call_envs(lambda: pyplot_for(needed_by))


def _panels(pyplot: Any, runs: Runs, ylabel: str) -> tuple[Any, dict[str, Any]]:
    """A figure with one panel a task."""
    count = len(runs.tasks)
    figure, axes = pyplot.subplots(
        1, count, figsize=(3.4 * count, 3.2), sharex=True, sharey=True, squeeze=False
    )
    for task, axis in zip(runs.tasks, axes[0], strict=True):
        axis.set_title(task + (" (held out)" if runs.is_held_out(task) else ""))
    axes[0, 0].set_ylabel(ylabel)
    return figure, dict(zip(runs.tasks, axes[0], strict=True))


def _finish(
    pyplot: Any, figure: Any, axes: Sequence[Any], out: Path, command: str = "plot"
) -> Path:
    """One legend for all panels, below them; saved and closed."""
    labelled = {}
    for axis in axes:
        handles, labels = axis.get_legend_handles_labels()
        labelled |= dict(zip(labels, handles, strict=True))
    figure.tight_layout()
    columns = max(1, int(figure.get_figwidth() / 2.8))  # inches a label may take
    place: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.0)}
    figure.legend(labelled.values(), labelled.keys(), ncols=columns, fontsize=8, **place)
    with as_config_error():
        save_figure(figure, out, command, dpi=110, bbox_inches="tight")
    pyplot.close(figure)
    return out


def _draw_band(axis: Any, curves: Sequence[Series], color: str, style: str, label: str) -> None:
    if not curves:
        return
    steps, middle, low, high = band(curves)
    if not len(steps):  # at no step do all have a figure: no mean, each by itself
        for curve in curves:
            _draw_band(axis, [curve], color, style, label)
        return
    one = len(steps) == 1  # a line or an area of one point is not seen
    marker = "o" if one else None
    axis.plot(steps, middle, color=color, ls=style, lw=1.2, marker=marker, ms=4, label=label)
    if len(curves) > 1:
        axis.fill_between(steps, low, high, color=color, alpha=0.2, lw=3 if one else 0)


def plot_success(runs: Runs, out: Path) -> Path:
    """Success over env steps: training episodes at any and last step, evaluations as marks."""
    pyplot = _pyplot()
    figure, panels = _panels(pyplot, runs, "success rate")
    for index, group in enumerate(runs.groups):
        color = f"C{index}"
        for task, axis in panels.items():
            for rule, style in (("any", "-"), ("last", ":")):
                curves = runs.curves(group, f"train/{task}/success_{rule}")
                _draw_band(axis, curves, color, style, f"{group}, training, {rule} step")
            k = max(runs.config(group).eval.k)
            label = f"{group}, evaluation k = {k}, any step{runs.mark(group, task)}"
            shape = "x" if runs.holds_out(group, task) else "o"
            for curve in runs.curves(group, f"eval/{task}/k{k}/success_any"):
                axis.plot(*zip(*curve, strict=True), shape, color=color, ms=4, mfc="w", label=label)
            axis.set_xlabel("env steps")
            axis.set_ylim(-0.03, 1.03)
    return _finish(pyplot, figure, list(panels.values()), out)


def plot_returns(runs: Runs, out: Path) -> Path:
    """Return over env steps (the paper's Figure 5): training episodes, and evaluations of tests."""
    pyplot = _pyplot()
    figure, panels = _panels(pyplot, runs, "return")
    for index, group in enumerate(runs.groups):
        color = f"C{index}"
        for task, axis in panels.items():
            curves = runs.curves(group, f"train/{task}/return")
            _draw_band(axis, curves, color, "-", f"{group}, training")
            k = max(runs.config(group).eval.k)
            curves = runs.curves(group, f"eval/{task}/k{k}/return")
            label = f"{group}, evaluation k = {k}{runs.mark(group, task)}"
            style = ":" if runs.holds_out(group, task) else "--"
            _draw_band(axis, curves, color, style, label)
            axis.set_xlabel("env steps")
    return _finish(pyplot, figure, list(panels.values()), out)


def plot_bars(runs: Runs, out: Path) -> Path:
    """Final success per task, groups side by side (the paper's Figure 4); any step, last inside."""
    pyplot = _pyplot()
    figure, axis = pyplot.subplots(figsize=(1.8 * len(runs.tasks) + 2, 3.4))
    width = 0.8 / len(runs.groups)
    for index, group in enumerate(runs.groups):
        for place, task in enumerate(runs.tasks):
            results = runs.final(group, task)
            if not results:
                continue
            k = max(results[0])
            x = place + (index - (len(runs.groups) - 1) / 2) * width
            figures = [[r[k][f"success_{rule}"] for r in results] for rule in ("any", "last")]
            label = f"{group}, k = {k} (filled: last step){runs.mark(group, task)}"
            hatch = "////" if runs.holds_out(group, task) else None
            outline: dict[str, Any] = {"ec": f"C{index}", "fc": "none", "hatch": hatch}
            axis.bar(x, interquartile_mean(figures[0]), 0.9 * width, label=label, **outline)
            axis.bar(x, interquartile_mean(figures[1]), 0.9 * width, color=f"C{index}", alpha=0.45)
            axis.plot([x] * len(results), figures[0], ".", color="k", ms=4)  # the seeds
    axis.set_xticks(
        range(len(runs.tasks)),
        [t + ("\n(held out)" if runs.is_held_out(t) else "") for t in runs.tasks],
    )
    axis.set_ylabel("success rate")
    axis.set_ylim(0, 1.03)
    return _finish(pyplot, figure, [axis], out)


def plot_k_shot(runs: Runs, out: Path) -> Path:
    """Final success by number of adaptation episodes."""
    pyplot = _pyplot()
    figure, panels = _panels(pyplot, runs, "success rate, any step")
    for index, group in enumerate(runs.groups):
        for task, axis in panels.items():
            curves = [
                [(float(k), figures["success_any"]) for k, figures in curve.items()]
                for curve in runs.final(group, task)
            ]
            style = ":" if runs.holds_out(group, task) else "-"
            _draw_band(axis, curves, f"C{index}", style, group + runs.mark(group, task))
            axis.set_xlabel("adaptation episodes k")
            axis.set_ylim(-0.03, 1.03)
    return _finish(pyplot, figure, list(panels.values()), out)


@contextlib.contextmanager
def _pictures(pyplot: Any, out: Path) -> Iterator[None]:
    """Makes the directory that pictures go to, and reports one that refuses them."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with as_config_error():
            yield
    except OSError as error:
        cause = f"cannot write to {out}: {error.strerror}"
        raise ConfigError(cause, "give --out a directory you may write to") from error
    finally:
        pyplot.close("all")


def plot_learning(runs: Sequence[Path], out: Path) -> list[Path]:
    """Every figure that the runs' metrics and evaluations allow, as PNG in the directory `out`.

    Raises:
        ConfigError: matplotlib is missing, a run has no figures, or `out` cannot be written.
    """
    pyplot, loaded = _pyplot(), Runs(runs)
    with _pictures(pyplot, out):
        drawn = [
            plot_success(loaded, out / "success.png"),
            plot_returns(loaded, out / "returns.png"),
        ]
        if any(loaded.final(group, task) for group in loaded.groups for task in loaded.tasks):
            drawn.append(plot_bars(loaded, out / "bars.png"))
            drawn.append(plot_k_shot(loaded, out / "k_shot.png"))
    return drawn


def plot_inspections(runs: Sequence[Path], out: Path) -> list[Path]:
    """routing.png and z.png of the runs that were inspected, in the directory `out`.

    A line on standard error for each of the two that an inspected run has nothing to show in.

    Raises:
        ConfigError: matplotlib is missing, an inspection.json cannot be read, or `out` written.
    """
    pyplot, drawn = _pyplot(), []
    read = [(name, read_inspection(run)) for name, run in zip(shown_names(runs), runs, strict=True)]
    found = [(name, inspection) for name, inspection in read if inspection is not None]
    figures = (
        ("routing.png", plot_routing, "modules to route to", lambda x: x.routing),
        ("z.png", plot_latents, "latent z", lambda x: x.latents),
    )
    with _pictures(pyplot, out):
        for file, plot, part, part_of in figures:
            shown = []
            for name, inspection in found:
                if part_of(inspection) is not None:
                    shown.append((name, inspection))
                else:
                    print(f"{name} is not in {file}: its policy has no {part}", file=sys.stderr)
            if shown:
                drawn.append(plot(pyplot, shown, out / file))
    return drawn


def check_figure(path: Path, command: str, force: bool) -> None:
    """Fails before hours of episodes rather than after, at `plot_adaptation`.

    Args:
        command: whose figure it is to be.
        force: replace a file that is no such figure.

    Raises:
        ConfigError: matplotlib is not installed, has no such kind of picture, or the file cannot
            or may not be written.
    """
    figure = _pyplot("--figure").Figure()
    if path.suffix.lower().removeprefix(".") not in figure.canvas.get_supported_filetypes():
        raise ConfigError(f"--figure {path} has no ending of a picture", "give it one, as F.png")
    writable(path, "--figure", written_by(command), force)


def plot_adaptation(
    curves: Mapping[str, Mapping[Any, Mapping[str, float]]], task: str, out: Path
) -> Path:
    """Success against episodes of own experience, a line for each way to adapt (`finetune`).

    Args:
        curves: way -> number of episodes, or its text as in JSON -> figures.
    """
    pyplot = _pyplot()
    figure, axis = pyplot.subplots(figsize=(6, 3.6))
    for adapt, curve in curves.items():
        points = sorted((int(n), figures["success_any"]) for n, figures in curve.items())
        axis.plot(*zip(*points, strict=True), "o-", ms=4, lw=1.2, label=adapt)
    axis.set_xscale("symlog", linthresh=1)
    axis.axhline(0.8, color="k", lw=0.6, ls=":")
    axis.set_title(f"{task}: adapted from a policy that never saw it")
    axis.set_xlabel("episodes of own experience")
    axis.set_ylabel("success rate, any step")
    axis.set_ylim(-0.03, 1.03)
    return _finish(pyplot, figure, [axis], out, "finetune")
