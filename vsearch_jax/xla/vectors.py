"""3-vectors as three arrays, one for each coordinate.

XLA on CPU vectorises over the shape of the coordinate arrays. It does not vectorise over a last axis of length 3.
"""

from __future__ import annotations

from jax import Array

Vector = tuple[Array, Array, Array]
"""x, y and z; arrays of one shape, or of shapes that broadcast."""


def dot(a: Vector, b: Vector) -> Array:
    """Returns the inner product of two vectors, an array of the coordinates' shape.

    Args:
      a: x, y and z of the first vector.
      b: x, y and z of the second vector.
    """
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
