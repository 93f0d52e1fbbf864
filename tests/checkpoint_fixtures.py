"""Shared by the tests of checkpoints: a state with every kind of leaf, saved and read back."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import struct

from cmrl_jax.config import files as config_io
from cmrl_jax.config.schema import Config, ConfigError
from cmrl_jax.storage import checkpoint, manifest


@struct.dataclass
class State:
    """The kinds of leaf and node that a learner has."""

    params: dict[str, jax.Array]
    opt_state: Any
    absent: jax.Array | None
    nothing: tuple
    no_elements: jax.Array
    key: jax.Array
    count: jax.Array
    flags: jax.Array
    lanes: int = struct.field(pytree_node=False)


def init_state(seed: int = 0) -> State:
    params = {"a.b/c": jnp.arange(6.0).reshape(2, 3) + seed, "w": jnp.float32(0.1 + seed)}
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(1e-3))
    return State(
        params=params,
        opt_state=optimizer.init(params),
        absent=None,
        nothing=(),
        no_elements=jnp.zeros((0, 4)),
        key=jax.random.split(jax.random.key(seed), 2),
        count=jnp.int32(2**24 + 1 + seed),
        flags=jnp.array([True, False]),
        lanes=3,
    )


VERSIONS: dict[str, str | None] = {"jax": "0.12.0", "flax": "0.12.12"}
ABSTRACT = {"learner": jax.eval_shape(init_state), "replay": None, "context": None}


def make_meta(iteration: int, **changes: Any) -> dict[str, Any]:
    config = config_io.to_dict(Config())
    numbers = {"env_steps": 10 * iteration, "wall_s": 1.5, "csv_offset": 123}
    meta = {"config": config, "iteration": iteration, "versions": VERSIONS, "goals_sha256": "ab"}
    return meta | numbers | changes


def save_steps(run: Path, *steps: int, keep: int | None = None) -> None:
    with checkpoint.full_store(run, keep) as store:
        for step in steps:
            trees = {"learner": init_state(step), "replay": None, "context": None}
            assert store.save(trees, make_meta(step))


def unlist(run: Path, step: int) -> None:
    """Removes the list of a step's files, so that orbax itself meets what is wrong with them."""
    (run / "ckpt" / str(step) / manifest.NAME).unlink()


def assert_equal_trees(found: Any, expected: Any) -> None:
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)


def restore(run: Path, **options: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    with checkpoint.full_store(run, read_only=True) as store:
        return store.restore(ABSTRACT, **options)


def cause_and_cure(run: Path, **options: Any) -> tuple[str, str]:
    with pytest.raises(ConfigError) as raised:
        restore(run, **options)
    return raised.value.cause, raised.value.cure
