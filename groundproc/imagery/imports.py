"""Rigs of other programs: rig.yaml, COLMAP's cameras.txt, OpenSfM's camera_models.json, told apart by their content."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from flightlog.errors import CaptureError
from groundproc.imagery.camera import EQUIDISTANT, RADTAN, Camera
from groundproc.imagery.colmap import read_cameras
from groundproc.imagery.rig import Rig, RigCamera, read_rig

_MOST_BYTES: Final = 1 << 22


def load_rig(path: Path) -> Rig:
    """Read a rig in any of the forms.

    Raises
    ------
    ConfigError, CaptureError
        It cannot be read.
    """
    if path.suffix.lower() == ".txt":
        return read_cameras(path)
    if path.suffix.lower() == ".json":
        return read_opensfm(path)
    return read_rig(path)


def read_opensfm(path: Path) -> Rig:
    """Cameras of OpenSfM: lengths are shares of the longer side, and the middle of the picture is the origin.

    Source: opensfm.org/docs, camera models. `perspective`, `brown` and `fisheye` have an equal here.

    Raises
    ------
    CaptureError
        It cannot be read, or has a projection without an equal here.
    """
    try:
        with path.open("rb") as file:
            tree = json.loads(file.read(_MOST_BYTES).decode("utf-8"))
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None
    except (UnicodeDecodeError, ValueError, RecursionError):
        raise CaptureError(f"{path}: is no JSON") from None
    of: dict[str, list[str]] = {}
    if isinstance(tree, list) and tree and isinstance(tree[0], Mapping) and "cameras" in tree[0]:
        shots = tree[0].get("shots")  # a reconstruction
        for name, shot in shots.items() if isinstance(shots, Mapping) else ():
            of.setdefault(str(shot.get("camera") if isinstance(shot, Mapping) else None), []).append(str(name))
        tree = tree[0]["cameras"]
    if not isinstance(tree, Mapping) or not tree or not all(isinstance(one, Mapping) for one in tree.values()):
        raise CaptureError(f"{path}: holds no cameras of OpenSfM, expected names with projection_type, width, height")
    several = len(tree) > 1
    return Rig(
        tuple(
            RigCamera(
                str(name), _camera(one, f"{path}: {name}"), images=tuple(of.get(str(name), ())) if several else ()
            )
            for name, one in tree.items()
        )
    )


def _camera(one: Mapping[str, Any], place: str) -> Camera:
    kind = one.get("projection_type", "perspective")
    if kind not in ("perspective", "brown", "fisheye", "simple_radial"):
        raise CaptureError(
            f"{place}: projection_type {kind!r} found, expected perspective, brown, fisheye or simple_radial"
        )
    try:
        value = {name: float(one[name]) for name in one if name != "projection_type"}
        width, height = int(value["width"]), int(value["height"])
        focal_x = value.get("focal_x", value.get("focal", 0.0))
        focal_y = value.get("focal_y", value.get("focal", 0.0))
    except (TypeError, ValueError, KeyError, OverflowError):
        raise CaptureError(f"{place}: expected numbers: width, height, focal, k1, k2") from None
    size = max(width, height)
    if not (width > 0 and height > 0 and 0.0 < focal_x < np.inf and 0.0 < focal_y < np.inf):
        raise CaptureError(f"{place}: expected a picture and a focal length above 0")
    centre = (
        (width - 1) / 2.0 + size * value.get("c_x", 0.0),
        (height - 1) / 2.0 + size * value.get("c_y", 0.0),
    )
    names = ("k1", "k2") if kind == "fisheye" else ("k1", "k2", "p1", "p2", "k3")
    coefficients = tuple(value.get(name, 0.0) for name in names)
    model = EQUIDISTANT if kind == "fisheye" else RADTAN
    return Camera(width, height, size * focal_x, centre, model, coefficients, focal_y / focal_x)
