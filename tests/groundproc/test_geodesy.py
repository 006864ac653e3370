"""Local frame and projections against formulas written out here and against PROJ; what is not there is refused."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyproj
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flightlog.errors import GeodesyError
from groundproc.cloud.georeference import project
from groundproc.geodesy import (
    LARGEST_RESIDUAL_M,
    LocalFrame,
    Projection,
    check_area,
    projected_crs,
    undulation,
    utm_epsg,
    with_sea_level,
)

Array = npt.NDArray[np.float64]

# WGS 84 (NIMA TR8350.2)
A_M, FLATTENING = 6_378_137.0, 1 / 298.257223563
E2 = FLATTENING * (2 - FLATTENING)


def earth_centred(latitude_deg: Array, longitude_deg: Array, height_m: Array) -> Array:
    lat, lon = np.deg2rad(latitude_deg), np.deg2rad(longitude_deg)
    normal = A_M / np.sqrt(1 - E2 * np.sin(lat) ** 2)
    return np.stack(
        [
            (normal + height_m) * np.cos(lat) * np.cos(lon),
            (normal + height_m) * np.cos(lat) * np.sin(lon),
            (normal * (1 - E2) + height_m) * np.sin(lat),
        ],
        axis=-1,
    )


def east_north_up(origin: tuple[float, float, float], place: tuple[Array, Array, Array]) -> Array:
    """The textbook's rotation of the difference of two earth-centred positions."""
    lat, lon = np.deg2rad(origin[:2])
    axes = np.array(
        [
            [-np.sin(lon), np.cos(lon), 0.0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ]
    )
    away = earth_centred(*place) - earth_centred(*(np.array(v) for v in origin))
    return np.asarray(away @ axes.T)


@settings(max_examples=100, deadline=None)
@given(
    latitude=st.floats(-89.9, 89.9),
    longitude=st.floats(-180, 180),
    height=st.floats(-100, 4000),
    step=st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(-100, 500)),
)
def test_local_coordinates_are_the_textbooks(
    latitude: float, longitude: float, height: float, step: tuple[float, float, float]
) -> None:
    frame = LocalFrame(latitude, longitude, height)
    place = (
        np.array([np.clip(latitude + step[0], -90, 90)]),
        np.array([longitude + step[1]]),
        np.array([height + step[2]]),
    )
    local = frame.from_geodetic(*place)
    np.testing.assert_allclose(local, east_north_up((latitude, longitude, height), place), rtol=0, atol=1e-6)
    back = frame.to_geodetic(local)
    np.testing.assert_allclose(earth_centred(*back), earth_centred(*place), rtol=0, atol=1e-5)


def test_east_is_east_north_is_north_and_up_is_up() -> None:
    frame = LocalFrame(58.394, 15.574, 61.3)
    local = frame.from_geodetic(
        np.array([58.394, 58.395, 58.394]), np.array([15.575, 15.574, 15.574]), np.array([61.3, 61.3, 71.3])
    )
    np.testing.assert_allclose(local[2], [0.0, 0.0, 10.0], rtol=0, atol=1e-6)
    assert local[0, 0] == pytest.approx(58.5, abs=0.2)  # 0.001 deg of longitude at cos(58.394)
    assert local[1, 1] == pytest.approx(111.4, abs=0.2)  # 0.001 deg of latitude


@pytest.mark.parametrize(
    ("latitude", "longitude", "epsg"),
    [
        (58.394, 15.574, 32633), (-35.363, 149.165, 32755), (0.0, 0.0, 32631), (-0.001, -0.001, 32730),
        (10.0, 180.0, 32601), (10.0, -180.0, 32601), (10.0, 179.999, 32660), (84.0, 3.0, 32631), (-80.0, 3.0, 32731),
    ],
)  # fmt: skip
def test_utm_zones_are_those_of_the_grid(latitude: float, longitude: float, epsg: int) -> None:
    assert utm_epsg(latitude, longitude) == epsg
    area = pyproj.CRS.from_epsg(epsg).area_of_use
    assert area is not None
    assert area.south <= latitude <= area.north
    assert (
        min(abs(longitude + turn - area.west) for turn in (-360, 0, 360)) <= 6.0 or area.west <= longitude <= area.east
    )


