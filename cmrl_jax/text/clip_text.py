"""The text tower of CLIP in linen: token ids -> projected vector of the end-of-text token.

The parameters are named as in the Flax checkpoints of `transformers` (`flax_model.msgpack`), so
that one of those is the parameter tree itself; `to_params` renames those of torch. Everything runs
in float64 and is rounded once at the end, so a table does not depend on the device that built it.

Source: Radford et al. 2021; huggingface/transformers: src/transformers/models/clip/modeling_clip.py
for the names, the configurations and the two eos rules.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from cmrl_jax.config.schema import ConfigError
from cmrl_jax.text.clip_tokenizer import VOCABULARY

ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "quick_gelu": lambda x: x * jax.nn.sigmoid(1.702 * x),
    "gelu": partial(jax.nn.gelu, approximate=False),
}
# Configurations older than July 2023 say 2, which no text holds; the vector is then read at the
# highest id, else at the first `eos_token_id`. They differ where ids above eos were added.
LEGACY_EOS = 2
CURE = "give --weights a directory with the config.json and the model.safetensors of a CLIP model"


@dataclass(frozen=True)
class Architecture:
    """Sizes of a text tower under the names of CLIP's config.json; the defaults are B/32's."""

    vocab_size: int = VOCABULARY
    hidden_size: int = 512
    intermediate_size: int = 2048
    projection_dim: int = 512
    num_hidden_layers: int = 12
    num_attention_heads: int = 8
    max_position_embeddings: int = 77
    hidden_act: str = "quick_gelu"
    layer_norm_eps: float = 1e-5
    eos_token_id: int = VOCABULARY - 1

    @classmethod
    def read(cls, config: Mapping[str, Any]) -> Architecture:
        """Reads a config.json: that of a whole CLIP, or that of a text tower with projection.

        What it leaves out has the default, as in `transformers`.

        Raises:
            ConfigError: another kind of model, or sizes that make no tower.
        """
        kind = config.get("model_type")
        if kind == "clip":
            text = {**(config.get("text_config") or {}), **(config.get("text_config_dict") or {})}
            # The projection belongs to the whole model; the text part's own entry is not used.
            text["projection_dim"] = config.get("projection_dim", cls.projection_dim)
        elif kind == "clip_text_model":
            text = dict(config)
        else:
            raise ConfigError(f"the config.json is of a model of type {kind!r}, not CLIP", CURE)
        found = cls(**{name: text[name] for name in cls.__dataclass_fields__ if name in text})
        found._check()
        return found

    def _check(self) -> None:
        for name, default in ((f.name, f.default) for f in self.__dataclass_fields__.values()):
            value = getattr(self, name)
            if type(value) is not type(default) or (type(value) is int and value < 1):
                raise ConfigError(f"the config.json has {name} {value!r}", CURE)
        if self.hidden_act not in ACTIVATIONS:
            known = " and ".join(ACTIVATIONS)
            cause = f"the config.json has hidden_act {self.hidden_act!r}; {known} are built"
            raise ConfigError(cause, CURE)
        if self.hidden_size % self.num_attention_heads:
            cause = f"{self.num_attention_heads} heads do not divide a width of {self.hidden_size}"
            raise ConfigError(f"the config.json is wrong: {cause}", CURE)
        if self.vocab_size < VOCABULARY:
            cause = f"{self.vocab_size} tokens, CLIP's tokenizer has {VOCABULARY}"
            raise ConfigError(f"the config.json is of another vocabulary: {cause}", CURE)


class _Embeddings(nn.Module):
    arch: Architecture

    @nn.compact
    def __call__(self, ids: jax.Array) -> jax.Array:
        arch = self.arch
        tokens = nn.Embed(arch.vocab_size, arch.hidden_size, name="token_embedding")(ids)
        positions = nn.Embed(
            arch.max_position_embeddings, arch.hidden_size, name="position_embedding"
        )
        return tokens + positions(jnp.arange(ids.shape[1]))


class _Attention(nn.Module):
    arch: Architecture

    @nn.compact
    def __call__(self, x: jax.Array, mask: jax.Array) -> jax.Array:
        heads, width = self.arch.num_attention_heads, self.arch.hidden_size

        def split(name: str) -> jax.Array:
            return nn.Dense(width, name=name)(x).reshape(*x.shape[:2], heads, width // heads)

        query, key, value = (split(name) for name in ("q_proj", "k_proj", "v_proj"))
        mixed = nn.dot_product_attention(query, key, value, mask=mask)
        return nn.Dense(width, name="out_proj")(mixed.reshape(x.shape))


class _Mlp(nn.Module):
    arch: Architecture

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        inner = nn.Dense(self.arch.intermediate_size, name="fc1")(x)
        return nn.Dense(self.arch.hidden_size, name="fc2")(ACTIVATIONS[self.arch.hidden_act](inner))


def _layer_norm(arch: Architecture, name: str) -> nn.LayerNorm:
    return nn.LayerNorm(epsilon=arch.layer_norm_eps, use_fast_variance=False, name=name)


class _Block(nn.Module):
    arch: Architecture

    @nn.compact
    def __call__(self, x: jax.Array, mask: jax.Array) -> jax.Array:
        arch = self.arch
        x = x + _Attention(arch, name="self_attn")(_layer_norm(arch, "layer_norm1")(x), mask)
        return x + _Mlp(arch, name="mlp")(_layer_norm(arch, "layer_norm2")(x))


class _Layers(nn.Module):
    arch: Architecture

    @nn.compact
    def __call__(self, x: jax.Array, mask: jax.Array) -> jax.Array:
        for index in range(self.arch.num_hidden_layers):
            x = _Block(self.arch, name=str(index))(x, mask)
        return x


class _Encoder(nn.Module):
    arch: Architecture

    @nn.compact
    def __call__(self, x: jax.Array, mask: jax.Array) -> jax.Array:
        return _Layers(self.arch, name="layers")(x, mask)


class _TextModel(nn.Module):
    arch: Architecture

    @nn.compact
    def __call__(self, ids: jax.Array) -> jax.Array:
        x = _Embeddings(self.arch, name="embeddings")(ids)  # (sentence, token, hidden)
        x = _Encoder(self.arch, name="encoder")(x, nn.make_causal_mask(ids))
        x = _layer_norm(self.arch, "final_layer_norm")(x)
        eos = self.arch.eos_token_id
        at = (ids if eos == LEGACY_EOS else ids == eos).argmax(-1)
        return jnp.take_along_axis(x, at[:, None, None], axis=1)[:, 0]


class TextTower(nn.Module):
    """Token ids (sentence, token) -> text vectors (sentence, projection_dim), not normalised."""

    arch: Architecture

    @nn.compact
    def __call__(self, ids: jax.Array) -> jax.Array:
        pooled = _TextModel(self.arch, name="text_model")(ids)
        return nn.Dense(self.arch.projection_dim, use_bias=False, name="text_projection")(pooled)


def to_params(tensors: Mapping[str, np.ndarray], arch: Architecture) -> dict[str, Any]:
    """Returns the parameters of the tower from the tensors of a checkpoint.

    Args:
        tensors: under torch's dotted names (a linear `weight` is (out, in)) or, joined by dots,
            under those of a Flax checkpoint. Those of other towers are left out.

    Raises:
        ConfigError: a tensor is missing or of another shape; names the first.
    """
    ids = jax.ShapeDtypeStruct((1, arch.max_position_embeddings), jnp.int32)
    wanted = jax.eval_shape(TextTower(arch).init, jax.random.key(0), ids)["params"]

    def fill(path: Any, leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        stem, _, kind = name.rpartition(".")
        if name in tensors:  # a bias is called the same by both
            values = tensors[name]
        elif f"{stem}.weight" in tensors:
            values = tensors[f"{stem}.weight"]
            values = values.T if kind == "kernel" else values
        else:
            raise ConfigError(f"the checkpoint has no {stem} ({kind})", CURE)
        if values.shape != leaf.shape:
            cause = f"its {stem} ({kind}) is {values.shape}, its config.json asks for {leaf.shape}"
            raise ConfigError(f"the checkpoint is of another architecture: {cause}", CURE)
        return values

    return jax.tree_util.tree_map_with_path(fill, wanted)


def text_vectors(
    arch: Architecture, params: Mapping[str, Any], rows: Sequence[Sequence[int]]
) -> np.ndarray:
    """Returns float64 (sentence, projection_dim), not normalised.

    Args:
        rows: token ids of each sentence, bos and eos included, at most `max_position_embeddings`.
    """
    # No token sees a later one, so what stands after the first eos changes nothing.
    ids = np.full((len(rows), max(map(len, rows))), VOCABULARY - 1, np.int32)
    for row, tokens in zip(ids, rows, strict=True):
        row[: len(tokens)] = tokens
    with jax.enable_x64(True):
        double = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), params)
        return np.asarray(jax.jit(TextTower(arch).apply)({"params": double}, ids))
