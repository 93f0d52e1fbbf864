"""Run by test_parallel.py in a process with four fake devices: what is split lies in four parts."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from cmrl_jax import parallel
from cmrl_jax.algorithms.common import replay
from cmrl_jax.config.files import load_config
from cmrl_jax.evaluation.session import Session

TASKS, LANES, CAPACITY, OBS = 3, 4, 24, 2


def make_steps(first: int, count: int) -> replay.Transition:
    """Transitions (time, task, lane, ...) that tell all of these apart."""
    shape = (count, TASKS, LANES)
    number = first * 100 + jnp.arange(np.prod(shape), dtype=jnp.float32).reshape(shape)
    obs = jnp.stack([number, -number], -1)
    flags = jnp.zeros(shape, bool)
    return replay.Transition(
        obs=obs,
        action=number[..., None],
        reward=number,
        terminated=flags,
        truncated=flags,
        first=flags,
        next_obs=obs + 0.5,
    )


def fill(ring: Any) -> Any:
    """Ten vector steps into a ring of six, in chunks: it wraps around inside a chunk."""
    for first, count in ((0, 4), (4, 4), (8, 2)):
        ring = replay.add(ring, make_steps(first, count))
    return ring


def part_shapes(array: jax.Array) -> set[tuple[int, ...]]:
    assert len(array.addressable_shards) == 4
    return {shard.data.shape for shard in array.addressable_shards}


def check_ring(mesh: Any) -> None:
    ring: Any = replay.init_replay(TASKS, CAPACITY, LANES, OBS, 1)
    expected = jax.jit(fill)(ring)  # no mesh in force
    width = ring.rows.shape[-1]
    by_slot = NamedSharding(mesh, PartitionSpec(None, parallel.AXIS))
    ring = ring.replace(rows=jax.device_put(ring.rows, by_slot))
    with parallel.using(mesh):
        program = jax.jit(fill).lower(ring).compile()
    found = program(ring)
    np.testing.assert_array_equal(found.rows, expected.rows)
    assert (int(found.index), int(found.size)) == (int(expected.index), int(expected.size))
    assert part_shapes(found.rows) == {(TASKS, CAPACITY // 4, width)}
    whole = f"f32[{TASKS},{CAPACITY},{width}]"
    assert whole not in str(program.as_text()), "a device holds the ring of all"


def check_lanes_and_batches(mesh: Any) -> None:
    seen = []

    def lane_by_lane(x: jax.Array) -> jax.Array:
        seen.append(x.shape)
        return 2 * x

    lanes = jnp.arange(12.0)
    with parallel.using(mesh):
        doubled = jax.jit(parallel.by_part(lane_by_lane))(lanes)
        batch = jax.jit(lambda x: parallel.split(x, 1))(jnp.zeros((3, 8, 2)))
        gathered = jax.jit(parallel.gather)(doubled)
    np.testing.assert_array_equal(doubled, 2 * lanes)
    assert seen[0] == (3,) and part_shapes(doubled) == {(3,)}
    assert part_shapes(batch) == {(3, 2, 2)} and part_shapes(gathered) == {(12,)}


def check_iteration(mesh: Any) -> None:
    """The training iteration asks for it: three of twelve lanes a device, batches by transition."""
    config = load_config("smoke.yaml", {"env.physics": "native"})
    session = Session(config)
    iteration = session.algorithm.make_iteration(session.train_placements())
    run = parallel.placed(jax.eval_shape(session.algorithm.init, jax.random.key(0)), mesh)
    with parallel.using(mesh):
        equations = list(walk(jax.jit(iteration).trace(run).jaxpr.jaxpr))
    shapes = lambda name: {e.outvars[0].aval.shape for e in equations if e.primitive.name == name}
    assert shapes("pure_callback") == {(3, 66)}  # MuJoCo C's states
    assert {(3, 32, 39), (3, 32, 4), (3, 2, 32, 4)} <= shapes("sharding_constraint")


def walk(jaxpr: Any) -> Iterator[Any]:
    """All equations, those inside loops and branches too."""
    for equation in jaxpr.eqns:
        yield equation
        for value in equation.params.values():
            for inner in value if isinstance(value, tuple) else (value,):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from walk(inner)


if __name__ == "__main__":
    jax.config.update("jax_num_cpu_devices", 4)
    mesh = parallel.make_mesh()
    assert parallel.size(mesh) == 4
    check_ring(mesh)
    check_lanes_and_batches(mesh)
    check_iteration(mesh)
