"""A cloud that a browser asks for node by node: what it is told first, and the bytes of a node."""

from collections.abc import Sequence
from functools import reduce
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt
import pyproj

from groundproc.cloud.nodes import Key, octree_of
from groundproc.cloud.reader import look
from groundproc.cloud.sameness import agreed_crs
from groundproc.viewer.readers import Readers
from groundproc.viewer.scene import origin_of, scene
from groundproc.viewer.shades import TIME, shades_of

Array = npt.NDArray[np.float64]

_SAMPLE: Final = 150_000
"""Points that tell what the attributes span."""
_SAMPLED: Final = 12
"""Files of many that tell it, where none is an overview."""
CLASS: Final = "classification"
_BULK: Final = (5.0, 95.0)
"""Percentiles of each axis between which most points lie."""


class Served:
    """COPC files for the page, one or the tiles of a large cloud.

    Use as a context manager.

    Parameters
    ----------
    files : sequence of Path
        Octrees that share no point.
    of : Path
        The cloud that they show, by its own name.
    paths : sequence of ndarray, shape (k, 3)
        Of a flight, in the cloud's CRS.
    overview : Path, optional
        An octree of some of the points of all files, for looking from afar.

    Raises
    ------
    CaptureError
        One cannot be read.
    GeodesyError
        They lie in several CRSs, or in angles.
    """

    def __init__(
        self, files: Sequence[Path], of: Path, paths: Sequence[Array] = (), overview: Path | None = None
    ) -> None:
        everything = [*files] if overview is None else [*files, overview]
        self._clouds = [look(path) for path in everything]
        crs = agreed_crs(self._clouds)
        self._octrees = [octree_of(path) for path in everything]
        self._readers = Readers(list(zip(self._clouds, self._octrees, strict=True)))
        self._timed = all(cloud.timed for cloud in self._clouds) and len({each.week_time for each in self._clouds}) == 1
        try:
            self._describe(of, paths, len(files), crs)
        except BaseException:
            self._readers.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._readers.close()

    def _describe(self, of: Path, paths: Sequence[Array], files: int, crs: pyproj.CRS | None) -> None:
        """Look at some points, and say what there is."""
        overview = files < len(self._octrees)
        looked = [files] if overview else np.unique(np.linspace(0, files - 1, _SAMPLED).astype(int)).tolist()
        parts = []
        for tree in looked:
            octree, seen = self._octrees[tree], 0
            for key in sorted(octree.nodes):
                with self._readers.of(tree) as reader:
                    parts.append(reader.read(octree.nodes[key]))
                seen += octree.nodes[key].points
                if seen >= _SAMPLE / len(looked):
                    break
        xyz = np.concatenate([points.xyz_m for points, _ in parts])
        common = reduce(set.intersection, (set(cloud.columns) for cloud in self._clouds))
        columns = {
            name: np.concatenate([points[name] for points, _ in parts])
            for name in parts[0][0].columns
            if name in common
        }
        time_s = np.concatenate([time for _, time in parts])
        self._begin_s = float(time_s.min())
        self.shades = shades_of(columns, time_s - self._begin_s if self._timed else None, keep=(CLASS,))
        low, high = xyz.min(axis=0), xyz.max(axis=0)
        # single precision counts from where the points are, not from the middle to one that lies astray
        self.origin_m = origin_of(*np.percentile(xyz, _BULK, axis=0))
        spacing_m = min(octree.spacing_m for octree in self._octrees)
        told = scene(self.origin_m, (low, high), xyz, self.shades, paths, spacing_m, crs)
        self.scene: dict[str, Any] = told | {
            "name": of.name,
            "total": sum(cloud.points for cloud in self._clouds[:files]),
            "trees": [self._told(tree, tree == files) for tree in range(len(self._octrees))],
        }

    def _told(self, tree: int, overview: bool) -> dict[str, Any]:
        octree = self._octrees[tree]
        return {
            "corner": (np.array(octree.corner_m) - self.origin_m).round(4).tolist(),
            "side": octree.side_m,
            "spacing": round(octree.spacing_m, 4),
            "overview": overview,
            "nodes": [[*key, node.points] for key, node in sorted(octree.nodes.items())],
        }

    def node(self, tree: int, key: Key) -> bytes | None:
        """Places from the scene's origin as float32, shape (n, 3), then a byte for each point of each shade; None: no such node.

        Raises
        ------
        CaptureError
            It is damaged.
        """
        node = self._octrees[tree].nodes.get(key) if tree < len(self._octrees) else None
        if node is None:
            return None
        names = {shade.name for shade in self.shades}
        with self._readers.of(tree) as reader:
            points, time_s = reader.read(node, names)
        parts = [(points.xyz_m - self.origin_m).astype("<f4").tobytes()]
        for shade in self.shades:
            values = time_s - self._begin_s if shade.name == TIME else points[shade.name]
            parts.append(shade.encode(values).tobytes())
        return b"".join(parts)
