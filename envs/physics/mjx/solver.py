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

from envs.physics.mjx import rotations

MIN_VALUE = 1e-15  # mjMINVAL
MIN_IMPEDANCE, MAX_IMPEDANCE = 1e-4, 0.9999  # mjMINIMP, mjMAXIMP
_SMALLEST_SLIP = 1e-10  # keeps the direction of friction finite where nothing slips


class Rows(NamedTuple):
    """Equalities and joint limits of one lane, a scalar each."""

    jacobian: jax.Array  # (row, joint)
    weight: jax.Array  # (row,) inverse of the regulariser, MuJoCo's efc_D; 0 switches a row off
    reference: jax.Array  # (row,) reference acceleration, MuJoCo's efc_aref


class RowGeometry(NamedTuple):
    """What rows are made of; `pos` drives the reference, `impedance_pos` the impedance."""

    jacobian: jax.Array  # (row, joint)
    pos: jax.Array  # (row,)
    impedance_pos: jax.Array  # (row,)
    invweight: jax.Array  # (row,)
    solref: jax.Array  # (row, 2)
    solimp: jax.Array  # (row, 5)
    active: jax.Array  # (row,) 1.0 where it is


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


def make_rows(geometry: RowGeometry, qvel: jax.Array, timestep: float) -> Rows:
    """Rows from their geometry, at a joint velocity (joint,)."""
    jacobian, pos, impedance_pos, invweight, solref, solimp, active = geometry
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
    size = jnp.sqrt(rotations.dot(tangent, tangent) + _SMALLEST_SLIP**2)
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


