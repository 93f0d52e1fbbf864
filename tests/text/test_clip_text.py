"""The CLIP text tower is torch's, whatever the architecture and the file its weights come in."""

import hashlib
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import clip_cases as cases
import numpy as np
import pytest
from flax.serialization import msgpack_serialize
from safetensors.numpy import save_file

from cmrl_jax.cli.main import main
from cmrl_jax.config.schema import ConfigError
from cmrl_jax.text import clip_tokenizer, clip_weights
from cmrl_jax.text.clip_text import Architecture
from cmrl_jax.text.encoders import embed, find_encoder
from cmrl_jax.text.goals import load_goals, read_table

ROOT = Path(__file__).parents[2]
SMALL = ("gelu", "legacy-eos")


def load_script():
    spec = importlib.util.spec_from_file_location("clip_golden", ROOT / "scripts/clip_golden.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


clip_golden = load_script()


def golden(name: str) -> np.ndarray:
    """Torch's vectors of the sentences, not normalised."""
    with np.load(cases.GOLDEN) as data:
        return data[f"{name}/vectors"][: len(cases.SENTENCES)]


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def flax_tree(tensors: dict[str, np.ndarray]) -> dict:
    """The tensors as `transformers` laid out its Flax checkpoints: (in, out) kernels, nested."""
    tree: dict = {}
    for name, values in tensors.items():
        *path, leaf = name.split(".")
        if leaf == "weight":
            kinds = {"token_embedding": "embedding", "position_embedding": "embedding"}
            kinds |= {"layer_norm1": "scale", "layer_norm2": "scale", "final_layer_norm": "scale"}
            leaf = kinds.get(path[-1], "kernel")
        node = tree
        for part in path:
            node = node.setdefault(part, {})
        node[leaf] = values.T if leaf == "kernel" else values
    return tree


def write_model(directory: Path, name: str, kind: str = "projection") -> Path:
    """A model directory with random weights, in one of the forms that CLIP is published in."""
    config, tensors = cases.ARCHITECTURES[name], cases.random_tensors(cases.ARCHITECTURES[name])
    directory.mkdir()
    whole = {"model_type": "clip", "projection_dim": config["projection_dim"]}
    whole |= {"text_config": {**config, "projection_dim": 999}, "vision_config": {}}
    others = {"logit_scale": np.array(2.6), "vision_model.x.weight": np.zeros(3)}
    others["text_model.embeddings.position_ids"] = np.arange(77)[None]
    if kind == "projection":
        whole = {"model_type": "clip_text_model", **config}
        save_file(tensors, directory / "model.safetensors")
    elif kind == "whole":
        save_file(tensors | others, directory / "model.safetensors")
    elif kind == "msgpack":
        tree = flax_tree(tensors) | {"vision_model": {"x": {"kernel": np.zeros((3, 2))}}}
        (directory / "flax_model.msgpack").write_bytes(msgpack_serialize(tree))
    (directory / "config.json").write_text(json.dumps(whole))
    return directory


# Tokenizer and tower ------------------------------------------------------------------------------


@pytest.mark.parametrize("positions", [77, 20])
def test_tokenizer_equals_the_definition(positions):
    ours = clip_tokenizer.load_tokenizer(positions)(cases.SENTENCES)
    assert ours == cases.reference_rows(positions)
    assert max(map(len, ours)) == positions
    assert ours[3] == ours[4] == [49406, 49407]  # nothing, and blanks


def test_tokenizer_has_the_ids_that_clip_has():
    """As openai/clip-vit-base-patch32 documents them."""
    tokenize = clip_tokenizer.load_tokenizer(77)
    assert tokenize(["a photo of a cat"]) == [[49406, 320, 1125, 539, 320, 2368, 49407]]
    vocabulary, merges = clip_tokenizer.read_bpe(cases.BPE_FILE.read_bytes())
    assert len(vocabulary) == 49408 and len(merges) == 48894
    assert [vocabulary[s] for s in ("!", "a</w>", "in", "jekyll</w>", "<|endoftext|>")] == [
        0, 320, 512, 49405, 49407,
    ]  # fmt: skip


def test_damaged_vocabulary(tmp_path, monkeypatch):
    for content in (None, b"", cases.BPE_FILE.read_bytes()[:-1]):
        path = tmp_path / "bpe.gz"
        if content is not None:
            path.write_bytes(content)
        monkeypatch.setattr(clip_tokenizer, "BPE_FILE", path)
        with pytest.raises(ConfigError, match="bpe.gz is missing or is not the file"):
            clip_tokenizer.load_tokenizer(77)


@pytest.mark.parametrize("name", SMALL)
def test_tower_equals_torch(name):
    """Golden vectors of torch's CLIPTextModelWithProjection: scripts/clip_golden.py wrote them."""
    with np.load(cases.GOLDEN) as data:
        assert clip_golden.difference(name, data) < 1e-5


@pytest.mark.parametrize("name", cases.ARCHITECTURES)
def test_tower_equals_torch_itself(name):
    pytest.importorskip("torch", reason="the golden vectors stand in for it; extra torch")
    assert clip_golden.difference(name, clip_golden.outputs(name)) < 1e-4


def test_b32_has_the_published_shape():
    """Its 63 million parameters; what it computes is compared where torch is."""
    assert Architecture() == Architecture.read({"model_type": "clip", "text_config": {}})
    assert Architecture.read({"model_type": "clip_text_model", **cases.ARCHITECTURES["b32"]}) == (
        Architecture(eos_token_id=2)
    )


# Model directories --------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["projection", "whole", "msgpack"])
def test_every_form_of_a_checkpoint_gives_torchs_vectors(tmp_path, kind):
    directory = write_model(tmp_path / "model", "legacy-eos", kind)
    encoder = find_encoder("clip-vit-b-32", directory)
    vectors = encoder.encode(cases.SENTENCES)
    assert vectors.dtype == np.float32
    np.testing.assert_allclose(vectors, unit(golden("legacy-eos")), atol=1e-5)
    [model] = (p for p in directory.iterdir() if p.name != "config.json")
    sha256 = hashlib.sha256(model.read_bytes()).hexdigest()
    # Weights that are not the published ones do not get the published name.
    assert (encoder.name, encoder.weights_sha256) == (f"clip-{sha256[:12]}", sha256)


def test_table_from_a_directory(tmp_path, refused, capsys):
    directory = write_model(tmp_path / "model", "gelu", "whole")
    out = tmp_path / "t.npz"
    words = ["goals", "--encoder", "clip-vit-b-32", "--weights", str(directory)]
    cause, cure = refused(*words)
    assert "is not the published clip-vit-b-32" in cause and "--out" in cure
    for _ in range(2):
        assert main([*words, "--out", str(out)]) == 0
    line = capsys.readouterr().out.splitlines()
    assert len(set(line)) == 1  # the same file again, hash for hash
    table = read_table(out)
    assert (table.vectors.shape, table.heldout_vectors.shape) == ((4, 9, 24), (4, 3, 24))
    np.testing.assert_allclose(
        [table.vectors[0, 0], table.vectors[1, 0]],
        unit(golden("gelu")[:2]),  # "open the drawer", "close the drawer"
        atol=1e-5,
    )
    assert load_goals(str(out), ("drawer-close",)).encoder == table.encoder

    ours = embed(["close the drawer", "shut it"], table.encoder, directory)
    np.testing.assert_array_equal(ours[0], table.vectors[1, 0])
    with pytest.raises(ConfigError, match=f"holds {table.encoder}, and the goals are vectors of"):
        embed(["shut it"], "clip-vit-b-32", directory)
    with pytest.raises(ConfigError, match="published nowhere") as error:
        embed(["shut it"], table.encoder)
    assert "--weights DIR" in error.value.cure


def test_published_weights_carry_the_name(tmp_path, monkeypatch):
    directory = write_model(tmp_path / "model", "gelu")
    sha256 = find_encoder("clip-vit-b-32", directory).weights_sha256
    monkeypatch.setattr(clip_weights, "SHA256", sha256)
    monkeypatch.setattr(clip_weights, "download", lambda: directory)
    found = find_encoder("clip-vit-b-32")
    assert found.name == "clip-vit-b-32"
    assert found.revision == f"openai/clip-vit-base-patch32 {clip_weights.REVISION}"
    assert embed(["open"], "clip-vit-b-32").shape == (1, 24)


def damage_config(directory: Path, **changes: object) -> None:
    path = directory / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1000])


