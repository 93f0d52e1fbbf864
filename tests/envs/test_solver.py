"""Rows and cones against MuJoCo's own, and the solver against a general minimiser in float64."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.optimize import minimize

from envs.physics.mjx.backend import LINE_SEARCH_ITERATIONS, SOLVER_ITERATIONS
from envs.physics.mjx.solver import Cones, RowGeometry, Rows, make_cones, make_rows, solve

BALL = """
<mujoco><option timestep="0.0025" cone="elliptic"/>
  <default><geom solref="{solref}" solimp="{solimp}" friction=".7 .05 0"/></default>
  <worldbody>
    <geom type="plane" size="1 1 .1" margin=".002"/>
    <body pos="0 0 {height}"><freejoint/>
      <geom type="sphere" size=".05" mass=".3" condim="4"/></body>
    <body pos="0 0 2"><joint type="slide" range="{depth} 1" limited="true" solreflimit="{solref}"
      solimplimit="{solimp}"/><geom type="sphere" size=".05" mass=".4"/></body>
  </worldbody></mujoco>"""


@pytest.mark.parametrize("depth", [-0.001, 0.0, 0.0002, 0.0007, 0.002, 0.01])
@pytest.mark.parametrize(
    ("solref", "solimp"),
    [
        ((0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0)),
        ((0.01, 1.0), (0.99, 0.99, 0.01, 0.5, 2.0)),
        ((0.003, 0.7), (0.8, 0.97, 0.004, 0.3, 2.0)),  # time constant below two timesteps
    ],
)
def test_rows_and_cones_equal_mujocos(depth, solref, solimp):
    """A ball pressed into the ground, and a slide past its limit by as much."""
    text = lambda values: " ".join(map(str, values))
    xml = BALL.format(solref=text(solref), solimp=text(solimp), height=0.05 - depth, depth=depth)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qvel[:] = 0.1, -0.2, -0.3, 0.5, 0.6, 0.7, -0.4
    mujoco.mj_forward(model, data)
    jacobian = data.efc_J.reshape(-1, model.nv)
    limited = data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT
    common = {"qvel": data.qvel, "timestep": model.opt.timestep}
    contact = data.contact[0]
    cones = make_cones(
        jacobian=jacobian[None, ~limited],
        friction=contact.friction[None, [0, 2]],
        pos=np.array([contact.dist - 0.002]),
        invweight=model.body_invweight0[[1], 0],
        solref=np.array([solref]),
        solimp=np.array([solimp]),
        active=np.ones(1),
        **common,
    )
    scale = contact.friction[[0, 0, 0, 2]]  # mu, f1, f2, f3
    np.testing.assert_allclose(cones.mu, contact.mu, rtol=1e-6)
    np.testing.assert_allclose(cones.weight * scale**2, data.efc_D[~limited], rtol=2e-5)
    aref = scale * data.efc_aref[~limited]
    np.testing.assert_allclose(cones.reference[0], aref, rtol=2e-5, atol=1e-4)
    assert limited.sum() == (depth > 0)
    pos = data.qpos[[7]] - depth
    geometry: Any = (
        jacobian[limited],
        pos,
        pos,
        model.dof_invweight0[[6]],
        np.array([solref]),
        np.array([solimp]),
        np.ones(1),
    )
    rows = make_rows(RowGeometry(*geometry), **common)
    if depth > 0:
        np.testing.assert_allclose(rows.weight, data.efc_D[limited], rtol=2e-5)
        np.testing.assert_allclose(rows.reference, data.efc_aref[limited], rtol=2e-5, atol=1e-4)


def problem(seed: int, rows: int = 18, contacts: int = 8, equalities: int = 6):
    """A random convex problem of ten joints: rows and contacts of mixed stiffness, some off."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((10, 10))
    mass = root @ root.T / 10 + 0.3 * np.eye(10)
    force = 5 * rng.standard_normal(10)
    weight = lambda count: 10 ** rng.uniform(-1, 2, count) * (rng.random(count) < 0.8)
    of_rows: Any = (
        rng.standard_normal((rows, 10)),
        weight(rows),
        10 * rng.standard_normal(rows),
    )
    friction = rng.uniform(0.3, 1.2, (contacts, 2)) * (1.0, 0.1)
    friction[::2, 1] = 0.0  # no torsional friction
    scale = friction[:, [0, 0, 0, 1]]
    of_cones: Any = (
        scale[..., None] * rng.standard_normal((contacts, 4, 10)),
        weight(contacts),
        scale * 10 * rng.standard_normal((contacts, 4)),
        friction[:, 0],
    )
    return mass, force, Rows(*of_rows), Cones(*of_cones), equalities


