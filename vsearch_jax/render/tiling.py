"""An image cut into equal parts that are drawn one after another."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array


class Tiling(NamedTuple):
    """N parts of h x w pixels that cover an image, row by row; those at its right and lower edge may reach beyond.

    Attributes:
      size: height H and width W of the image.
      part: h and w, at most H and W.
    """

    size: tuple[int, int]
    part: tuple[int, int]

    @property
    def rows(self) -> int:
        """The number of parts below one another."""
        return -(-self.size[0] // self.part[0])

    @property
    def columns(self) -> int:
        """The number of parts beside one another."""
        return -(-self.size[1] // self.part[1])

    def _pad(self, plane: Array, axes: tuple[int, ...]) -> Array:
        beyond = (self.rows * self.part[0] - self.size[0], self.columns * self.part[1] - self.size[1])
        return jnp.pad(plane, [(0, beyond[axis] if axis in axes else 0) for axis in (0, 1)], mode="edge")

    def split_axes(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Returns f32[N, 1, w] and f32[N, h, 1] of what depends on the column, f32[1, W], and the row, f32[H, 1]."""
        x = self._pad(x, (1,)).reshape(self.columns, 1, self.part[1])
        y = self._pad(y, (0,)).reshape(self.rows, self.part[0], 1)
        return jnp.tile(x, (self.rows, 1, 1)), jnp.repeat(y, self.columns, axis=0)

    def split(self, plane: Array) -> Array:
        """Returns [N, h, w] of [H, W]."""
        grid = self._pad(plane, (0, 1)).reshape(self.rows, self.part[0], self.columns, self.part[1])
        return grid.transpose(0, 2, 1, 3).reshape(-1, *self.part)

    def join(self, parts: Array) -> Array:
        """Returns [H, W, C] of [N, C, h, w], and [H, W] of [N, h, w]."""
        height, width = self.size
        grid = parts.reshape(self.rows, self.columns, -1, *self.part).transpose(0, 3, 1, 4, 2)
        whole = grid.reshape(self.rows * self.part[0], self.columns * self.part[1], -1)[:height, :width]
        return whole if parts.ndim == 4 else whole[..., 0]
