"""The script for a borrowed accelerator, on a CPU: each part at toy size, and parts that fail."""

import json
import math

import jax
import pytest

from cmrl_jax.config.schema import ConfigError
from scripts import accelerator_check
from scripts.accelerator_check import PARTS, main

JSON = "check.json"


@pytest.fixture
def check(tmp_path):
    """Runs the script at toy size -> exit code, and its file."""

    def run(*words):
        path = tmp_path / JSON
        code = main(["--toy", "--json", str(path), *words])
        return code, json.loads(path.read_text())

    return run


def figures_of(document):
    return {row["name"]: row["value"] for row in document["rows"]}


@pytest.mark.slow
def test_every_part_ends_and_leaves_its_figures(check, monkeypatch):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    parts = [name for name in PARTS if name not in ("device", "naive")]
    code, document = check("--parts", ",".join(parts))
    figures = figures_of(document)
    assert code == 0 and document["device"].startswith("cpu")
    assert {f"{name}/part_s" for name in ("device", *parts)} <= figures.keys()
    assert all(math.isfinite(value) for value in figures.values())
    # Every run learned at once, as a toy asks no success of it.
    assert figures["main/seeds_that_learned"] == figures["large/seeds_that_learned"] == 1
    assert figures["main-seeds/seeds_that_learned"] == accelerator_check.TOY.seeds
    assert figures["main/learned_env_steps"] == 600
    # What was compiled for the first is there for the second.
    assert figures["main-again/first_iteration_s"] < figures["main/first_iteration_s"]
    assert figures["mjx/control_steps_per_s"] > 0
    rates = [r for r in document["rows"] if r["name"] == "learner/gradient_steps_per_s"]
    tuned, triton = accelerator_check.FLAGS.values()
    assert [r["xla_flags"] for r in rates] == ["", "", tuned, triton, tuned, triton]
    assert all(r["value"] > 0 for r in rates)
    workers = [r["workers"] for r in document["rows"] if r["name"].startswith("native_workers/")]
    assert workers[:2] == [1, 2]


def test_a_part_that_fails_is_told_and_the_next_one_runs(check, monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "none")
    code, document = check("--parts", "learner,main")
    assert code == 1
    assert [row["name"] for row in document["rows"]] == [
        f"{name}/exit_code" for name in ("device", "learner", "main")
    ]


def test_a_part_that_takes_too_long_is_cut_off_and_none_begins_without_time(
    check, monkeypatch, capsys
):
    function, _ = PARTS["device"]
    monkeypatch.setitem(PARTS, "device", (function, 0.2))
    monkeypatch.setitem(PARTS, "learner", (function, 0.0))
    code, document = check("--parts", "learner")
    assert code == 0 and figures_of(document) == {"device/cut_off_s": 0.2}
    assert "no time is left for learner" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "cause"),
    [
        (("--parts", "lerner"), "unknown part 'lerner'"),
        (("--minutes", "0"), "argument --minutes: 0 is no whole number from 1"),
        (("--seed", "1"), "unknown argument '--seed'"),
    ],
)
def test_mistakes_are_refused(words, cause, tmp_path):
    with pytest.raises(ConfigError) as error:
        main([*words, "--json", str(tmp_path / JSON)])
    assert error.value.cause.startswith(cause) and error.value.cure
    assert not (tmp_path / JSON).exists()


def test_a_file_of_another_command_stays(tmp_path):
    path = tmp_path / JSON
    path.write_text("mine")
    with pytest.raises(ConfigError, match="this command did not write it"):
        main(["--toy", "--json", str(path)])
    assert path.read_text() == "mine"


def test_every_part_computes_as_a_run_does(monkeypatch):
    """In full precision, also where no run is built that would ask for it."""
    seen = []
    note = lambda size, began: seen.append(jax.config.jax_default_matmul_precision)
    monkeypatch.setitem(PARTS, "mjx", (note, 60))
    before = jax.config.jax_default_matmul_precision
    jax.config.update("jax_default_matmul_precision", None)
    try:
        main(["--toy", "--part", "mjx"])
    finally:
        jax.config.update("jax_default_matmul_precision", before)
    assert seen == ["highest"]