@pytest.mark.parametrize("latitude", [84.001, -80.001, 90.0, float("nan")])
def test_utm_ends_near_the_poles(latitude: float) -> None:
    with pytest.raises(GeodesyError, match="EPSG"):
        utm_epsg(latitude, 15.0)


@pytest.mark.parametrize(
    ("epsg", "why"),
    [
        (9999, "no such"), (1, "no such"), (4326, "projected"), (4979, "projected"), (4978, "projected"), (2225, "metres"),
        (5845, "projected"), (5773, "projected"),
    ],
)  # fmt: skip
def test_a_crs_that_cannot_be_used_is_refused_by_name(epsg: int, why: str) -> None:
    """Unknown, geographic, three-dimensional, earth-centred, in feet, compound, vertical."""
    with pytest.raises(GeodesyError, match=rf"EPSG:{epsg}.*{why}"):
        projected_crs(epsg)


@pytest.mark.parametrize(
    ("epsg", "latitude", "longitude"),
    [
        (32633, 58.39, 15.57),  # Sweden
        (32633, 58.39, 12.0),  # on its edge
        (3006, 63.8, 20.3),  # one zone for a country
        (32660, 44.0, 179.99),  # the last before the 180th meridian
        (3832, -17.7, 178.0),  # an area that lies across it, on both sides
        (3832, -17.7, -178.0),
        (2193, -36.8, 174.7),
    ],
)
def test_a_crs_holds_the_places_that_it_is_made_for(epsg: int, latitude: float, longitude: float) -> None:
    check_area(projected_crs(epsg), latitude, longitude)


@pytest.mark.parametrize(
    ("epsg", "latitude", "longitude", "zone"),
    [
        (32610, 58.39, 15.57, "EPSG:32633"),
        (32733, 58.39, 15.57, "EPSG:32633"),
        (32633, 58.39, 11.9, "EPSG:32632"),
        (3006, -33.9, 18.4, "EPSG:32734"),
        (32660, 44.0, -179.98, "EPSG:32601"),
        (2193, 36.8, 174.7, "EPSG:32660"),
    ],
)
def test_elsewhere_a_crs_is_refused_with_the_zone_that_would_do(
    epsg: int, latitude: float, longitude: float, zone: str
) -> None:
    with pytest.raises(GeodesyError, match=f"EPSG:{epsg}.*{zone}.*--crs-anyway"):
        check_area(projected_crs(epsg), latitude, longitude)


def test_one_place_of_the_flight_outside_is_enough() -> None:
    with pytest.raises(GeodesyError, match=r"11\.9 E, which EPSG:32632"):
        check_area(projected_crs(32633), np.array([58.0, 58.0]), np.array([12.1, 11.9]))


def test_near_the_poles_no_zone_is_named() -> None:
    with pytest.raises(GeodesyError, match="86 N, 15 E; --crs-anyway"):
        check_area(projected_crs(32633), 86.0, 15.0)


@pytest.mark.parametrize("epsg", [32633, 3006, 3009, 25833, 3067, 2154])
def test_the_polynomial_is_proj_itself_to_a_tenth_of_a_millimetre(epsg: int) -> None:
    """Fitted to the box of a chunk of points, checked at random places inside it against a transformer made here."""
    latitude, longitude = (46.5, 3.2) if epsg == 2154 else (58.394, 15.574)
    frame = LocalFrame(latitude, longitude, 61.3)
    projection = Projection(frame, projected_crs(epsg))
    rng = np.random.default_rng(1)
    local = rng.uniform([-300, -300, -20], [300, 300, 120], (2000, 3)) + np.array([400.0, -250.0, 0.0])
    projected = local.copy()
    project(projected, projection.polynomial(local.min(axis=0), local.max(axis=0)))
    lat, lon, height = frame.to_geodetic(local)
    exact = pyproj.Transformer.from_crs(4326, epsg, always_xy=True).transform(lon, lat)
    away = projected - np.stack([*exact, height], axis=1)
    assert np.abs(away).max() < LARGEST_RESIDUAL_M


