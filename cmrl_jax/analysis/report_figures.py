"""Figures of `train.py report`, by plotly: one panel a task, values under the pointer.

Colours stand for groups of runs (run_set.py) in every figure. What is text or grid has no colour
here: the page's style gives it one, light or dark.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cmrl_jax.analysis.inspection_figures import CIRCLE, row_name
from cmrl_jax.analysis.inspection_file import Inspection
from cmrl_jax.analysis.pca import principal_axes
from cmrl_jax.analysis.run_set import Runs, Series, band
from cmrl_jax.evaluation.statistics import wilson_interval
from cmrl_jax.registry import task_names
from cmrl_jax.storage.run_files import Adaptation, Evaluation

# Told apart by people who do not see all colours (Okabe and Ito 2008), on white and on black.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8B8B8B")
HEIGHT = 290  # pixels


def color(index: int) -> str:
    return COLORS[index % len(COLORS)]


def success_panel(go: Any, runs: Runs, task: str) -> Any:
    """Success over env steps: training at any step (line), last (dotted); evaluations (marks)."""
    figure = _figure(go, "env steps", "success rate", [-0.03, 1.03])
    for index, group in enumerate(runs.groups):
        for rule, dash in (("any", "solid"), ("last", "dot")):
            curves = runs.curves(group, f"train/{task}/success_{rule}")
            _add_band(figure, curves, color(index), dash, f"{group}: training, {rule} step")
        k = max(runs.config(group).eval.k)
        name = f"{group}: evaluation, k = {k}{runs.mark(group, task)}"
        for curve in runs.curves(group, f"eval/{task}/k{k}/success_any"):
            _add_marks(figure, curve, color(index), name, runs.holds_out(group, task))
    return figure


def return_panel(go: Any, runs: Runs, task: str) -> Any:
    """Return over env steps: training (line), evaluations (dashed; marks where there is one)."""
    figure = _figure(go, "env steps", "return")
    for index, group in enumerate(runs.groups):
        curves = runs.curves(group, f"train/{task}/return")
        _add_band(figure, curves, color(index), "solid", f"{group}: training")
        k = max(runs.config(group).eval.k)
        curves = runs.curves(group, f"eval/{task}/k{k}/return")
        name = f"{group}: evaluation, k = {k}{runs.mark(group, task)}"
        _add_band(figure, curves, color(index), "dash", name)
    return figure


def k_shot_panel(go: Any, runs: Runs, task: str) -> Any:
    """Final success at any step by adaptation episodes; of one run with Wilson's interval."""
    figure = _figure(go, "adaptation episodes k", "success rate, any step", [-0.03, 1.03])
    for index, group in enumerate(runs.groups):
        name = group + runs.mark(group, task)
        evaluations = [e for e in runs.evaluations_of(group) if task in e.tasks]
        if len(evaluations) == 1:
            _add_evaluation(figure, evaluations[0], task, color(index), name)
            continue
        curves = [
            [(float(k), figures["success_any"]) for k, figures in curve.items()]
            for curve in runs.final(group, task)
        ]
        _add_band(figure, curves, color(index), "solid", name)
    return figure


def files_panel(go: Any, evaluations: dict[str, Evaluation], task: str) -> Any:
    """Success by adaptation episodes of evaluations by name, each with Wilson's interval."""
    figure = _figure(go, "own episodes k", "success rate, any step", [-0.03, 1.03])
    for index, (name, evaluation) in enumerate(evaluations.items()):
        if task in evaluation.tasks:
            _add_evaluation(figure, evaluation, task, color(index), name)
    return figure


def finetune_panel(go: Any, adaptation: Adaptation) -> Any:
    """Success against own episodes, a line for each way to adapt."""
    figure = _figure(go, "own episodes", "success rate, any step", [-0.03, 1.03])
    for index, (way, curve) in enumerate(adaptation.curves.items()):
        points = [(float(n), figures["success_any"]) for n, figures in curve.items()]
        _add_band(figure, [points], color(index), "solid", way, mode="lines+markers")
    return figure


def routing_map(go: Any, inspection: Inspection) -> Any:
    """Mean weight of the actor's modules, task x (layer, module); white is the equal share."""
    usage = inspection.routing
    assert usage is not None  # the caller has looked
    tasks, layers, modules = usage.mean.shape
    columns = [f"{layer + 1}.{module + 1}" for layer, module in np.ndindex(layers, modules)]
    flat = lambda array: array.reshape(tasks, -1)
    figure = _figure(go, "layer.module", "", height=110 + 44 * tasks)
    figure.add_heatmap(
        z=flat(usage.mean),
        x=columns,
        y=[row_name(inspection, task) for task in inspection.tasks],
        customdata=np.stack([flat(usage.low), flat(usage.high)], -1),
        hovertemplate="%{y}<br>module %{x}: %{z:.2f}<br>its readers: %{customdata[0]:.2f} to "
        "%{customdata[1]:.2f}<extra></extra>",
        texttemplate="%{z:.2f}",
        colorscale="PuOr",
        zmin=0,
        zmid=1 / modules,
        zmax=max(1, 2 / modules),
        showscale=False,
        xgap=2,
        ygap=2,
    )
    figure.update_xaxes(type="category")
    figure.update_yaxes(autorange="reversed", automargin=True)
    return figure


