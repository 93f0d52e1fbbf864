"""`train.py report`: runs as one web page that needs no network: what was run, and what it gave.

plotly (extra `viz`) draws the figures and is written into the page, which is most of its size. Text
of users (names, sentences, paths) is escaped.
"""

from __future__ import annotations

import base64
import html
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from cmrl_jax.analysis import report_figures as figures
from cmrl_jax.analysis.inspection_figures import verdict
from cmrl_jax.analysis.inspection_file import Inspection, read_inspection
from cmrl_jax.analysis.run_set import Runs
from cmrl_jax.commands import quoted, shown
from cmrl_jax.config.extras import require_extra
from cmrl_jax.config.presets import preset_of
from cmrl_jax.config.schema import call_envs
from cmrl_jax.evaluation.options import EvalOptions
from cmrl_jax.evaluation.statistics import interquartile_mean, seeds_band, wilson_interval
from cmrl_jax.formats import format_duration
from cmrl_jax.places import DATA
from cmrl_jax.registry import task_names
from cmrl_jax.storage.documents import is_there, read_json
from cmrl_jax.storage.run_files import (
    Adaptation,
    Evaluation,
    read_adaptation,
    read_evaluation,
)
from cmrl_jax.storage.run_groups import shown_names
from cmrl_jax.training.films import sheets_of
from envs.outputs import replacing, written_by

VERSIONS = "versions.json"
Presets = Mapping[Path, tuple[str, dict[str, Any]]]  # of each run: see `preset_of`


@dataclass(frozen=True)
class Files:
    """What lies beside the runs: by name, what `eval --json` and `finetune --json` wrote."""

    evaluations: dict[str, Evaluation]
    adaptations: dict[str, Adaptation]


def write_report(runs: Sequence[Path], files: Sequence[Path], out: Path) -> Path:
    """One page of some runs, and of further evaluations of their policies.

    Args:
        files: what `eval --json` or `finetune --json` wrote.

    Raises:
        ConfigError: plotly is missing, a file is missing or damaged, or `out` cannot be written.
    """
    go, script = _plotly()
    found = _read(files)  # first: a file that was mistyped is the user's likeliest mistake
    page = "".join(_page(go, Runs(runs), runs, found))
    template = Template((DATA / "report.html").read_text(encoding="utf-8"))
    title = html.escape(", ".join(shown_names(runs)))
    text = template.substitute(mark=written_by("report"), title=title, plotly=script, body=page)

    def write() -> None:
        with replacing(out) as part:
            part.write_text(text, encoding="utf-8")

    call_envs(write)
    return out


def _plotly() -> tuple[Any, str]:
    """plotly's figures, and its JavaScript."""
    require_extra("report")
    import plotly.graph_objects as go
    from plotly.offline import get_plotlyjs

    return go, get_plotlyjs()


def _read(files: Sequence[Path]) -> Files:
    found = Files({}, {})
    names = [f"{path.parent.name}/{path.stem}" for path in files]
    for short, path in zip(names, files, strict=True):
        name = str(path.with_suffix("")) if names.count(short) > 1 else short
        if "curves" in read_json(path, "give a file that eval --json or finetune --json wrote"):
            found.adaptations[name] = read_adaptation(path)
        else:
            found.evaluations[name] = read_evaluation(path)
    return found


def _page(go: Any, runs: Runs, paths: Sequence[Path], files: Files) -> Iterable[str]:
    """The page's sections, those that there is something to show for."""
    presets = {path: preset_of(runs.configs[path]) for path in paths}
    yield _section("What was run", _run_table(runs, presets))
    if len(runs.groups) > 1:
        yield _legend(runs.groups)
    yield _section("Success over training", _panels(go, runs, figures.success_panel), _SUCCESS)
    yield _section("Return over training", _panels(go, runs, figures.return_panel))
    if any(runs.final(group, task) for group in runs.groups for task in runs.tasks):
        panels = _panels(go, runs, figures.k_shot_panel)
        yield _section("Final evaluation", panels + _final_table(runs), _FINAL)
    yield from _file_sections(go, files)
    yield from _inspections(go, paths)
    yield from _films(paths)
    yield _section("To do it again", _commands(runs, presets))


def _section(title: str, body: str, note: str = "") -> str:
    told = f"<p class=note>{note}</p>" if note else ""
    return f"<section><h2>{html.escape(title)}</h2>{told}{body}</section>\n"


