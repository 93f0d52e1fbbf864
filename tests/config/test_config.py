"""The strict loader, its round trip, and every rule of `validate`, through the command line."""

import dataclasses
import json
import re
from pathlib import Path

import pytest
import yaml

from cmrl_jax.algorithms.cmrl.rules import lane_groups
from cmrl_jax.config.files import (
    FREE_ON_RESUME,
    changed_fields,
    check_resumable,
    find_config,
    from_dict,
    load_config,
    resolve,
    to_dict,
    to_yaml,
)
from cmrl_jax.config.schema import Config, ConfigError, leaves

CONFIGS = sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))

# YAML text, what the cause must say, what the cure must say.
TRAPS = [
    ("sac: {lr: 3e-4}", "sac.lr needs a number, got the text '3e-4'", "write 3.0e-4"),
    ("sac: {lr: 1e6}", "got the text '1e6'", "write 1.0e+6"),
    ("sac: {lr: 1.0e6}", "got the text '1.0e6'", "write 1.0e+6"),
    ("sac: {lr: '0.1'}", "got the text '0.1'", "write 0.1 without quotes"),
    ("sac: {lr: .nan}", "sac.lr is nan", "finite"),
    ("sac: {lr: .inf}", "sac.lr is inf", "finite"),
    ("sac: {lr: true}", "sac.lr needs a number, got true", "write a number"),
    ("train: {env_steps: 1e6}", "needs a whole number", "write 1000000"),
    ("train: {env_steps: 1.0e+6}", "got 1000000.0", "write 1000000"),
    ("seed: 0.5", "seed needs a whole number, got 0.5", "whole number"),
    ("seed: true", "seed needs a whole number, got true", "whole number"),
    ("seed: 017", "YAML reads 017 as another number", "leading 0"),
    ("seed: 1:30", "YAML reads 1:30 as another number", "colon"),
    ("seed: 1:30.5", "YAML reads 1:30.5 as another number", "colon"),
    ("seed:", "seed has no value", "default"),
    ("seed: 2026-01-01", "got 2026-01-01", "whole number"),
    ("seed: !!python/name:os.getcwd", "a kind no key takes", "remove it"),
    ("name: 3", "name needs text", "text"),
    ("seed: 1\nname: x\nseed: 2", "'seed' stands twice", "keep one"),
    ("sac: {lr: 0.1}\nsac: {tau: 0.1}", "'sac' stands twice", "keep one"),
    ("sac: {lr: 0.1, lr: 0.2}", "'sac.lr' stands twice", "keep one"),
    ("log: {progress: 1}", "needs true or false, got 1", "true or false"),
    ("log: {progress: 'yes'}", "needs true or false", "true or false"),
    ("model: {net: sotf}", "model.net got the text 'sotf'", "did you mean 'soft'? valid: soft"),
    ("encoder: {goal_fusion: off}", "encoder.goal_fusion got false", "valid: none, concat"),
    ("encoder: {goal_fusion: null}", "encoder.goal_fusion got nothing", "valid: none"),
    ("model: {modules: 2}", "model.modules needs a list, got 2", "[2]"),
    ("model: {modules: [2, 2]}", "needs 3 values, got 2", "list of 3"),
    ("model: {mlp_hidden: [64, 64.5]}", "needs a whole number, got 64.5", "whole number"),
    ("tasks: {train: drawer-open}", "tasks.train needs a list", "[drawer-open]"),
    ("trian: {env_steps: 1}", "unknown key 'trian'", "did you mean 'train'?"),
    ("train: {step: 1}", "unknown key 'train.step'", "valid: env_steps, minutes"),
    ("train:\n\n  env_stesp: 1", ":3)", "did you mean 'train.env_steps'?"),
    ("train: {batch: 1}", "unknown key 'train.batch'", "did you mean 'sac.batch'?"),
    ("no: 1", "unknown key 'no'", "valid: name"),
    ("sac: 3", "'sac' is a section, got 3", "valid: variant"),
    ("- seed", "holds no mapping", "key: value"),
    ("sac: {lr: [", "is not valid YAML", "quotes"),
    ("sac:\n\tlr: 1", ":2 is not valid YAML", "indentation"),
]


