"""Policies that come with the project: found by name, and whole."""

import tempfile
from pathlib import Path

import pytest

from cmrl_jax.cli.evaluate_flags import find_runs
from cmrl_jax.cli.main import main
from cmrl_jax.cli.plot_flags import check_inspectable, check_runs
from cmrl_jax.cli.train import run_train
from cmrl_jax.config.files import run_config
from cmrl_jax.config.schema import ConfigError
from cmrl_jax.storage.kept_policies import kept_policies
from cmrl_jax.storage.manifest import find_damage
from cmrl_jax.storage.packed import packed_steps, unpack
from cmrl_jax.storage.run_dir import find_run, place_beside

NAME = "cmrl-window-close-s0"


def test_a_name_is_the_policy_unless_a_run_is_called_so(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert find_run(Path(NAME)) == kept_policies()[NAME]
    (tmp_path / NAME).mkdir()
    (tmp_path / NAME / "config.yaml").touch()
    assert find_run(Path(NAME)) == Path(NAME)


def test_a_typo_is_told_the_name():
    with pytest.raises(ConfigError, match="does not exist") as raised:
        find_run(Path("cmrl-window-clse-s0"))
    assert NAME in raised.value.cure


def test_patterns_of_a_sweep_match_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = find_runs(["cmrl-window-close-s*"])
    assert [run.name for run in found] == [f"cmrl-window-close-s{seed}" for seed in range(5)]


@pytest.mark.parametrize("name", kept_policies())
def test_each_is_whole_and_can_be_acted_by(name):
    run = kept_policies()[name]
    run_config(run)
    ((step, packed),) = packed_steps(run / "policy").items()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / str(step)
        unpack(packed, place)
        assert find_damage(place) is None


def test_nothing_is_written_into_one(tmp_path, monkeypatch):
    """By name or by path: it is not gone on with, and what is made of it goes elsewhere."""
    monkeypatch.chdir(tmp_path)
    kept = kept_policies()[NAME]
    before = {path: path.stat().st_mtime_ns for path in kept.rglob("*")}
    for run in (NAME, str(kept)):
        with pytest.raises(ConfigError, match="comes with the project") as raised:
            run_train(["--run", run, "--resume"])
        assert "--config ml4.yaml" in raised.value.cure
        assert place_beside(find_run(Path(run))) == Path("runs") / NAME
    for refused in (
        lambda: check_inspectable(Path(NAME)),
        lambda: check_runs([Path(NAME)]),
    ):
        with pytest.raises(ConfigError, match="comes with the project"):
            refused()
    words = ["finetune", "--run", NAME, "--task", "window-close", "--json", "f.json"]
    assert main(words) == 2
    assert place_beside(tmp_path) == tmp_path
    assert before == {path: path.stat().st_mtime_ns for path in kept.rglob("*")}