def _cone_derivatives(
    u: jax.Array, cones: Cones, slip: _Slip
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Rows R (6 contact, joint), w and p (6 contact,): the contacts' cost has the derivatives R' p
    and R' diag(w) R by the joint acceleration.
    """
    # Where a contact slides, friction keeps its size and only turns: the slack's own curvature.
    turning = -slip.slides * slip.slack * slip.bend  # (contact,) >= 0
    along = slip.across[:, 1:] / cones.mu[:, None]  # unit vectors, (contact, 3)
    frame = [cones.jacobian[:, i] for i in range(4)]
    slack_rows = sum(slip.across[:, i, None] * frame[i] for i in range(4))
    along_rows = sum(along[:, i, None] * frame[1 + i] for i in range(3))
    tangent = slip.sticks + turning
    weight = [slip.sticks, tangent, tangent, tangent, slip.slides, -turning]
    pull = [*(slip.sticks * u[:, i] for i in range(4)), slip.slides * slip.slack]
    return (
        jnp.concatenate([*frame, slack_rows, along_rows]),
        jnp.concatenate(weight),
        jnp.concatenate([*pull, jnp.zeros_like(turning)]),
    )


class _Cost:
    """The cost of one lane over the joint acceleration a, see `solve`."""

    def __init__(self, mass, force, smooth_acceleration, rows, cones, equalities):
        self.mass, self.smooth_acceleration = mass, smooth_acceleration
        self.rows, self.cones = rows, cones
        self.count, self.joints = rows.jacobian.shape
        self.always = jnp.arange(self.count) < equalities
        # All that is linear in a, in one product: rows, contacts, the smooth part.
        self.jacobian = jnp.concatenate([rows.jacobian, cones.jacobian.reshape(-1, self.joints)])
        self.linear = jnp.concatenate([self.jacobian, mass])
        self.offset = jnp.concatenate([rows.reference, cones.reference.reshape(-1), force])

    def parts(self, y):
        """Of rows (row,), contacts (contact, 4) and joints (joint,) in a product with `linear`."""
        return y[: self.count], y[self.count : -self.joints].reshape(-1, 4), y[-self.joints :]

    def residuals(self, a):
        return self.parts(self.linear @ a - self.offset)

    def row_weight(self, x):
        return self.rows.weight * (self.always | (x < 0))

    def value(self, a):
        x, u, smooth = self.residuals(a)
        slip = _slip(u, self.cones)
        contacts = slip.sticks * rotations.dot(u, u) + slip.slides * slip.slack**2
        constraints = _total(self.row_weight(x) * x * x, contacts)
        return 0.5 * (smooth @ (a - self.smooth_acceleration) + constraints)

    def constraint_force(self, a):
        x, u, _ = self.residuals(a)
        by_cone = _cone_gradient(u, _slip(u, self.cones))
        return -jnp.concatenate([self.row_weight(x) * x, by_cone.reshape(-1)]) @ self.jacobian

    def newton_step(self, x, u, smooth):
        """The step that minimises the quadratic with the cost's derivatives at these residuals."""
        weight = self.row_weight(x)
        cone_rows, cone_weight, cone_pull = _cone_derivatives(u, self.cones, _slip(u, self.cones))
        rows = jnp.concatenate([self.rows.jacobian, cone_rows])
        weights = jnp.concatenate([weight, cone_weight])
        pull = jnp.concatenate([weight * x, cone_pull])
        # Hessian and gradient as one product.
        both = rows.T @ jnp.concatenate([weights[:, None] * rows, pull[:, None]], 1)
        return -solve_positive(self.mass + both[:, :-1], smooth + both[:, -1])

    def along(self, x, u, smooth, direction):
        """A function of a number: the cost's first two derivatives that far along a direction."""
        x_change, u_change, smooth_change = self.parts(self.linear @ direction)
        slope, curvature = smooth @ direction, smooth_change @ direction  # of the smooth part
        tangent_squared = rotations.dot(u_change[:, 1:], u_change[:, 1:])
        u_squared = u_change[:, 0] ** 2 + tangent_squared

        def derivatives(step):
            x_at, u_at = x + step * x_change, u + step * u_change
            slip = _slip(u_at, self.cones)
            weight = self.row_weight(x_at) * x_change
            slack_change = rotations.dot(slip.across, u_change)
            along_change = (slack_change - u_change[:, 0]) / self.cones.mu
            turned = slip.slack * slip.bend * (tangent_squared - along_change**2)
            first = _total(weight * x_at, rotations.dot(_cone_gradient(u_at, slip), u_change))
            bent = slip.sticks * u_squared + slip.slides * (slack_change**2 - turned)
            second = _total(weight * x_change, bent)
            return slope + step * curvature + first, curvature + second

        return derivatives


def _total(by_row: jax.Array, by_contact: jax.Array) -> jax.Array:
    """The sum of both; rows are dealt out to contacts first, so that it is a single reduction."""
    contacts = len(by_contact)
    dealt = jnp.pad(by_row, (0, -len(by_row) % contacts)).reshape(-1, contacts)
    return jnp.sum(sum(dealt, start=by_contact))


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
    cost = _Cost(mass, force, smooth_acceleration, rows, cones, equalities)

    def newton(a, _):
        residuals = cost.residuals(a)
        direction = cost.newton_step(*residuals)
        step = line_search(cost.along(*residuals, direction), line_search_iterations)
        return a + step * direction, None

    is_warm_better = cost.value(warm_start) < cost.value(smooth_acceleration)
    start = jnp.where(is_warm_better, warm_start, smooth_acceleration)
    a, _ = jax.lax.scan(newton, start, None, length=iterations)
    return a, cost.constraint_force(a)


def solve_positive(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Solution (n,) of a small symmetric positive definite system (n, n), by Cholesky factors."""
    # On a GPU a library call for ten by ten matrices costs more than their arithmetic; on a CPU
    # it costs as much, and compiles in less time.
    return jax.lax.platform_dependent(matrix, vector, cpu=_by_library, default=_in_numbers)


def _by_library(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix), vector)


def _in_numbers(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """The same written out number by number, which XLA makes two kernels of."""
    n = len(vector)
    factor: list[list[jax.Array]] = []
    inverse: list[jax.Array] = []  # of the diagonal
    half: list[jax.Array] = []  # L half = vector
    for i in range(n):
        row: list[jax.Array] = []
        for j in range(i):
            rest = sum((row[k] * factor[j][k] for k in range(j)), start=jnp.zeros(()))
            row.append((matrix[i, j] - rest) * inverse[j])
        pivot = matrix[i, i] - sum((x * x for x in row), start=jnp.zeros(()))
        inverse.append(jax.lax.rsqrt(pivot))
        rest = sum((row[k] * half[k] for k in range(i)), start=jnp.zeros(()))
        half.append((vector[i] - rest) * inverse[i])
        factor.append(row)
    solution: list[jax.Array] = [jnp.zeros(())] * n
    for i in reversed(range(n)):
        rest = sum((factor[k][i] * solution[k] for k in range(i + 1, n)), start=jnp.zeros(()))
        solution[i] = (half[i] - rest) * inverse[i]
    return jnp.stack(solution)


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
    search = lambda unroll: lambda: jax.lax.scan(iterate, start, None, iterations, unroll=unroll)
    # A loop starts more kernels on a GPU, and compiles in less time where nothing is started.
    (step, _, _), _ = jax.lax.platform_dependent(cpu=search(False), default=search(True))
    return step
