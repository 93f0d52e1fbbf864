"""Every figure and table of results/ again, from the files kept there: `python scripts/figures.py`.

Figures of several runs go to results/figures, routing and z of each that has an inspection.json to
its own folder; the table of final evaluations, as Markdown, to standard output. Runs that are not
there yet are left out, and figures of several runs with fewer than two.
"""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from cmrl_jax.config import TASKS  # noqa: E402
from cmrl_jax.inspection_file import FILE as INSPECTION  # noqa: E402
from cmrl_jax.plots import plot_inspections, plot_learning  # noqa: E402

RESULTS = ROOT / "results"
# Directory under results/figures -> runs under results/, whichever of them are there.
FIGURES = {
    "baselines": ("cmrl-seed0", "cmrl-seed1", "pearl", "cmrl-paper", "mtsac"),
    "cmrl-pearl": ("cmrl-seed0", "cmrl-seed1", "pearl"),  # the paper's Figures 4 and 5
    "single-task": ("sac-drawer-open", "sac-drawer-close", "sac-window-open", "sac-window-close"),
    "ablations": (
        "cmrl-seed0",
        "cmrl-no-return-norm",
        "cmrl-shared-alpha",
        "cmrl-no-router",
        "cmrl-no-goal",
        "cmrl-white-noise",
    ),
}


def table(runs: list[Path]) -> list[str]:
    """Success at any / last step of the final evaluations at the largest k, a row a run."""
    head = ["run", "env steps", "gradient steps", "wall minutes", "k", *TASKS]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for run in runs:
        result = json.loads((run / "eval.json").read_text(encoding="utf-8"))
        with (run / "metrics.csv").open(encoding="utf-8", newline="") as file:
            last = list(csv.DictReader(file))[-1]
        cells, k = [], ""
        for task in TASKS:
            by_k = result["tasks"].get(task)
            if by_k is None:
                cells.append("")
                continue
            k = max(by_k, key=int)
            figures = by_k[k]
            cells.append(f"{figures['success_any']:.2f} / {figures['success_last']:.2f}")
        wall = f"{float(last['wall_s']) / 60:.1f}"
        counts = [f"{int(last[name]):,}" for name in ("env_steps", "gradient_steps")]
        lines.append("| " + " | ".join([run.name, *counts, wall, k, *cells]) + " |")
    return lines


def main() -> int:
    kept = lambda name: (RESULTS / name / "eval.json").is_file()
    drawn = []
    for folder, names in FIGURES.items():
        runs = [RESULTS / name for name in names if kept(name)]
        if len(runs) > 1:
            drawn += plot_learning(runs, RESULTS / "figures" / folder)
    for file in sorted(RESULTS.glob(f"*/{INSPECTION}")):
        drawn += plot_inspections([file.parent], file.parent)
    for path in drawn:
        print(path.relative_to(ROOT), file=sys.stderr)
    listed = dict.fromkeys(name for names in FIGURES.values() for name in names)
    print("\n".join(table([RESULTS / name for name in listed if kept(name)])))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