@pytest.mark.parametrize(("text", "cause", "cure"), TRAPS, ids=[trap[0] for trap in TRAPS])
def test_yaml_trap_is_refused(refused, tmp_path, text, cause, cure):
    path = tmp_path / "x.yaml"
    path.write_text(text)
    got = refused("--config", str(path))
    assert cause in got[0] and str(path) in got[0]
    assert cure in got[1]


def test_file_that_is_not_text(refused, tmp_path):
    path = tmp_path / "x.yaml"
    path.write_bytes(b"\xff\xfe\x00")
    assert "not text" in refused("--config", str(path))[0]


# Flags over ml4.yaml, what the cause must say. A cure `set a.b: value` is tried: it must help.
RULES = [
    ("sac.lr=-1.0", "sac.lr is -1.0"),
    ("seed=-1", "seed is -1"),
    ("train.minutes=-2", "train.minutes is -2"),
    ("sac.gamma=1.5", "sac.gamma is 1.5"),
    ("sac.gamma=0.0", "sac.gamma is 0.0"),
    ("sac.n_step=0", "sac.n_step is 0"),
    ("sac.n_step=201", "sac.n_step 201 is longer than env.horizon 200"),
    ("encoder.p_empty=2", "encoder.p_empty is 2"),
    ("model.mlp_hidden=128,0", "model.mlp_hidden is 0"),
    ("model.mlp_hidden=", "model.mlp_hidden is empty"),
    ("encoder.hidden=", "encoder.hidden is empty"),
    ("eval.goals=51", "eval.goals is 51"),
    ("sac.batch=340001", "sac.batch 340001 is over train.capacity 340000"),
    ("collect.lanes=97", "collect.lanes 97 is not divisible by the 3 training tasks"),
    ("collect.lanes=6", "the 2 lanes of a task cannot be split"),
    ("collect.group_frac=0.5,0.5,0.5", "sums to 1.5"),
    ("train.capacity=102401", "102401 is not a multiple of the 32 lanes of a task"),
    ("train.capacity=3200", "3200 is below one episode of the 32 lanes of a task"),
    ("collect.chunk=11", "env.horizon 200 is not a multiple of collect.chunk 11"),
    ("tasks.train=drawer-opn", "unknown task 'drawer-opn' in tasks.train"),
    ("tasks.test=reach", "unknown task 'reach' in tasks.test"),
    ("tasks.train=", "tasks.train is empty"),
    ("tasks.train=drawer-open,drawer-open", "'drawer-open' stands twice in tasks.train"),
    ("tasks.test=drawer-open", "'drawer-open' is in tasks.train and in tasks.test"),
    ("encoder.goal_fusion=none", "0.25 of the lanes to text with encoder.goal_fusion none"),
    ("encoder.goal_fusion=concat", "0.25 of the lanes to text with encoder.goal_fusion concat"),
    (
        "encoder.goal_fusion=none collect.group_frac=0.5,0,0.5 encoder.aux=none",
        "encoder.p_empty is 0.5 with encoder.goal_fusion none",
    ),
    (
        "encoder.goal_fusion=none collect.group_frac=0.5,0,0.5",
        "encoder.aux contrastive with encoder.goal_fusion none",
    ),
    (
        "tasks.train=drawer-open",
        "encoder.aux contrastive with one training task",
    ),
    (
        "model.conditioning=task_id tasks.test= encoder.aux=recon",
        "encoder.aux recon with model.conditioning task_id: no z to train",
    ),
    (
        "model.conditioning=task_id encoder.aux=none",
        "['window-close'] with model.conditioning task_id",
    ),
    ("model.conditioning=none tasks.test=", "model.net soft with model.conditioning none"),
    ("model.modular_actor=false model.modular_critic=false", "neither modular_actor nor"),
    ("model.modules=1,2,64", "model.modules is [1, 2, 64]"),
    ("model.modules=2,1,64", "model.modules is [2, 1, 64]"),
    ("sac.variant=v model.critic=c51", "sac.variant v with model.critic c51"),
    (
        "model.conditioning=task_id encoder.aux=none tasks.test=",
        "eval.k [0, 2] with model.conditioning task_id",
    ),
    ("eval.k=", "eval.k is empty"),
    ("eval.final_k=1,1", "eval.final_k [1, 1] repeats"),
    ("eval.goal_set=test", "eval.goal_set 'test' is no goal set"),
    ("eval.goal_set=fresh:", "eval.goal_set 'fresh:' is no goal set"),
    ("eval.goal_set=fresh:-1", "eval.goal_set 'fresh:-1' is no goal set"),
    ("train.env_steps=0", "train.env_steps and train.minutes are both 0"),
]


