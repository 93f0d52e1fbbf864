"""What one wants to know of a borrowed accelerator, in one run and in the order of interest:

    python scripts/accelerator_check.py --minutes 15 --json h100.json

Every part is a process of its own, so that one that fails or takes too long costs no other; each
figure is in the file as soon as it is known. Compiled programs are kept between the parts and
nowhere else: what comes first finds an empty cache, what comes again a filled one. `--list` names
the parts, `--parts A,B` chooses among them, `--toy` makes each as small as it goes.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Timer
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

import cmrl_jax as cj  # noqa: E402
from cmrl_jax.cli.flags import add_force, names, parse, whole  # noqa: E402
from cmrl_jax.config.schema import ConfigError, require  # noqa: E402
from cmrl_jax.evaluation.session import prepare_jax  # noqa: E402
from cmrl_jax.storage.output_files import writable  # noqa: E402
from envs.command_line import Parser, suggest, typed_path  # noqa: E402
from envs.outputs import written_by  # noqa: E402
from scripts.experiments import refused  # noqa: E402

# One evaluation of 20 places a task, by the sentence alone, in every second iteration at most.
WATCHED = {"eval.every": 0.01, "eval.wall_share": 0.5, "eval.goals": 20, "eval.k": (0,)}
COMMAND = "accelerator_check"  # whose mark the file has
LANES = (256, 2048, 8192, 32768)


@dataclass(frozen=True)
class Size:
    """What the parts are made with.

    Attributes:
        main, large: configurations of the main job and of accelerator scale.
        changes: keys of both.
        success: at which training is over, by any step, on every training task.
        seeds: of the part that trains several.
        lanes: of the physics.
    """

    main: str = "ml4.yaml"
    large: str = "ml4-large.yaml"
    changes: tuple[tuple[str, Any], ...] = ()
    success: float = 0.9
    seeds: int = 8
    lanes: tuple[int, ...] = LANES


TOY = Size(
    main="smoke.yaml",
    large="smoke.yaml",
    changes=(
        ("env.physics", "native"),
        ("model.net", "mlp"),
        ("eval.goals", 2),
        ("eval.wall_share", 1.0),
    ),
    success=0.0,
    seeds=2,
    lanes=(2,),
)


class Lines:
    """Rows as lines of JSON on standard output, for the process that began this one.

    Args:
        labels: of every row.
    """

    def __init__(self, **labels: Any):
        self.labels = labels

    def add(self, name: str, value: float, unit: str, **labels: Any) -> None:
        row = {"name": name, "value": value, "unit": unit} | self.labels | labels
        print(json.dumps(row), flush=True)


class Watch(cj.Logger):
    """Notes when a run ends its first iteration, and when it has learned all its tasks.

    Args:
        on_first, on_learned: are called then, once each.
    """

    def __init__(
        self,
        tasks: tuple[str, ...],
        success: float,
        on_first: Callable[[], None],
        on_learned: Callable[[], None],
    ):
        self.tasks, self.success = tasks, success
        self.on_first, self.on_learned = on_first, on_learned
        self.first: float | None = None  # clock times
        self.learned: float | None = None
        self.env_steps = 0

    def row(self, row: Any, progress: Any) -> None:
        now = time.time()
        if self.first is None:
            self.first = now
            self.on_first()
        if self.learned:
            return
        self.env_steps = row["env_steps"]
        found = [row.get(f"eval/{task}/k0/success_any") for task in self.tasks]
        if None not in found and min(found) >= self.success:
            self.learned = now
            self.on_learned()


def learn(name: str, config_file: str, size: Size, seeds: int, began: float) -> None:
    """Trains until all seeds have learned all tasks; seconds count from the command on."""
    config = cj.load_config(config_file, {**WATCHED, **dict(size.changes)})
    stop = cj.Stop()
    watches: list[Watch] = []
    labels = {"config": config_file, "seeds": seeds}
    add = lambda figure, value, unit: Lines().add(f"{name}/{figure}", value, unit, **labels)

    def on_first() -> None:
        times = [watch.first for watch in watches if watch.first]
        if len(times) == seeds:
            add("first_iteration_s", max(times) - began, "s")

    def on_learned() -> None:
        times = [watch.learned for watch in watches if watch.learned]
        add("seeds_that_learned", len(times), "1")
        add("newest_learned_s", max(times) - began, "s")
        if len(times) == seeds:
            add("learned_s", max(times) - began, "s")
            add("learned_env_steps", max(watch.env_steps for watch in watches), "1")
            stop.request()

    def loggers(one: cj.Config) -> list[cj.Logger]:
        watches.append(Watch(one.tasks.train, size.success, on_first, on_learned))
        return [watches[-1]]

    with tempfile.TemporaryDirectory() as folder:
        cj.train(config, Path(folder) / "run", seeds=seeds, loggers=loggers, stop=stop)
    if not any(watch.learned for watch in watches):
        add("seeds_that_learned", 0, "1")


def device(size: Size, began: float) -> None:
    print(json.dumps({"device": prepare_jax(cj.load_config(size.main))}), flush=True)


def physics(size: Size, began: float) -> None:
    from cmrl_jax.bench.physics import bench_backend

    bench_backend("mjx", size.lanes, Lines())


def learner(config_file: str) -> None:
    from cmrl_jax.bench.main import bench_learner

    bench_learner(cj.load_config(config_file), Lines(xla_flags=os.environ.get("XLA_FLAGS", "")))


def workers(size: Size, began: float) -> None:
    from cmrl_jax.bench.physics import bench_workers

    bench_workers(Lines())


def naive(size: Size, began: float) -> None:
    from cmrl_jax.bench.physics import bench_naive

    bench_naive(Lines())


def play(name: str, size: Size, began: float) -> None:
    """A part, in the process that is its own."""
    for ending, flags in FLAGS.items():
        if name.endswith(ending):  # read once, when jax looks for its device
            os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip()
    prepare_jax(cj.load_config(size.main))  # its precision holds for what builds no run, too
    PARTS[name][0](size, began)


# What it is worth, and costs, to try kernels for each product; with Triton's as XLA has it.
TUNED, TRITON = "-tuned", "-triton"
FLAGS = {
    TUNED: "--xla_gpu_autotune_level=4",
    TRITON: "--xla_gpu_autotune_level=4 --xla_gpu_enable_triton_gemm=true",
}
# Name -> what it does, and the seconds that it may take at most.
PARTS: dict[str, tuple[Callable[[Size, float], None], float]] = {
    "device": (device, 60),
    "main": (lambda s, t: learn("main", s.main, s, 1, t), 300),
    "mjx": (physics, 240),
    "main-again": (lambda s, t: learn("main-again", s.main, s, 1, t), 200),
    "main-seeds": (lambda s, t: learn("main-seeds", s.main, s, s.seeds, t), 300),
    "learner": (lambda s, t: learner(s.main), 120),
    "native-workers": (workers, 120),
    "large": (lambda s, t: learn("large", s.large, s, 1, t), 900),
    "large-learner": (lambda s, t: learner(s.large), 300),
    f"large-learner{TUNED}": (lambda s, t: learner(s.large), 300),
    f"large-learner{TRITON}": (lambda s, t: learner(s.large), 300),
    f"learner{TUNED}": (lambda s, t: learner(s.main), 120),
    f"learner{TRITON}": (lambda s, t: learner(s.main), 120),
    "naive": (naive, 300),
}


def run_part(name: str, toy: bool, cache: Path, seconds: float) -> Iterator[dict[str, Any]]:
    """Rows of a part in a process of its own, as it finds them, and last how it ended."""
    command = [sys.executable, __file__, "--part", name, "--began", str(time.time())]
    # What it leaves lying when it is cut off goes with the folder of all.
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache), "TMPDIR": str(cache)}
    started = time.monotonic()
    with subprocess.Popen(
        command + ["--toy"] * toy, stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdout is not None
        timer = Timer(seconds, process.kill)
        timer.start()
        try:
            yield from (json.loads(line) for line in process.stdout if line.startswith("{"))
            code = process.wait()
        finally:
            timer.cancel()
            process.kill()
    taken = time.monotonic() - started
    if code and taken >= seconds:
        yield {"name": f"{name}/cut_off_s", "value": seconds, "unit": "s"}
    elif code:
        yield {"name": f"{name}/exit_code", "value": code, "unit": "1"}
    else:
        yield {"name": f"{name}/part_s", "value": taken, "unit": "s"}


def check(minutes: int, path: Path, chosen: Sequence[str], toy: bool) -> int:
    """Runs the parts for which there is time; returns 1 if one of them failed."""
    from cmrl_jax.bench.main import Report

    end, failed = time.monotonic() + 60 * minutes, False
    report = Report(path, "unknown", COMMAND)
    with tempfile.TemporaryDirectory() as cache:
        for name in ("device", *chosen):
            seconds = min(PARTS[name][1], end - time.monotonic())
            if seconds <= 0:
                print(f"no time is left for {name}", flush=True)
                continue
            for row in run_part(name, toy, Path(cache), seconds):
                if "device" in row:
                    report.device = row["device"]
                else:
                    report.add(**row)
                failed |= row.get("name") == f"{name}/exit_code"
    return int(failed)


def main(words: Sequence[str]) -> int:
    summary, *_ = (__doc__ or "").partition(":")
    parser = Parser(prog="python scripts/accelerator_check.py", description=summary)
    others = [name for name in PARTS if name != "device"]
    parser.add_argument("--minutes", type=whole(1), default=15, help="in all [15]")
    parser.add_argument("--json", type=typed_path, default=Path("accelerator.json"), metavar="F")
    parser.add_argument("--parts", type=names, default=others, metavar="A,B", help="only these")
    parser.add_argument("--toy", action="store_true", help="each as small as it goes")
    parser.add_argument("--list", action="store_true", help="the parts, in order")
    parser.add_argument("--part", choices=PARTS, help=argparse.SUPPRESS)  # for the process of one
    parser.add_argument("--began", type=float, default=0.0, help=argparse.SUPPRESS)
    add_force(parser)
    args = parse(parser, words)
    if args.list:
        print("\n".join(others))
        return 0
    if args.part:
        play(args.part, TOY if args.toy else Size(), args.began)
        return 0
    for name in args.parts:
        cure = f"{suggest(name, others)}choose from: {', '.join(others)}"
        require(name in others, f"unknown part '{name}'", cure)
    writable(args.json, "--json", written_by(COMMAND), args.force)
    return check(args.minutes, args.json, args.parts, args.toy)


if __name__ == "__main__":
    try:
        raise SystemExit(main(sys.argv[1:]))
    except ConfigError as error:
        raise SystemExit(refused(error.cause, error.cure)) from None
