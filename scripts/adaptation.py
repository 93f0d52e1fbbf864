"""The adaptation table: `python scripts/adaptation.py train`, `score`, `finetune`, then `table`.

Each of the four tasks is held out once, a fold, with five seeds. `train` makes the runs, one after
another; what is finished is left alone and what was stopped goes on, so it can be stopped and given
again at any time. Runs go to runs/adaptation/NAME; config, versions, command and the last policy of
each are copied to results/adaptation/policies/NAME, learning curves of RL2 and MAML to
results/adaptation/curves/NAME. `score` evaluates those copies, one JSON an
evaluation in results/adaptation/scores/NAME; what is there already is not run again. `finetune`
goes on from the winner of a search with gradient steps, beside SAC from scratch, for one seed a
fold: it needs the run itself. `table` puts
them together as results/adaptation/folds.json, the figures and the Markdown of README. `--list`
prints every command. Names after the word choose among the runs.
"""

from __future__ import annotations

import csv
import itertools
import json
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from cmrl_jax.cli.main import main as main_of_train  # noqa: E402
from cmrl_jax.config.schema import ConfigError  # noqa: E402
from cmrl_jax.evaluation.statistics import seeds_interval  # noqa: E402
from cmrl_jax.storage.documents import read_json  # noqa: E402
from cmrl_jax.storage.packed import pack  # noqa: E402
from scripts import experiments  # noqa: E402
from scripts.experiments import refused  # noqa: E402

RUNS, RESULTS = Path("runs/adaptation"), Path("results/adaptation")
POLICIES, SCORES = RESULTS / "policies", RESULTS / "scores"
TASKS = ("drawer-open", "drawer-close", "window-open", "window-close")
SEEDS = range(5)
FIGURES = ("success_any", "success_last")
K = (0, 1, 2, 5, 10, 20)

# What is trained in every fold. PEARL sees what the others see and begins as they do, so that only
# the method differs; the networks of `untrained` are as initialised: iteration 0 learns nothing.
KINDS = {
    "cmrl": "--config ml4.yaml",
    "pearl": "--config pearl.yaml --env.obs_mode canonical --collect.scatter 40"
    " --train.capacity 340000 --sac.policy_average 0.1",
    # PEARL's belief over transitions on the main job's own actor-critic: no text, no modules.
    "pearlsac": "--config ml4.yaml --model.net mlp --model.mlp_hidden 128,128,128"
    " --encoder.goal_fusion none --encoder.p_empty 0.0 --encoder.aux none"
    " --collect.group_frac 0.5,0.0,0.5",
    "untrained": "--config ml4.yaml --train.env_steps 19200",
    "rl2": "--config rl2.yaml",
    "maml": "--config maml.yaml",
}
_K = f"--k {','.join(map(str, K))}"
_TASK = "--protocol task --eval-seeds 5"  # five adaptation runs, each on goals in its own order
EVALUATIONS = {  # flags of `eval`; native physics unless they say otherwise
    "search-task": f"--adapt search {_K} {_TASK}",
    "search-goal": f"--adapt search {_K}",
    "posterior-task": f"{_K} {_TASK}",
    "posterior-goal": f"{_K}",
    "arms": "--adapt arms --k " + ",".join(map(str, range(32))),  # four z, eight views, no reach
    "text-shuffled": "--k 0 --text-control shuffled",
    "text-zero": "--k 0 --text-control zero",
    "trained": "--k 0",
    "trained-goal": f"{_K}",
    "trained-search": "--adapt search --k 20 --protocol task --eval-seeds 3",
    # Its own function adapts for 10 episodes and counts the 3 after them.
    "metaworld": "--adapt search --physics metaworld --k 0",
    "metaworld-own": "--physics metaworld --k 0",
}
_OF_PEARL = ("posterior-task", "posterior-goal", "search-task", "search-goal", "trained")
META_RL = ("rl2", "maml")
_OF_META_RL = ("posterior-task", "posterior-goal", "trained-goal", "metaworld-own")
OF_KIND = {
    "cmrl": tuple(x for x in EVALUATIONS if x not in ("metaworld-own", "trained-goal")),
    "pearl": _OF_PEARL,
    "pearlsac": _OF_PEARL,
    "untrained": ("search-task", "search-goal"),
} | dict.fromkeys(META_RL, _OF_META_RL)
FINETUNE = "finetune"  # from the winner of a search, and SAC from scratch; needs the run itself


