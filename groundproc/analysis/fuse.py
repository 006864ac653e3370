"""Clouds of other scanners and of photogrammetry merged into one, each laid on the first."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CoverageError, GeodesyError
from groundproc.analysis.epochs import Squares
from groundproc.analysis.placesearch import Found, search
from groundproc.analysis.registration import MOST, Registration, register
from groundproc.cloud import reader
from groundproc.cloud.merger import Merger
from groundproc.cloud.metres import METRES, Metres, agreed_metres
from groundproc.cloud.selection import SURFACES
from groundproc.files import written_aside

Array = npt.NDArray[np.float64]

_LEAST_KNOWN_M: Final = 0.5
"""A larger sigma of the place is that of what was assumed, not of what was seen."""


@dataclass(frozen=True, slots=True)
class Laid:
    """A cloud and how it lies on the first.

    Attributes
    ----------
    path : Path
    points : int
    registration : Registration or None
        In metres; None: it is the first, or was left as it is.
    place : Found or None
        Where a search put it.
    unit : Metres
        Of the clouds.
    """

    path: Path
    points: int
    registration: Registration | None
    place: Found | None = None
    unit: Metres = METRES


def fuse(
    paths: Sequence[Path], output: Path, registered: bool, progress: Callable[[int], object], *, searched: bool = False
) -> list[Laid]:
    """Merge clouds: the first as it is, the others moved onto it; `epoch` says which cloud a point is from.

    Parameters
    ----------
    paths : sequence of Path
    output : Path
    registered : bool
        They lie on each other already: all points stay where they are.
    progress : callable
        Told of points done.
    searched : bool
        Place and heading of the others are not known: they are looked for.

    Raises
    ------
    GeodesyError
        They are in different CRS.
    CoverageError
        One does not fit on the first, or at several places alike.
    """
    clouds = [reader.look(path) for path in paths]
    first = clouds[0]
    for other in clouds[1:]:
        a, b = first.horizontal, other.horizontal
        if a is not None and b is not None and not a.equals(b, ignore_axis_order=True):
            raise GeodesyError(f"{other.path}: is in {b.name}, but {first.path} in {a.name}; expected one CRS")
    metres = agreed_metres(clouds)
    laid = [Laid(first.path, first.points, None)]
    if registered:
        laid += [Laid(cloud.path, cloud.points, None) for cloud in clouds[1:]]
    else:
        base = metres.of(_sample(first, progress))
        for cloud in clouds[1:]:
            sample = metres.of(_sample(cloud, progress))
            found = _laid(cloud, base, sample, f"{first.path} and {cloud.path}", searched)
            laid.append(replace(found, unit=metres))
    with written_aside(output) as aside, Merger(clouds, aside, ("epoch",)) as merged:
        squares: list[Squares] = [Squares() for _ in clouds]
        for number, (cloud, each) in enumerate(zip(clouds, laid, strict=True)):
            for chunk in reader.chunks(cloud, columns=()):
                moved = None
                if each.registration is not None:
                    moved = metres.back(each.registration.move(metres.of(chunk.points.xyz_m)))
                merged.write(chunk.record, {"epoch": np.full(len(chunk.points), number, np.uint8)}, moved)
                squares[number].add(chunk.points.xyz_m if moved is None else moved)
                progress(len(chunk.points))
            if not squares[number].meet(squares[0]):
                raise CoverageError(
                    f"{first.path} and {cloud.path}: have no place in common, expected clouds that lie on each other; `swath merge` puts "
                    "neighbours into one file"
                )
    return laid


def _laid(cloud: reader.Cloud, base: Array, sample: Array, what: str, searched: bool) -> Laid:
    """A cloud laid on a sample of the first by one of itself."""
    if not searched:
        return Laid(cloud.path, cloud.points, _certain(register(base, sample, what), what))
    place = search(base, sample, what)
    fine = _certain(register(base, sample @ place.matrix[:3, :3].T + place.matrix[:3, 3], what), what)
    return Laid(cloud.path, cloud.points, replace(fine, matrix=fine.matrix @ place.matrix), place)


def _certain(found: Registration, what: str) -> Registration:
    """A registration, if it tells all of the place.

    Raises
    ------
    CoverageError
        They would fit as well, moved along some direction.
    """
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3])[-1]))
    if sigma_m > _LEAST_KNOWN_M:
        raise CoverageError(
            f"{what}: fit as well moved along each other (a sigma of {sigma_m:.1f} m, expected below {_LEAST_KNOWN_M:g} m), for nothing "
            "stands up or slopes where both are; --registered takes them as they lie"
        )
    return found


def _sample(cloud: reader.Cloud, progress: Callable[[int], object]) -> Array:
    step = max(1, -(-cloud.points // MOST))
    parts = []
    for chunk in reader.chunks(replace(cloud, choices=(SURFACES,)), columns=()):
        parts.append(chunk.points.xyz_m[::step])
        progress(len(chunk.points))
    if not parts:
        raise CoverageError(f"{cloud.path}: all its points are classed as noise or as what moves")
    return np.concatenate(parts)


def told(laid: Sequence[Laid]) -> list[dict[str, Any]]:
    """Plain figures."""
    out = []
    for number, each in enumerate(laid):
        one: dict[str, Any] = {"epoch": number, "file": str(each.path), "points": each.points}
        found = each.registration
        if found is not None:
            sigma = np.sqrt(np.diag(found.covariance))
            matrix = each.unit.matrix(found.matrix)
            one |= {
                "matrix": matrix.tolist(), "sigma_m": sigma[:3].tolist(), "sigma_deg": np.rad2deg(sigma[3:]).tolist(),
                "residual_m": found.residual_m, "overlap": found.overlap, "fit": found.fit,
            }  # fmt: skip
        if each.place is not None:
            one |= {"correlation": each.place.correlation, "correlation_sigmas": each.place.sigmas}
        out.append(one)
    return out
