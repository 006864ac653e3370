"""E57 (ASTM E2807): coordinates in double precision, intensity and colour; large clouds as several scans."""

import uuid
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import SourceError
from groundproc.cloud.exports import Progress
from groundproc.cloud.points import Points
from groundproc.cloud.reader import Cloud, chunks

_SCAN: Final = 10_000_000
"""Points of one scan: the library wants a scan at once."""


def write(cloud: Cloud, path: Path, progress: Progress) -> None:
    """See `exports`. The CRS is stated as WKT in the file's coordinate metadata."""
    from pye57 import libe57

    try:
        with _opened(path, "" if cloud.crs is None else cloud.crs.to_wkt()) as file:
            waiting: list[dict[str, npt.NDArray[Any]]] = []
            count = 0
            for chunk in chunks(cloud):
                waiting.append(_fields(chunk.points))
                count += len(chunk.points)
                progress(len(chunk.points))
                if count >= _SCAN:
                    _scan(file, waiting)
                    waiting, count = [], 0
            if waiting:
                _scan(file, waiting)
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


def _fields(points: Points) -> dict[str, npt.NDArray[Any]]:
    """What E57 has names for."""
    found: dict[str, npt.NDArray[Any]] = {
        f"cartesian{axis}": points.xyz_m[:, number] for number, axis in enumerate("XYZ")
    }
    if "intensity" in points:
        found["intensity"] = points["intensity"].astype(np.float64)
    if "red" in points:
        for name in ("red", "green", "blue"):
            found[f"color{name.capitalize()}"] = (points[name] >> 8).astype(np.uint8)
    return found


def _scan(file: Any, parts: list[dict[str, npt.NDArray[Any]]]) -> None:
    file.write_scan_raw({name: np.concatenate([part[name] for part in parts]) for name in parts[0]})
