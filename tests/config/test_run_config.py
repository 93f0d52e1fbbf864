"""A run's own config.yaml: what it says of a run that is older than one of its keys."""

import dataclasses

import pytest
import yaml

from cmrl_jax.config.files import (
    changed_fields,
    check_resumable,
    load_config,
    read_yaml,
    resolve,
    run_config,
    to_dict,
    to_yaml,
)
from cmrl_jax.storage.run_groups import group_runs, settings_of


def make_old_run(run, obs_mode):
    """A run of smoke.yaml from before `env.origin` was recorded; its config, as read now."""
    config = load_config("smoke.yaml", {"env.physics": "native", "env.obs_mode": obs_mode})
    record = to_dict(config)
    del record["env"]["origin"]
    (run / "policy").mkdir(parents=True)
    (run / "config.yaml").write_text(yaml.safe_dump(record))
    return config


COMMANDS = (
    "--resume",
    "--resume --config smoke.yaml --env.physics native --env.obs_mode canonical",
    "eval --k 0",
    "eval --physics metaworld",
    "sweep",
    "finetune --task window-close",
    "render --k 0",
    "plot --inspect",
)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_policy_that_learned_from_another_origin_does_not_act(tmp_path, refused, command):
    run = tmp_path / "run"
    make_old_run(run, "canonical")
    before = (run / "config.yaml").read_bytes()
    word = "--runs" if command == "sweep" else "--run"
    cause, cure = refused(*command.split(), word, str(run))
    assert str(run) in cause and "env.origin: reset observation -> settled" in cause
    assert f"train anew with --config {run / 'config.yaml'}" in cure
    assert (run / "config.yaml").read_bytes() == before
    assert sorted(path.name for path in run.iterdir()) == ["config.yaml", "policy"]


def test_metaworlds_observations_have_no_origin(tmp_path):
    config = make_old_run(tmp_path, "metaworld")
    assert run_config(tmp_path) == config
    saved = read_yaml(tmp_path / "config.yaml")[0]
    assert changed_fields(saved, config) == []
    check_resumable(saved, config, tmp_path)


def test_figures_of_an_older_origin_are_still_read_as_those_of_another_run(tmp_path):
    """A mean over seeds must not mix the two."""
    runs = [tmp_path / "x-seed0", tmp_path / "x-seed1"]
    config = make_old_run(runs[0], "canonical")
    runs[1].mkdir()
    (runs[1] / "config.yaml").write_text(to_yaml(dataclasses.replace(config, seed=1)))
    read = {run: run_config(run, acts=False) for run in runs}
    changed = dict(settings_of(read[runs[0]]).items() - settings_of(config).items())
    assert changed == {"env.origin": "reset observation"}
    groups = group_runs({run: settings_of(found) for run, found in read.items()})
    assert groups == {
        "x, env.origin reset observation": [runs[0]],
        "x, env.origin settled": [runs[1]],
    }


def test_an_older_record_is_a_config_for_new_runs(tmp_path):
    """As is a user's YAML, which names no origin: both mean today's, and a run records it."""
    config = make_old_run(tmp_path, "canonical")
    again = resolve(*read_yaml(tmp_path / "config.yaml"))
    assert again == config and again.env.origin == "settled"
    (tmp_path / "config.yaml").write_text(to_yaml(again))
    assert "origin: settled" in (tmp_path / "config.yaml").read_text()
    assert run_config(tmp_path) == config
