"""MuJoCo's soft constraints for one lane, and the primal Newton solver that resolves them.

The constraint model is MuJoCo's (documentation, "Computation": reference acceleration, impedance,
elliptic friction cone). A convex cost is minimised over the joint acceleration by a fixed number of
Newton steps with a bracketed line search; a fixed budget keeps lanes in step under vmap. Ten
joints: seven arm hinges, two fingers, the fixture's slide.

NOTES
1. A contact pays for the part of its residual that its friction cone cannot produce. In
   coordinates scaled by the friction coefficients (normal by mu) that is half the weighted squared
   distance from the cone n >= mu |t|: zero inside it, |u|^2 inside its polar cone (the contact
   sticks), (n - mu |t|)^2 / (1 + mu^2) in between (it slides). MuJoCo's impratio is 1 here.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

MIN_VALUE = 1e-15  # mjMINVAL
MIN_IMPEDANCE, MAX_IMPEDANCE = 1e-4, 0.9999  # mjMINIMP, mjMAXIMP
_SMALLEST_SLIP = 1e-10  # keeps the direction of friction finite where nothing slips


class Rows(NamedTuple):
    """Equalities and joint limits of one lane, a scalar each."""

    jacobian: jax.Array  # (row, joint)
    weight: jax.Array  # (row,) inverse of the regulariser, MuJoCo's efc_D; 0 switches a row off
    reference: jax.Array  # (row,) reference acceleration, MuJoCo's efc_aref


class Cones(NamedTuple):
    """Contacts of one lane: normal, two tangents and spin each, scaled by mu, f1, f2, f3."""

    jacobian: jax.Array  # (contact, 4, joint)
    weight: jax.Array  # (contact,) efc_D of the normal over mu^2; 0 switches a contact off
    reference: jax.Array  # (contact, 4)
    mu: jax.Array  # (contact,) coefficient of sliding friction


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


def make_cones(jacobian, friction, pos, invweight, solref, solimp, qvel, timestep, active):
    """Contacts from their geometry; the normal alone is driven by `pos`.

    Args:
        jacobian: (contact, 4, joint) motion along normal and tangents, and spin about the normal.
        friction: (contact, 2) sliding and torsional coefficients; torsional 0 for none.
        pos: (contact,) distance less margin, negative in contact.
        invweight, active: (contact,).
        solref, solimp: (contact, 2), (contact, 5).
    """
    k, b, d = stiffness_damping_impedance(solref, solimp, pos, timestep)
    mu = friction[:, 0]
    scale = friction[:, jnp.array([0, 0, 0, 1])]  # (contact, 4)
    reference = -b[:, None] * (jacobian @ qvel)
    reference = reference.at[:, 0].add(-k * d * pos)
    regulariser = jnp.maximum(invweight * (1 - d) / d, MIN_VALUE)
    return Cones(
        jacobian=scale[..., None] * jacobian,
        weight=active / (regulariser * mu * mu),
        reference=scale * reference,
        mu=mu,
    )


class _Slip(NamedTuple):
    """Where the residual u (contact, 4) of contacts lies, see NOTE 1."""

    sticks: jax.Array  # (contact,) weight where it lies in the polar cone, else 0
    slides: jax.Array  # (contact,) weight / (1 + mu^2) where it lies between the cones, else 0
    slack: jax.Array  # (contact,) n - mu |t|
    across: jax.Array  # (contact, 4) derivative of the slack: (1, -mu t / |t|)
    bend: jax.Array  # (contact,) second derivative of mu |t| across the direction of t


def _slip(u: jax.Array, cones: Cones) -> _Slip:
    normal, tangent = u[:, 0], u[:, 1:]
    size = jnp.sqrt(jnp.sum(tangent * tangent, -1) + _SMALLEST_SLIP**2)
    slack = normal - cones.mu * size
    is_inside, is_polar = slack >= 0, cones.mu * normal + size <= 0
    ones = jnp.ones_like(normal)[:, None]
    return _Slip(
        sticks=jnp.where(is_polar, cones.weight, 0.0),
        slides=jnp.where(is_inside | is_polar, 0.0, cones.weight / (1 + cones.mu**2)),
        slack=slack,
        across=jnp.concatenate([ones, -cones.mu[:, None] * tangent / size[:, None]], 1),
        bend=cones.mu / size,
    )


def _cone_gradient(u: jax.Array, slip: _Slip) -> jax.Array:
    """Derivative of the contacts' cost by u, (contact, 4)."""
    return slip.sticks[:, None] * u + (slip.slides * slip.slack)[:, None] * slip.across