def latents_scatter(go: Any, inspection: Inspection) -> Any:
    """z by its first two principal components, by task; the dashed circle holds 95 % of N(0, I)."""
    latents = inspection.latents
    assert latents is not None  # the caller has looked
    centre, axes, shares = principal_axes(latents.z.reshape(-1, latents.z.shape[-1]))
    project = lambda x: ((x - centre) @ axes.T).T
    figure = _figure(
        go,
        f"first component ({shares[0]:.0%} of z's variance)",
        f"second component ({shares[1]:.0%})",
        height=440,
    )
    for row, task in enumerate(inspection.tasks):
        style: dict[str, Any] = {"color": color(task_names().index(task))}
        name = row_name(inspection, task)
        hover = f"{name}<br>%{{x:.2f}}, %{{y:.2f}}<extra>z drawn</extra>"
        mean = hover.replace("z drawn", "posterior's mean")
        _add_points(figure, project(latents.z[row]), style | {"size": 4, "opacity": 0.5}, hover)
        _add_points(figure, project(latents.mean[row]), style | {"size": 9}, mean, name)
        if latents.text_mean is not None:
            sign = style | {"size": 14 + 4 * row, "symbol": "diamond-open", "line": {"width": 2}}
            text = hover.replace("z drawn", "text alone")
            _add_points(figure, project(latents.text_mean[row])[:, None], sign, text)
    if latents.kl is not None:  # without information bottleneck no prior is in force
        angle = np.linspace(0, 2 * np.pi, 100)
        circle = project(np.zeros(len(centre))) + CIRCLE * np.stack(
            [np.cos(angle), np.sin(angle)], 1
        )
        line = {"color": COLORS[-1], "dash": "dash", "width": 1}
        figure.add_scatter(
            x=circle[:, 0], y=circle[:, 1], mode="lines", line=line, hoverinfo="skip"
        )
    figure.update_yaxes(scaleanchor="x")
    return figure


def _figure(
    go: Any, x: str, y: str, y_range: Sequence[float] | None = None, height: int = HEIGHT
) -> Any:
    """An empty figure in the page's style, as wide as where it stands."""
    clear = "rgba(0,0,0,0)"
    figure = go.Figure()
    figure.update_layout(
        template="none",
        height=height,
        margin={"l": 52, "r": 12, "t": 10, "b": 44},
        paper_bgcolor=clear,
        plot_bgcolor=clear,
        showlegend=False,
        hovermode="closest",
        font={"family": "system-ui, sans-serif", "size": 12},
    )
    figure.update_xaxes(title=x, zeroline=False)
    figure.update_yaxes(title=y, zeroline=False, range=y_range)
    return figure


def _add_band(
    figure: Any,
    curves: Sequence[Series],
    shade: str,
    dash: str,
    name: str,
    mode: str = "lines",
) -> None:
    """The IQM of some curves and its 95 % interval; each by itself where they do not overlap."""
    if not curves:
        return
    steps, middle, low, high = band(curves)
    if not len(steps):
        for curve in curves:
            _add_band(figure, [curve], shade, dash, name, mode)
        return
    if len(curves) > 1:
        line: dict[str, Any] = {"width": 0}
        figure.add_scatter(x=steps, y=high, mode="lines", line=line, hoverinfo="skip")
        figure.add_scatter(
            x=steps,
            y=low,
            mode="lines",
            line=line,
            fill="tonexty",
            fillcolor=_faint(shade),
            hoverinfo="skip",
        )
    figure.add_scatter(
        x=steps,
        y=middle,
        mode=mode if len(steps) > 1 else "markers",  # a line of one point is not seen
        line={"color": shade, "dash": dash, "width": 1.6},
        customdata=np.stack([low, high], 1),
        name=name,
        hovertemplate="%{x:,}: %{y:.3~f}"
        + (" (%{customdata[0]:.3~f} to %{customdata[1]:.3~f})" if len(curves) > 1 else ""),
    )


def _add_marks(figure: Any, curve: Series, shade: str, name: str, is_held_out: bool) -> None:
    x, y = zip(*curve, strict=True)
    marker = {"color": shade, "size": 7, "symbol": "x-thin" if is_held_out else "circle-open"}
    marker["line"] = {"color": shade, "width": 1.5}
    template = "%{x:,}: %{y:.3~f}"
    figure.add_scatter(x=x, y=y, mode="markers", marker=marker, name=name, hovertemplate=template)


def _add_evaluation(figure: Any, evaluation: Evaluation, task: str, shade: str, name: str) -> None:
    """Success at any step by k, with Wilson's interval over goals where their number is known."""
    curve, goals = evaluation.tasks[task], evaluation.facts.get("goals")
    k, rates = list(curve), np.array([figures["success_any"] for figures in curve.values()])
    error = None
    if isinstance(goals, int) and goals > 0:
        ends = np.array([wilson_interval(rate, goals) for rate in rates])
        above, below = ends[:, 1] - rates, rates - ends[:, 0]
        error = {"array": above, "arrayminus": below, "thickness": 1.2, "width": 4}
    figure.add_scatter(
        x=k,
        y=rates,
        error_y=error,
        mode="lines+markers",
        line={"color": shade, "width": 1.6},
        name=name,
        hovertemplate="k = %{x}: %{y:.3~f}",
    )


def _add_points(
    figure: Any, xy: np.ndarray, marker: dict[str, Any], template: str, name: str = ""
) -> None:
    x, y = xy
    options: dict[str, Any] = {"marker": marker, "hovertemplate": template, "name": name}
    figure.add_scatter(x=x, y=y, mode="markers", **options)


def _faint(shade: str) -> str:
    red, green, blue = (int(shade[place : place + 2], 16) for place in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.2)"