@pytest.mark.parametrize(("flags", "cause"), RULES, ids=[rule[0] for rule in RULES])
def test_rule_is_refused_and_its_cure_helps(refused, flags, cause):
    words = [f"--{flag}" for flag in flags.split()]
    got = refused("--config", "ml4.yaml", *words)
    assert cause in got[0]
    cured = re.match(r"(?:set|use) ([a-z_]+\.[a-z_]+): (\[.*?\]|[\w.-]+)(?:,|$)", got[1])
    if cured:
        values = dict(flag.split("=") for flag in flags.split()) | {cured[1]: cured[2]}
        try:
            load_config("ml4.yaml", values)
        except ConfigError as error:
            assert cause not in error.cause  # another rule may speak up next


def test_unknown_task_suggests(refused):
    cure = refused("--config", "ml4.yaml", "--tasks.train", "drawer-opn")[1]
    assert cure.startswith("did you mean 'drawer-open'?")


@pytest.mark.parametrize("path", CONFIGS, ids=[path.name for path in CONFIGS])
def test_shipped_config_is_valid_and_survives_its_yaml(path):
    config = load_config(path)
    again = resolve(yaml.safe_load(to_yaml(config)))
    assert again == config
    assert from_dict(json.loads(json.dumps(to_dict(config)))) == config
    assert hash(config) == hash(again)  # a static argument of jit


def test_yaml_that_pyyaml_would_write_oddly_survives():
    config = from_dict(
        {"sac": {"lr": 1e-7, "grad_clip": 1e20}, "name": "1e3", "tasks": {"test": []}}
    )
    assert from_dict(yaml.safe_load(to_yaml(config))) == config


def test_defaults_are_the_main_job():
    assert load_config("ml4.yaml") == Config()


def test_ml4_names_every_key_that_matters():
    """Except switches that no preset uses and widths of parts that the preset leaves out."""
    data = yaml.safe_load(find_config("ml4.yaml").read_text())
    named = {f"{section}.{key}" for section in data if isinstance(data[section], dict)
             for key in data[section]}  # fmt: skip
    other = ("ppo.", "rl2.", "maml.")  # algorithms of their own
    keys = {name for name, _, _ in leaves(Config()) if "." in name and not name.startswith(other)}
    left_out = keys - named
    assert left_out == {
        "model.mlp_hidden", "model.critic_bins", "model.critic_v_max",
        "model.critic_agg", "encoder.aux_weight",
        "env.name", "env.origin",
    }  # fmt: skip


def test_a_key_that_an_older_run_lacks_has_the_default_of_its_time(tmp_path):
    """Also where the default is another one today; a file that is no run's record has today's."""
    record = to_dict(load_config("ml4-plain.yaml"))
    lacking = ("collect", "scatter"), ("encoder", "aux"), ("env", "obs_mode")
    for section, key in (*lacking, ("sac", "policy_average")):
        del record[section][key]
    path = tmp_path / "x.yaml"
    path.write_text(yaml.safe_dump(record))
    plain = load_config("ml4-plain.yaml")
    assert load_config(path) == plain and changed_fields(record, plain) == []
    changed = changed_fields(record, Config())
    assert ("collect.scatter", 0, 40) in changed and ("sac.policy_average", 0.0, 0.1) in changed
    path.write_text("model: {net: mlp}\n")
    assert load_config(path).collect.scatter == 40


