"""Data parallelism over the local devices: lanes, rings and batches are split over one axis.

Everything learned is replicated, the loss stays a mean over the whole batch, and XLA inserts the
communication: one program text for 1 to N devices. The mesh is jax's ambient one, in force while a
program is traced. With one device there is none, and nothing here changes the program.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import jax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "data"


def make_mesh() -> Mesh | None:
    """All local devices on one axis; None with a single one."""
    devices = jax.local_devices()
    if len(devices) == 1:
        return None
    # MJX is not written for explicit axes, the default.
    return jax.make_mesh((len(devices),), (AXIS,), (jax.sharding.AxisType.Auto,), devices=devices)


def size(mesh: Mesh | None) -> int:
    """Devices of a mesh."""
    return 1 if mesh is None else mesh.size


def using(mesh: Mesh | None) -> contextlib.AbstractContextManager[Any]:
    """Puts the mesh in force, for what is traced inside."""
    return contextlib.nullcontext() if mesh is None else jax.set_mesh(mesh)


def is_split() -> bool:
    """Whether a mesh is in force, and not inside of what each device runs by itself."""
    return jax.sharding.AxisType.Auto in jax.sharding.get_abstract_mesh().axis_types


def split(tree: Any, axis: int = 0) -> Any:
    """The arrays of a traced tree with one axis split over the devices.

    Args:
        axis: its length is divisible by their number (`rules.check_devices`).
    """
    return _constrain(tree, PartitionSpec(*[None] * axis, AXIS))


def gather(tree: Any) -> Any:
    """The arrays of a traced tree whole on every device."""
    return _constrain(tree, PartitionSpec())


def by_part(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of arrays with a leading lane axis, run by each device on its own lanes.

    For what treats lanes one by one: loops, solvers and host callbacks then stay on their device.
    """
    if not is_split():
        return function
    lanes = PartitionSpec(AXIS)
    return jax.shard_map(function, in_specs=lanes, out_specs=lanes, check_vma=False)


def over_seeds(function: Callable[..., Any], mesh: Mesh | None, run: Any) -> Callable[..., Any]:
    """`function`: RunState of seeds -> RunState, metrics; each device runs it on its own seeds.

    Args:
        run: the state's tree of axes, 0 where there is a leading seed axis, else None.
    """
    if mesh is None:
        return function
    specs = _specs(run)
    return jax.shard_map(
        function,
        mesh=mesh,
        in_specs=(specs,),
        out_specs=(specs, PartitionSpec(AXIS)),
        check_vma=False,
    )


def placed_seeds(shapes: Any, mesh: Mesh | None, axes: Any) -> Any:
    """The shapes of a `RunState` of seeds with where each array lies; `axes` as of `over_seeds`."""
    if mesh is None:
        return shapes

    def place(leaf: Any, spec: PartitionSpec) -> Any:
        if leaf is None:
            return None
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=NamedSharding(mesh, spec))

    return jax.tree.map(place, shapes, _specs(axes), is_leaf=lambda part: part is None)


def _specs(axes: Any) -> Any:
    """Where the leaves of a tree of axes lie: split over the devices by seed, or on each."""
    of_axis = lambda axis: PartitionSpec() if axis is None else PartitionSpec(AXIS)
    return jax.tree.map(of_axis, axes, is_leaf=lambda axis: axis is None)


def _constrain(tree: Any, spec: PartitionSpec) -> Any:
    if not is_split():
        return tree
    return jax.tree.map(lambda x: jax.lax.with_sharding_constraint(x, spec), tree)


def placed(run: Any, mesh: Mesh | None) -> Any:
    """The shapes of a `RunState` with where each array lies.

    What has `rows` (task, slot, ...), a ring, is split by slot; all else is on every device.
    Without a mesh jax's default stays.
    """
    if mesh is None:
        return run
    everywhere = NamedSharding(mesh, PartitionSpec())
    by_slot = NamedSharding(mesh, PartitionSpec(None, AXIS))

    def place(leaf: Any, where: NamedSharding) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=where)

    whole = jax.tree.map(lambda leaf: place(leaf, everywhere), run)
    is_ring = lambda part: hasattr(part, "rows")
    split = lambda part: part.replace(rows=place(part.rows, by_slot)) if is_ring(part) else part
    return jax.tree.map(split, whole, is_leaf=is_ring)


def on_one_device(tree: Any) -> Any:
    """Arrays that every device holds, as one device's; for programs that run on one."""
    devices = jax.local_devices()
    return tree if len(devices) == 1 else jax.device_put(tree, devices[0])