def runs() -> list[str]:
    """Names of all runs, KIND-FOLD-sSEED, the seeds of a fold last: each sweep has every fold."""
    return [f"{kind}-{fold}-s{seed}" for kind, seed, fold in itertools.product(KINDS, SEEDS, TASKS)]


def parts(name: str) -> tuple[str, str, int]:
    """Kind, fold and seed of a run's name."""
    kind, _, rest = name.partition("-")
    fold, _, seed = rest.rpartition("-s")
    return kind, fold, int(seed)


def typed(name: str) -> list[str]:
    """What a user types to begin a run."""
    kind, fold, seed = parts(name)
    train = ",".join(task for task in TASKS if task != fold)
    words = ["train.py", *shlex.split(KINDS[kind]), "--tasks.train", train, "--tasks.test", fold]
    return [*words, "--env.physics", "native", "--seed", str(seed), "--run", str(RUNS / name)]


def evaluations_of(name: str) -> list[str]:
    """What is asked of a run's policy; of Meta-World's own function in the paper's fold alone."""
    kind, fold, _ = parts(name)
    of_paper = ("metaworld", "metaworld-own")
    return [x for x in OF_KIND[kind] if x not in of_paper or fold == "window-close"]


def score_command(name: str, evaluation: str) -> list[str]:
    """What a user would type for an evaluation of a run's kept policy, or for its fine-tuning."""
    _, fold, _ = parts(name)
    out = ["--json", str(SCORES / name / f"{evaluation}.json")]
    if evaluation == FINETUNE:
        run = ["--run", str(RUNS / name), "--task", fold, "--physics", "native"]
        return ["train.py", "finetune", *run, "--adapt", "search,scratch", *out]
    trained = ",".join(task for task in TASKS if task != fold)
    tasks = trained if evaluation.startswith("trained") else fold
    words = ["train.py", "eval", "--run", str(POLICIES / name), "--tasks", tasks]
    flags = shlex.split(EVALUATIONS[evaluation])
    # One number of lanes for all, so that a way to adapt is one program for all.
    usual = [] if "--physics" in flags else ["--physics", "native", "--lanes", "50"]
    return [*words, *usual, *flags, *out]


def keep(name: str) -> None:
    """Copies what scoring needs of a finished run: the policy saved last and its facts."""
    run, kept = RUNS / name, POLICIES / name
    if parts(name)[0] in META_RL:  # first: what a policy is there of is not kept again
        experiments.keep(run, RESULTS / "curves" / name, typed(name))
    last = max(int(path.name) for path in (run / "policy").iterdir() if path.name.isdigit())
    shutil.rmtree(kept, ignore_errors=True)
    pack(run / "policy" / str(last), kept / "policy" / f"{last}.zip")
    for file in ("config.yaml", "versions.json"):
        shutil.copy(run / file, kept / file)
    spoken = f"python {shlex.join(typed(name))}\n"
    (kept / "command.txt").write_text(spoken, encoding="utf-8")


def train(names: list[str]) -> int:
    """Makes the runs that are missing; the exit code of one that was stopped."""
    for name in names:
        if code := experiments.finish(RUNS / name, typed(name)):
            return code
        if not (POLICIES / name).exists():
            keep(name)
    return 0


def score(names: list[str]) -> int:
    """Makes the evaluations that are missing of the policies that are there."""
    for name in names:
        for evaluation in evaluations_of(name):
            if (POLICIES / name).exists() and (code := score_once(name, evaluation)):
                return code
    return 0


def finetune(names: list[str]) -> int:
    """Fine-tunes the first seed of every fold, where its run has ended and lies here."""
    for name in filter(is_finetuned, names):
        is_ended = (POLICIES / name).exists() and (RUNS / name / "ckpt").exists()
        if is_ended and (code := score_once(name, FINETUNE)):
            return code
    return 0


def is_finetuned(name: str) -> bool:
    kind, _, seed = parts(name)
    return kind == "cmrl" and seed == 0


