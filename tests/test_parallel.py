"""Several devices compute what one computes, up to the order of sums, and share its checkpoints.

Runs on four fake CPU devices are processes of their own: this one keeps its single device.
"""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from run_helpers import ITERATIONS, ROOT, checkpoint_leaves, modular, rows_of, smoke, start

from cmrl_jax import parallel
from cmrl_jax.algorithms.cmrl.rules import Rules
from cmrl_jax.config.files import load_config
from cmrl_jax.config.schema import ConfigError

DEVICES = 4


def on_four_devices(run, *words):
    with start(run, *words, JAX_NUM_CPU_DEVICES=str(DEVICES)) as process:
        out = process.communicate()[0]
    assert process.returncode == 0, out
    assert f"{DEVICES} device(s)" in out and "rematerialization" not in out, out


def assert_close_training(run, other):
    """The same draws throughout; sums over lanes and batch are made in another order.

    What differs by rounding in the first gradient differs by a step in a weight whose gradient is
    about zero, since Adam divides one by the other: measured after 30 steps, 3 % of a small bias's
    norm and 3e-3 of a figure. Other draws, or a lane less, differ by tenths.
    """
    for index, (row, expected) in enumerate(zip(rows_of(run), rows_of(other), strict=True)):
        tolerance = 1e-3 if index < 2 else 1e-2  # before Adam has amplified anything, and after
        for column in row:
            if column.startswith("train/"):
                figures = [
                    float(text) if text else np.nan for text in (row[column], expected[column])
                ]
                np.testing.assert_allclose(
                    *figures, rtol=tolerance, atol=tolerance / 10, err_msg=column
                )
    leaves, meta = checkpoint_leaves(run)
    expected, expected_meta = checkpoint_leaves(other)
    assert leaves.keys() == expected.keys()
    assert meta["iteration"] == expected_meta["iteration"]
    for path, leaf in expected.items():
        if leaf.dtype.kind in "iu":  # counters and the key
            np.testing.assert_array_equal(leaves[path], leaf, err_msg=path)
        else:
            distance = np.linalg.norm(leaves[path] - leaf)
            assert distance <= 0.1 * np.linalg.norm(leaf) + 1e-3, path


@pytest.mark.slow
def test_a_run_begun_on_four_devices_goes_on_with_one(undisturbed_modular, tmp_path):
    run = tmp_path / "run"
    on_four_devices(run, *modular(ITERATIONS - 1))
    assert json.loads((run / "versions.json").read_text())["device_count"] == DEVICES
    assert smoke(run, *modular(), "--resume") == 0
    assert_close_training(run, undisturbed_modular)


@pytest.mark.slow
def test_a_run_begun_on_one_device_goes_on_with_four(undisturbed_modular, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(undisturbed_modular, run)
    shutil.rmtree(run / "ckpt" / str(ITERATIONS))
    on_four_devices(run, *modular(), "--resume")
    assert_close_training(run, undisturbed_modular)


def test_lanes_rings_and_batches_lie_in_four_parts():
    script = Path(__file__).with_name("four_devices.py")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, str(script)], capture_output=True, env=environment)
    assert done.returncode == 0, done.stderr.decode()


def test_one_device_has_no_mesh_and_no_other_program():
    assert jax.device_count() == 1 and parallel.make_mesh() is None
    x = jnp.zeros(3)
    with parallel.using(None):
        assert parallel.split(x) is x and parallel.gather(x) is x and not parallel.is_split()
        assert parallel.by_part(jnp.sin) is jnp.sin
    shapes = jax.eval_shape(lambda: {"a": x})
    assert parallel.placed(shapes, None) is shapes


@pytest.mark.parametrize(
    "flags, devices, cause, cure",
    [
        ({}, 1, None, None),
        ({}, 4, None, None),
        ({}, 8, "collect.lanes 12 cannot be divided among 8 devices", "collect.lanes: 24,"),
        ({"train.capacity": "2004"}, 8, "collect.lanes", "24"),
        ({"collect.lanes": "24", "train.capacity": "2008"}, 16, "collect.lanes", ": 48,"),
        ({"collect.lanes": "24", "train.capacity": "2000"}, 3, "train.capacity 2000", ": 2016,"),
        ({"train.capacity": "2004"}, 3, "collect.context_episodes 2", ": 3,"),
        ({"train.capacity": "2004", "collect.context_episodes": "3"}, 3, "sac.batch 32", ": 33,"),
    ],
)
def test_what_cannot_be_divided_is_refused(flags, devices, cause, cure):
    config = load_config("smoke.yaml", flags)
    if cause is None:
        Rules(config).check_devices(devices)
        return
    with pytest.raises(ConfigError) as raised:
        Rules(config).check_devices(devices)
    assert cause in raised.value.cause and cure in raised.value.cure
    assert "fewer devices" in raised.value.cure


def test_the_context_of_prior_lanes_alone_is_divided_too():
    config = load_config("smoke.yaml")  # 1 prior lane a task, 50 steps, 2 episodes
    collect = dataclasses.replace(config.collect, context_lanes="prior")
    config = dataclasses.replace(config, collect=dataclasses.replace(collect, context_episodes=1))
    with pytest.raises(ConfigError, match="context_episodes 1 cannot"):
        Rules(config).check_devices(4)


def test_too_many_devices_are_two_lines_before_any_compile(tmp_path):
    with start(tmp_path / "run", *modular(), JAX_NUM_CPU_DEVICES="5") as process:
        out = process.communicate()[0]
    assert process.returncode == 2
    cause, cure = out.splitlines()[-2:]
    assert cause == "error: collect.lanes 12 cannot be divided among 5 devices"
    assert cure.startswith("fix: set collect.lanes: 15, or show fewer devices")
    assert "compiling" not in out
