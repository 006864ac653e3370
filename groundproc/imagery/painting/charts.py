"""A surface of heights as triangles with a texture: level parts as the map shows them, walls each on a patch of its own.

Seen from above a wall has no width, and nothing of it would be in a texture that lies on the map. So squares of four neighbouring heights
that differ much get a patch as large as they are; all patches of a tile stand in one picture beside each other.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.imagery.painting.surface import Surface

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

TEXTURE_PX: Final = 2048
"""Side of the texture of a tile."""
STEEP: Final = 1.2
"""Heights that differ by more than so many cells belong to a wall."""
_ATLAS_PX: Final = 2048
"""Width of a picture of patches."""
_TALLEST_PX: Final = 8192
_MOST_SIDE_PX: Final = 1024
"""Of a patch; of a larger wall texels are larger."""


@dataclass(frozen=True, slots=True)
class Chart:
    """Triangles that share a texture, and its texels.

    Attributes
    ----------
    vertex_m : ndarray, shape (v, 3)
        Easting, northing, height.
    uv : ndarray of float32, shape (v, 2)
        Place in the texture: right and down, 0 to 1.
    triangle : ndarray of int64, shape (t, 3)
        Anticlockwise from outside.
    size_px : tuple of int
        Width and height of the texture.
    texel : ndarray of int64, shape (k, 2)
        Column and row of those texels that a triangle shows.
    place_m : ndarray, shape (k, 3)
        Where these are.
    normal : ndarray, shape (k, 3)
    steep : bool
    """

    vertex_m: Array
    uv: npt.NDArray[np.float32]
    triangle: Ints
    size_px: tuple[int, int]
    texel: Ints
    place_m: Array
    normal: Array
    steep: bool


def charts(surface: Surface, texel_m: float) -> Iterator[Chart]:
    """All charts of a surface, tile by tile."""
    cells = max(4, int(TEXTURE_PX * texel_m / surface.grid.cell_m))
    rows, columns = surface.height_m.shape
    for top in range(0, max(rows - 1, 0), cells):
        for left in range(0, max(columns - 1, 0), cells):
            height = surface.height_m[top : top + cells + 1, left : left + cells + 1].astype(np.float64)
            corners = np.stack([height[:-1, :-1], height[:-1, 1:], height[1:, :-1], height[1:, 1:]])
            there = np.isfinite(corners).all(axis=0)
            with np.errstate(invalid="ignore"):
                steep = there & (corners.max(axis=0) - corners.min(axis=0) > STEEP * surface.grid.cell_m)
            tile = _Tile(surface, top, left, height)
            if (there & ~steep).any():
                yield _level(tile, there & ~steep, texel_m)
            if steep.any():
                yield _walls(tile, steep, texel_m)


@dataclass(frozen=True, slots=True)
class _Tile:
    """Heights of a part of a surface; its first row and column."""

    surface: Surface
    top: int
    left: int
    height_m: Array

    def place(self, row: npt.NDArray[Any], column: npt.NDArray[Any]) -> tuple[Array, Array]:
        """Easting and northing of the middle of cells."""
        grid = self.surface.grid
        east = grid.west_m + (self.left + column + 0.5) * grid.cell_m
        return east, grid.north_m - (self.top + row + 0.5) * grid.cell_m


def _level(tile: _Tile, chosen: npt.NDArray[np.bool_], texel_m: float) -> Chart:
    """Squares that lie flat enough, with a texture as the map has it."""
    rows, columns = np.array(tile.height_m.shape) - 1
    cell = tile.surface.grid.cell_m
    size = max(1, round(columns * cell / texel_m)), max(1, round(rows * cell / texel_m))
    row, column = np.nonzero(chosen)
    vertices, corner = np.unique(
        np.concatenate([(row + i) * (columns + 1) + column + j for i, j in _CORNERS]), return_inverse=True
    )
    of_row, of_column = np.divmod(vertices, columns + 1)
    east, north = tile.place(of_row, of_column)
    uv = np.stack([of_column / columns, of_row / rows], axis=1).astype(np.float32)
    down, right = np.mgrid[: size[1], : size[0]].reshape(2, -1)
    x, y = (right + 0.5) * (columns / size[0]), (down + 0.5) * (rows / size[1])
    at_row, at_column = np.minimum(y.astype(np.int64), rows - 1), np.minimum(x.astype(np.int64), columns - 1)
    shown = chosen[at_row, at_column]
    height, normal = _on_triangles(tile, at_row[shown], at_column[shown], y[shown], x[shown])
    e, n = tile.place(y[shown], x[shown])
    return Chart(
        np.stack([east, north, tile.height_m[of_row, of_column]], axis=1), uv, _triangles(corner.reshape(4, -1)), size,
        np.stack([right[shown], down[shown]], axis=1), np.stack([e, n, height], axis=1), normal, False,
    )  # fmt: skip


_CORNERS: Final = ((0, 0), (0, 1), (1, 0), (1, 1))
"""Row and column: north-west, north-east, south-west, south-east."""


def _triangles(corner: Ints) -> Ints:
    """Two triangles for each square with corners, shape (4, n): parted from north-west to south-east."""
    nw, ne, sw, se = corner
    return np.concatenate([np.stack([nw, sw, se], axis=1), np.stack([nw, se, ne], axis=1)]).astype(np.int64)


def _on_triangles(tile: _Tile, row: Ints, column: Ints, y: Array, x: Array) -> tuple[Array, Array]:
    """Heights of places in squares as their triangles have them, and the normals of these."""
    nw, ne, sw, se = (tile.height_m[row + i, column + j] for i, j in _CORNERS)
    fy, fx = y - row, x - column
    lower = fx <= fy
    east = np.where(lower, se - sw, ne - nw)
    south = np.where(lower, sw - nw, se - ne)
    cell = tile.surface.grid.cell_m
    normal = np.stack([-east / cell, south / cell, np.ones_like(east)], axis=1)
    return nw + fx * east + fy * south, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _walls(tile: _Tile, chosen: npt.NDArray[np.bool_], texel_m: float) -> Chart:
    """Squares of walls, each on a patch."""
    row, column = np.nonzero(chosen)
    corner = np.stack([_corner(tile, row + i, column + j) for i, j in _CORNERS])
    while True:
        size = _sizes(corner, texel_m)
        origin, tall = _packed(size + 2)
        if tall <= _TALLEST_PX or texel_m > 1e3:
            break
        texel_m *= 1.3
    whole = (_ATLAS_PX, max(tall, 1))
    uv = np.stack([origin + 1 + np.array([j, i]) * size for i, j in _CORNERS]) / np.array(whole)
    count = len(row)
    number = np.arange(4 * count).reshape(4, count)
    normal = np.cross(corner[2] - corner[1], corner[3] - corner[0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    texels, places, normals = [], [], []
    for n in range(count):
        wide, high = size[n].tolist()
        down, right = np.mgrid[-1 : high + 1, -1 : wide + 1].reshape(2, -1)
        s, t = ((each + 0.5).clip(0.0, side) / side for each, side in ((right, wide), (down, high)))
        texels.append(np.stack([origin[n, 0] + 1 + right, origin[n, 1] + 1 + down], axis=1))
        upper = corner[0, n] + s[:, None] * (corner[1, n] - corner[0, n])
        lower = corner[2, n] + s[:, None] * (corner[3, n] - corner[2, n])
        places.append(upper + t[:, None] * (lower - upper))
        normals.append(np.broadcast_to(normal[n], (len(s), 3)))
    return Chart(
        corner.reshape(-1, 3), uv.reshape(-1, 2).astype(np.float32), _triangles(number), whole, np.concatenate(texels),
        np.concatenate(places), np.concatenate(normals), True,
    )  # fmt: skip


def _corner(tile: _Tile, row: Ints, column: Ints) -> Array:
    east, north = tile.place(row, column)
    return np.stack([east, north, tile.height_m[row, column]], axis=1)


def _sizes(corner: Array, texel_m: float) -> Ints:
    """Texels across and down of each patch: as long as the longer of its sides."""

    def side(a: int, b: int, c: int, d: int) -> Array:
        lengths = [np.linalg.norm(corner[i] - corner[j], axis=1) for i, j in ((a, b), (c, d))]
        return np.asarray(np.maximum(*lengths))

    long_m = np.stack([side(0, 1, 2, 3), side(0, 2, 1, 3)], axis=1)
    return np.clip(np.ceil(long_m / texel_m), 1, _MOST_SIDE_PX).astype(np.int64)


def _packed(size: Ints) -> tuple[Ints, int]:
    """Upper left corners of patches in rows of falling height, shape (n, 2), and the height of them all."""
    origin = np.zeros_like(size)
    x = y = row_high = 0
    for n in np.argsort(-size[:, 1], kind="stable").tolist():
        wide, high = size[n].tolist()
        if x + wide > _ATLAS_PX:
            x, y, row_high = 0, y + row_high, 0
        origin[n] = x, y
        x, row_high = x + wide, max(row_high, high)
    return origin, y + row_high
