"""Every figure and table of results/ again, from the files kept there: `python scripts/figures.py`.

Figures of several runs go to results/figures, routing and z of each that has an inspection.json to
its own folder; the tables, as Markdown, to standard output. Runs that are not there yet are left
out, and figures of several runs with fewer than two.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from cmrl_jax.config import TASKS  # noqa: E402
from cmrl_jax.config_io import read_yaml, resolve  # noqa: E402
from cmrl_jax.inspection_file import FILE as INSPECTION  # noqa: E402
from cmrl_jax.plots import (  # noqa: E402
    plot_adaptation,
    plot_inspections,
    plot_learning,
    read_metrics,
)
from scripts import controls  # noqa: E402

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
        result = json.loads((run / "eval.json").read_text(encoding="utf-8"))
        config = resolve(*read_yaml(run / "config.yaml"))
        rows = read_metrics(run)
        cells, k = [], ""
        for task in TASKS:
            by_k = result["tasks"].get(task)
            if by_k is None:
                cells.append("")
                continue
            k = max(by_k, key=int)
            figures = by_k[k]
            held_out = " (held out)" if task in config.tasks.test else ""
            cells.append(f"{figures['success_any']:.2f} / {figures['success_last']:.2f}{held_out}")
        wall = f"{float(rows[-1]['wall_s']) / 60:.1f}"
        counts = [f"{int(rows[-1][name]):,}" for name in ("env_steps", "gradient_steps")]
        solved = steps_to_solve(rows, config.tasks.train, max(config.eval.k))
        lines.append("| " + " | ".join([run.name, *counts, wall, solved, k, *cells]) + " |")
    return lines


def steps_to_solve(rows: list[dict[str, str]], tasks: tuple[str, ...], k: int) -> str:
    """Env steps at the first evaluation where each of `tasks` succeeds on 0.9 of its goals."""
    for row in rows:
        if min(float(row.get(f"eval/{task}/k{k}/success_any") or 0) for task in tasks) >= 0.9:
            return f"{int(row['env_steps']):,}"
    return "-"


def adaptation_figures() -> list[Path]:
    """The curves of every results/finetune/RUN.json, a figure a task."""
    curves: dict[str, dict] = {}
    for file in sorted((RESULTS / "finetune").glob("*.json")):
        result = json.loads(file.read_text(encoding="utf-8"))
        named = {f"{file.stem}, {name}": curve for name, curve in result["curves"].items()}
        curves.setdefault(result["task"], {}).update(named)
    out = RESULTS / "finetune"
    return [plot_adaptation(found, task, out / f"{task}.png") for task, found in curves.items()]


def main() -> int:
    kept = lambda names: [
        RESULTS / name for name in names if (RESULTS / name / "eval.json").is_file()
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
    raise SystemExit(main())