def cost(a, mass, force, rows, cones, equalities):
    """MuJoCo's primal objective, up to a constant: float64 numpy, one contact after another.

    Zones and weights of its documentation ("Computation", elliptic cones): top, bottom, middle.
    """
    x = rows.jacobian @ a - rows.reference
    pays = (np.arange(len(x)) < equalities) | (x < 0)
    total = 0.5 * a @ mass @ a - force @ a + 0.5 * (rows.weight * pays * x * x).sum()
    for jacobian, weight, reference, mu in zip(*cones, strict=True):
        u = jacobian @ a - reference
        normal, slip = u[0], np.linalg.norm(u[1:])
        if normal >= mu * slip:
            continue
        if mu * normal + slip <= 0:
            total += 0.5 * weight * (u @ u)
        else:
            total += 0.5 * weight / (1 + mu * mu) * (normal - mu * slip) ** 2
    return total


@pytest.fixture(scope="module")
def solver():
    return jax.jit(solve, static_argnums=(6, 7, 8))


def single(tree):
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)


@pytest.mark.parametrize("seed", range(8))
def test_solution_is_the_minimum(solver, seed):
    mass, force, rows, cones, equalities = problem(seed)
    smooth = np.linalg.solve(mass, force)
    args = (mass, force, rows, cones, equalities)
    best = minimize(cost, smooth, args, method="BFGS", options={"gtol": 1e-7}).x
    arrays = single((mass, force, smooth, 0 * smooth))
    constraints = (*single((rows, cones)), equalities)
    a, constraint_force = solver(*arrays, *constraints, 12, 12)
    np.testing.assert_allclose(a, best, atol=2e-3)
    np.testing.assert_allclose(constraint_force, mass @ best - force, atol=2e-2)
    # The budget in use starts, within an episode, from the last solution: nothing is left to do.
    budget = (SOLVER_ITERATIONS, LINE_SEARCH_ITERATIONS)
    again, _ = solver(*arrays[:3], a, *constraints, *budget)
    assert cost(np.float64(again), *args) <= cost(np.float64(a), *args) + 1e-3


def test_what_is_off_or_holds_does_nothing(solver):
    mass, force, rows, cones, _ = problem(0)
    smooth = np.linalg.solve(mass, force)
    met, met_cones = rows.jacobian @ smooth - 1.0, cones.jacobian @ smooth
    met_cones[:, 0] -= 20 * np.linalg.norm(cones.jacobian, axis=-1).max()  # far above the ground
    ones, contacts = np.ones_like(met), np.ones_like(cones.mu)

    def answer(row_weight, row_reference, cone_weight, cone_reference):
        constraints = single(
            (
                Rows(rows.jacobian, row_weight, row_reference),
                Cones(cones.jacobian, cone_weight, cone_reference, cones.mu),
            )
        )
        return solver(*single((mass, force, smooth, smooth)), *constraints, 0, 4, 6)

    for harmless in (
        (ones, met, contacts, met_cones),
        (0 * ones, met + 50, 0 * contacts, met_cones + 50),
    ):
        a, constraint_force = answer(*harmless)
        np.testing.assert_allclose(a, smooth, atol=1e-4)
        np.testing.assert_array_equal(constraint_force, np.zeros(10))
    for pulled in ((ones, met + 2, contacts, met_cones), (ones, met, contacts, met_cones + 50)):
        assert np.abs(answer(*pulled)[0] - smooth).max() > 0.1
