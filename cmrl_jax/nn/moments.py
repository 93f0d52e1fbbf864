"""A running mean and variance that stay right however long a run is.

Float32 holds 24 bits. A count in it stands still at 2^24; a growing sum loses its terms; and a mean
that moves by less and less in the end takes in rare large values alone, because the frequent small
ones round to nothing, so it drifts. Here the count has 64 bits, and a mean is a pair, the value and
what rounding has kept out of it so far (Kahan's sum).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct


@struct.dataclass
class Count:
    """A whole number of 64 bits, which jax lacks by default: two halves, each () uint32."""

    hi: jax.Array
    lo: jax.Array

    @classmethod
    def of(cls, number: int) -> Count:
        return cls(*(jnp.asarray(half, jnp.uint32) for half in divmod(number, 2**32)))

    def plus(self, number: int) -> Count:
        """The sum with a number below 2^32."""
        lo = self.lo + jnp.uint32(number)
        return Count(self.hi + (lo < self.lo).astype(jnp.uint32), lo)

    def as_float(self) -> jax.Array:
        """The nearest float32 number."""
        return self.hi.astype(jnp.float32) * 2.0**32 + self.lo.astype(jnp.float32)

    def __int__(self) -> int:
        return int(self.hi) * 2**32 + int(self.lo)


@struct.dataclass
class Mean:
    """`value + rest`, each float32 (...); the rest is below the value's last bit."""

    value: jax.Array
    rest: jax.Array


@struct.dataclass
class Moments:
    """Of all values so far.

    Attributes:
        count: (), how many, the same for all of (...).
        mean: (...).
        variance: (...), mean of the squared deviations.
    """

    count: Count
    mean: Mean
    variance: Mean


def init_moments(shape: tuple[int, ...]) -> Moments:
    """Of no value at all."""
    zero = Mean(jnp.zeros(shape, jnp.float32), jnp.zeros(shape, jnp.float32))
    return Moments(Count.of(0), zero, zero)


def add_values(moments: Moments, number: int, shift: jax.Array, variance: jax.Array) -> Moments:
    """The moments with a batch merged in, by Chan's formula.

    Args:
        number: values in the batch.
        shift: (...) the batch's mean less `moments.mean.value`: a difference of the values
            themselves, so that a small spread around a large mean is not lost.
        variance: (...) of the batch around its own mean.
    """
    count = moments.count.plus(number)
    batches = count.as_float() / number  # of that size
    spread = variance + rounded(jnp.square(shift) * (1.0 - 1.0 / batches))
    return Moments(
        count=count,
        mean=_moved(moments.mean, shift / batches),
        variance=_moved(moments.variance, (spread - moments.variance.value) / batches),
    )


def rounded(products: jax.Array) -> jax.Array:
    """Products that are to be summed, rounded to float32 before, whatever program they stand in.

    A compiler may fuse a product into the sum that follows, and does so in one program and not in
    another: the results would differ in their last bit. A quotient it leaves alone.
    """
    return jax.lax.optimization_barrier(products)


def _moved(mean: Mean, step: jax.Array) -> Mean:
    step = step + mean.rest
    value = mean.value + step
    return Mean(value, step - (value - mean.value))