def score_once(name: str, evaluation: str) -> int:
    """Makes one evaluation, unless it is there; its exit code."""
    out = SCORES / name / f"{evaluation}.json"
    if out.exists():
        return 0
    print(f"== {name} {evaluation}", flush=True)
    out.parent.mkdir(parents=True, exist_ok=True)
    part, cells = out.with_suffix(".part.json"), out.with_suffix(".part.csv")
    for path in (part, cells):  # of a command that was stopped
        path.unlink(missing_ok=True)
    _, *words = score_command(name, evaluation)
    words[words.index(str(out))] = str(part)
    table = [] if evaluation == FINETUNE else ["--csv", str(cells)]
    # In this process, where what was compiled for one evaluation serves the next.
    code = main_of_train([*words, *table])
    if not code:
        if table:
            keep_goals(cells, part)
        part.replace(out)
    return code


def keep_goals(cells: Path, out: Path) -> None:
    """Adds each goal's success, mean over draws, to an evaluation's JSON; removes the cells."""
    by_goal: dict[tuple[str, str, int], list[dict[str, str]]] = {}
    with cells.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            by_goal.setdefault((row["task"], row["k"], int(row["goal"])), []).append(row)
    found = json.loads(out.read_text(encoding="utf-8"))
    for (task, k, _), rows in sorted(by_goal.items()):
        goals = found["tasks"][task][k].setdefault("goals", {x: [] for x in FIGURES})
        for figure in FIGURES:
            goals[figure].append(round(sum(float(r[figure]) for r in rows) / len(rows), 4))
    out.write_text(json.dumps(found) + "\n", encoding="utf-8")
    cells.unlink()


CURVES = ("cmrl", "cmrl-posterior", "pearl", "pearl-sac", "untrained-search", "random-arm")
GRADIENTS = ("finetune", "scratch")
METHODS = {  # of (kind, adapt)
    ("cmrl", "search"): "cmrl",
    ("cmrl", "posterior"): "cmrl-posterior",
    ("pearl", "posterior"): "pearl",
    ("pearl", "search"): "pearl-search",
    ("pearlsac", "posterior"): "pearl-sac",
    ("pearlsac", "search"): "pearl-sac-search",
    ("untrained", "search"): "untrained-search",
    ("rl2", "posterior"): "rl2",
    ("maml", "posterior"): "maml",
}


def rows_of(name: str) -> list[dict[str, Any]]:
    """The rows of a run's evaluations."""
    kind, fold, seed = parts(name)
    rows: list[dict[str, Any]] = []

    def add(method: str, protocol: str, k: int, figures: dict[str, Any]) -> None:
        row = {"fold": fold, "method": method, "protocol": protocol, "seed": seed, "k": k}
        rows.append(row | {x: figures[x] for x in FIGURES})

    path = SCORES / name / f"{FINETUNE}.json"
    curves = read_json(path, "remove it, and score again")["curves"] if path.exists() else {}
    for adapt, curve in curves.items():
        for k, figures in curve.items():
            add({"search": "finetune"}.get(adapt, adapt), "task", int(k), figures)
    for adapt, protocol in itertools.product(("search", "posterior"), ("task", "goal")):
        for k, figures in figures_of(name, f"{adapt}-{protocol}", fold).items():
            add(METHODS[kind, adapt], protocol, k, figures)
    for text in ("shuffled", "zero"):
        for k, figures in figures_of(name, f"text-{text}", fold).items():
            add(f"cmrl-text-{text}", "goal", k, figures)
    if arms := list(figures_of(name, "arms", fold).values()):
        mirrors = len(arms) // len(TASKS)  # of each z: the task's own, and three trained ones
        fixed = {
            "random-arm": mean(arms),
            "blind-arm": mean(arms[mirrors::mirrors]),  # a trained task's z, nothing mirrored
            "oracle-arm": max(arms, key=lambda f: (f["success_any"], f["success_last"])),
        }
        # What does not adapt is the same whatever it has seen.
        for (method, figures), k, protocol in itertools.product(fixed.items(), K, ("task", "goal")):
            add(method, protocol, k, figures)
    return rows


