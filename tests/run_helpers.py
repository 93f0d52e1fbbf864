"""Shared by the tests of whole runs: starting one, and reading back all that it left."""

import csv
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cmrl_jax.cli.main import main
from cmrl_jax.config.files import load_config
from cmrl_jax.evaluation.session import Session
from cmrl_jax.storage.checkpoint import full_store, policy_store, split_run

ROOT = Path(__file__).resolve().parent.parent
TRAIN = (sys.executable, str(ROOT / "train.py"))
ITERATIONS = 4  # of the undisturbed native run


def modular(iterations=ITERATIONS):
    """Flags of a smoke run on MuJoCo C, which compiles nothing."""
    return "--env.physics", "native", "--train.env_steps", str(600 * iterations)


def native(iterations=ITERATIONS):
    """The same without modules, half of it to compile: for tests that ask nothing of networks."""
    return *modular(iterations), "--model.net", "mlp"


def smoke_words(run, *words):
    return ["--config", "smoke.yaml", "--run", str(run), *words]


def smoke(run, *words):
    """A run of smoke.yaml in this process -> exit code."""
    return main(smoke_words(run, *words))


def start(run, *words, under=(), **environment):
    """A run of smoke.yaml in a process of its own, its lines on `stdout`.

    Args:
        under: a command that starts it, such as `nohup`.
    """
    return subprocess.Popen(
        [*under, *TRAIN, *smoke_words(run, *words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=run.parent,
        env=os.environ | environment,
    )


def run_in_shell(redirection, *words, **environment):
    """`train.py WORDS` with its streams as a shell's `redirection` leaves them."""
    command = ["sh", "-c", f'exec "$@" {redirection}', "sh", *TRAIN, *words]
    return subprocess.run(command, capture_output=True, text=True, env=os.environ | environment)


def run_and_signal(run, marker, *words, signals=(signal.SIGTERM,), under=(), **environment):
    """A run in a process of its own that gets `signals` when it prints `marker`.

    Returns:
        Its exit code and its lines.
    """
    with start(run, *words, under=under, **environment) as process:
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


def tensorboard_points(directory):
    """(env step, tag, figure) of the points in a directory, as TensorBoard shows them.

    A START drops every point of its step and of later ones.
    """
    from tensorboardX.proto import event_pb2

    events: Any = event_pb2
    points = []
    for path in sorted(directory.glob("events.*")):
        data = path.read_bytes()
        while data:  # records: length (8 bytes), checksum (4), event, checksum (4)
            length = int.from_bytes(data[:8], "little")
            event = events.Event.FromString(data[12 : 12 + length])
            if event.session_log.status == events.SessionLog.START:
                points = [point for point in points if point[0] < event.step]
            points += [(event.step, v.tag, v.simple_value) for v in event.summary.value]
            data = data[16 + length :]
    return sorted(points)


def wandb_points(directory):
    """(env step, tag, figure) of the points that W&B's offline runs in a directory hold.

    Films, which are files to W&B, are left out.
    """
    import wandb
    from wandb.proto import wandb_internal_pb2

    # A process of W&B's own writes the files, and goes on after a run has finished; this waits.
    wandb.teardown()
    proto: Any = wandb_internal_pb2
    points = {}
    for path in sorted(directory.glob("offline-run-*/*.wandb")):
        for data in leveldb_records(path.read_bytes()):
            record = proto.Record.FromString(data)
            if record.WhichOneof("record_type") == "history":
                items = {i.key or "/".join(i.nested_key): i.value_json for i in record.history.item}
                step = int(items.pop("_step"))
                shown = {k: v for k, v in items.items() if not k.startswith(("_", "film/"))}
                points |= {(step, name): json.loads(value) for name, value in shown.items()}
    return sorted((step, name, float(np.float32(v))) for (step, name), v in points.items())


def leveldb_records(data):
    """The records of a file in LevelDB's log format, after W&B's 7 bytes of their own."""
    block, at, parts = 32768, 7, []
    while at + 7 <= len(data):
        if block - at % block < 7:  # a header does not straddle blocks
            at += block - at % block
            continue
        length, kind = int.from_bytes(data[at + 4 : at + 6], "little"), data[at + 6]
        parts.append(data[at + 7 : at + 7 + length])
        at += 7 + length
        if kind in (1, 4):  # whole, or the last part
            yield b"".join(parts)
            parts = []


def csv_points(path):
    """The figures of metrics.csv in the form of `tensorboard_points`."""
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    leading = ("iteration", "env_steps", "gradient_steps", "wall_s", "seed")
    return sorted(
        (int(row["env_steps"]), name, float(np.float32(text)))
        for row in rows
        for name, text in row.items()
        if text and name not in leading
    )


def leaves_of(tree):
    """{path: array}; typed keys as their numbers."""
    plain = lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): np.asarray(plain(leaf)) for path, leaf in leaves}


def abstract_run(run):
    """The shapes of a run's state, by checkpoint item."""
    config = load_config(str(run / "config.yaml"))
    return split_run(jax.eval_shape(Session(config).algorithm.init, jax.random.key(0)))


def checkpoint_leaves(run, step=None):
    """{path: array} of a full checkpoint, the newest by default, and its meta record."""
    with full_store(run, read_only=True) as store:
        trees, meta = store.restore(abstract_run(run), step=step)
    return leaves_of(trees), meta


def steps(run):
    """Iterations of a run's full checkpoints."""
    with full_store(run, read_only=True) as store:
        return store.steps()


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


def go_on(run, undisturbed):
    """Resumes a run to its end, which must be that of the undisturbed one."""
    assert smoke(run, *native(), "--resume") == 0
    assert_same_result(run, undisturbed)
