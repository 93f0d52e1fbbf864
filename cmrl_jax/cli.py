"""Command line: `train` (the default), `eval`, `plot` and `bench`.

A user's mistake is one line of cause, one of cure and exit code 2, before jax is imported; any
other exception keeps its traceback. jax and mujoco are imported by the commands alone, so that
`--help` answers at once.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NoReturn

from cmrl_jax.config import Config, ConfigError, leaves, suggest
from cmrl_jax.config_io import (
    check_resumable,
    config_dirs,
    field_types,
    find_config,
    read_yaml,
    resolve,
    to_yaml,
)
from cmrl_jax.run_dir import (
    config_stem,
    find_run,
    new_run,
    resumed_run,
    write_text,
    writing_to,
)
from cmrl_jax.stop import StopSignal
from cmrl_jax.validate import check_goal_set

COMMANDS = ("train", "eval", "plot", "bench")
# Commands and options of the design whose code is not there yet: refused by name.
NOT_BUILT = ("sweep", "finetune", "render", "goals")
EVAL_NOT_BUILT = {"z": ("prior", "shuffled", "other", "text"), "physics": ("metaworld",)}


class _Parser(argparse.ArgumentParser):
    """argparse with our two-line errors in place of its usage text."""

    def error(self, message: str) -> NoReturn:
        raise ConfigError(message, f"see: {self.prog} --help")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        return _dispatch(words)
    except ConfigError as error:
        for label, text in (("error", error.cause), ("fix", error.cure)):
            print(f"{label}: {' '.join(text.split())}", file=sys.stderr)
        return 2


def _dispatch(words: list[str]) -> int:
    command = "train"
    if words and not words[0].startswith("-"):
        command, *words = words
    if command in NOT_BUILT:
        cause = f"the command '{command}' is not built yet"
        raise ConfigError(cause, f"commands: {', '.join(COMMANDS)}")
    if command not in COMMANDS:
        near = suggest(command, COMMANDS)
        cure = f"{near}commands: {', '.join(COMMANDS)}; train needs --config ml4.yaml"
        raise ConfigError(f"unknown command '{command}'", cure)
    return {"train": _train, "eval": _eval, "plot": _plot, "bench": _bench}[command](words)


def _parse(parser: argparse.ArgumentParser, words: list[str]) -> argparse.Namespace:
    """Parses all of `words`; the first that means nothing is an error with a suggestion."""
    args, unknown = parser.parse_known_args(words)
    if unknown:
        word = unknown[0].partition("=")[0]
        flags = [flag for flag in parser._option_string_actions if flag.startswith("--")]
        cure = f"{suggest(word, flags)}see: {parser.prog} --help"
        raise ConfigError(f"unknown argument '{word}'", cure)
    return args


def train_parser() -> argparse.ArgumentParser:
    """Flags of `train`: one for each leaf of the config schema, with its text and default."""
    parser = _Parser(
        prog="python train.py",
        usage="python train.py --config X.yaml [--section.key VALUE ...] [--run DIR] [--resume]",
        description="Meta-trains on the tasks of a YAML config, in one process, on any device.",
        epilog=f"commands: {', '.join(COMMANDS)}; each has its own --help",
        allow_abbrev=False,
    )
    parser.add_argument("--config", metavar="X.yaml", help="a file, or a name in configs/")
    parser.add_argument("--run", metavar="DIR", type=Path, help="run directory [runs/X-TIME]")
    parser.add_argument(
        "--resume", action="store_true", help="go on with --run DIR, or with the newest run of X"
    )
    groups = {"": parser.add_argument_group("config: defaults < YAML < these flags")}
    for name, f, default in leaves(Config()):
        section = name.rpartition(".")[0]
        if section not in groups:
            groups[section] = parser.add_argument_group(section)
        text = f"{f.metadata['doc']} [{_shown(default)}]".replace("%", "%%")
        groups[section].add_argument(
            f"--{name}", metavar=_metavar(default, f, name), default=argparse.SUPPRESS, help=text
        )
    return parser


def _shown(default: Any) -> str:
    if isinstance(default, tuple):
        return ",".join(str(item) for item in default)
    return str(default).lower() if isinstance(default, bool) else str(default)


def _metavar(default: Any, f: Any, name: str) -> str:
    owner: Any = Config
    for section in name.split(".")[:-1]:
        owner = field_types(owner)[section]
    hint = field_types(owner)[f.name]
    if typing.get_origin(hint) is Literal:
        return "|".join(typing.get_args(hint))
    if typing.get_origin(hint) is tuple:
        return "A,B,.."
    return {bool: "true|false", int: "N", float: "X", str: "TEXT"}[type(default)]


def _train(words: list[str]) -> int:
    args = vars(_parse(train_parser(), words))
    name, run, resume = args.pop("config"), args.pop("run"), args.pop("resume")
    if name is None and run is not None and resume:
        name = str(find_run(run) / "config.yaml")
    if name is None:
        found = sorted({p.name for d in config_dirs()[1:] for p in d.glob("*.yaml")})
        raise ConfigError("no --config given", f"add --config with one of: {', '.join(found)}")
    path = find_config(name)
    config = resolve(*read_yaml(path), flags=args)
    _check_extras(config)
    if resume:
        run = resumed_run(config_stem(path), run)
        if (run / "config.yaml").is_file():
            check_resumable(read_yaml(run / "config.yaml")[0], config, run)
    else:
        run = new_run(config_stem(path), run)
    with writing_to(run):
        write_text(run / "config.yaml", to_yaml(config))  # from here on it can be resumed
        stop = StopSignal()  # before the imports that take seconds
        try:
            from cmrl_jax import trainer

            return trainer.train(config=config, run_dir=run, stop=stop, resume=resume)
        finally:
            stop.restore()


def _check_extras(config: Config) -> None:
    if config.log.tensorboard and importlib.util.find_spec("tensorboardX") is None:
        cause = "log.tensorboard needs the package tensorboardX, which is not installed"
        raise ConfigError(cause, "pip install 'cmrl-jax[viz]', or set log.tensorboard: false")


def _counts(text: str) -> tuple[int, ...]:
    counts = tuple(int(item) for item in text.split(","))
    if min(counts) < 0:
        raise ValueError(text)
    return counts


def _natural(text: str) -> int:
    number = int(text)
    if number < 0:
        raise ValueError(text)
    return number


_counts.__name__, _natural.__name__ = "list of counts", "whole number"  # argparse names them


def eval_parser() -> argparse.ArgumentParser:
    """Flags of `eval`."""
    parser = _Parser(
        prog="python train.py eval",
        description="Evaluates a policy checkpoint: k adaptation episodes, then the one counted.",
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("--run", metavar="DIR", type=Path, required=True, help="run directory")
    add("--k", type=_counts, metavar="0,1,2", help="adaptation episodes [eval.final_k of the run]")
    add("--goals", type=_natural, default=50, metavar="N", help="goals a task, 1 to 50 [50]")
    add("--goal-set", default="heldout", metavar="SET", help="train, heldout or fresh:<seed>")
    add("--seed", type=_natural, default=0, metavar="S", help="seed of the evaluation's draws [0]")
    add("--horizon", type=_natural, metavar="H", help="control steps an episode [env.horizon]")
    add("--checkpoint", type=_natural, metavar="N", help="iteration of the checkpoint [the last]")
    add(
        "--physics",
        metavar="P",
        choices=("mjx", "native", *EVAL_NOT_BUILT["physics"]),
        help="mjx, native; metaworld is not built yet [env.physics of the run]",
    )
    add(
        "--z",
        default="posterior",
        metavar="Z",
        choices=("posterior", *EVAL_NOT_BUILT["z"]),
        help="posterior; prior, shuffled, other and text are not built yet [posterior]",
    )
    add("--text", metavar="SENTENCE", help="a goal in your own words (not built yet)")
    add("--json", type=Path, metavar="F", help="write the figures to this file")
    return parser


def _eval(words: list[str]) -> int:
    args = _parse(eval_parser(), words)
    for name, options in EVAL_NOT_BUILT.items():
        if getattr(args, name) in options:
            cause = f"--{name} {getattr(args, name)} is not built yet"
            raise ConfigError(cause, f"leave --{name} out")
    if args.text is not None:
        raise ConfigError("--text is not built yet", "leave --text out")
    check_goal_set(args.goal_set, "--goal-set")
    if not 1 <= args.goals <= 50:
        raise ConfigError(f"--goals is {args.goals}", "give 1 to 50: a goal set has 50 a task")
    if args.horizon == 0:
        raise ConfigError("--horizon is 0", "give at least one control step")
    run = find_run(args.run)
    config = resolve(*read_yaml(run / "config.yaml"))
    k = args.k if args.k is not None else config.eval.final_k
    if config.model.conditioning != "z" and any(k):
        cause = f"--k {_shown(k)} with model.conditioning {config.model.conditioning}"
        raise ConfigError(cause, "give --k 0: only a latent z can adapt")
    _writable(args.json)

    from cmrl_jax import evaluate_cli

    return evaluate_cli.evaluate_run(
        run=run,
        k=k,
        goals=args.goals,
        goal_set=args.goal_set,
        seed=args.seed,
        horizon=args.horizon,
        physics=args.physics,
        checkpoint=args.checkpoint,
        json_path=args.json,
    )


def plot_parser() -> argparse.ArgumentParser:
    """Flags of `plot`."""
    parser = _Parser(
        prog="python train.py plot",
        description="Draws success per task over env steps from a run's metrics.csv.",
        allow_abbrev=False,
    )
    parser.add_argument("--run", metavar="DIR", type=Path, required=True, help="run directory")
    parser.add_argument("--out", metavar="F", type=Path, help="picture [DIR/success.png]")
    return parser


def _plot(words: list[str]) -> int:
    args = _parse(plot_parser(), words)

    from cmrl_jax import plots

    out = args.out or args.run / "success.png"
    plots.plot_success(args.run, out)
    print(out)
    return 0


def bench_parser() -> argparse.ArgumentParser:
    """Flags of `bench`."""
    parser = _Parser(
        prog="python train.py bench",
        description="Measures physics, learner, start-up and memory on this machine.",
        allow_abbrev=False,
    )
    parser.add_argument("--rows", default="", metavar="A,B", help="only rows of these kinds")
    parser.add_argument(
        "--json", type=Path, default=Path("bench.json"), metavar="F", help="[bench.json]"
    )
    return parser


def _bench(words: list[str]) -> int:
    args = _parse(bench_parser(), words)
    _writable(args.json)

    from cmrl_jax import bench

    rows = tuple(row.strip() for row in args.rows.split(",") if row.strip())
    return bench.main(json_path=args.json, rows=rows)


def _writable(path: Path | None) -> None:
    """Fails now rather than after an hour of figures."""
    if path is None:
        return
    try:
        existed = path.exists()
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("a", encoding="utf-8").close()
        if not existed:
            path.unlink()
    except OSError as error:
        cause = f"cannot write {path}: {error.strerror}"
        raise ConfigError(cause, "give --json a file you may write to") from error
