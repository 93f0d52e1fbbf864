"""MuJoCo's soft constraints for one lane, and the primal Newton solver that resolves them.

The constraint model is MuJoCo's (documentation, "Computation": reference acceleration, impedance,
pyramidal friction cone). A cost of active quadratic rows is minimised over the joint acceleration
by a fixed number of Newton steps with an exact line search; a fixed budget keeps lanes in step
under vmap. Ten joints: seven arm hinges, two fingers, the fixture's slide.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

MIN_VALUE = 1e-15  # mjMINVAL
MIN_IMPEDANCE, MAX_IMPEDANCE = 1e-4, 0.9999  # mjMINIMP, mjMAXIMP


class Rows(NamedTuple):
    """Constraint rows of one lane."""

    jacobian: jax.Array  # (row, joint)
    weight: jax.Array  # (row,) inverse of the regulariser, MuJoCo's efc_D; 0 switches a row off
    reference: jax.Array  # (row,) reference acceleration, MuJoCo's efc_aref


def stiffness_damping_impedance(solref, solimp, pos, timestep):
    """Stiffness k, damping b, impedance d(pos) of rows; solref (..., 2), solimp (..., 5)."""
    timeconst = jnp.maximum(solref[..., 0], 2 * timestep)
    dampratio = solref[..., 1]
    low, high, width, mid, power = (solimp[..., i] for i in range(5))
    stiffness = 1 / (high * high * timeconst * timeconst * dampratio * dampratio)
    damping = 2 / (high * timeconst)
    x = jnp.minimum(jnp.abs(pos) / jnp.maximum(width, MIN_VALUE), 1.0)
    # Every geom, joint and weld of the scenes has power 2.
    below = x * x / mid
    above = 1 - (1 - x) * (1 - x) / (1 - mid)
    impedance = low + jnp.where(x < mid, below, above) * (high - low)
    return stiffness, damping, jnp.clip(impedance, MIN_IMPEDANCE, MAX_IMPEDANCE)


def make_rows(jacobian, pos, impedance_pos, invweight, solref, solimp, qvel, timestep, active):
    """Rows from their geometry: `pos` drives the reference, `impedance_pos` the impedance."""
    k, b, d = stiffness_damping_impedance(solref, solimp, impedance_pos, timestep)
    regulariser = jnp.maximum(invweight * (1 - d) / d, MIN_VALUE)
    return Rows(
        jacobian=jacobian,
        weight=active / regulariser,
        reference=-b * (jacobian @ qvel) - k * d * pos,
    )


def solve(
    mass: jax.Array,
    force: jax.Array,
    smooth_acceleration: jax.Array,
    warm_start: jax.Array,
    rows: Rows,
    equalities: int,
    iterations: int,
    line_search_iterations: int,
) -> tuple[jax.Array, jax.Array]:
    """Joint acceleration (joint,) and constraint force (joint,) of one lane.

    Minimises 1/2 (a - a0)' M (a - a0) + 1/2 sum_i D_i [J_i a - aref_i]^2 over active rows; the
    first `equalities` rows are always active, the others where J_i a < aref_i.
    """
    always = jnp.arange(rows.weight.shape[0]) < equalities

    def residual(a):
        return rows.jacobian @ a - rows.reference

    def active_weight(x):
        return rows.weight * (always | (x < 0))

    def cost(a):
        x = residual(a)
        return 0.5 * (mass @ a - force) @ (a - smooth_acceleration) + 0.5 * jnp.sum(
            active_weight(x) * x * x
        )

    start = jnp.where(cost(warm_start) < cost(smooth_acceleration), warm_start, smooth_acceleration)

    def newton(a, _):
        x = residual(a)
        weight = active_weight(x)
        gradient = mass @ a - force + rows.jacobian.T @ (weight * x)
        hessian = mass + (rows.jacobian.T * weight) @ rows.jacobian
        factor = jax.scipy.linalg.cho_factor(hessian)
        search = -jax.scipy.linalg.cho_solve(factor, gradient)
        step = line_search(
            x,
            rows.jacobian @ search,
            gradient,
            mass @ search,
            search,
            weight,
            rows,
            always,
            line_search_iterations,
        )
        return a + step * search, None

    a, _ = jax.lax.scan(newton, start, None, length=iterations)
    x = residual(a)
    return a, -rows.jacobian.T @ (active_weight(x) * x)


def line_search(x, jv, gradient, mass_search, search, weight, rows, always, iterations):
    """Minimiser of the convex, piecewise quadratic cost along `search`: bracketed Newton steps."""
    curvature_smooth = search @ mass_search
    # Slope of the smooth part at 0: gradient less the active rows' share.
    slope_smooth = gradient @ search - jnp.sum(weight * x * jv)

    def derivatives(step):
        at = x + step * jv
        w = rows.weight * (always | (at < 0)) * jv
        return slope_smooth + step * curvature_smooth + jnp.sum(w * at), (
            curvature_smooth + jnp.sum(w * jv)
        )

    def iterate(carry, _):
        step, low, high = carry
        slope, curvature = derivatives(step)
        low = jnp.where(slope < 0, step, low)
        high = jnp.where(slope < 0, high, step)
        newton = step - slope / jnp.maximum(curvature, MIN_VALUE)
        bisect = jnp.where(jnp.isinf(high), 2 * step + 1, 0.5 * (low + high))
        inside = (newton > low) & (newton < high)
        return (jnp.where(inside, newton, bisect), low, high), None

    start = (jnp.ones(()), jnp.zeros(()), jnp.full((), jnp.inf))
    (step, _, _), _ = jax.lax.scan(iterate, start, None, length=iterations)
    return step
