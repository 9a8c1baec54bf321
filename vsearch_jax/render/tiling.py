"""Splits an image into equal tiles that are rendered one after another."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array


class Tiling(NamedTuple):
    """How an image is split into N tiles of h x w pixels each, numbered row by row.

    Tiles at the right and lower edge may extend beyond the image.

    Attributes:
      size: height H and width W of the image in pixels.
      tile: height h and width w of a tile in pixels, at most H and W.
    """

    size: tuple[int, int]
    tile: tuple[int, int]

    @property
    def num_rows(self) -> int:
        """Number of rows of tiles that cover the image."""
        return -(-self.size[0] // self.tile[0])

    @property
    def num_columns(self) -> int:
        """Number of columns of tiles that cover the image."""
        return -(-self.size[1] // self.tile[1])

    def _pad(self, plane: Array, axes: tuple[int, ...]) -> Array:
        """Repeats the last row and column up to the edge of the tiles, along `axes` only."""
        excess = (self.num_rows * self.tile[0] - self.size[0], self.num_columns * self.tile[1] - self.size[1])
        return jnp.pad(plane, [(0, excess[axis] if axis in axes else 0) for axis in (0, 1)], mode="edge")

    def split_axes(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Splits per-column and per-row values of an H x W image into the values of the N tiles of h x w pixels.

        Args:
          x: f32[1, W], one value for each column of the image.
          y: f32[H, 1], one value for each row of the image.

        Returns:
          Values of the columns of each tile, f32[N, 1, w], and of the rows of each tile, f32[N, h, 1].
        """
        x = self._pad(x, (1,)).reshape(self.num_columns, 1, self.tile[1])
        y = self._pad(y, (0,)).reshape(self.num_rows, self.tile[0], 1)
        return jnp.tile(x, (self.num_rows, 1, 1)), jnp.repeat(y, self.num_columns, axis=0)

    def split(self, plane: Array) -> Array:
        """Splits an image [H, W] into N tiles [N, h, w]. Where a tile extends beyond the image, edge pixels repeat."""
        grid = self._pad(plane, (0, 1)).reshape(self.num_rows, self.tile[0], self.num_columns, self.tile[1])
        return grid.transpose(0, 2, 1, 3).reshape(-1, *self.tile)

    def join(self, tiles: Array) -> Array:
        """Joins N tiles to an image: [N, C, h, w] to [H, W, C] for C channels, or [N, h, w] to [H, W]."""
        height, width = self.size
        grid = tiles.reshape(self.num_rows, self.num_columns, -1, *self.tile).transpose(0, 3, 1, 4, 2)
        joined = grid.reshape(self.num_rows * self.tile[0], self.num_columns * self.tile[1], -1)[:height, :width]
        return joined if tiles.ndim == 4 else joined[..., 0]
