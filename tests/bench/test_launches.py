"""Kernels of a compiled program, counted from its text; the text is that of the CPU's compiler."""

import importlib.metadata
import importlib.util
import json
import subprocess

import jax
import jax.numpy as jnp
import pytest

from cmrl_jax.bench import launches
from cmrl_jax.bench.launches import Launches, bench_launches, count_launches
from cmrl_jax.bench.main import Report
from cmrl_jax.config.schema import ConfigError


def count(function, *args):
    return count_launches(jax.jit(function).lower(*args).compile().as_text() or "").kernels


X = jnp.arange(6.0).reshape(2, 3)
square = lambda x: jnp.tanh(x @ x.T) @ x  # more than one kernel


def loop(outer, inner):
    def body(_, x):
        return jax.lax.fori_loop(0, inner, lambda _, x: square(x), jnp.sin(x))

    return lambda x: jax.lax.fori_loop(0, outer, body, x)


def test_a_loop_counts_its_body_as_often_as_it_runs():
    counts = {(m, n): count(loop(m, n), X) for m in (50, 60) for n in (30, 40)}
    inner = (counts[50, 40] - counts[50, 30]) / (50 * 10)
    assert inner >= 3 and inner == int(inner)
    assert counts[60, 40] - counts[60, 30] == 60 * 10 * inner
    outer = (counts[60, 30] - counts[50, 30]) / 10 - 30 * inner
    assert outer >= 1 and outer == int(outer)


def test_a_loop_that_may_end_early_counts_once():
    def search(x):
        return jax.lax.while_loop(lambda x: jnp.sum(x) < 100.0, square, x)

    assert count(square, X) <= count(search, X) <= 3 * count(square, X)


def test_of_branches_the_costliest_counts():
    long = lambda x: square(square(square(x)))

    def either(first, second):
        branch = lambda x: jax.lax.cond(x[0, 0] > 0, first, second, x)
        return count(branch, X)

    assert either(long, square) == either(square, long) > either(square, square)
    index = lambda i, x: jax.lax.switch(i, [square, long, square], x)
    assert count(index, 1, X) >= count(long, X)


def test_copies_are_counted_apart():
    text = """
ENTRY %main (x: f32[2]) -> f32[2] {
  %x = f32[2]{0} parameter(0)
  %copy.1 = f32[2]{0} copy(%x)
  ROOT %fusion = f32[2]{0} fusion(%copy.1), kind=kLoop, calls=%fused
}
"""
    assert count_launches(text) == Launches(kernels=2, copies=1)


def test_without_the_wheels_they_are_skipped_or_refused(tmp_path, capsys, monkeypatch, refused):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    bench_launches(Report(tmp_path / "bench.json", "cpu"))
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith("skipped: rows 'launches' need jax's CUDA wheels")
    cause, cure = refused("bench", "--rows", "launches", "--json", str(tmp_path / "bench.json"))
    assert cause == "rows 'launches' need jax's CUDA wheels"
    assert f"jax-cuda13-plugin=={importlib.metadata.version('jaxlib')}" in cure
    assert not (tmp_path / "bench.json").exists()


def test_a_program_that_does_not_compile_stops_it_and_leaves_the_rows(
    tmp_path, monkeypatch, capsys
):
    row = 'noise\n{"kernels": 9.5, "copies": 1, "compile_s": 3}\n'
    ptxas = "function 'fusion_4', {} bytes spill stores, 9 bytes spill loads\n"
    warned = ptxas.format(700) + "other\n" + ptxas.format(44)
    answers = [
        subprocess.CompletedProcess((), 0, row, warned),
        subprocess.CompletedProcess((), 1, "", "no such device\n"),
    ]
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(subprocess, "run", lambda command, **options: answers.pop(0))
    monkeypatch.setattr(launches, "PROGRAMS", {"gradient_step": ("a.yaml",), "vector_step": ("b",)})
    with pytest.raises(ConfigError, match="'vector_step' does not compile"):
        bench_launches(Report(tmp_path / "bench.json", "cpu"))
    rows = json.loads((tmp_path / "bench.json").read_text())["rows"]
    figures = {row["name"]: row["value"] for row in rows}
    assert figures["launches/gradient_step"] == 9.5 and len(figures) == 4
    assert figures["launches/gradient_step_spilled_bytes"] == 744
    assert "no such device" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(("config_file", "most"), [("ml4.yaml", 370), ("ml4-large.yaml", 480)])
def test_a_gradient_step_is_few_kernels_that_fit_their_registers(
    tmp_path, monkeypatch, config_file, most
):
    if importlib.util.find_spec("jax_cuda13_plugin") is None:
        pytest.skip("needs the wheels that check_wheels names")
    monkeypatch.setattr(launches, "PROGRAMS", {"gradient_step": (config_file,)})
    bench_launches(Report(tmp_path / "bench.json", "cpu"))
    kernels, *_, spilled = json.loads((tmp_path / "bench.json").read_text())["rows"]
    assert kernels["name"] == "launches/gradient_step" and 50 < kernels["value"] < most
    assert spilled["name"].endswith("_spilled_bytes") and spilled["value"] < 1000
