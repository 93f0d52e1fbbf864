"""Every figure and table of results/ again, from the files kept there: `python scripts/figures.py`.

Figures of several runs go to results/figures, routing and z of each that has an inspection.json to
its own folder; the tables, as Markdown, to standard output. Runs that are not there yet are left
out, and figures of several runs with fewer than two.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from cmrl_jax.analysis.inspection_file import FILE as INSPECTION  # noqa: E402
from cmrl_jax.analysis.plots import plot_adaptation, plot_inspections, plot_learning  # noqa: E402
from cmrl_jax.config.files import run_config  # noqa: E402
from cmrl_jax.config.schema import ConfigError  # noqa: E402
from cmrl_jax.storage.run_files import (  # noqa: E402
    EVALUATION,
    METRICS,
    Row,
    figure,
    read_adaptation,
    read_evaluation,
    read_metrics,
)
from envs.tasks import TASKS  # noqa: E402
from scripts import controls  # noqa: E402
from scripts.experiments import refused  # noqa: E402

RESULTS = ROOT / "results"
# Table, and directory under results/figures -> runs under results/, whichever of them are there.
GROUPS = {
    "cmrl-pearl": ("cmrl-seed0", "cmrl-seed1", "pearl"),  # the paper's Figures 4 and 5
    "baselines": (
        "cmrl-seed0",
        "cmrl-seed1",
        "grounded-seed0",
        "grounded-seed1",
        "pearl",
        "cmrl-paper",
        "mtsac",
    ),
    "single-task": ("sac-drawer-open", "sac-drawer-close", "sac-window-open", "sac-window-close"),
    "held-out": (
        "cmrl-seed0",
        "cmrl-seed1",
        "cmrl-holdout-drawer-close",
        "cmrl-holdout-drawer-open",
        "cmrl-holdout-window-open",
        "cmrl-canonical-seed0",
        "cmrl-canonical-seed1",
    ),
    "ablations": (
        "cmrl-seed0",
        "cmrl-seed1",
        "cmrl-white-noise",
        "cmrl-no-return-norm",
        "cmrl-shared-alpha",
        "cmrl-no-router",
        "cmrl-no-goal",
    ),
    "words": ("words-kl", "words-canonical", "words-recon", "words-contrastive", "words-all"),
}


def table(runs: list[Path]) -> list[str]:
    """Success at any / last step of the final evaluations at the largest k, a row a run."""
    head = ["run", "env steps", "gradient steps", "wall minutes", "steps to 0.9", "k", *TASKS]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for run in runs:
        evaluation = read_evaluation(run / EVALUATION)
        config = run_config(run, acts=False)
        rows = read_metrics(run)
        cells, k = [], max(max(by_k) for by_k in evaluation.tasks.values())
        for task in TASKS:
            figures = evaluation.tasks.get(task, {}).get(k)
            if figures is None:
                cells.append("")
                continue
            held_out = " (held out)" if task in config.tasks.test else ""
            cells.append(f"{figures['success_any']:.2f} / {figures['success_last']:.2f}{held_out}")
        last = lambda column: figure(rows[-1], column, run / METRICS)
        counts = [f"{last(name):,.0f}" for name in ("env_steps", "gradient_steps")]
        wall = f"{last('wall_s') / 60:.1f}"
        solved = steps_to_solve(rows, config.tasks.train, max(config.eval.k))
        lines.append(
            "| " + " | ".join([controls.label(run), *counts, wall, solved, str(k), *cells]) + " |"
        )
    return lines


def steps_to_solve(rows: list[Row], tasks: tuple[str, ...], k: int) -> str:
    """Env steps at the first evaluation where each of `tasks` succeeds on 0.9 of its goals."""
    for row in rows:
        if min(row.get(f"eval/{task}/k{k}/success_any", 0) for task in tasks) >= 0.9:
            return f"{row['env_steps']:,.0f}"
    return "-"


def adaptation_figures() -> list[Path]:
    """The curves of every results/finetune/RUN.json, a figure a task."""
    curves: dict[str, dict] = {}
    for file in sorted((RESULTS / "finetune").glob("*.json")):
        found = read_adaptation(file)
        named = {f"{file.stem}, {way}": curve for way, curve in found.curves.items()}
        curves.setdefault(found.task, {}).update(named)
    out = RESULTS / "finetune"
    return [plot_adaptation(found, task, out / f"{task}.png") for task, found in curves.items()]


def main() -> int:
    kept = lambda names: [
        RESULTS / name for name in names if (RESULTS / name / EVALUATION).is_file()
    ]
    drawn = []
    for folder, names in GROUPS.items():
        if len(kept(names)) > 1:
            drawn += plot_learning(kept(names), RESULTS / "figures" / folder)
    for file in sorted(RESULTS.glob(f"*/{INSPECTION}")):
        drawn += plot_inspections([file.parent], file.parent)
    drawn += adaptation_figures()
    for path in drawn:
        print(path.relative_to(ROOT), file=sys.stderr)
    for group, names in GROUPS.items():
        print(f"\n{group}\n", *table(kept(names)), sep="\n")
    for file in sorted(RESULTS.glob("*/controls/posterior.json")):
        print("", *controls.table(file.parent.parent), sep="\n")
    return 0


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except ConfigError as error:
        raise SystemExit(refused(error.cause, error.cure)) from None
