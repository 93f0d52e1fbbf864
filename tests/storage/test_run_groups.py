"""Which runs a figure takes for seeds of one; no file is read but where a test writes one."""

from pathlib import Path

import pytest

from cmrl_jax.config.files import load_config
from cmrl_jax.config.schema import Config, leaves
from cmrl_jax.storage.run_groups import FREE_AMONG_SEEDS, group_runs, settings_of, shown_names


def made_with(**of_run):
    """Run directory -> settings: `a__x` stands for a/x, its value for dotted flags."""
    return {
        Path(run.replace("__", "/").replace("_", "-")): settings_of(
            load_config("smoke.yaml", flags)
        )
        for run, flags in of_run.items()
    }


def test_runs_that_differ_in_their_seed_are_one():
    found = group_runs(made_with(cmrl_seed0={}, cmrl_seed1={"seed": "1"}, pearl={}))
    assert found == {"cmrl": [Path("cmrl-seed0"), Path("cmrl-seed1")], "pearl": [Path("pearl")]}
    assert list(group_runs(made_with(a__run={}, b__run={"seed": "1"}))) == ["run"]


FREE = {
    "name": "other",
    "eval.every": "0.25",
    "eval.wall_share": "0.5",
    "eval.final_k": "0",
    "log.progress": "false",
    "checkpoint.keep": "7",
    "runtime.compile_cache": "elsewhere",
}


@pytest.mark.parametrize("name", FREE)
def test_what_no_figure_depends_on_does_not_part_seeds(name):
    found = group_runs(made_with(x_seed0={}, x_seed1={"seed": "1", name: FREE[name]}))
    assert list(found) == ["x"]


PARTING = {
    "env.horizon": "200",
    "train.env_steps": "3600",
    "train.minutes": "5.0",
    "eval.goals": "3",
    "eval.final_goals": "3",
    "eval.goal_set": "train",
    "eval.seed": "1",
    "eval.k": "0",
    "sac.lr": "0.001",
    "runtime.matmul_precision": "default",
}


@pytest.mark.parametrize("name", PARTING)
def test_runs_that_differ_in_more_are_told_apart_by_it(name):
    found = group_runs(made_with(a__run={}, b__run={"seed": "1", name: PARTING[name]}))
    assert list(found.values()) == [[Path("a/run")], [Path("b/run")]]
    labels = list(found)
    assert labels[1] == f"run, {name} {PARTING[name]}" and labels[0].startswith(f"run, {name} ")


def test_every_free_field_is_one_of_the_schema():
    names = [name for name, _, _ in leaves(Config())]
    for free in FREE_AMONG_SEEDS:
        assert [n for n in names if n == free or (free.endswith(".") and n.startswith(free))], free


def test_groups_are_told_apart_by_as_few_fields_as_do():
    long = {"env.horizon": "200", "sac.lr": "0.001", "eval.goals": "3"}
    found = group_runs(
        made_with(
            a__x_seed0={},
            a__x_seed1={"seed": "1"},
            b__x_seed0=long,
            b__x_seed1=long | {"seed": "1"},
            c__x_seed0={"env.horizon": "200"},
        )
    )
    assert {label: len(runs) for label, runs in found.items()} == {
        "x, env.horizon 50, sac.lr 0.0003": 2,
        "x, env.horizon 200, sac.lr 0.001": 2,
        "x, env.horizon 200, sac.lr 0.0003": 1,
    }


def test_one_seed_twice_is_no_second_sample():
    twice = made_with(a__x={}, b__x={}, c__x={"seed": "1"})
    assert group_runs(twice) == {
        "x, seed 0 (a/x)": [Path("a/x")],
        "x, seed 0 (b/x)": [Path("b/x")],
        "x, seed 1 (c/x)": [Path("c/x")],
    }


def test_names_in_titles_tell_runs_apart():
    assert shown_names([Path("a/x"), Path("a/y")]) == ["x", "y"]
    assert shown_names([Path("a/x"), Path("b/x"), Path("y")]) == ["a/x", "b/x", "y"]