MODEL = "model.safetensors"
DAMAGES = {
    "no directory": (lambda d: d.rename(d.parent / "x"), "has no model.safetensors and no flax"),
    "no config": (lambda d: (d / "config.json").unlink(), "has no config.json"),
    "no JSON": (lambda d: (d / "config.json").write_text("{"), "is not JSON"),
    "a list": (lambda d: (d / "config.json").write_text("[]"), "holds no JSON object"),
    "truncated": (lambda d: truncate(d / MODEL), "is truncated or of another format"),
    "empty": (lambda d: (d / MODEL).write_bytes(b""), "is truncated or of another format"),
    "only torch": (lambda d: (d / MODEL).rename(d / "pytorch_model.bin"), "which only torch can"),
    "BERT": (lambda d: damage_config(d, model_type="bert"), "of type 'bert', not CLIP"),
    "layers": (lambda d: damage_config(d, num_hidden_layers=3), "has no text_model.encoder.layers"),
    "width": (lambda d: damage_config(d, hidden_size=64), "of another architecture"),
    "heads": (lambda d: damage_config(d, num_attention_heads=5), "5 heads do not divide"),
    "activation": (lambda d: damage_config(d, hidden_act="relu"), "hidden_act 'relu'"),
    "vocabulary": (lambda d: damage_config(d, vocab_size=100), "another vocabulary"),
    "no number": (lambda d: damage_config(d, hidden_size="32"), "has hidden_size '32'"),
    "eos list": (lambda d: damage_config(d, eos_token_id=[2]), "has eos_token_id [2]"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_broken_model_directory(tmp_path, refused, damage):
    directory = write_model(tmp_path / "model", "gelu")
    out = tmp_path / "t.npz"
    apply, expected = DAMAGES[damage]
    apply(directory)
    words = ["goals", "--encoder", "clip-vit-b-32", "--weights", str(directory), "--out", str(out)]
    cause, cure = refused(*words)
    assert expected in cause and ("--weights" in cure or "safetensors" in cure)
    assert not out.exists()


def test_truncated_msgpack(tmp_path):
    directory = write_model(tmp_path / "model", "gelu", "msgpack")
    truncate(directory / "flax_model.msgpack")
    with pytest.raises(ConfigError, match="truncated or of another format"):
        find_encoder("clip-vit-b-32", directory).encode(["open"])


def run_alone(words: list[str], **env: str) -> subprocess.CompletedProcess:
    """The command line in a process of its own; prints the modules of interest that it loaded."""
    code = (
        "import sys; from cmrl_jax.cli.main import main; code = main(sys.argv[1:]);"
        "print(sorted({'torch', 'transformers', 'mujoco'} & set(sys.modules))); sys.exit(code)"
    )
    command = [sys.executable, "-c", code, *words]
    environment = os.environ | env
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment)


def test_no_hub(tmp_path):
    """Offline and with an empty cache: cause, cure, and nothing of the hub client's own."""
    out = str(tmp_path / "t.npz")
    words = ["goals", "--encoder", "clip-vit-b-32", "--out", out]
    done = run_alone(words, HF_HUB_OFFLINE="1", HF_HOME=str(tmp_path / "hub"))
    assert done.returncode == 2, done.stderr
    error, fix = done.stderr.splitlines()
    assert error.startswith("error: openai/clip-vit-base-patch32 cannot be downloaded")
    assert clip_weights.REVISION in fix and "--weights DIR" in fix


def test_torch_is_not_imported_even_where_it_is(tmp_path):
    """A torch lies in the path, of which `transformers` would import parts if asked for them."""
    package = tmp_path / "path" / "torch"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('torch was imported')\n")
    info = tmp_path / "path" / "torch-2.13.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: torch\nVersion: 2.13.0\n")
    directory = write_model(tmp_path / "model", "gelu")
    words = ["goals", "--encoder", "clip-vit-b-32", "--weights", str(directory)]
    words += ["--out", str(tmp_path / "t.npz")]
    done = run_alone(words, PYTHONPATH=str(tmp_path / "path"))
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "['transformers']"
    assert done.stderr == ""