def test_keys_of_older_configurations_are_read_with_their_only_value(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text("env: {impl: jax}\ncollect: {own_context: false}\n")
    assert load_config(path) == Config()
    saved = to_dict(Config())
    saved["model"]["router_shared"] = False
    assert changed_fields(saved, Config()) == []
    path.write_text("env:\n  impl: warp\n")
    with pytest.raises(ConfigError, match=r"env.impl got the text 'warp' \(.*:2\), .* never built"):
        load_config(path)


def test_sections_without_keys_and_empty_files_mean_defaults(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text("sac:\ntrain:\n  minutes: 3\n")
    config = load_config(path)
    assert config == dataclasses.replace(
        Config(), train=dataclasses.replace(Config().train, minutes=3.0)
    )
    assert isinstance(config.train.minutes, float)
    path.write_text("")
    assert load_config(path) == Config()


def test_flags_win_over_yaml_over_defaults(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text("sac: {batch: 64, tau: 0.01}")
    config = load_config(path, {"sac.batch": "32", "log.tensorboard": "true", "name": "off"})
    assert (config.sac.batch, config.sac.tau, config.sac.gamma) == (32, 0.01, 0.99)
    assert config.log.tensorboard is True and config.name == "off"


@pytest.mark.parametrize("text", ["64,32", "[64, 32]", "[64,32]"])
def test_list_flags(text):
    assert load_config("ml4.yaml", {"model.mlp_hidden": text}).model.mlp_hidden == (64, 32)


@pytest.mark.parametrize("text", ["", "[]"])
def test_empty_list_flags(text):
    assert load_config("ml4.yaml", {"tasks.test": text}).tasks.test == ()


def test_configs_are_looked_up_here_before_the_repository(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert find_config("ml4.yaml").parent.name == "configs"
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs" / "ml4.yaml").write_text("seed: 5")
    assert load_config("ml4.yaml").seed == 5
    (tmp_path / "ml4.yaml").write_text("seed: 6")
    assert load_config("ml4.yaml").seed == 6


def test_missing_config_lists_those_found(refused):
    cause, cure = refused("--config", "ml5.yaml")
    assert cause == "config 'ml5.yaml' not found"
    assert cure.startswith("did you mean 'ml4.yaml'?") and "pearl.yaml" in cure


def test_lane_groups_split_every_lane():
    def groups(lanes, shares):
        base = Config()
        collect = dataclasses.replace(base.collect, lanes=3 * lanes, group_frac=shares)
        return lane_groups(dataclasses.replace(base, collect=collect))

    assert groups(32, (0.25, 0.25, 0.5)) == (8, 8, 16)
    assert groups(4, (0.25, 0.25, 0.5)) == (1, 1, 2)
    assert groups(32, (0.5, 0.0, 0.5)) == (16, 0, 16)
    for lanes in range(1, 40):
        for shares in ((0.25, 0.25, 0.5), (0.1, 0.2, 0.7), (1 / 3, 1 / 3, 1 / 3), (1.0, 0.0, 0.0)):
            counts = groups(lanes, shares)
            assert sum(counts) == lanes
            assert all(abs(n - s * lanes) < 1 for n, s in zip(counts, shares, strict=True))


def test_resume_may_change_reports_and_length_only():
    saved = json.loads(json.dumps(to_dict(Config())))
    free = {
        "train.env_steps": "5", "train.minutes": "3", "eval.goals": "3", "log.progress": "false",
        "checkpoint.minutes": "1", "runtime.compile_cache": "", "name": "other",
    }  # fmt: skip
    assert changed_fields(saved, load_config("ml4.yaml", free)) == []
    reports = [name for name, _, _ in leaves(Config()) if name.startswith(("eval.", "log."))]
    refused = [name for name in reports if not name.startswith(FREE_ON_RESUME)]
    assert refused == ["eval.k"]  # names columns of metrics.csv
    for name, f, value in leaves(Config()):
        if name not in free and name not in reports and not name.startswith("checkpoint."):
            section, _, key = name.rpartition(".")
            other = {bool: False if value else True, int: 7, float: 0.7, str: "?", tuple: (9,)}
            owner = getattr(Config(), section) if section else Config()
            part = dataclasses.replace(owner, **{key: other[type(value)]})
            config = dataclasses.replace(Config(), **{section: part}) if section else part
            assert [change[0] for change in changed_fields(saved, config)] == [name], f


def test_resume_with_another_schema():
    saved = to_dict(Config())
    del saved["sac"]["n_step"]  # added after the run was made: counts as its default
    assert changed_fields(saved, Config()) == []
    saved["sac"]["gone"] = 1
    assert changed_fields(saved, Config()) == [("sac.gone", 1, None)]


def test_resume_names_the_changed_field():
    config = load_config("ml4.yaml", {"seed": "3"})
    with pytest.raises(ConfigError) as error:
        check_resumable(to_dict(Config()), config, Path("runs/x"))
    assert "seed: 0 -> 3" in error.value.cause and "runs/x/config.yaml" in error.value.cure
