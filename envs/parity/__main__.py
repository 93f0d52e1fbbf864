"""How far the port is from Meta-World: `python -m envs.parity.__main__`.

Five parts, each against the environment objects of the `metaworld` package: (1) observation, reward
and success in injected states, (2) one control step from them, (3) recorded actions replayed,
(4) scripted policies in closed loop, (5) start observations. It reports and does not judge: the
exit code is 0 whenever it could measure.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import time
from collections.abc import Sequence
from typing import Any

from envs.command_line import Parser, run, typed_path, whole
from envs.goal_names import GOALS, LARGEST_SEED, name_of
from envs.goal_sets import load_goal_set
from envs.outputs import FORCE_HELP, check_output, write_json, written_by

DEFAULT_NOISE = 0.3  # of the second closed-loop run when all parts are measured
STATE_GOALS = 10  # parts 1 to 3 take their states from at most so many goals a task
MAX_HORIZON = 500  # Meta-World's own limit


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="python -m envs.parity.__main__",
        description="Measures this port of Meta-World's ML4 tasks against Meta-World itself.",
        allow_abbrev=False,
    )
    parser.add_argument("--policies", action="store_true", help="part 4 only: scripted policies")
    parser.add_argument("--physics", default="mjx", metavar="mjx|native", help="backend [mjx]")
    goals = whole(1, GOALS, f"a goal set has {GOALS} goals a task")
    parser.add_argument("--goals", type=goals, default=10, metavar="N", help="goals a task [10]")
    parser.add_argument(
        "--seed",
        type=whole(0, LARGEST_SEED),
        metavar="S",
        help="of the noise [0]; without --goal-set also of the goals: fresh:S, or the packaged "
        "set of that seed (0: train, 1000: heldout)",
    )
    parser.add_argument("--goal-set", metavar="NAME", help="train, heldout or fresh:S [heldout]")
    parser.add_argument(
        "--noise",
        type=float,
        metavar="X",
        help=f"action noise of part 4 [0; all parts: 0 and {DEFAULT_NOISE}]",
    )
    steps = whole(1, MAX_HORIZON, f"Meta-World's episodes end at {MAX_HORIZON} steps")
    parser.add_argument(
        "--horizon", type=steps, default=200, metavar="H", help="control steps an episode [200]"
    )
    parser.add_argument("--json", type=typed_path, metavar="F", help="write the figures there, too")
    parser.add_argument("--force", action="store_true", help=FORCE_HELP)
    return parser


def _check(args: argparse.Namespace) -> None:
    """Raises ValueError (cause, cure) for what the parser cannot see."""
    if args.physics not in ("mjx", "native"):
        raise ValueError(f"unknown physics backend '{args.physics}'\nuse --physics mjx or native")
    if args.noise is not None and not 0 <= args.noise < float("inf"):
        raise ValueError(f"--noise {args.noise} is no standard deviation\nuse 0 or more, as 0.3")
    if args.json:
        check_output(args.json, "--json", written_by("envs.parity.__main__"), args.force)


def measure(
    physics: str,
    goal_set: str,
    goals: int,
    horizon: int,
    noises: Sequence[float],
    seed: int,
    all_parts: bool,
) -> dict[str, Any]:
    """Measures the port.

    Args:
        physics: backend, `mjx` or `native`.
        goal_set: see `goal_sets.load_goal_set`.
        goals: goals a task, the first of the set.
        horizon: control steps an episode.
        noises: standard deviations of the action noise, one closed-loop run each; the figures of
            the first stand directly under the task's name.
        seed: of noise and of perturbed and random rollouts.
        all_parts: False measures the closed loop only.

    Returns:
        A dict in the shape of the JSON file.

    Raises:
        ValueError: unknown goal set.
    """
    places = load_goal_set(goal_set)[:, :goals]
    # Parity is a matter of float32; TF32 on an accelerator would be another number format.
    import jax

    jax.config.update("jax_default_matmul_precision", "highest")
    from envs.parity import parts as parts
    from envs.tasks import METAWORLD_TASKS

    port = parts.Port(places.shape[0] * goals, physics)
    tasks: dict[str, dict[str, Any]] = {task: {} for task in METAWORLD_TASKS}

    def add(results: list[dict[str, Any]]) -> None:
        for task, result in zip(METAWORLD_TASKS, results, strict=True):
            tasks[task] |= result

    runs = {}
    for noise in noises:
        stream = parts.draw_noise(places, horizon, noise, seed)
        runs[f"{noise:g}"] = parts.measure_closed_loop(port, places, stream)
    add(next(iter(runs.values())))
    add(
        [
            {"closed_loop": {n: run[i] for n, run in runs.items()}}
            for i in range(len(METAWORLD_TASKS))
        ]
    )
    if all_parts:
        rollouts = parts.record(places[:, :STATE_GOALS], horizon, seed)
        add(parts.measure_injected(port, rollouts))
        add(parts.measure_open_loop(port, rollouts))
        add(parts.measure_resets(port, places))
    names = ("jax", "mujoco", "mujoco-mjx", "metaworld")
    return {
        "tasks": tasks,
        "physics": physics,
        "goals": goals,
        "goal_set": goal_set,
        "seed": seed,
        "noise": noises[0],
        "horizon": horizon,
        "versions": {name: importlib.metadata.version(name) for name in names},
    }


def _measure_and_report(words: Sequence[str] | None) -> None:
    args = _parser().parse_args(words)
    _check(args)
    goal_set = args.goal_set or ("heldout" if args.seed is None else name_of(args.seed))
    noises = [args.noise or 0.0]
    if not args.policies:
        noises.append(DEFAULT_NOISE if noises[0] == 0 else 0.0)
    start = time.perf_counter()
    seed, all_parts = args.seed or 0, not args.policies
    result = measure(args.physics, goal_set, args.goals, args.horizon, noises, seed, all_parts)
    result["seconds"] = round(time.perf_counter() - start, 1)
    from envs.parity.report import finite, report

    print(report(result))
    print(f"\nmeasured in {result['seconds']:.0f} s, compiling included")
    if args.json:
        write_json(args.json, "envs.parity.__main__", finite(result))


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the measurement; a mistake of the user is two lines (cause, cure) and exit code 2."""
    return run(lambda: _measure_and_report(argv))


if __name__ == "__main__":
    raise SystemExit(main())
