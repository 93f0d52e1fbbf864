"""Kills one training run again and again with SIGKILL, and compares its result with a run in peace.

    python scripts/kill_loop.py [--kills 20] [--iterations 40] [--dir DIR]

Kills are spread from start-up to the final evaluation, at least `--in-saves` of them inside a save
(its temporary directory is left behind). Exit code 0: the last checkpoint and metrics.csv are the
undisturbed run's, bit for bit, and nothing unreadable is left. Minutes on two cores: most of it is
start-up, MuJoCo C and a warm compile cache make it seconds each.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]  # this working tree, whatever is installed

from cmrl_jax.cli.flags import natural, seed  # noqa: E402
from envs.command_line import typed_path, whole  # noqa: E402

STEPS = 600  # env steps of an iteration of smoke.yaml
SAVING = re.compile(r"(\d+)\.orbax-checkpoint-tmp")


class Kill(NamedTuple):
    """When to kill: `delay` seconds after the process is seen at `moment` (of `iteration`)."""

    moment: str  # "start-up", "save", "iteration" or "final evaluation"
    iteration: int
    delay: float


def plan(kills: int, iterations: int, rng: random.Random) -> list[Kill]:
    """A fifth in start-up, two in the final evaluation, two thirds of the others in a save.

    Iterations are spread evenly: each start gets a few iterations further than the one before.
    """
    in_start, in_end = kills // 5, 2
    rest = kills - in_start - in_end
    chosen = []
    for i in range(rest):
        iteration = 1 + i * (iterations - 2) // rest
        moment = "iteration" if i % 3 == 2 else "save"
        chosen.append(Kill(moment, iteration, rng.uniform(0.0, 0.1)))
    for i in range(in_start):  # the first before anything is saved, the others among the rest
        chosen.insert(i * (rest // in_start) + i, Kill("start-up", 0, rng.uniform(0.5, 5.0)))
    return chosen + [Kill("final evaluation", iterations, rng.uniform(0.0, 0.3))] * in_end


def steps(run: Path) -> list[int]:
    """Whole checkpoints in a run, seen from outside."""
    folder = run / "ckpt"
    return (
        sorted(int(p.name) for p in folder.iterdir() if p.name.isdigit()) if folder.is_dir() else []
    )


def saving(run: Path) -> list[int]:
    """Iterations whose save is going on, or was cut short."""
    names = [p.name for p in (run / "ckpt").iterdir()] if (run / "ckpt").is_dir() else []
    return [int(match[1]) for name in names if (match := SAVING.fullmatch(name))]


def is_at(kill: Kill, run: Path) -> bool:
    """Whether the process has come to the moment of the kill."""
    if kill.moment == "start-up":
        return True
    if kill.moment == "save":
        return any(iteration >= kill.iteration for iteration in saving(run))
    return bool(steps(run)) and steps(run)[-1] >= kill.iteration and not saving(run)


def train(run: Path, iterations: int, cache: Path) -> subprocess.Popen[bytes]:
    """Starts or goes on with a run that saves each iteration."""
    words = ["--config", "smoke.yaml", "--env.physics", "native", "--checkpoint.minutes", "0"]
    words += ["--train.env_steps", str(iterations * STEPS), "--run", str(run)]
    words += ["--resume"] if (run / "config.yaml").exists() else []
    with open(run.with_suffix(".log"), "ab") as log:
        return subprocess.Popen(
            [sys.executable, str(ROOT / "train.py"), *words],
            cwd=ROOT,
            stdout=log,
            stderr=log,
            env=os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache), "JAX_PLATFORMS": "cpu"},
        )


def to_the_end(run: Path, iterations: int, cache: Path) -> float:
    """Lets a run finish; returns the seconds that it took."""
    started = time.monotonic()
    if train(run, iterations, cache).wait() != 0:
        raise SystemExit(f"the run failed, see {run.with_suffix('.log')}")
    return time.monotonic() - started


def kill_once(kill: Kill, run: Path, iterations: int, cache: Path) -> bool:
    """Starts the run and kills it; prints a line; returns whether that cut a save short."""
    before, started = steps(run), time.monotonic()
    process = train(run, iterations, cache)
    while not is_at(kill, run):
        if process.poll() is not None:
            raise SystemExit(f"the run ended before {kill}, see {run.with_suffix('.log')}")
        time.sleep(0.0005)
    time.sleep(kill.delay)
    process.kill()
    if process.wait() != -signal.SIGKILL:
        raise SystemExit(f"the run ended by itself at {kill}, see {run.with_suffix('.log')}")
    cut, after = saving(run), steps(run)
    show = lambda found: ", ".join(map(str, found)) or "-"
    figures = f"{show(before[-1:]):>7} {show(after):>9} {show(cut):>8}"
    print(f"{kill.moment:<17} {time.monotonic() - started:>6.1f} s {figures}", flush=True)
    return bool(cut)


def unreadable(run: Path) -> list[str]:
    """What is in a run directory that is neither a file of the design nor a sound checkpoint."""
    from run_helpers import checkpoint_leaves

    from cmrl_jax.storage.manifest import find_damage

    expected = {"config.yaml", "versions.json", "metrics.csv", "eval.json", "ckpt", "policy"}
    found = [path.name for path in run.iterdir() if path.name not in expected | {".lock"}]
    for store in ("ckpt", "policy"):
        for path in (run / store).iterdir():
            if not path.name.isdigit() or find_damage(path):
                found.append(f"{store}/{path.name}")
            elif store == "ckpt":
                checkpoint_leaves(run, step=int(path.name))  # raises where it cannot be read
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("--kills", type=whole(2), default=20)
    parser.add_argument("--in-saves", type=natural, default=5)
    parser.add_argument("--iterations", type=whole(3), default=40)
    parser.add_argument("--seed", type=seed, default=0, help="of the moments")
    parser.add_argument(
        "--dir", type=typed_path, help="where both runs are kept [a temporary directory]"
    )
    args = parser.parse_args()
    folder = args.dir or Path(tempfile.mkdtemp(prefix="kill-loop-"))
    folder.mkdir(parents=True, exist_ok=True)
    peace, run, cache = folder / "undisturbed", folder / "killed", folder / "cache"
    for name in (peace, run):
        shutil.rmtree(name, ignore_errors=True)

    print(f"undisturbed: {to_the_end(peace, args.iterations, cache):.1f} s", flush=True)
    print(f"{'killed in':<17} {'after':>8} {'before':>7} {'whole':>9} {'cut save':>8}")
    cut = 0
    for kill in plan(args.kills, args.iterations, random.Random(args.seed)):
        cut += kill_once(kill, run, args.iterations, cache)
    print(f"to the end: {to_the_end(run, args.iterations, cache):.1f} s")

    from run_helpers import assert_same_result, checkpoint_leaves, rows_of

    assert_same_result(run, peace)
    assert (run / "eval.json").read_bytes() == (peace / "eval.json").read_bytes()
    left = unreadable(run)
    leaves, meta = checkpoint_leaves(run)
    print(f"kills: {args.kills}, {cut} inside a save; iteration {meta['iteration']}")
    print(f"equal bit for bit: {len(leaves)} checkpoint leaves, {len(rows_of(run))} rows of CSV")
    print(f"unreadable files left: {', '.join(left) or 'none'}")
    return 0 if cut >= args.in_saves and not left else 1


if __name__ == "__main__":
    sys.exit(main())