def figures_of(name: str, evaluation: str, task: str) -> dict[int, dict[str, Any]]:
    """k -> figures on a task; nothing where it was not evaluated."""
    path = SCORES / name / f"{evaluation}.json"
    if not path.exists():
        return {}
    found = read_json(path, "remove it, and score again")["tasks"][task]
    return {int(k): figures for k, figures in found.items()}


def mean(figures: list[dict[str, Any]]) -> dict[str, float]:
    return {x: sum(f[x] for f in figures) / len(figures) for x in FIGURES}


def table(names: list[str]) -> int:
    """Writes folds.json and curves.png from the evaluations that are there; prints the tables."""
    rows = [row for name in names for row in rows_of(name)]
    lines = ",\n".join(json.dumps(row) for row in rows)
    (RESULTS / "folds.json").write_text(f'{{"rows": [\n{lines}\n]}}\n', encoding="utf-8")
    print(f"{RESULTS / 'folds.json'}: {len(rows)} rows")
    print("", *by_episodes(rows), sep="\n")
    for protocol in ("task", "goal"):
        print("", *markdown(rows, protocol), sep="\n")
    print("", *intervals(names), sep="\n")
    print("", *trained_tasks(names), sep="\n")
    print("", *in_metaworld(names), sep="\n")
    print("", *episodes_needed(rows), sep="\n")
    draw_curves(rows, RESULTS / "curves.png")
    return 0


def by_episodes(rows: list[dict[str, Any]]) -> list[str]:
    """Any (last) step of the search by task after k own episodes: means over seeds."""
    lines = [f"| held out | {' | '.join(f'k = {k}' for k in K)} |", "|" + " --- |" * (len(K) + 1)]
    for fold in TASKS:
        cells = []
        for k in K:
            asked = {"fold": fold, "method": "cmrl", "protocol": "task", "k": k}
            found = [row for row in rows if asked.items() <= row.items()]
            text = "{success_any:.2f} ({success_last:.2f})"
            cells.append(text.format(**mean(found)) if found else "")
        lines.append(f"| {fold} | {' | '.join(cells)} |")
    return lines


def markdown(rows: list[dict[str, Any]], protocol: str) -> list[str]:
    """Any / last step at k = 20 by fold: mean over seeds, and the worst seed's any step."""
    head = [f"{protocol} protocol, k = {K[-1]}", *TASKS]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    by_method: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for row in rows:
        last = K[-1] if not row["method"].startswith("cmrl-text") else 0
        counts = row["protocol"] == protocol and row["k"] == last
        if counts and row["method"] not in GRADIENTS:  # they have a table of their own
            by_method.setdefault(row["method"], {}).setdefault(row["fold"], []).append(row)
    for method, folds in by_method.items():
        cells = []
        for fold in TASKS:
            found = folds.get(fold, [])
            if not found:
                cells.append("")
                continue
            means, worst = mean(found), min(r["success_any"] for r in found)
            text = "{success_any:.2f} / {success_last:.2f}".format(**means)
            cells.append(f"{text}, worst {worst:.2f} of {len(found)}")
        lines.append("| " + " | ".join([method, *cells]) + " |")
    return lines


def intervals(names: list[str]) -> list[str]:
    """IQM over seeds with its interval over seeds and goals, the search by the task protocol."""
    lines = ["| fold | k | any step, IQM | last step, IQM |", "| --- | --- | --- | --- |"]
    for fold, k in itertools.product(TASKS, K):
        own = [n for n in names if parts(n)[:2] == ("cmrl", fold)]
        found = [figures_of(n, "search-task", fold).get(k) for n in own]
        goals = [f["goals"] for f in found if f]
        if not goals:
            continue
        cells = []
        for figure in FIGURES:
            middle, (low, high) = seeds_interval([np.array([g[figure] for g in goals])])
            cells.append(f"{middle:.2f} [{low:.2f}, {high:.2f}]")
        lines.append(f"| {fold} | {k} | {cells[0]} | {cells[1]} |")
    return lines


