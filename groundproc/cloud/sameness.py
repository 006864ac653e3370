"""Whether clouds lie in one CRS, heights and times included: only then do their coordinates go together as they are."""

from collections.abc import Sequence

import numpy as np
import pyproj

from flightlog.errors import CaptureError, GeodesyError
from groundproc.cloud.reader import Cloud, chunks


def agreed_crs(clouds: Sequence[Cloud]) -> pyproj.CRS | None:
    """The CRS of all of some clouds; None: not one states any.

    Raises
    ------
    GeodesyError
        They differ in plan or in what heights refer to, or one states what another does not.
    """
    first = clouds[0]
    for other in clouds[1:]:
        for what, pick in (("coordinates", horizontal), ("heights", vertical)):
            mine, theirs = pick(first.crs), pick(other.crs)
            if not same(mine, theirs):
                raise GeodesyError(
                    f"{other.path}: {what} in {named(theirs)}, but {first.path} in {named(mine)}; expected one CRS for all; bring them "
                    "into one before"
                )
    return first.crs


def agreed_map_crs(clouds: Sequence[Cloud], given: pyproj.CRS | None) -> pyproj.CRS:
    """The projected CRS of all of some clouds in metres; heights may differ, and stay what they are.

    A CRS that is given goes before what the files state.

    Raises
    ------
    CaptureError
        A file states none and none is given, they differ, or it is not projected in metres.
    """
    crs = given
    for cloud in clouds:
        if given is not None:
            break
        if cloud.horizontal is None:
            raise CaptureError(f"{cloud.path}: states no CRS; give it with --crs")
        if crs is not None and not crs.equals(cloud.horizontal, ignore_axis_order=True):
            raise CaptureError(
                f"{cloud.path}: is in {cloud.horizontal.name}, expected {crs.name} as {clouds[0].path.name}"
            )
        crs = cloud.horizontal if crs is None else crs
    assert crs is not None
    if not crs.is_projected or {axis.unit_name for axis in crs.axis_info} != {"metre"}:
        raise CaptureError(
            f"{clouds[0].path}: is in {crs.name}, expected a projected CRS in metres; `swath transform` makes it"
        )
    return crs


def agreed_times(clouds: Sequence[Cloud]) -> None:
    """Refuse clouds whose times count from different beginnings.

    Raises
    ------
    CaptureError
    """
    timed = [cloud for cloud in clouds if cloud.timed]
    if len({cloud.week_time for cloud in timed}) > 1:
        # times that are 0 count from nowhere: programs that know none write them so, and leave the header's bit unset
        timed = [cloud for cloud in timed if not cloud.week_time or _any_time(cloud)]
    for other in timed[1:]:
        if other.week_time != timed[0].week_time:
            weekly, standard = (other, timed[0]) if other.week_time else (timed[0], other)
            raise CaptureError(
                f"{weekly.path}: its times are seconds of the GPS week, those of {standard.path} adjusted standard GPS time; expected one "
                "of both"
            )


def _any_time(cloud: Cloud) -> bool:
    """Whether the first points of a file have times."""
    first = next(chunks(cloud, columns=()), None)
    return first is not None and bool(np.any(first.record.gps_time))


def horizontal(crs: pyproj.CRS | None) -> pyproj.CRS | None:
    """The part of a CRS in plan."""
    return crs.sub_crs_list[0] if crs is not None and crs.is_compound else crs


def vertical(crs: pyproj.CRS | None) -> pyproj.CRS | None:
    """What heights refer to, where it is stated apart."""
    return crs.sub_crs_list[1] if crs is not None and crs.is_compound else None


def same(a: pyproj.CRS | None, b: pyproj.CRS | None) -> bool:
    """Whether two are one CRS, by whatever names."""
    if a is None or b is None:
        return a is b
    if a.equals(b, ignore_axis_order=True):
        return True
    codes = a.to_epsg(), b.to_epsg()
    return codes[0] is not None and codes[0] == codes[1]


def named(crs: pyproj.CRS | None) -> str:
    """For people."""
    return "none that is stated" if crs is None else str(crs.name)
