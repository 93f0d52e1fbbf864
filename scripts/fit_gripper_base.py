"""Fits the polytope that stands for the gripper's base mesh against handles.

    python scripts/fit_gripper_base.py        # writes envs/data/gripper_base.csv, half a minute

A row is a face: outward normal, distance from the origin (frame of body `right_hand`, metres). The
largest plane distance is to equal the distance to the mesh's convex hull, at probes up to a window
handle's radius away from it; the sides that push a handle (+-x) count ten times. Planes start as
means of hull faces that lie within 22 degrees of one another, 15 on those sides.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy.spatial import ConvexHull

from envs.engine import mujoco
from envs.physics.mjx.geometry import BASE_FILE
from envs.physics.model import load_scene

MERGE_ANGLE, SIDE_MERGE_ANGLE = np.radians(22), np.radians(15)
HANDLE_RADIUS, PROBES, STEPS = 0.008, 6000, 4000
SIDE, SIDE_WEIGHT = 0.8, 10.0  # |x| of the normals of the pushing sides


def base_hull() -> ConvexHull:
    """Convex hull of the base mesh in the frame of its body."""
    model = load_scene("window")
    body = model.body("right_hand").id
    (geom,) = np.flatnonzero((model.geom_bodyid == body) & (model.geom_contype > 0))
    mesh = model.geom_dataid[geom]
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    vertices = model.mesh_vert[first : first + count] @ rotation.reshape(3, 3).T
    return ConvexHull(vertices + model.geom_pos[geom])


def merged_normals(normal: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Area-weighted means of faces within the merge angle, largest groups first."""
    angle = np.where(np.abs(normal[:, 0]) > SIDE, SIDE_MERGE_ANGLE, MERGE_ANGLE)
    near, left, merged = normal @ normal.T > np.cos(angle)[:, None], area > 0, []
    while left.any():
        seed = np.argmax(np.where(left, near @ (area * left), -1.0))
        group = near[seed] & left
        mean = area[group] @ normal[group]
        merged.append(mean / np.linalg.norm(mean))
        left &= ~group
    return np.array(merged)


def main() -> None:
    hull = base_hull()
    points, corners = hull.points, hull.points[hull.simplices]
    normal = hull.equations[:, :3]
    edges = np.diff(corners, axis=1)
    area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)

    # Probes over faces, and over corners along their mean normal: distances known by construction.
    rng = np.random.default_rng(0)
    face = rng.choice(len(area), PROBES, p=area / area.sum())
    on_face = np.einsum("pc,pcx->px", rng.dirichlet([1, 1, 1], PROBES), corners[face])
    outward = np.zeros_like(points)
    np.add.at(outward, hull.simplices, (area[:, None] * normal)[:, None])
    vertex = hull.vertices
    outward = outward[vertex] / np.linalg.norm(outward[vertex], axis=1, keepdims=True)
    distance = rng.uniform(0, HANDLE_RADIUS, PROBES + len(vertex))
    surface = np.concatenate([on_face, points[vertex]])
    direction = np.concatenate([normal[face], outward])
    probe = surface + distance[:, None] * direction
    weight = np.where(np.abs(direction[:, 0]) > SIDE, SIDE_WEIGHT, 1.0)

    def error_mm(planes):
        directions, offset_cm = planes
        unit = directions / jnp.linalg.norm(directions, axis=1, keepdims=True)
        return 1e3 * (jnp.max(probe @ unit.T - offset_cm / 100, 1) - distance)

    def loss(planes):
        error = error_mm(planes)
        return jnp.mean(weight * (error**2 + error**4))

    start = merged_normals(normal, area)
    planes = (jnp.asarray(start), jnp.asarray(100 * np.max(points @ start.T, 0)))
    optimiser = optax.adam(optax.cosine_decay_schedule(5e-3, STEPS))
    state = optimiser.init(planes)

    @jax.jit
    def step(planes, state):
        updates, state = optimiser.update(jax.grad(loss)(planes), state)
        return optax.apply_updates(planes, updates), state

    for _ in range(STEPS):
        planes, state = step(planes, state)
    error = np.asarray(error_mm(planes))
    rms = lambda e: float(np.sqrt(np.mean(e**2)))
    print(
        f"{len(start)} faces; rms {rms(error):.2f} mm, on the sides "
        f"{rms(error[weight > 1]):.2f} mm; largest {np.abs(error).max():.2f} mm"
    )
    directions = np.asarray(planes[0])
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    table = np.column_stack([unit, np.asarray(planes[1]) / 100])
    np.savetxt(Path(BASE_FILE), table, fmt="%.5f", delimiter=",", header="nx,ny,nz,offset")


if __name__ == "__main__":
    main()
