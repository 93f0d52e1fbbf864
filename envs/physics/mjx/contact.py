"""Narrow-phase collision of gripper shapes with fixture shapes, and the choice of contacts to keep.

Per lane and substep there are 24 + 3 + 23 candidate points; only a few can be in contact at once,
and each kept point costs the solver four rows. So every family keeps its deepest few.
All functions are for one lane; callers vmap. Distances in metres, world frame.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from envs.physics.mjx.geometry import BASE_HANDLE_COUNT, FixtureShapes, Gripper, Material

FINGER_SLOTS, BASE_SLOTS, BOX_SLOTS = 4, 2, 4  # contacts kept a family
_EPS = 1e-9
_CUTS = 5  # of a handle's axis; more change no contact by 1 um


class Contacts(NamedTuple):
    """Contact points, gripper first: a positive `dist` beyond the margin is inactive."""

    dist: jax.Array  # (contact,)
    pos: jax.Array  # (contact, 3)
    normal: jax.Array  # (contact, 3) from gripper to fixture
    part: jax.Array  # (contact,) HAND, RIGHT or LEFT
    moves: jax.Array  # (contact,) 1.0 if the fixture side rides on the slide
    material: Material  # mixed


def mix(gripper: Material, fixture: Material) -> Material:
    """MuJoCo's mixing rule for equal priority and solmix: largest friction, mean solver values."""
    return Material(
        friction=jnp.maximum(gripper.friction, fixture.friction),
        solref=0.5 * (gripper.solref + fixture.solref),
        solimp=0.5 * (gripper.solimp + fixture.solimp),
        margin=jnp.maximum(gripper.margin, fixture.margin),
        invweight=gripper.invweight + fixture.invweight,
    )


def _take(material: Material, index: jax.Array) -> Material:
    return Material(*(jnp.asarray(leaf)[index] for leaf in material))


def _deepest(contacts: Contacts, count: int) -> jax.Array:
    """The `count` contacts deepest beyond their margin, packed; they carry the load of the others.

    With n points in contact and fewer kept, each kept one is as stiff as n / count of them:
    otherwise a hard push sinks in deeper than the handle is thick, and passes through.
    """
    depth = contacts.material.margin - contacts.dist
    share = jnp.maximum(jnp.sum(depth > 0) / count, 1.0)
    _, index = jax.lax.top_k(depth, count)
    softer = contacts.material._replace(invweight=contacts.material.invweight / share)
    return _packed(contacts._replace(material=softer))[index]


def _packed(contacts: Contacts) -> jax.Array:
    """All numbers of contacts as a table (contact, number), from which one gather takes rows."""
    return jax.vmap(lambda one: ravel_pytree(one)[0])(contacts)


def _unpacked(table: jax.Array, like: Contacts) -> Contacts:
    """Contacts of a table; `like`: any of the same kind."""
    _, unravel = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], like))
    return jax.vmap(unravel)(table)


