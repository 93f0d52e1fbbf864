"""Shared by the tests of whole runs: starting one, and reading back all that it left."""

import csv
import os
import signal
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from cmrl_jax.checkpoint import full_store, policy_store, split_run
from cmrl_jax.cli import main
from cmrl_jax.collect import init_run
from cmrl_jax.config_io import load_config
from cmrl_jax.session import Session

ROOT = Path(__file__).resolve().parent.parent
ITERATIONS = 4  # of the undisturbed native run


def native(iterations=ITERATIONS):
    """Flags of a smoke run of seconds: MuJoCo C compiles nothing."""
    return "--env.physics", "native", "--train.env_steps", str(600 * iterations)


def smoke_words(run, *words):
    return ["--config", "smoke.yaml", "--run", str(run), *words]


def smoke(run, *words):
    """A run of smoke.yaml in this process -> exit code."""
    return main(smoke_words(run, *words))


def start(run, *words, **environment):
    """A run of smoke.yaml in a process of its own, its lines on `stdout`."""
    return subprocess.Popen(
        [sys.executable, str(ROOT / "train.py"), *smoke_words(run, *words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=run.parent,
        env=os.environ | environment,
    )


def run_and_signal(run, marker, *words, signals=(signal.SIGTERM,), **environment):
    """A run in a process of its own that gets `signals` when it prints `marker`.

    Returns:
        Its exit code and its lines.
    """
    with start(run, *words, **environment) as process:
        assert process.stdout is not None
        lines = []
        for line in process.stdout:
            lines.append(line)
            if line.startswith(marker):
                for number in signals:
                    process.send_signal(number)
        return process.wait(), lines


def rows_of(run):
    """Rows of metrics.csv as text, without the columns that depend on the clock."""
    with open(run / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    is_clock = lambda column: column == "wall_s" or column.startswith("time/")
    return [{c: text for c, text in row.items() if not is_clock(c)} for row in rows]


def leaves_of(tree):
    """{path: array}; typed keys as their numbers."""
    plain = lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): np.asarray(plain(leaf)) for path, leaf in leaves}


def abstract_run(run):
    """The shapes of a run's state, by checkpoint item."""
    config = load_config(str(run / "config.yaml"))
    learner = Session(config).learner
    return split_run(jax.eval_shape(lambda key: init_run(config, learner, key), jax.random.key(0)))


def checkpoint_leaves(run, step=None):
    """{path: array} of a full checkpoint, the newest by default, and its meta record."""
    with full_store(run, read_only=True) as store:
        trees, meta = store.restore(abstract_run(run), step=step)
    return leaves_of(trees), meta


def policy_steps(run):
    """Iterations of a run's policy checkpoints."""
    with policy_store(run, read_only=True) as store:
        return store.steps()


def assert_same_result(run, other):
    """Bit for bit: every leaf of the newest checkpoint, and all of metrics.csv but the clock.

    And policy checkpoints of the same iterations.
    """
    assert policy_steps(run) == policy_steps(other)
    header = [(r / "metrics.csv").read_bytes().splitlines()[0] for r in (run, other)]
    assert header[0] == header[1]
    assert rows_of(run) == rows_of(other)
    leaves, meta = checkpoint_leaves(run)
    expected, expected_meta = checkpoint_leaves(other)
    assert leaves.keys() == expected.keys() and len(leaves) > 30
    for path, leaf in expected.items():
        assert leaf.dtype == leaves[path].dtype
        assert leaf.tobytes() == leaves[path].tobytes(), path
    timed = ("wall_s", "csv_offset")
    for name in expected_meta.keys() - timed:
        assert meta[name] == expected_meta[name], name
