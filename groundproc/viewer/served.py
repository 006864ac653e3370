"""A cloud that a browser asks for node by node: what it is told first, and the bytes of a node."""

import contextlib
import queue
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from groundproc.cloud.nodes import Key, NodeReader, octree_of
from groundproc.cloud.reader import Cloud, look
from groundproc.viewer.scene import origin_of, scene
from groundproc.viewer.shades import TIME, shades_of

Array = npt.NDArray[np.float64]

_SAMPLE: Final = 150_000
"""Points that tell what the attributes span."""
_READERS: Final = 2
"""Nodes that are unpacked at the same time."""
CLASS: Final = "classification"
_BULK: Final = (5.0, 95.0)
"""Percentiles of each axis between which most points lie."""


class Served:
    """A COPC file for the page.

    Use as a context manager.

    Parameters
    ----------
    path : Path
        The octree.
    of : Path
        The cloud that it shows, by its own name.
    paths : sequence of ndarray, shape (k, 3)
        Of a flight, in the cloud's CRS.

    Raises
    ------
    CaptureError
        It cannot be read.
    """

    def __init__(self, path: Path, of: Path, paths: Sequence[Array] = ()) -> None:
        self.cloud: Cloud = look(path)
        self._octree = octree_of(path)
        self._stack = contextlib.ExitStack()
        self._readers: queue.SimpleQueue[NodeReader] = queue.SimpleQueue()
        try:
            for _ in range(_READERS):
                self._readers.put(self._stack.enter_context(NodeReader(self.cloud, self._octree)))
            self._describe(of, paths)
        except BaseException:
            self._stack.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _describe(self, of: Path, paths: Sequence[Array]) -> None:
        """Look at some points, and say what there is."""
        octree, seen = self._octree, 0
        parts = []
        for key in sorted(octree.nodes):
            with self._reader() as reader:
                parts.append(reader.read(octree.nodes[key]))
            seen += octree.nodes[key].points
            if seen >= _SAMPLE:
                break
        xyz = np.concatenate([points.xyz_m for points, _ in parts])
        columns = {name: np.concatenate([points[name] for points, _ in parts]) for name in parts[0][0].columns}
        time_s = np.concatenate([time for _, time in parts])
        self._begin_s = float(time_s.min())
        self.shades = shades_of(columns, time_s - self._begin_s if self.cloud.timed else None, keep=(CLASS,))
        low, high = xyz.min(axis=0), xyz.max(axis=0)
        # single precision counts from where the points are, not from the middle to one that lies astray
        self.origin_m = origin_of(*np.percentile(xyz, _BULK, axis=0))
        told = scene(self.origin_m, (low, high), xyz, self.shades, paths, octree.spacing_m, self.cloud.crs)
        self.scene: dict[str, Any] = told | {
            "name": of.name,
            "total": self.cloud.points,
            "corner": (np.array(octree.corner_m) - self.origin_m).round(4).tolist(),
            "side": octree.side_m,
            "nodes": [[*key, node.points] for key, node in sorted(octree.nodes.items())],
        }

    @contextlib.contextmanager
    def _reader(self) -> Iterator[NodeReader]:
        reader = self._readers.get()
        try:
            yield reader
        finally:
            self._readers.put(reader)

    def node(self, key: Key) -> bytes | None:
        """Places from the scene's origin as float32, shape (n, 3), then a byte for each point of each shade; None: no such node.

        Raises
        ------
        CaptureError
            It is damaged.
        """
        node = self._octree.nodes.get(key)
        if node is None:
            return None
        names = {shade.name for shade in self.shades}
        with self._reader() as reader:
            points, time_s = reader.read(node, names)
        parts = [(points.xyz_m - self.origin_m).astype("<f4").tobytes()]
        for shade in self.shades:
            values = time_s - self._begin_s if shade.name == TIME else points[shade.name]
            parts.append(shade.encode(values).tobytes())
        return b"".join(parts)
