"""Constraint rows against MuJoCo's own, and the solver against a general minimiser in float64."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.optimize import minimize

from envs.mjx_physics import LINE_SEARCH_ITERATIONS, SOLVER_ITERATIONS
from envs.solver import Rows, make_rows, solve

BALL = """
<mujoco><option timestep="0.0025" cone="pyramidal"/>
  <worldbody>
    <geom type="plane" size="1 1 .1" solref="{solref}" solimp="{solimp}" margin=".002"/>
    <body pos="0 0 {height}"><freejoint/>
      <geom type="sphere" size=".05" mass=".3" solref="{solref}" solimp="{solimp}"/></body>
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
def test_rows_equal_mujocos(depth, solref, solimp):
    text = lambda values: " ".join(map(str, values))
    xml = BALL.format(solref=text(solref), solimp=text(solimp), height=0.05 - depth)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qvel[:3] = 0.1, -0.2, -0.3
    mujoco.mj_forward(model, data)
    assert data.nefc == 4
    friction = data.contact.friction[0, 0]
    pos = np.full(4, data.contact.dist[0] - 0.002)
    invweight = model.body_invweight0[1, 0] * (1 + friction**2) * 2 * friction**2
    rows = make_rows(
        jacobian=data.efc_J.reshape(4, -1),
        pos=pos,
        impedance_pos=pos,
        invweight=np.full(4, invweight),
        solref=np.tile(solref, (4, 1)),
        solimp=np.tile(solimp, (4, 1)),
        qvel=data.qvel,
        timestep=model.opt.timestep,
        active=np.ones(4),
    )
    np.testing.assert_allclose(rows.weight, data.efc_D, rtol=2e-5)
    np.testing.assert_allclose(rows.reference, data.efc_aref, rtol=2e-5, atol=1e-4)


def problem(seed: int, rows: int = 40, equalities: int = 6):
    """A random convex problem of ten joints with rows of mixed stiffness, some switched off."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((10, 10))
    mass = root @ root.T / 10 + 0.3 * np.eye(10)
    force = 5 * rng.standard_normal(10)
    weight = 10 ** rng.uniform(-1, 2, rows) * (rng.random(rows) < 0.8)
    jacobian, reference = rng.standard_normal((rows, 10)), 10 * rng.standard_normal(rows)
    rows_of_it: Any = (jacobian, weight, reference)
    return mass, force, Rows(*rows_of_it), equalities


def cost(a, mass, force, rows, equalities):
    """MuJoCo's primal objective, up to a constant, by its definition: float64 numpy."""
    x = rows.jacobian @ a - rows.reference
    pays = (np.arange(len(x)) < equalities) | (x < 0)
    return 0.5 * a @ mass @ a - force @ a + 0.5 * (rows.weight * pays * x * x).sum()


@pytest.fixture(scope="module")
def solver():
    return jax.jit(solve, static_argnums=(5, 6, 7))


@pytest.mark.parametrize("seed", range(8))
def test_solution_is_the_minimum(solver, seed):
    mass, force, rows, equalities = problem(seed)
    smooth = np.linalg.solve(mass, force)
    args = (mass, force, rows, equalities)
    best = minimize(cost, smooth, args, method="BFGS", options={"gtol": 1e-9}).x
    arrays = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (mass, force, smooth, 0 * smooth))
    single = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), rows)
    a, constraint_force = solver(*arrays, single, equalities, 12, 12)
    np.testing.assert_allclose(a, best, atol=2e-3)
    np.testing.assert_allclose(constraint_force, mass @ best - force, atol=2e-2)
    # The budget in use starts, within an episode, from the last solution: nothing is left to do.
    again, _ = solver(*arrays[:3], a, single, equalities, SOLVER_ITERATIONS, LINE_SEARCH_ITERATIONS)
    assert cost(np.float64(again), *args) <= cost(np.float64(a), *args) + 1e-3


def test_rows_switched_off_and_inequalities_that_hold_do_nothing(solver):
    mass, force, rows, _ = problem(0)
    smooth = jnp.asarray(np.linalg.solve(mass, force), jnp.float32)
    mass, force = jnp.asarray(mass, jnp.float32), jnp.asarray(force, jnp.float32)
    met = jnp.asarray(rows.jacobian, jnp.float32) @ smooth - 1.0
    ones = jnp.ones_like(met)
    jacobian = jnp.asarray(rows.jacobian, jnp.float32)
    for harmless in (Rows(jacobian, ones, met), Rows(jacobian, 0 * ones, met + 50)):
        a, constraint_force = solver(mass, force, smooth, smooth, harmless, 0, 4, 6)
        np.testing.assert_allclose(a, smooth, atol=1e-4)
        np.testing.assert_array_equal(constraint_force, np.zeros(10))
    pulled, _ = solver(mass, force, smooth, smooth, Rows(jacobian, ones, met + 2), 0, 4, 6)
    assert np.abs(pulled - smooth).max() > 0.1
