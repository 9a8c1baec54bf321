"""3-vectors as three arrays, one for each coordinate.

XLA on CPU vectorises over the shape of the coordinate arrays. It does not vectorise over a last axis of length 3.
"""

from __future__ import annotations

from jax import Array

Vector = tuple[Array, Array, Array]
"""x, y and z; arrays of one shape, or of shapes that broadcast."""


def dot(a: Vector, b: Vector) -> Array:
    """Returns the inner product of vectors that are stored by coordinate (Vector: the tuple of the arrays x, y and z).

    Args:
      a: Vector, f32[...] for each coordinate.
      b: Vector, f32[...] for each coordinate.

    Returns:
      f32[...], one inner product for each vector.
    """
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
