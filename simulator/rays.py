"""Beams against triangles: Embree finds the triangle, its plane in double precision the distance."""

import numpy as np
import numpy.typing as npt
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh

from simulator.materials import TRANSMISSION
from simulator.parts import World

Hits = npt.NDArray[np.int32]


class Surfaces:
    """The triangles of a world, ready for ray casting; opaque ones and panes apart, so that a beam goes through glass.

    Attributes
    ----------
    planes : ndarray, shape (n, 4)
        Unit normal and offset of each triangle: normal . point = offset.
    """

    def __init__(self, world: World) -> None:
        normals = world.normals()
        offsets = np.einsum("ij,ij->i", normals, world.triangles_m[:, 0])
        self.planes = np.concatenate([normals, offsets[:, None]], axis=1)
        clear = TRANSMISSION[world.material] > 0
        self._opaque = _Layer(world, np.flatnonzero(~clear))
        self._clear = _Layer(world, np.flatnonzero(clear)) if clear.any() else None

    def opaque(self, origins_m: npt.NDArray[np.float32], directions: npt.NDArray[np.float32]) -> Hits:
        """Triangle first met by each ray, -1 for none, shape (n,)."""
        return self._opaque.first(origins_m, directions)

    def clear(self, origins_m: npt.NDArray[np.float32], directions: npt.NDArray[np.float32]) -> Hits:
        """Pane first met by each ray, -1 for none, shape (n,)."""
        if self._clear is None:
            return np.full(len(origins_m), -1, np.int32)
        return self._clear.first(origins_m, directions)


class _Layer:
    def __init__(self, world: World, index: npt.NDArray[np.intp]) -> None:
        # the last entry stands for "no triangle", which Embree calls -1
        self._index = np.append(index, -1).astype(np.int32)
        self._scene = rtcore_scene.EmbreeScene()
        self._mesh = TriangleMesh(self._scene, world.triangles_m[index].astype(np.float32))

    def first(self, origins_m: npt.NDArray[np.float32], directions: npt.NDArray[np.float32]) -> Hits:
        found = self._scene.run(origins_m, directions, query="INTERSECT")
        return np.asarray(self._index[found])
