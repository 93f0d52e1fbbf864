"""Command line: `train` (the default) and the commands in `COMMANDS`.

A user's mistake is one line of cause, one of cure and exit code 2, before jax is imported; any
other exception keeps its traceback. jax and mujoco are imported by the commands alone, so that
`--help` answers at once.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cmrl_jax import streams
from cmrl_jax.cli import (
    evaluate_flags,
    finetune_flags,
    plot_flags,
    render_flags,
    report_flags,
    train,
)
from cmrl_jax.cli.flags import COMMANDS, add_force, names, parse, parser_of
from cmrl_jax.config.files import (
    run_config,
)
from cmrl_jax.config.schema import ConfigError, call_envs
from cmrl_jax.evaluation import finetune_options
from cmrl_jax.stop import is_interrupt
from cmrl_jax.storage.output_files import distinct, writable
from cmrl_jax.storage.run_dir import find_own_run
from envs.command_line import suggest, typed_path
from envs.outputs import written_by


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    streams.open_streams()
    output: Any = streams.Output(sys.stdout)
    with contextlib.redirect_stdout(output):
        try:
            code = _outcome(words)
            failed = streams.failure(output)
        except (OSError, SystemExit):  # a failed print; `--help`, whose failed print argparse hides
            code, failed = 0, streams.failure(output) or output.error
            if failed is None:
                raise
    return streams.exit_code(failed) if failed and not code else code


def _outcome(words: list[str]) -> int:
    """The exit code of a command, after two lines where its user can mend what stopped it."""
    try:
        return _dispatch(words)
    except ConfigError as error:
        return _refuse(error.cause, error.cure)
    except ValueError as error:
        if not _stopped_its_import(error, "jax"):
            raise
        return _refuse(f"jax does not start: {error}", "correct that variable, or unset it")
    except (KeyboardInterrupt, RuntimeError) as error:
        if not is_interrupt(error):
            raise
        return 128 + signal.SIGINT


def _refuse(cause: str, cure: str) -> int:
    """Says what is wrong and what to do; returns the exit code."""
    lines = (("error", cause), ("fix", cure))
    streams.to_stderr(*(f"{label}: {' '.join(text.split())}" for label, text in lines))
    return 2


def _stopped_its_import(error: BaseException, package: str) -> bool:
    """Whether code of a package raised an error that kept the package from being imported."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    module = "" if trace is None else trace.tb_frame.f_globals.get("__name__", "")
    return module.partition(".")[0] == package and package not in sys.modules


def _dispatch(words: list[str]) -> int:
    command = "train"
    if words and not words[0].startswith("-"):
        command, *words = words
    if command not in COMMANDS:
        near = suggest(command, COMMANDS)
        cure = f"{near}commands: {', '.join(COMMANDS)}; train needs --config ml4.yaml"
        raise ConfigError(f"unknown command '{command}'", cure)
    run = {
        "train": train.run_train,
        "eval": evaluate_flags.run_eval,
        "sweep": evaluate_flags.run_sweep,
        "finetune": _finetune,
        "plot": _plot,
        "bench": _bench,
        "render": _render,
        "report": _report,
        "goals": _goals,
    }
    return run[command](words)


def _plot(words: list[str]) -> int:
    args = parse(plot_flags.add_flags(parser_of("plot", plot_flags.DESCRIPTION)), words)
    plot_flags.check_runs(args.run)
    inspected, out = args.run if args.inspect else (), args.out or args.run[0] / "plots"
    for run in inspected:
        plot_flags.check_inspectable(run)
    for name in plot_flags.PICTURES:
        writable(out / name, "--out", written_by("plot"), args.force)

    from cmrl_jax.analysis import plots

    for picture in plots.plot_learning(args.run, out):
        print(picture, flush=True)
    if inspected:
        from cmrl_jax.analysis import inspection  # jax, which no figure needs

        for run in inspected:
            print(inspection.inspect_run(run) or f"{run} has neither z nor modules to inspect")
    for picture in plots.plot_inspections(args.run, out):
        print(picture)
    return 0


def _report(words: list[str]) -> int:
    args = parse(report_flags.add_flags(parser_of("report", report_flags.DESCRIPTION)), words)
    plot_flags.check_runs(args.run)
    out = args.out or args.run[0] / "report.html"
    writable(out, "--out", written_by("report"), args.force)

    from cmrl_jax.analysis import report

    print(report.write_report(args.run, args.json, out))
    return 0


def bench_parser() -> argparse.ArgumentParser:
    """Flags of `bench`."""
    text = "Measures physics, learner, start-up and memory here; counts kernels of a GPU."
    parser = parser_of("bench", text)
    parser.add_argument(
        "--rows", type=names, default=(), metavar="A,B", help="only rows of these kinds"
    )
    parser.add_argument(
        "--json", type=typed_path, default=Path("bench.json"), metavar="F", help="[bench.json]"
    )
    add_force(parser)
    return parser


def _bench(words: list[str]) -> int:
    args = parse(bench_parser(), words)
    writable(args.json, "--json", written_by("bench"), args.force)

    from cmrl_jax.bench import main as bench

    return bench.main(json_path=args.json, rows=args.rows)


def _render(words: list[str]) -> int:
    parser = parser_of("render", render_flags.DESCRIPTION)
    run, options, out = render_flags.options_of(parse(render_flags.add_flags(parser), words))

    from envs.render.frames import choose_gl

    call_envs(choose_gl)  # before anything imports mujoco
    from cmrl_jax.analysis import render

    return render.render_run(run, options, out)


def _goals(words: list[str]) -> int:
    from cmrl_jax.cli import goals as goals_cli

    parser = parser_of("goals", goals_cli.DESCRIPTION)
    goals_cli.add_flags(parser)
    return goals_cli.run(parse(parser, words))


def _finetune(words: list[str]) -> int:
    parser = parser_of("finetune", finetune_flags.DESCRIPTION)
    args = parse(finetune_flags.add_flags(parser), words)
    options, run = finetune_flags.options_of(args), find_own_run(args.run)
    finetune_options.check_run(run_config(run), options)
    distinct(json=args.json, figure=args.figure)
    writable(args.json, "--json", written_by("finetune"), args.force)
    if args.figure is not None:
        from cmrl_jax.analysis import plots

        plots.check_figure(args.figure, "finetune", args.force)

    from cmrl_jax.cli import finetune as finetune_cli

    return finetune_cli.finetune_run(run, options, args.json, args.figure)
