"""Is z used, are the words? Every control of `eval` on finished runs: `python scripts/controls.py
NAME ...`, runs of scripts/experiments.py.

Each control is one `python train.py eval` (`--list` prints them) and one JSON in
results/NAME/controls. What is there already is not run again; a policy that reads no text has no
text controls, one without z none at all. `table` is the Markdown of scripts/figures.py.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from cmrl_jax.config.files import run_config  # noqa: E402
from cmrl_jax.config.schema import Config, ConfigError  # noqa: E402
from cmrl_jax.storage.run_files import EVALUATION, read_evaluation  # noqa: E402
from scripts.experiments import RESULTS, RUNS, refused  # noqa: E402

CONTROLS = {
    "posterior": "",  # the protocol itself
    "z-prior": "--z prior",
    "z-shuffled": "--z shuffled",
    "z-other": "--z other",
    "z-text": "--z text",
    "text-shuffled": "--text-control shuffled",
    "text-zero": "--text-control zero",
    "text-heldout": "--paraphrases heldout",
}
K = "0,1,2,5,10"


def applies(control: str, config: Config) -> bool:
    """Whether a policy has what the control takes away."""
    if config.model.conditioning != "z":
        return False
    fusion = config.encoder.goal_fusion
    if control == "z-text":
        return fusion in ("factor", "both")
    return not control.startswith("text-") or fusion != "none"


def kept_file(results: Path, control: str) -> Path:
    """Where a run's folder of results/ keeps a control."""
    return results / "controls" / f"{control}.json"


def command(name: str, control: str) -> list[str]:
    words = ["train.py", "eval", "--run", str(RUNS / name), "--k", K]
    kept = kept_file(RESULTS / name, control)
    return [*words, *shlex.split(CONTROLS[control]), "--json", str(kept)]


def label(run: Path) -> str:
    """A run's name in a table; marked where its policy saw what no policy is shown any more."""
    origin = run_config(run, acts=False).env.origin
    return run.name if origin == Config().env.origin else f"{run.name} (old origin)"


def table(run: Path) -> list[str]:
    """Success at any step of every control, a row a control and a column a task; k side by side."""
    kept = {name: kept_file(run, name) for name in CONTROLS}
    found = {name: read_evaluation(path).tasks for name, path in kept.items() if path.is_file()}
    tasks = list(found["posterior"])
    head = [f"{label(run)}, k = {K.replace(',', ', ')}", *tasks]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for name, by_task in found.items():
        cells = []
        for task in tasks:
            figures = [by_task.get(task, {}).get(int(k)) for k in K.split(",")]
            cells.append(" ".join(f"{f['success_any']:.2f}" if f else "-" for f in figures))
        lines.append("| " + " | ".join([name, *cells]) + " |")
    return lines


def main(words: list[str]) -> int:
    if "--list" in words:
        for control in CONTROLS:
            print(f"python {shlex.join(command('NAME', control))}")
        return 0
    finished = sorted(path.parent.name for path in (ROOT / RUNS).glob(f"*/{EVALUATION}"))
    unknown = [name for name in words if name not in finished]
    if unknown or not words:
        cause = f"no finished run {unknown[0]} in {RUNS}" if unknown else "no run is named"
        return refused(cause, f"choose from {', '.join(finished) or 'none yet'}")
    for name in words:
        config = run_config(ROOT / RUNS / name)
        for control in CONTROLS:
            kept = kept_file(ROOT / RESULTS / name, control)
            if kept.exists() or not applies(control, config):
                continue
            kept.parent.mkdir(parents=True, exist_ok=True)
            print(f"== {name} {control}", flush=True)
            code = subprocess.run([sys.executable, *command(name, control)], cwd=ROOT).returncode
            if code:
                return code
    return 0


if __name__ == "__main__":
    try:
        raise SystemExit(main(sys.argv[1:]))
    except ConfigError as error:
        raise SystemExit(refused(error.cause, error.cure)) from None
