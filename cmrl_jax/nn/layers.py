"""Linen building blocks of networks.py: initialisers, linear layers and the plain MLP.

A layer takes several arrays and acts on their concatenation without building it: they may
broadcast to one another, so one z for a whole batch is never repeated in memory.
The NOTES at the head of networks.py apply.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

Initializer = Callable[..., jax.Array]

HEAD_SCALE = 3e-3


def symmetric_uniform(scale: float) -> Initializer:
    """Initialiser U(-scale, scale); linen's own `uniform` starts at 0."""

    def init(key: jax.Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> jax.Array:
        return jax.random.uniform(key, shape, dtype, -scale, scale)

    return init


def outputs_uniform(key: jax.Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> jax.Array:
    """U(+-1/sqrt(k)), k the number of outputs, for kernels (..., in, out) (NOTE 8)."""
    return symmetric_uniform(1.0 / math.sqrt(shape[-1]))(key, shape, dtype)


def he_uniform(key: jax.Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> jax.Array:
    """U(+-sqrt(6/k)), k the number of inputs, for kernels (..., in, out)."""
    return symmetric_uniform(math.sqrt(6.0 / max(shape[-2], 1)))(key, shape, dtype)


class Initialisers(NamedTuple):
    """Kernel and bias initialisers of hidden layers, of output heads and of routing logits."""

    kernel: Initializer
    bias: Initializer
    head_kernel: Initializer
    head_bias: Initializer
    routing_kernel: Initializer
    routing_bias: Initializer


def make_initialisers(scheme: str) -> Initialisers:
    """Initialisers of `model.init`: `official` or `flax`, see the NOTES of networks.py."""
    small = symmetric_uniform(HEAD_SCALE)
    if scheme == "official":
        return Initialisers(
            outputs_uniform, nn.initializers.constant(0.1), small, small, small, small
        )
    zeros = nn.initializers.zeros_init()
    return Initialisers(he_uniform, zeros, small, small, symmetric_uniform(1e-3), zeros)


class Linear(nn.Module):
    """Dense layer on the concatenation of its arguments, which may broadcast to one another."""

    features: int
    kernel_init: Initializer
    bias_init: Initializer

    @nn.compact
    def __call__(self, *parts: jax.Array) -> jax.Array:
        sizes = [part.shape[-1] for part in parts]
        kernel = self.param("kernel", self.kernel_init, (sum(sizes), self.features))
        y = self.param("bias", self.bias_init, (self.features,))
        offset = 0
        for part, size in zip(parts, sizes, strict=True):
            if size:
                y = y + part @ kernel[offset : offset + size]
            offset += size
        return y


class MLP(nn.Module):
    """relu MLP on the concatenation of its arguments; `norm` puts LayerNorm before every relu."""

    hidden: tuple[int, ...]
    out: int
    norm: bool
    initialisers: Initialisers

    @nn.compact
    def __call__(self, *parts: jax.Array) -> tuple[jax.Array, None]:
        init = self.initialisers
        for width in self.hidden:
            y = Linear(width, init.kernel, init.bias)(*parts)
            parts = (nn.relu(nn.LayerNorm()(y) if self.norm else y),)
        return Linear(self.out, init.head_kernel, init.head_bias)(*parts), None


class ModuleLayer(nn.Module):
    """n linear modules as one product: (..., in) shared or (..., n, in) own input -> (..., n, out).

    Kernel (n, in, out), bias (n, out).
    """

    modules: int
    features: int
    initialisers: Initialisers

    @nn.compact
    def __call__(self, x: jax.Array, shared: bool) -> jax.Array:
        shape = (self.modules, x.shape[-1], self.features)
        kernel = self.param("kernel", self.initialisers.kernel, shape)
        bias = self.param("bias", self.initialisers.bias, (self.modules, self.features))
        return jnp.einsum("...i,nio->...no" if shared else "...ni,nio->...no", x, kernel) + bias