def test_grid_north_and_scale_are_those_of_the_place() -> None:
    """UTM 33 at 58.39 N 15.574 E: convergence and scale by PROJ's own factors."""
    frame = LocalFrame(58.394, 15.574, 0.0)
    projection = Projection(frame, projected_crs(32633))
    origin, north = projection.exact(np.array([[0.0, 0, 0], [0.0, 100, 0]]))
    factors = pyproj.Proj(32633).get_factors(15.574, 58.394)
    assert np.arctan2(north[0] - origin[0], north[1] - origin[1]) == pytest.approx(
        -np.deg2rad(factors.meridian_convergence), abs=1e-6
    )
    assert np.hypot(*(north - origin)[:2]) / 100 == pytest.approx(factors.meridional_scale, abs=1e-7)


def test_a_box_too_large_for_the_polynomial_is_refused() -> None:
    projection = Projection(LocalFrame(58.394, 15.574, 0.0), projected_crs(32633))
    with pytest.raises(GeodesyError, match="departs from a second-order surface"):
        projection.polynomial(np.full(3, -20_000.0), np.full(3, 20_000.0))


def test_a_place_that_a_projection_does_not_cover_is_refused() -> None:
    with pytest.raises(GeodesyError):
        Projection(LocalFrame(-35.4, 149.2, 580.0), projected_crs(3035)).polynomial(np.full(3, -1e7), np.full(3, 1e7))


def test_heights_above_the_sea_are_declared_as_egm_96() -> None:
    crs = with_sea_level(projected_crs(32633))
    assert crs.is_compound
    assert [part.to_epsg() for part in crs.sub_crs_list] == [32633, 5773]


# Geoid ----------------------------------------------------------------------------------------------------------------


def test_a_number_is_the_undulation_itself() -> None:
    assert undulation("29.354", 58.39, 15.57) == 29.354
    assert undulation("-5", 0, 0) == -5.0


@pytest.mark.parametrize("geoid", ["130", "-1e9", "nan", "inf"])
def test_a_number_that_no_geoid_has_is_refused(geoid: str) -> None:
    with pytest.raises(GeodesyError, match="geoid"):
        undulation(geoid, 58.39, 15.57)


def test_a_geoid_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(GeodesyError, match="neither a number"):
        undulation(str(tmp_path / "egm96_15.gtx"), 58.39, 15.57)
    with pytest.raises(GeodesyError, match="neither a number"):
        undulation("", 58.39, 15.57)


def test_a_file_that_is_no_grid_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.gtx").write_text("no grid at all\n" * 10)
    with pytest.raises(GeodesyError, match="is it a grid"):
        undulation(str(tmp_path / "notes.gtx"), 58.39, 15.57)


def gtx(path: Path, south: float, west: float, step: float, heights: Array) -> Path:
    """A NOAA GTX grid: four doubles, two ints, rows from the south, big endian."""
    rows, columns = heights.shape
    head = np.array([south, west, step, step], ">f8").tobytes() + np.array([rows, columns], ">i4").tobytes()
    path.write_bytes(head + heights.astype(">f4").tobytes())
    return path


def test_a_grid_is_interpolated_with_its_own_sign(tmp_path: Path) -> None:
    """N = H_ellipsoid - H_sea: a grid of 20 + 0.5 per step to the north + 0.25 to the east, in a folder with a space."""
    folder = tmp_path / "my grids"
    folder.mkdir()
    rows, columns = np.mgrid[0:5, 0:9]
    path = gtx(folder / "village.gtx", 57.0, 14.0, 0.5, 20 + 0.5 * rows + 0.25 * columns)
    assert undulation(str(path), 58.4, 15.6) == pytest.approx(20 + 0.5 * 2.8 + 0.25 * 3.2, abs=1e-4)


def test_a_place_outside_the_grid_is_refused(tmp_path: Path) -> None:
    path = gtx(tmp_path / "village.gtx", 57.0, 14.0, 0.5, np.full((5, 9), 20.0))
    with pytest.raises(GeodesyError, match="covers"):
        undulation(str(path), -35.36, 149.17)


def test_debians_own_grid_of_egm_96_gives_the_height_of_linkoping() -> None:
    path = Path("/usr/share/proj/egm96_15.gtx")
    if not path.is_file():
        pytest.skip("proj-data is not installed: no egm96_15.gtx")
    # h 80.000 <-> H 50.646, as PROJ's own EPSG:5773 has it with this grid
    assert undulation(str(path), 58.41, 15.62) == pytest.approx(29.354, abs=0.1)