def _run_table(runs: Runs, presets: Presets) -> str:
    head = ["run", "configuration", "seed", "env steps", "time", "device", "commit, date", "faults"]
    lines = []
    for name, (path, (preset, changed)) in zip(
        shown_names(list(presets)), presets.items(), strict=True
    ):
        config, rows = runs.configs[path], runs.rows[path]
        keys = (f"{key}: {shown(value)}" for key, value in changed.items() if key != "seed")
        flags = "<br>".join(map(html.escape, keys))
        made = _versions(path)
        commit = str(made.get("commit") or "not recorded")[:8]
        packages = ", ".join(f"{p} {made[p]}" for p in ("jax", "mujoco", "python") if p in made)
        lines.append(
            [
                html.escape(name),
                html.escape(preset) + (f"<div class=small>{flags}</div>" if flags else ""),
                str(config.seed),
                f"{rows[-1]['env_steps']:,.0f}",
                format_duration(rows[-1].get("wall_s", float("nan"))),
                html.escape(f"{made.get('device', '?')} x {made.get('device_count', '?')}, ")
                + html.escape(f"{made.get('cpu_count', '?')} processors")
                + f"<div class=small>{html.escape(packages)}</div>",
                html.escape(f"{commit}, {str(made.get('date', '?'))[:10]}"),
                _faults(rows),
            ]
        )
    return _table(head, lines)


def _versions(run: Path) -> dict[str, Any]:
    path = run / VERSIONS
    return read_json(path, "put it back from a copy, or remove it") if is_there(path) else {}


def _faults(rows: Sequence[Mapping[str, float]]) -> str:
    """What was skipped or put back, of the rows that metrics.csv holds."""
    faults = sum(row.get("train/physics_faults", 0.0) for row in rows)
    skipped = max(row.get("train/skipped", 0.0) for row in rows)
    words = [f"{faults:.0f} lanes put back"] if faults else []
    words += [f"up to {skipped:.1%} of an iteration's gradients skipped"] if skipped else []
    return "; ".join(words) or "none"


def _legend(names: Iterable[str], colors: Iterable[str] = figures.COLORS) -> str:
    items = (
        f'<span><i style="background:{color}"></i>{html.escape(name)}</span>'
        for name, color in zip(names, itertools.cycle(colors), strict=False)
    )
    return f"<p class=legend>{''.join(items)}</p>"


def _panels(go: Any, runs: Runs, panel: Any) -> str:
    shown_tasks = [
        (task + (" (held out)" if runs.is_held_out(task) else ""), panel(go, runs, task))
        for task in runs.tasks
    ]
    return _grid((title, figure) for title, figure in shown_tasks if figure.data)


def _grid(panels: Iterable[tuple[str, Any]]) -> str:
    cells = (f"<figure><h3>{html.escape(t)}</h3>{_drawn(f)}</figure>" for t, f in panels)
    return f"<div class=grid>{''.join(cells)}</div>"


def _drawn(figure: Any) -> str:
    """A figure as data, which the page's script draws once all of the page has its place."""
    # plotly writes "<" and "/" of texts as \\u003c and \\u002f: none ends the script.
    return f'<div class=plot><script type="application/json">{figure.to_json()}</script></div>'


def _final_table(runs: Runs) -> str:
    lines = []
    for group in runs.groups:
        for task in runs.tasks:
            curves = runs.final(group, task)
            for k in curves[0] if curves else ():
                any_step, last, returns = (
                    [curve[k][name] for curve in curves]
                    for name in ("success_any", "success_last", "return")
                )
                middle = [float(interquartile_mean(x)) for x in (any_step, last, returns)]
                interval = _interval(runs, group, any_step)
                cells = [group + runs.mark(group, task), task, str(k)]
                cells += [f"{middle[0]:.2f}", interval, f"{middle[1]:.2f}", f"{middle[2]:,.0f}"]
                lines.append([html.escape(cell) for cell in cells])
    head = ["run", "task", "k", "success, any step", "95 %", "last step", "return"]
    return _table(head, lines)


def _interval(runs: Runs, group: str, rates: Sequence[float]) -> str:
    """95 %: of one run Wilson's over its goals, of several the bootstrap's over the seeds."""
    goals = {e.facts.get("goals") for e in runs.evaluations_of(group)}
    if len(rates) > 1:
        _, low, high = seeds_band(np.array(rates)[:, None])
        return f"{low[0]:.2f} to {high[0]:.2f} ({len(rates)} seeds)"
    (count,) = goals if len(goals) == 1 else (None,)
    if not isinstance(count, int) or count < 1:
        return ""
    return "{:.2f} to {:.2f}".format(*wilson_interval(rates[0], count))


def _file_sections(go: Any, files: Files) -> Iterable[str]:
    tasks = {task: None for e in files.evaluations.values() for task in e.tasks}  # in order
    if tasks:
        legend = _legend(_told(name, e) for name, e in files.evaluations.items())
        panels = [(task, figures.files_panel(go, files.evaluations, task)) for task in tasks]
        yield _section(
            "Adaptation", legend + _grid(panels), "Success at any step after k own episodes."
        )
    for name, adaptation in files.adaptations.items():
        panel = (adaptation.task, figures.finetune_panel(go, adaptation))
        yield _section(f"Fine-tuning: {name}", _grid([panel]))


