"""The committed learning runs, one after another: `python scripts/experiments.py [NAME ...]`.

A run that is finished is left alone, one that was stopped is resumed, so this command can be
stopped (Ctrl-C, SIGTERM) and given again at any time. Runs go to runs/experiments/NAME; what
results/ keeps of each (config, versions, thinned metrics, evaluation, inspection) is copied to
results/NAME.
`--list` prints the commands. All runs have one budget, BUDGET, but for the single-task ones, the
multi-task ceiling, those that ask whether words matter, and the large configuration on a CPU.
"""

from __future__ import annotations

import csv
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from cmrl_jax.config.schema import ConfigError  # noqa: E402
from cmrl_jax.storage.documents import read_csv  # noqa: E402
from cmrl_jax.storage.run_files import EVALUATION, METRICS, read_evaluation  # noqa: E402

RUNS, RESULTS = Path("runs/experiments"), Path("results")
CSV_ROWS = 100  # kept of a run's metrics

BUDGET = "--env.physics native --train.env_steps 1200000"
SINGLE = "--config sac.yaml --env.physics native"  # 500,000 env steps
CMRL = f"--config ml4-plain.yaml {BUDGET}"
GROUNDED = f"--config ml4.yaml {BUDGET} --collect.scatter 0 --train.capacity 102400"
GROUNDED += " --sac.policy_average 0"
# Do words matter? Half the budget, and a KL weight at which z may carry something.
WORDS = "--config ml4-plain.yaml --env.physics native --train.env_steps 600000 --kl.beta 0.001"
# ml4-large.yaml with the widths, batch and lanes that two CPU cores carry; its critic, latent and
# target rate are as they are.
LARGE = "--config ml4-large.yaml --env.physics native --train.env_steps 600000"
LARGE += " --model.modules 2,2,64 --model.trunk_width 128 --model.gating_width 64"
LARGE += " --encoder.context_max 64 --sac.batch 128 --collect.lanes 96"
LARGE += " --collect.updates_per_vector_step 4 --train.capacity 340000"

EXPERIMENTS = {
    "cmrl-seed0": CMRL,
    "cmrl-seed1": f"{CMRL} --seed 1",
    "grounded-seed0": GROUNDED,
    "grounded-seed1": f"{GROUNDED} --seed 1",
    "mtsac": "--config mtsac.yaml --env.physics native --train.env_steps 960000",
    "pearl": f"--config pearl.yaml {BUDGET}",
    "sac-drawer-close": f"{SINGLE} --tasks.train drawer-close",
    "sac-window-open": f"{SINGLE} --tasks.train window-open",
    "sac-window-close": f"{SINGLE} --tasks.train window-close",
    "sac-drawer-open": f"{SINGLE} --tasks.train drawer-open",
    "cmrl-holdout-drawer-close": (
        f"{CMRL} --tasks.train drawer-open,window-open,window-close --tasks.test drawer-close"
    ),
    "cmrl-holdout-drawer-open": (
        f"{CMRL} --tasks.train drawer-close,window-open,window-close --tasks.test drawer-open"
    ),
    "cmrl-holdout-window-open": (
        f"{CMRL} --tasks.train drawer-open,drawer-close,window-close --tasks.test window-open"
    ),
    "cmrl-canonical-seed0": f"{CMRL} --env.obs_mode canonical",
    "cmrl-canonical-seed1": f"{CMRL} --env.obs_mode canonical --seed 1",
    "cmrl-paper": f"--config cmrl-paper.yaml {BUDGET}",
    "cmrl-white-noise": (
        f"{CMRL} --collect.noise_correlation 0 --collect.noise_scale 1 --sac.target_entropy -1"
    ),
    "cmrl-no-return-norm": f"{CMRL} --sac.reward_norm none",
    "cmrl-shared-alpha": f"{CMRL} --sac.alpha shared",
    "cmrl-no-router": f"{CMRL} --model.net mlp",
    "cmrl-no-goal": (
        f"{CMRL} --encoder.goal_fusion none --encoder.p_drop_goal 0 --encoder.p_empty 0"
        " --collect.group_frac 0.5,0,0.5"
    ),
    "words-contrastive": f"{WORDS} --encoder.aux contrastive",
    "words-all": (
        f"{WORDS} --encoder.aux contrastive --env.obs_mode canonical --model.router_input z"
        " --encoder.p_empty 0.5 --encoder.p_drop_goal 0"
    ),
    "words-kl": WORDS,
    "words-recon": f"{WORDS} --encoder.aux recon",
    "words-canonical": f"{WORDS} --env.obs_mode canonical",
    "large-on-cpu": LARGE,
}


def typed(name: str) -> list[str]:
    """What a user types to begin a run."""
    return ["train.py", *shlex.split(EXPERIMENTS[name]), "--run", str(RUNS / name)]


def finish(run: Path, words: list[str]) -> int:
    """Makes a run, or goes on with one that is there; 0 once it is finished, else an exit code.

    Args:
        words: what a user types to begin it.
    """
    if (run / EVALUATION).exists():
        return 0
    print(f"== {run.name}", flush=True)
    resumed = ["--resume"] if (run / "config.yaml").exists() else []
    code = subprocess.run([sys.executable, *words, *resumed], cwd=ROOT).returncode
    return code or int(not (run / EVALUATION).exists())  # stopped: the next call goes on with it


def keep(run: Path, kept: Path, words: list[str]) -> None:
    """Copies what results/ keeps of a finished run; the metrics thinned to `CSV_ROWS` rows.

    Args:
        words: what a user types to begin it.
    """
    # Read first: a damaged file does not take the place of the one that is kept.
    header, by_line = read_csv(run / METRICS, "put it back from a copy, or run the experiment anew")
    rows = list(by_line.values())
    read_evaluation(run / EVALUATION)
    kept.mkdir(parents=True, exist_ok=True)
    for file in ("config.yaml", "versions.json", EVALUATION):
        shutil.copy(run / file, kept / file)
    if (run / "inspection.json").is_file():  # of `train.py plot --inspect`
        shutil.copy(run / "inspection.json", kept / "inspection.json")
    evaluated = [i for i, column in enumerate(header) if column.startswith("eval/")]
    stride = -(-len(rows) // CSV_ROWS)
    thinned = [
        row
        for i, row in enumerate(rows)
        if i % stride == 0 or i == len(rows) - 1 or any(row[c] for c in evaluated)
    ]
    with (kept / METRICS).open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([header, *thinned])
    (kept / "command.txt").write_text(f"python {shlex.join(words)}\n", encoding="utf-8")


def refused(cause: str, cure: str) -> int:
    """Says what a user got wrong, as train.py does; returns the exit code."""
    print(f"error: {cause}\nfix: {cure}", file=sys.stderr)
    return 2


def main(words: list[str]) -> int:
    if "--list" in words:
        print("\n".join(f"{name}: python {shlex.join(typed(name))}" for name in EXPERIMENTS))
        return 0
    unknown = [word for word in words if word not in EXPERIMENTS]
    if unknown:
        return refused(f"no experiment {unknown[0]}", f"choose from {', '.join(EXPERIMENTS)}")
    for name in words or EXPERIMENTS:
        if code := finish(RUNS / name, typed(name)):
            return code
        keep(RUNS / name, RESULTS / name, typed(name))
    return 0


if __name__ == "__main__":
    try:
        raise SystemExit(main(sys.argv[1:]))
    except ConfigError as error:
        raise SystemExit(refused(error.cause, error.cure)) from None
