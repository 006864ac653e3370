"""Collects shapes with their materials and names into one array of triangles."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simulator.materials import INDEX, TABLE
from simulator.meshes import placed

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class World:
    """All surfaces of a scene.

    Attributes
    ----------
    triangles_m : ndarray, shape (n, 3, 3)
        Corners in the local frame.
    material : ndarray of uint8, shape (n,)
        Index into `materials.TABLE`.
    surface : ndarray of int32, shape (n,)
        Index into `names`; triangles of one number belong together.
    names : tuple of str
    """

    triangles_m: Array
    material: npt.NDArray[np.uint8]
    surface: npt.NDArray[np.int32]
    names: tuple[str, ...]

    def normals(self) -> Array:
        """Unit normal of each triangle, shape (n, 3); zero for one without area."""
        t = self.triangles_m
        normal = np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        return np.asarray(normal / np.where(length > 0, length, 1.0))


class Parts:
    """Where a scene is put together."""

    def __init__(self) -> None:
        self._triangles: list[Array] = []
        self._materials: list[npt.NDArray[np.uint8]] = []
        self._surfaces: list[npt.NDArray[np.int32]] = []
        self._names: list[str] = []

    def add(self, name: str, material: str, triangles: Array) -> None:
        """Add a shape; a name that was used before continues that surface."""
        if name not in self._names:
            self._names.append(name)
        self._triangles.append(triangles)
        self._materials.append(np.full(len(triangles), INDEX[material], np.uint8))
        self._surfaces.append(np.full(len(triangles), self._names.index(name), np.int32))

    def place(self, other: "Parts", at: Array, heading_deg: float) -> None:
        """Add what another collected, turned clockwise about its origin and moved to a place."""
        for triangles, material, surface in zip(other._triangles, other._materials, other._surfaces, strict=True):
            self.add(other._names[surface[0]], TABLE[material[0]].name, placed(triangles, at, heading_deg))

    def world(self) -> World:
        """Everything added so far."""
        return World(
            np.concatenate(self._triangles),
            np.concatenate(self._materials),
            np.concatenate(self._surfaces),
            tuple(self._names),
        )
