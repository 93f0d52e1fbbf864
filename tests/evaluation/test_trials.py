"""What lanes are given: sentences by option, refusals, and how many lanes go into a batch."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from policy_fixtures import random_policy, small_config

from cmrl_jax.config.files import load_config, to_yaml
from cmrl_jax.config.schema import ConfigError
from cmrl_jax.evaluation.options import EvalOptions, check_run
from cmrl_jax.evaluation.session import Policy, Session
from cmrl_jax.evaluation.trials import batch_lanes, evaluation_config, trial_of

CASES = ("drawer-open", "drawer-close", "window-open", "window-close")


@pytest.fixture(scope="module")
def session():
    return Session(small_config())


@pytest.fixture
def policy(session):
    """A policy whose checkpoint holds other vectors than the table: the two can be told apart."""
    stored = {task: -session.goals.vectors[i, 0] for i, task in enumerate(session.eval_tasks)}
    return Policy(random_policy(session, 1), stored, {"goals_sha256": session.goals.sha256})


def texts(session, policy, tasks=CASES, **options):
    """(task, goal, G) of 7 goals."""
    return trial_of([policy], session, EvalOptions(goals=7, **options), tasks).texts[0]


def test_the_checkpoints_own_sentences_by_default(session, policy):
    found = texts(session, policy, ("window-open", "drawer-open"))
    for row, task in enumerate(("window-open", "drawer-open")):
        np.testing.assert_array_equal(found[row], np.tile(policy.goal_vectors[task], (7, 1)))


def test_held_out_sentences_in_turn(session, policy):
    found = texts(session, policy, paraphrases="heldout")
    table = session.goals.heldout_vectors
    assert 1 < table.shape[1] < 7
    for task in range(4):
        for goal in range(7):
            np.testing.assert_array_equal(found[task, goal], table[task, goal % table.shape[1]])


def test_shuffled_text_is_another_tasks(session, policy):
    found = texts(session, policy, ("window-close", "drawer-open"), text_control="shuffled")
    np.testing.assert_array_equal(found[0, 0], policy.goal_vectors["drawer-open"])
    np.testing.assert_array_equal(found[1, 0], policy.goal_vectors["drawer-close"])
    both = texts(session, policy, text_control="shuffled", paraphrases="heldout")
    np.testing.assert_array_equal(both[3, 1], session.goals.heldout_vectors[0, 1])


def test_zero_text(session, policy):
    found = texts(session, policy, text_control="zero")
    assert found.shape == (4, 7, 384) and not found.any()


def test_another_table_is_refused_where_it_is_read(session, policy):
    foreign = replace(policy, meta={"goals_sha256": "0" * 64})
    texts(session, foreign)  # the checkpoint's own sentences need no table
    texts(session, foreign, text_control="zero")
    with pytest.raises(ConfigError, match="is not the one the run was trained with") as error:
        texts(session, foreign, paraphrases="heldout")
    assert "--any-table" in error.value.cure
    found = texts(session, foreign, paraphrases="heldout", any_table=True)
    np.testing.assert_array_equal(found[0, 0], session.goals.heldout_vectors[0, 0])


def test_a_task_unknown_to_the_run_takes_the_tables_sentence(session, policy):
    del policy.goal_vectors["window-close"]
    found = texts(session, policy, ("window-close",))
    np.testing.assert_array_equal(found[0, 0], session.goals.vectors[3, 0])
    foreign = replace(policy, meta={"goals_sha256": "0" * 64})
    with pytest.raises(ConfigError, match="is not the one"):
        texts(session, foreign, ("window-close",))


def test_a_sentence_of_ones_own(session, policy, replace_module):
    asked = []

    def embed(sentences, encoder, weights):
        asked.append((sentences, encoder, weights))
        return np.full((1, 384), 0.5, np.float32)

    fake = SimpleNamespace(embed=embed)
    replace_module("cmrl_jax.text.encoders", fake)
    found = texts(session, policy, text="shut it", weights=Path("w"))
    assert asked == [(["shut it"], "minilm-l6-v2", Path("w"))] and np.all(found == 0.5)
    fake.embed = lambda *args: np.zeros((1, 512), np.float32)
    with pytest.raises(ConfigError, match="512 numbers, the run was trained on 384"):
        texts(session, policy, text="shut it")


def test_a_sentence_without_an_encoder_is_two_lines(session, policy, monkeypatch):
    monkeypatch.setitem(sys.modules, "cmrl_jax.text.encoders", None)
    with pytest.raises(ConfigError, match="--text needs the sentence encoder minilm") as error:
        texts(session, policy, text="shut it")
    assert error.value.cure


@pytest.mark.parametrize(
    ("config", "options", "cause"),
    [
        ({"model.conditioning": "task_id", "tasks.test": "[]"}, {"k": (0, 1)}, "--k 0,1 with"),
        ({"model.conditioning": "task_id", "tasks.test": "[]"}, {"k": (0,), "z": "prior"}, "--z"),
        (
            {"model.conditioning": "task_id", "tasks.test": "[]"},
            {"k": (0,), "tasks": ("window-close",)},
            "--tasks window-close with",
        ),
        ({"goal_fusion": "none"}, {"paraphrases": "heldout"}, "reads no text"),
        ({"goal_fusion": "none"}, {"text_control": "zero"}, "reads no text"),
        ({"goal_fusion": "none"}, {"z": "text"}, "reads no text"),
        ({"goal_fusion": "concat"}, {"z": "text"}, "--z text with encoder.goal_fusion concat"),
        ({}, {"z": "other", "tasks": ("window-open",)}, "--z other with one task"),
        ({}, {"z": "shuffled", "tasks": ("window-open",), "goals": 1}, "--z shuffled with one"),
        ({"goals.table": "one-hot"}, {"text": "shut it"}, "which has no encoder"),
    ],
)
def test_options_that_do_not_apply_to_a_run(tmp_path, config, options, cause):
    if fusion := config.pop("goal_fusion", None):
        config |= {
            "encoder.goal_fusion": fusion,
            "encoder.p_empty": "0.0",
            "collect.group_frac": "[0.5, 0.0, 0.5]",
        }
    if "model.conditioning" in config:
        config |= {"eval.k": "[0]", "eval.final_k": "[0]"}
    config = {"encoder.aux": "none"} | config
    (tmp_path / "config.yaml").write_text(to_yaml(load_config("smoke.yaml", config)))
    with pytest.raises(ConfigError) as error:
        check_run(EvalOptions(**options), tmp_path)
    assert cause in error.value.cause and error.value.cure


def test_physics_of_ones_own(tmp_path):
    (tmp_path / "config.yaml").write_text(to_yaml(small_config()))
    assert evaluation_config(tmp_path, None).env.physics == "native"
    assert evaluation_config(tmp_path, "mjx").env.physics == "mjx"


def test_lanes_of_a_batch():
    assert batch_lanes(200, unit=40, budget=256) == 200
    assert batch_lanes(8, unit=40, budget=256) == 40  # training's own program, from the cache
    assert batch_lanes(1000, unit=40, budget=256) == 256
    assert batch_lanes(200, unit=40, budget=10) == 10