def trained_tasks(names: list[str]) -> list[str]:
    """The worst training task of each run, any step: own sentence, and after a search."""
    lines = ["| run | own sentence | search, k = 20 |", "| --- | --- | --- |"]
    for name in (n for n in names if parts(n)[0] == "cmrl"):
        trained = [task for task in TASKS if task != parts(name)[1]]
        cells = []
        for evaluation, k in (("trained", 0), ("trained-search", 20)):
            found = [figures_of(name, evaluation, task).get(k) for task in trained]
            cells.append(f"{min(f['success_any'] for f in found if f):.2f}" if all(found) else "")
        if any(cells):
            lines.append(f"| {name} | {cells[0]} | {cells[1]} |")
    return lines


def in_metaworld(names: list[str]) -> list[str]:
    """Success that Meta-World's own `metalearning_evaluation` reports of the search."""
    lines = ["| run | Meta-World's own evaluation, after 10 episodes |", "| --- | --- |"]
    for name in names:
        found = [SCORES / name / f"{x}.json" for x in ("metaworld", "metaworld-own")]
        for path in filter(Path.exists, found):
            own = read_json(path, "remove it, and score again")["metalearning_evaluation"]["tasks"]
            lines.append(f"| {name} | {own[parts(name)[1]]['mean_success_rate']:.2f} |")
    return lines


def episodes_needed(rows: list[dict[str, Any]], enough: float = 0.8) -> list[str]:
    """Own episodes at the first read-out with that much success, gradient steps included.

    Fine-tuning makes none in the 20 episodes of the search that it begins with.
    """
    lines = [f"| fold | {' | '.join(GRADIENTS)} |", "| --- |" + " --- |" * len(GRADIENTS)]
    for fold in TASKS:
        cells = []
        for method in GRADIENTS:
            ks = [
                row["k"]
                for row in rows
                if (row["fold"], row["method"], row["protocol"]) == (fold, method, "task")
                and row["success_any"] >= enough
            ]
            cells.append(str(min(ks)) if ks else "")
        if any(cells):
            lines.append(f"| {fold} | {' | '.join(cells)} |")
    return lines


def draw_curves(rows: list[dict[str, Any]], path: Path) -> None:
    """Success against own episodes, a panel a fold: mean over seeds, and every seed of CMRL."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 3.6), layout="constrained")
    axes = figure.subplots(1, len(TASKS), sharey=True)
    for axis, fold in zip(axes, TASKS, strict=True):
        for method, color in zip(CURVES, ("C0", "C1", "C2", "C3", "C4", "C7"), strict=True):
            found = [
                r for r in rows if (r["fold"], r["method"], r["protocol"]) == (fold, method, "task")
            ]
            for seed in {r["seed"] for r in found} if method == "cmrl" else ():
                own = [r for r in found if r["seed"] == seed]
                axis.plot([r["k"] for r in own], [r["success_any"] for r in own], color, alpha=0.2)
            ks = sorted({r["k"] for r in found})
            for name, style in (("success_any", "-"), ("success_last", ":")):
                by_k = [[r[name] for r in found if r["k"] == k] for k in ks]
                means = [sum(x) / len(x) for x in by_k]
                label = method if name == "success_any" else None
                axis.plot(ks, means, style, color=color, label=label)
        axis.set(title=f"held out: {fold}", xlabel="own episodes", ylim=(-0.03, 1.03))
    axes[0].set_ylabel("success (any step; dotted: last)")
    axes[0].legend(fontsize=8)
    figure.savefig(path, dpi=110)
    print(path)


STEPS = {"train": train, "score": score, "finetune": finetune, "table": table}


def main(words: list[str]) -> int:
    if "--list" in words:
        for name in runs():
            print(f"python {shlex.join(typed(name))}")
            tuned = [FINETUNE] if is_finetuned(name) else []
            for evaluation in evaluations_of(name) + tuned:
                print(f"python {shlex.join(score_command(name, evaluation))}")
        return 0
    step, chosen = words[:1], words[1:]
    if not step or step[0] not in STEPS:
        return refused(f"what to do: {' '.join(step) or 'not said'}", f"say {', '.join(STEPS)}")
    unknown = [word for word in chosen if word not in runs()]
    if unknown:
        return refused(f"no run {unknown[0]}", "see --list for their names")
    return STEPS[step[0]](chosen or runs())


if __name__ == "__main__":
    try:
        raise SystemExit(main(sys.argv[1:]))
    except ConfigError as error:
        raise SystemExit(refused(error.cause, error.cure)) from None
