"""`train.py [train] --config ml4.yaml`: flags of the whole schema, the run directory, signals."""

from __future__ import annotations

import argparse
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from cmrl_jax.cli.flags import COMMANDS, Parser, parse
from cmrl_jax.cli.stop_signal import StopSignal
from cmrl_jax.commands import command, program, shown
from cmrl_jax.config.extras import require_extras_of
from cmrl_jax.config.files import (
    config_dirs,
    field_types,
    find_config,
    read_yaml,
    resolve,
)
from cmrl_jax.config.schema import Config, ConfigError, leaves, require
from cmrl_jax.stop import Stop
from cmrl_jax.storage.run_dir import all_begun, config_stem, find_own_run, runs_at, seed_dirs
from cmrl_jax.streams import READER_LEFT, exit_code, to_stderr
from cmrl_jax.text.goal_files import find_table
from envs.command_line import typed_path, whole


def train_parser() -> argparse.ArgumentParser:
    """Flags of `train`: one for each leaf of the config schema, with its text and default."""
    flags = Parser(
        prog=program(),
        usage="%(prog)s --config X.yaml [--section.key VALUE ...] [--run DIR] [--seeds N] "
        "[--resume]",
        description="Meta-trains on the tasks of a YAML config, in one process, on any device.",
        epilog=f"commands: {', '.join(COMMANDS)}; each has its own --help",
        allow_abbrev=False,
    )
    flags.add_argument(
        "--config", metavar="X.yaml", type=typed_path, help="a file, or a name in configs/"
    )
    flags.add_argument("--run", metavar="DIR", type=typed_path, help="run directory [runs/X-TIME]")
    flags.add_argument(
        "--seeds",
        metavar="N",
        type=whole(1),
        help="train N seeds, from `seed` on, in one program: runs DIR/seed0, DIR/seed1, ..",
    )
    flags.add_argument(
        "--resume", action="store_true", help="go on with --run DIR, or with the newest run of X"
    )
    groups = {"": flags.add_argument_group("config: defaults < YAML < these flags")}
    for name, f, default in leaves(Config()):
        section = name.rpartition(".")[0]
        if section not in groups:
            groups[section] = flags.add_argument_group(section)
        text = f"{f.metadata['doc']} [{shown(default)}]".replace("%", "%%")
        groups[section].add_argument(
            f"--{name}", metavar=_metavar(default, f, name), default=argparse.SUPPRESS, help=text
        )
    return flags


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


def run_train(words: Sequence[str]) -> int:
    """The command `train`; returns the exit code."""
    args = vars(parse(train_parser(), words))
    name, run, seeds, resume = (args.pop(key) for key in ("config", "run", "seeds", "resume"))
    if name is None and run is not None and resume:
        first = next(iter(seed_dirs(run).values()), run)
        name = find_own_run(first) / "config.yaml"
    if name is None:
        found = sorted({p.name for d in config_dirs()[1:] for p in d.glob("*.yaml")})
        raise ConfigError("no --config given", f"add --config with one of: {', '.join(found)}")
    path = find_config(name)
    config = resolve(*read_yaml(path), flags=args)
    _check_extras(config)
    place, runs = runs_at(config, config_stem(path), run, seeds, resume)
    cause = "--seed with a directory of several seeds"
    require(not resume or len(runs) == 1 or "seed" not in args, cause, "leave it away")
    with all_begun(runs, resume, place):
        stop = StopSignal()  # before the imports that take seconds
        try:
            return _in_console(runs, place, stop, resume)
        finally:
            stop.restore()


def _in_console(runs: Sequence[tuple[Config, Path]], place: Path, stop: Stop, resume: bool) -> int:
    """Trains, and says how it ended; returns the exit code.

    Args:
        place: what the user calls the run, or the directory of all.
    """
    from cmrl_jax.formats import format_duration
    from cmrl_jax.training import trainer
    from cmrl_jax.training.console import Console
    from cmrl_jax.training.loggers import loggers_of

    # Who cannot be told what happens has left: the run saves and ends.
    consoles = [
        Console(
            config.log.progress and len(runs) == 1,
            on_error=stop.request,
            label=f"seed {config.seed}: " if len(runs) > 1 else "",
        )
        for config, _ in runs
    ]
    outcome, *_ = trainer.train_seeds(
        configs=[config for config, _ in runs],
        run_dirs=[run for _, run in runs],
        loggers=[loggers_of(console, run[0]) for console, run in zip(consoles, runs, strict=True)],
        stop=stop,
        resume=resume,
    )
    console = consoles[0]
    if outcome.is_finished:
        _report([run for _, run in runs], place, console)
        console.message(f"done in {format_duration(outcome.wall_s)}: {place}")
        return 0
    text = f"stopped after iteration {outcome.iteration}; "
    text += f"go on with: {command('--run', place, '--resume')}"
    console.message(text)
    error = next((console.error for console in consoles if console.error is not None), None)
    if error is None:
        return 0
    to_stderr(text)
    is_left = error.errno in READER_LEFT
    return 0 if is_left else exit_code(error)


def _report(runs: Sequence[Path], place: Path, console: Any) -> None:
    """Writes a page of what was trained, or says why not: a run is done without it too."""
    from cmrl_jax.analysis.report import write_report

    try:
        console.message(f"report: {write_report(runs, [], place / 'report.html')}")
    except ConfigError as error:
        console.message(f"no report: {error.cause} ({error.cure})")


def _check_extras(config: Config) -> None:
    find_table(config.goals.table)
    require_extras_of(config)