def point_box(point: jax.Array, half: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Signed distance and outward normal from a box at the origin to points (..., 3)."""
    outside = point - jnp.clip(point, -half, half)
    norm = jnp.sqrt(jnp.sum(outside**2, -1, keepdims=True) + _EPS**2)
    depth = jnp.abs(point) - half  # negative inside
    face = (depth == depth.max(-1, keepdims=True)) * jnp.sign(point + _EPS)
    is_outside = jnp.any(depth > 0, -1, keepdims=True)
    dist = jnp.where(is_outside, norm, depth.max(-1, keepdims=True))[..., 0]
    return dist, jnp.where(is_outside, outside / norm, face)


def stem_box(stem: jax.Array, point: jax.Array, half: jax.Array) -> tuple[jax.Array, jax.Array]:
    """`point_box` for the end of a stick from `stem` to `point` (..., 3) that may pierce the box.

    A stick that came through a thin plate is pushed back the way it came, not out at the far side:
    where the stick crosses the box, faces turned away from the stem are no way out.
    """
    dist, normal = point_box(point, half)
    along = point - stem
    along = jnp.where(jnp.abs(along) < _EPS, _EPS, along)
    one, two = (-half - stem) / along, (half - stem) / along
    enter, leave = jnp.minimum(one, two).max(-1), jnp.maximum(one, two).min(-1)
    crosses = (enter < leave) & (enter < 1.0) & (leave > 0.0)
    # Depth below the six faces, those at +half first.
    depth = jnp.concatenate([half - point, half + point], -1)
    away = jnp.concatenate([stem < -half, stem > half], -1)
    depth = jnp.where(away, jnp.inf, depth)
    least = depth.min(-1)
    faces = (depth == least[..., None]).astype(point.dtype)
    out = faces[..., :3] - faces[..., 3:]
    return jnp.where(crosses, -least, dist), jnp.where(crosses[..., None], out, normal)


def _segment_box(start: jax.Array, end: jax.Array, half: jax.Array):
    """Two parameters in [0, 1] where a segment (..., 3) lies closest over a box at the origin.

    If the segment lies over a face, they are the ends of the overlap; at an edge or corner both are
    the closest point.
    """
    along = end - start
    length2 = jnp.sum(along**2, -1, keepdims=True)

    def nearest(point: jax.Array) -> jax.Array:
        return jnp.clip(jnp.sum((point - start) * along, -1, keepdims=True) / length2, 0.0, 1.0)

    t = nearest(jnp.zeros_like(start))
    for _ in range(4):  # alternating projection between segment and box
        t = nearest(jnp.clip(start + t * along, -half, half))
    _, normal = point_box(start + t * along, half)
    lateral = jnp.abs(normal) < jnp.abs(normal).max(-1, keepdims=True)
    safe = jnp.where(jnp.abs(along) < _EPS, _EPS, along)
    one, two = (-half - start) / safe, (half - start) / safe
    enter = jnp.where(lateral, jnp.minimum(one, two), -jnp.inf).max(-1, keepdims=True)
    leave = jnp.where(lateral, jnp.maximum(one, two), jnp.inf).min(-1, keepdims=True)
    enter, leave = jnp.clip(enter, 0.0, 1.0), jnp.clip(leave, 0.0, 1.0)
    over_face = leave > enter
    return jnp.where(over_face, enter, t), jnp.where(over_face, leave, t), over_face[..., 0]


def finger_capsule_contacts(
    gripper: Gripper,
    shapes: FixtureShapes,
    link_pos: jax.Array,
    link_rot: jax.Array,
    finger_slide: jax.Array,
    handle_shift: jax.Array,
) -> Contacts:
    """Finger boxes (4) against handle capsules (3), two points a pair."""
    hand = link_rot @ gripper.hand_rotation  # axes of the finger boxes in the world
    slide = jnp.concatenate([jnp.zeros(1), finger_slide])[gripper.finger_part]
    axis = jnp.concatenate([jnp.zeros((1, 3)), gripper.finger_axis])[gripper.finger_part]
    center = link_pos + (gripper.finger_center + axis * slide[:, None]) @ link_rot.T  # (4, 3)
    ends = jnp.asarray(shapes.capsule_ends) + handle_shift  # (3, 2, 3)
    local = (ends[None] - center[:, None, None]) @ hand  # (box, capsule, end, 3)
    half = jnp.asarray(gripper.finger_half)[:, None]
    first, second, over_face = _segment_box(local[:, :, 0], local[:, :, 1], half)
    t = jnp.stack([first, second], 2)  # (box, capsule, 2, 1)
    point = local[:, :, :1] + t * (local[:, :, 1:] - local[:, :, :1])
    dist, normal = point_box(point, half[:, :, None])
    dist = dist - shapes.capsule_radius[None, :, None]
    radius = jnp.asarray(shapes.capsule_radius)[None, :, None, None]
    surface = point - normal * (radius + 0.5 * dist[..., None])  # midway between both surfaces
    # One touching point, not two equal ones, where the capsule lies over an edge.
    dist = dist.at[:, :, 1].set(jnp.where(over_face, dist[:, :, 1], 1.0))
    material = mix(
        Material(*(jnp.asarray(x)[:, None, None] for x in gripper.finger_material)),
        Material(*(jnp.asarray(x)[None, :, None] for x in shapes.capsule_material)),
    )
    pairs = dist.shape
    flat = lambda x, tail=(): jnp.broadcast_to(x, pairs + tail).reshape((-1, *tail))
    return Contacts(
        dist=flat(dist),
        pos=flat(surface @ hand.T + center[:, None, None], (3,)),
        normal=flat(normal @ hand.T, (3,)),
        part=flat(jnp.asarray(gripper.finger_part)[:, None, None]),
        moves=flat(jnp.ones(())),
        material=Material(*(flat(leaf, leaf.shape[3:]) for leaf in material)),
    )


def segment_polytope(
    start: jax.Array, along: jax.Array, normal: jax.Array, offset: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """How deep segments lie in a convex polytope {x: normal x <= offset}.

    Along a segment the largest plane distance is convex and piecewise linear; its minimum is cut
    out by the steepest planes on either side. There the way out is the mixture of the two that is
    perpendicular to the segment.

    Args:
        start, along: (segment, 3) one end, and the way to the other.
        normal, offset: (face, 3), (face,).

    Returns:
        Parameter in [0, 1] of the deepest point (segment,), its largest plane distance (segment,)
        and the outward normal (segment, 3).
    """
    value, slope = start @ normal.T - offset, along @ normal.T  # (segment, face)

    faces = jnp.broadcast_to(jnp.arange(len(offset)), value.shape)

    def steepest(t):
        """Face, value and slope of the largest plane distance at t, taken in one reduction."""
        larger = lambda a, b: jax.tree.map(lambda x, y: jnp.where(a[0] >= b[0], x, y), a, b)
        found = (value + t[:, None] * slope, faces, value, slope)
        return jax.lax.reduce(found, (-jnp.inf, 0, 0.0, 0.0), larger, (1,))[1:]

    def crossing(low, high):
        """Where two lines meet, inside the segment; an end where it descends to that end."""
        rise = high[2] - low[2]
        t = (low[1] - high[1]) / jnp.maximum(rise, _EPS)
        t = jnp.where(low[2] >= 0, 0.0, jnp.where(high[2] <= 0, 1.0, t))
        return jnp.clip(t, 0.0, 1.0)

    low, high = steepest(jnp.zeros(len(start))), steepest(jnp.ones(len(start)))
    for _ in range(_CUTS):
        new = steepest(crossing(low, high))
        descends = new[2] < 0
        choose = lambda a, b: jnp.where(descends, a, b)
        low, high = (
            tuple(map(choose, new, low)),
            tuple(map(choose, high, new)),
        )
    t = crossing(low, high)
    # Weight of the plane that rises; at an end of the segment one plane alone is met.
    share = jnp.clip(-low[2] / jnp.maximum(high[2] - low[2], _EPS), 0.0, 1.0)
    share = jnp.where(t >= 1.0, 0.0, jnp.where(t <= 0.0, 1.0, share))[:, None]
    before, after = normal[low[0]], normal[high[0]]
    # Right through, from one face to the opposite one, there is no way out between the two.
    share = jnp.where(jnp.sum(before * after, 1, keepdims=True) < -0.5, jnp.round(share), share)
    out = (1 - share) * before + share * after
    dist = jnp.max(value + t[:, None] * slope, 1)
    return t, dist, out / jnp.linalg.norm(out, axis=1, keepdims=True)


def base_handle_contacts(
    gripper: Gripper,
    shapes: FixtureShapes,
    link_pos: jax.Array,
    link_rot: jax.Array,
    handle_shift: jax.Array,
) -> Contacts:
    """Gripper base polytope against handle capsules (3), one point a pair."""
    ends = (jnp.asarray(shapes.capsule_ends) + handle_shift - link_pos) @ link_rot  # (3, 2, 3)
    along = ends[:, 1] - ends[:, 0]
    t, dist, normal = segment_polytope(
        ends[:, 0], along, jnp.asarray(gripper.base_normal), jnp.asarray(gripper.base_offset)
    )
    radius = jnp.asarray(shapes.capsule_radius)
    dist = dist - radius
    normal = normal @ link_rot.T
    axis_point = (ends[:, 0] + t[:, None] * along) @ link_rot.T + link_pos
    base = Material(*(jnp.asarray(leaf)[None] for leaf in gripper.base_material))
    material = mix(base, Material(*(jnp.asarray(leaf) for leaf in shapes.capsule_material)))
    return Contacts(
        dist=dist,
        pos=axis_point - normal * (radius + 0.5 * dist)[:, None],
        normal=normal,
        part=jnp.zeros(dist.size, jnp.int32),
        moves=jnp.ones(dist.size),
        material=material._replace(invweight=material.invweight / BASE_HANDLE_COUNT),
    )


def sphere_box_contacts(
    gripper: Gripper,
    shapes: FixtureShapes,
    link_pos: jax.Array,
    link_rot: jax.Array,
    finger_slide: jax.Array,
    placement: jax.Array,
    handle_shift: jax.Array,
) -> Contacts:
    """Each gripper sphere (23) against the box it is deepest in: case, panels, frame, table."""
    slide = jnp.concatenate([jnp.zeros(1), finger_slide])[gripper.sphere_part]
    axis = jnp.concatenate([jnp.zeros((1, 3)), gripper.finger_axis])[gripper.sphere_part]
    moved = axis * slide[:, None]
    center = link_pos + (gripper.sphere_center + moved) @ link_rot.T  # (23, 3)
    stem = link_pos + (gripper.sphere_stem + moved) @ link_rot.T
    placed = jnp.asarray(shapes.box_placed)[:, None]
    moves = jnp.asarray(shapes.box_moves)[:, None]
    box = shapes.box_center + placed * placement + moves * (handle_shift - placement)  # (BOXES, 3)
    half = jnp.asarray(shapes.box_half)
    dist, _ = stem_box(stem[:, None] - box, center[:, None] - box, half)  # (23, BOXES)
    nearest = jnp.argmin(dist, 1)
    dist, normal = stem_box(stem - box[nearest], center - box[nearest], half[nearest])
    dist = dist - gripper.sphere_radius
    radius = jnp.asarray(gripper.sphere_radius)[:, None]
    material = mix(
        Material(*(jnp.asarray(x) for x in gripper.sphere_material)),
        _take(shapes.box_material, nearest),
    )
    return Contacts(
        dist=dist,
        pos=center - normal * (radius + 0.5 * dist[:, None]),
        normal=-normal,
        part=jnp.asarray(gripper.sphere_part),
        moves=jnp.asarray(shapes.box_moves)[nearest],
        material=material._replace(invweight=material.invweight / gripper.sphere_count),
    )


def find_contacts(
    gripper: Gripper,
    shapes: FixtureShapes,
    link_pos: jax.Array,
    link_rot: jax.Array,
    finger_slide: jax.Array,
    placement: jax.Array,
    handle_shift: jax.Array,
) -> Contacts:
    """The kept contacts of all three families.

    Args:
        link_pos, link_rot: pose of the last arm link, (3,) and (3, 3).
        finger_slide: slide positions of right and left finger (2,).
        placement: the fixture's position (3,).
        handle_shift: position of the fixture's moving part less its offset at slide 0 (3,), that is
            placement + axis * slide.
    """
    fingers = finger_capsule_contacts(
        gripper, shapes, link_pos, link_rot, finger_slide, handle_shift
    )
    base = base_handle_contacts(gripper, shapes, link_pos, link_rot, handle_shift)
    boxes = sphere_box_contacts(
        gripper, shapes, link_pos, link_rot, finger_slide, placement, handle_shift
    )
    kept = (
        _deepest(fingers, FINGER_SLOTS),
        _deepest(_without_torsion(base), BASE_SLOTS),
        _deepest(_without_torsion(boxes), BOX_SLOTS),
    )
    return _unpacked(jnp.concatenate(kept), fingers)


def _without_torsion(contacts: Contacts) -> Contacts:
    """Contacts that do not resist spinning about their normal (MuJoCo's condim 3)."""
    friction = jnp.asarray(contacts.material.friction).at[:, 1].set(0.0)
    return contacts._replace(material=contacts.material._replace(friction=friction))