def _told(name: str, evaluation: Evaluation) -> str:
    """An evaluation's name, with how it adapted."""
    words = [str(evaluation.facts[x]) for x in ("adapt", "protocol") if x in evaluation.facts]
    return f"{name} ({', '.join(words)})" if words else name


def _inspections(go: Any, paths: Sequence[Path]) -> Iterable[str]:
    found: list[tuple[str, Inspection]] = []
    for name, path in zip(shown_names(paths), paths, strict=True):
        if (inspection := read_inspection(path)) is not None:
            found.append((name, inspection))
    routed = [(name, x) for name, x in found if x.routing is not None]
    if routed:
        body = _grid((name, figures.routing_map(go, x)) for name, x in routed)
        yield _section("Routing by task", body, _ROUTING)
    latent = [(name, x) for name, x in found if x.latents is not None]
    if latent:
        tasks = sorted({task for _, x in latent for task in x.tasks}, key=task_names().index)
        body = _legend(tasks, [figures.color(task_names().index(task)) for task in tasks])
        body += _grid(
            (_with_verdict(name, x), figures.latents_scatter(go, x)) for name, x in latent
        )
        yield _section("Latent z", body, _LATENT)


def _with_verdict(name: str, inspection: Inspection) -> str:
    assert inspection.latents is not None  # the caller has looked
    return f"{name}: {verdict(inspection.latents)}"


def _films(paths: Sequence[Path]) -> Iterable[str]:
    """Films that `render` has left in the runs, else the last that training did; or the sheets."""
    cells = []
    for name, path in zip(shown_names(paths), paths, strict=True):
        trained = sheets_of(path)
        newest = [(f"{n:,} steps, ", sheet) for n, sheet in trained if n == trained[-1][0]]
        rendered = [("", sheet) for sheet in sorted((path / "render").glob("*.png"))]
        for when, sheet in rendered or newest:
            title = html.escape(f"{name}: {when}{sheet.stem}")
            film = sheet.with_suffix(".mp4")
            if film.is_file():
                shown_film = f'<video controls muted loop src="{_data("video/mp4", film)}"></video>'
            else:
                shown_film = f'<img alt="{title}" src="{_data("image/png", sheet)}">'
            cells.append(f"<figure><h3>{title}</h3>{shown_film}</figure>")
    if cells:
        yield _section("Films", f"<div class=grid>{''.join(cells)}</div>")


def _data(kind: str, path: Path) -> str:
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


def _commands(runs: Runs, presets: Presets) -> str:
    lines = []
    for path, (preset, changed) in presets.items():
        flags = [word for key, value in changed.items() for word in (f"--{key}", shown(value))]
        lines.append(f"python train.py {quoted('--config', preset, *flags, '--run', path)}")
        if (found := runs.evaluations.get(path)) is not None:
            k = ",".join(str(k) for k in next(iter(found.tasks.values())))
            words = ["--run", path, "--tasks", ",".join(found.tasks), "--k", k]
            words += ["--goal-set", found.facts.get("goal_set", "heldout")]
            words += [word for key, flag in _EVAL_FLAGS.items() for word in _flag(found, key, flag)]
            lines.append(f"python train.py eval {quoted(*words)}")
    return f"<pre>{html.escape(chr(10).join(lines))}</pre>"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """An HTML table; cells are HTML already."""
    top = "".join(f"<th>{html.escape(name)}</th>" for name in head)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    return f"<div class=wide><table><tr>{top}</tr>{body}</table></div>"


def _flag(found: Evaluation, key: str, flag: str) -> list[Any]:
    """A flag and its value, where an evaluation was taken with another than the usual one."""
    usual, value = asdict(EvalOptions()).get(key), found.facts.get(key)
    return [] if value in (None, "", usual) else [flag, value]


# What an evaluation's file says of how it was taken -> the flag of `eval`.
_EVAL_FLAGS = {
    "goals": "--goals",
    "seed": "--seed",
    "draws": "--eval-seeds",
    "horizon": "--horizon",
    "physics": "--physics",
    "policy": "--policy",
    "z": "--z",
    "adapt": "--adapt",
    "protocol": "--protocol",
    "paraphrases": "--paraphrases",
    "text_control": "--text-control",
    "text": "--text",
}
_SUCCESS = (
    "Episodes that training collected, exploring: at any step (line) and at the last (dotted). "
    "Marks: evaluations of the policy, crosses where the task was held out. Bands: 95 % over seeds."
)
_FINAL = (
    "On places that training never sees, after k episodes of adaptation. Of several seeds: the "
    "interquartile mean, and its bootstrap interval."
)
_ROUTING = "Mean weight with which each module of the actor is read; white is the equal share."
_LATENT = (
    "Dots: z drawn; large: a posterior's mean; diamonds: of the sentence alone; circle: N(0, I)."
)
