"""Clipped Adam and averages on flat vectors, one a network.

A network has some thirty leaves; raveled, clipping, the moments, the update and the averages are a
handful of large operations instead of hundreds of small ones: fewer to compile, fewer to launch.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import optax


def ravel(tree: Any, stacked: bool = False) -> Any:
    """All leaves as one vector (parameter,), or (network, parameter) if `stacked`; None of None."""
    if tree is None:
        return None
    leaves = jax.tree.leaves(tree)
    lead = leaves[0].shape[:1] if stacked else ()
    return jnp.concatenate([leaf.reshape(*lead, -1) for leaf in leaves], axis=-1)


def unravel(flat: Any, like: Any) -> Any:
    """The inverse of `ravel`, with the tree and the shapes of `like`."""
    if like is None:
        return None
    leaves, treedef = jax.tree.flatten(like)
    lead = math.prod(flat.shape[:-1])
    out, offset = [], 0
    for leaf in leaves:
        size = leaf.size // lead
        out.append(flat[..., offset : offset + size].reshape(leaf.shape))
        offset += size
    return jax.tree.unflatten(treedef, out)


def clip_by_norm(grads: jax.Array, max_norm: float) -> tuple[jax.Array, jax.Array]:
    """Scales (..., parameter) to a Euclidean norm of at most `max_norm` (0: leaves it alone).

    Returns:
        The gradients and the norm before clipping, (...): with leading axis network, each network
        is clipped on its own.
    """
    norm = jnp.sqrt(jnp.sum(jnp.square(grads), axis=-1))
    if max_norm == 0:
        return grads, norm
    return grads * jnp.minimum(1.0, max_norm / jnp.maximum(norm, 1e-12))[..., None], norm


def init_adam(params: Any, stacked: bool = False) -> Any:
    """Adam's state for a network, None for a network that does not exist.

    Args:
        stacked: the leaves have a leading axis of networks.
    """
    return None if params is None else optax.adam(0.0).init(ravel(params, stacked))


def adam_step(
    grads: jax.Array, opt_state: Any, params: jax.Array, lr: float, max_norm: float
) -> tuple[jax.Array, Any, jax.Array]:
    """One clipped Adam step on a flat vector (parameter,), or (network, parameter).

    Returns:
        New params, new optimizer state, and the gradient norm before clipping, () or (network,);
        it is finite exactly if the gradient is (or overflows when squared).
    """
    grads, norm = clip_by_norm(grads, max_norm)
    updates, opt_state = optax.adam(lr).update(grads, opt_state)
    new: Any = optax.apply_updates(params, updates)
    return new, opt_state, norm


def polyak(online: Any, target: Any, tau: float | jax.Array) -> Any:
    """target <- (1 - tau) target + tau online."""
    return jax.tree.map(lambda new, old: old + tau * (new - old), online, target)
