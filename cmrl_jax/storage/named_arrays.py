"""Trees as flat {path: array}, which is how a checkpoint stores, names and describes them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def flatten(tree: Any) -> dict[str, Any]:
    """{path: leaf}; arrays without elements are left out, because orbax refuses them."""
    return {
        jax.tree_util.keystr(path, simple=True, separator="/"): leaf
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
        if leaf.size
    }


def unflatten(abstract: Any, leaves: Mapping[str, Any]) -> Any:
    """The tree of `abstract` with the arrays that `flatten` named."""

    def fill(path: Any, leaf: Any) -> Any:
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        return leaves[name] if leaf.size else jnp.zeros(leaf.shape, leaf.dtype)

    return jax.tree_util.tree_map_with_path(fill, abstract)


def placed(leaf: Any) -> jax.ShapeDtypeStruct:
    """The leaf with a sharding of this process: the stored one may name devices it lacks."""
    sharding = leaf.sharding or jax.sharding.SingleDeviceSharding(jax.devices()[0])
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding)


def describe(leaf: Any) -> str:
    """`float32[3, 4]`; typed keys as the numbers that are stored for them."""
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.eval_shape(jax.random.key_data, leaf)
    return f"{leaf.dtype}{list(leaf.shape)}"


def not_finite(leaves: Mapping[str, Any]) -> str | None:
    """Path of the first array that holds a NaN or an infinity."""
    for path, leaf in leaves.items():
        if jnp.issubdtype(leaf.dtype, jnp.inexact) and not np.isfinite(leaf).all():
            return path
    return None