def _cone_hessian(cones: Cones, slip: _Slip) -> jax.Array:
    """Second derivative of the contacts' cost by the joint acceleration, (joint, joint)."""
    contacts, _, joints = cones.jacobian.shape
    # Where a contact slides, friction keeps its size and only turns: the slack's own curvature.
    turning = -slip.slides * slip.slack * slip.bend  # (contact,) >= 0
    along = slip.across[:, 1:] / cones.mu[:, None]  # unit vectors, (contact, 3)
    tangent = cones.jacobian[:, 1:]
    diagonal = jnp.concatenate(
        [slip.sticks[:, None], jnp.repeat((slip.sticks + turning)[:, None], 3, 1)], 1
    )
    rows = cones.jacobian.reshape(-1, joints)
    hessian = (rows.T * diagonal.reshape(-1)) @ rows
    slack_rows = jnp.einsum("cf,cfj->cj", slip.across, cones.jacobian)
    along_rows = jnp.einsum("cf,cfj->cj", along, tangent)
    hessian += (slack_rows.T * slip.slides) @ slack_rows
    return hessian - (along_rows.T * turning) @ along_rows


def solve(
    mass: jax.Array,
    force: jax.Array,
    smooth_acceleration: jax.Array,
    warm_start: jax.Array,
    rows: Rows,
    cones: Cones,
    equalities: int,
    iterations: int,
    line_search_iterations: int,
) -> tuple[jax.Array, jax.Array]:
    """Joint acceleration (joint,) and constraint force (joint,) of one lane.

    Minimises 1/2 (a - a0)' M (a - a0) + 1/2 sum_i D_i [J_i a - aref_i]^2 + contacts (NOTE 1) over
    the acceleration a; the first `equalities` rows always pay, the others where J_i a < aref_i.
    """
    always = jnp.arange(rows.weight.shape[0]) < equalities

    def residuals(a):
        return rows.jacobian @ a - rows.reference, cones.jacobian @ a - cones.reference

    def active_weight(x):
        return rows.weight * (always | (x < 0))

    def cost(a):
        x, u = residuals(a)
        slip = _slip(u, cones)
        contacts = slip.sticks * jnp.sum(u * u, -1) + slip.slides * slip.slack**2
        smooth = (mass @ a - force) @ (a - smooth_acceleration)
        return 0.5 * (smooth + jnp.sum(active_weight(x) * x * x) + jnp.sum(contacts))

    def constraint_gradient(x, u, slip):
        by_cones = jnp.einsum("cfj,cf->j", cones.jacobian, _cone_gradient(u, slip))
        return rows.jacobian.T @ (active_weight(x) * x) + by_cones

    def newton(a, _):
        x, u = residuals(a)
        slip = _slip(u, cones)
        gradient = mass @ a - force + constraint_gradient(x, u, slip)
        hessian = mass + (rows.jacobian.T * active_weight(x)) @ rows.jacobian
        hessian += _cone_hessian(cones, slip)
        factor = jax.scipy.linalg.cho_factor(hessian)
        search = -jax.scipy.linalg.cho_solve(factor, gradient)
        slope = (mass @ a - force) @ search  # of the smooth part, at a
        curvature = search @ mass @ search
        x_change, u_change = rows.jacobian @ search, cones.jacobian @ search

        def derivatives(step):
            """First and second derivative of the cost at a + step * search."""
            x_at, u_at = x + step * x_change, u + step * u_change
            slip = _slip(u_at, cones)
            weight = active_weight(x_at) * x_change
            first = jnp.sum(weight * x_at) + jnp.sum(_cone_gradient(u_at, slip) * u_change)
            slack_change = jnp.sum(slip.across * u_change, -1)
            tangent_change = jnp.sum(u_change[:, 1:] ** 2, -1)
            along_change = (slack_change - u_change[:, 0]) / cones.mu
            turned = slip.slack * slip.bend * (tangent_change - along_change**2)
            second = jnp.sum(weight * x_change) + jnp.sum(
                slip.sticks * jnp.sum(u_change**2, -1) + slip.slides * (slack_change**2 - turned)
            )
            return slope + step * curvature + first, curvature + second

        return a + line_search(derivatives, line_search_iterations) * search, None

    start = jnp.where(cost(warm_start) < cost(smooth_acceleration), warm_start, smooth_acceleration)
    a, _ = jax.lax.scan(newton, start, None, length=iterations)
    x, u = residuals(a)
    return a, -constraint_gradient(x, u, _slip(u, cones))


def line_search(derivatives, iterations: int) -> jax.Array:
    """Minimiser () of a convex function of one number >= 0, by bracketed Newton steps from 1.

    Args:
        derivatives: number -> first and second derivative there.
    """

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
