"""Checkpoints of older versions: arrays are read in the form they had, then brought up.

Running statistics from before `moments.py` were sums of squared deviations, and of returns a count
in float32; a run goes on from them with the means and the counts that they stand for. What was not
saved yet is NaN.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from cmrl_jax.nn.moments import Count

Leaves = dict[str, Any]

# Array that only the old form has -> all that stood where `_NEW` is now.
_OLD = {
    "obs_stats/summed_variance": ("mean", "summed_variance", "std_eps", "count/hi", "count/lo"),
    "return_stats/m2": ("mean", "m2", "count"),
}
_ADDED = ("params/task_z",)  # of policies, since there is a search over them
_NEW = (
    "moments/mean/value",
    "moments/mean/rest",
    "moments/variance/value",
    "moments/variance/rest",
    "moments/count/hi",
    "moments/count/lo",
)


def as_stored(wanted: Mapping[str, Any], saved: Iterable[str]) -> Leaves:
    """What to read, {path: abstract array}, for `wanted` from a checkpoint with the paths `saved`.

    It is `wanted` itself unless the checkpoint is an old one.
    """
    saved = set(saved)
    stored = {path: leaf for path, leaf in wanted.items() if path in saved or path not in _ADDED}
    for prefix, names in _old_parts(saved):
        if prefix + _NEW[0] in wanted:
            new = {name: stored.pop(prefix + name) for name in _NEW}
            like = dict.fromkeys(names, new["moments/mean/value"])
            if "count/hi" in names:
                of_count = new["moments/count/hi"]
                std_eps = jax.ShapeDtypeStruct((), jnp.float32, sharding=of_count.sharding)
                like |= {"count/hi": of_count, "count/lo": of_count, "std_eps": std_eps}
            stored |= {prefix + name: leaf for name, leaf in like.items()}
    return stored


def brought_up(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> Leaves:
    """The arrays `wanted`, {path: array}, from those that `as_stored` named for them."""
    out = dict(found)
    for path in _ADDED:
        if path in wanted and path not in found:
            out[path] = jnp.full(wanted[path].shape, jnp.nan, wanted[path].dtype)
    for prefix, names in _old_parts(found):
        old = {name: out.pop(prefix + name) for name in names}
        if "count" in old:  # (task,), the same for all
            count = old["count"][0]
            high = jnp.floor(count / 2.0**32)
            halves = high.astype(jnp.uint32), (count - high * 2.0**32).astype(jnp.uint32)
            total = old["m2"]
        else:
            halves = old["count/hi"], old["count/lo"]
            count = Count(*halves).as_float()
            total = old["summed_variance"]
        variance = total / jnp.maximum(count, 1.0)
        rest = jnp.zeros_like(total), jnp.zeros_like(total)  # a buffer each, to be donated
        new = (old["mean"], rest[0], variance, rest[1], *halves)
        out |= {prefix + name: leaf for name, leaf in zip(_NEW, new, strict=True)}
    return out


def _old_parts(paths: Iterable[str]) -> list[tuple[str, tuple[str, ...]]]:
    """Paths of the statistics that are in their old form, with the names of their arrays."""
    return [
        (path[: path.rindex("/") + 1], names)
        for path in paths
        for mark, names in _OLD.items()
        if path.endswith(mark)
    ]
