"""E57 (ASTM E2807): coordinates in double precision, intensity and colour; one scan, written piece by piece."""

import uuid
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import SourceError
from groundproc.cloud.exports import Progress, colour_bits
from groundproc.cloud.points import Points
from groundproc.cloud.reader import Cloud, chunks

Fields = dict[str, npt.NDArray[Any]]

_AT_ONCE: Final = 1 << 18
"""Points handed to the library at once."""
_AXES: Final = "XYZ"
_COLOURS: Final = ("Red", "Green", "Blue")


def write(cloud: Cloud, path: Path, progress: Progress) -> None:
    """See `exports`. The CRS is stated as WKT in the file's coordinate metadata."""
    from pye57 import libe57

    try:
        with _opened(path, "" if cloud.crs is None else cloud.crs.to_wkt()) as file:
            scan: _Scan | None = None
            shift = colour_bits(cloud)
            for chunk in chunks(cloud):
                fields = _fields(chunk.points, shift)
                scan = scan or _Scan(file, fields)
                scan.write(fields)
                progress(len(chunk.points))
            if scan is not None:
                scan.close()
    except (OSError, libe57.E57Exception) as error:
        raise SourceError(f"{path}: cannot be written ({' '.join(str(error).split())})") from None


def _opened(path: Path, crs: str) -> Any:
    """An empty file with the elements that every E57 has (ASTM E2807, table 1); pye57's own leave the CRS empty for good."""
    from pye57 import E57, libe57

    class File(E57):  # type: ignore[misc]  # the library has no types
        def write_default_header(self) -> None:
            file, root = self.image_file, self.root
            file.extensionsAdd("", libe57.E57_V1_0_URI)
            for name, text in (
                ("formatName", "ASTM E57 3D Imaging Data File"), ("guid", f"{{{uuid.uuid4()}}}"), ("coordinateMetadata", crs),
                ("e57LibraryVersion", libe57.E57_LIBRARY_ID),
            ):  # fmt: skip
                root.set(name, libe57.StringNode(file, text))
            root.set("versionMajor", libe57.IntegerNode(file, libe57.E57_FORMAT_MAJOR))
            root.set("versionMinor", libe57.IntegerNode(file, libe57.E57_FORMAT_MINOR))
            root.set("data3D", libe57.VectorNode(file, True))
            root.set("images2D", libe57.VectorNode(file, True))

    return File(str(path), mode="w")


def _fields(points: Points, shift: int) -> Fields:
    """What E57 has names for; colours are shifted by so many bits to fit into one byte."""
    found: Fields = {f"cartesian{axis}": points.xyz_m[:, number] for number, axis in enumerate(_AXES)}
    if "intensity" in points:
        found["intensity"] = points["intensity"]
    if "red" in points:
        for name in _COLOURS:
            found[f"color{name}"] = points[name.lower()] >> shift
    return found


class _Scan:
    """The points of a file, which come piece by piece.

    `pye57` has `write_scan_raw` for this. But it wants all points at once, and it stores coordinates in single precision: a northing of
    6,000 km is then off by a quarter of a metre.

    Parameters
    ----------
    file : pye57.E57
    fields : dict of str to ndarray
        That every piece has; these are not written yet.
    """

    def __init__(self, file: Any, fields: Fields) -> None:
        from pye57 import libe57

        self._e57, self._image = libe57, file.image_file
        self._low = dict.fromkeys(fields, np.inf)
        self._high = dict.fromkeys(fields, -np.inf)
        self._node = libe57.StructureNode(self._image)
        self._node.set("guid", libe57.StringNode(self._image, f"{{{uuid.uuid4()}}}"))
        self._node.set("name", libe57.StringNode(self._image, "Scan 0"))
        prototype = libe57.StructureNode(self._image)
        for name in fields:
            prototype.set(name, self._kind(name))
        points = libe57.CompressedVectorNode(self._image, prototype, libe57.VectorNode(self._image, True))
        self._node.set("points", points)
        file.data3d.append(self._node)
        self._room, buffers = file.make_buffers(list(fields), _AT_ONCE)
        self._writer = points.writer(buffers)

    def write(self, fields: Fields) -> None:
        """Append points."""
        count = len(next(iter(fields.values())))
        for begin in range(0, count, _AT_ONCE):
            some = slice(begin, min(begin + _AT_ONCE, count))
            for name, values in fields.items():
                self._room[name][: some.stop - begin] = values[some]
            self._writer.write(some.stop - begin)
        if count:
            for name, values in fields.items():
                self._low[name] = min(self._low[name], float(values.min()))
                self._high[name] = max(self._high[name], float(values.max()))

    def close(self) -> None:
        """All points are there: state their limits (ASTM E2807, table 8)."""
        self._writer.close()
        self._limits("cartesianBounds", {axis.lower(): f"cartesian{axis}" for axis in _AXES})
        if "intensity" in self._low:
            self._limits("intensityLimits", {"intensity": "intensity"})
        if "colorRed" in self._low:
            whole = {
                f"color{name}{end}": value for name in _COLOURS for end, value in (("Minimum", 0), ("Maximum", 255))
            }
            colours = self._e57.StructureNode(self._image)
            for name, value in whole.items():
                colours.set(name, self._e57.IntegerNode(self._image, value))
            self._node.set("colorLimits", colours)

    def _kind(self, name: str) -> Any:
        """What a field is stored as."""
        if name.startswith("color"):
            return self._e57.IntegerNode(self._image, 0, 0, 255)
        return self._e57.FloatNode(
            self._image, 0.0, self._e57.E57_DOUBLE if name[-1] in _AXES else self._e57.E57_SINGLE
        )

    def _limits(self, name: str, fields: dict[str, str]) -> None:
        """State least and largest value of some fields, by what they are called there."""
        found = self._e57.StructureNode(self._image)
        for stem, field in fields.items():
            found.set(f"{stem}Minimum", self._e57.FloatNode(self._image, self._low[field]))
            found.set(f"{stem}Maximum", self._e57.FloatNode(self._image, self._high[field]))
        self._node.set(name, found)
