"""What a use cannot be made of: another place, another time, no intensity, no CRS. Each is one sentence, and nothing is written."""

import json
import re
from pathlib import Path

import laspy
import numpy as np
import numpy.typing as npt
import pyproj
import pytest
import rasterio
from rasterio.transform import from_origin
from strips import GPS_S, ORIGIN, Scene, Strip

from groundproc.cli import main

SIDE_M, COUNT, FAR_M = 30.0, 20_000, 10_000.0
Array = npt.NDArray[np.float64]
CRS_MEMBER = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32633"}}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hut on a waved slope, and files that do not belong to it."""
    folder, rng = tmp_path_factory.mktemp("refused"), np.random.default_rng(1)
    xyz = np.column_stack([rng.uniform(0, SIDE_M, (COUNT, 2)), rng.normal(0, 0.02, COUNT)])
    xyz[:, 2] += 100.0 + 0.05 * xyz[:, 0] + 0.5 * np.sin(xyz[:, 1] / 6)
    xyz[(np.abs(xyz[:, 0] - 20) < 3) & (np.abs(xyz[:, 1] - 20) < 2), 2] += 3.0
    time_s = np.sort(rng.uniform(0, 20, COUNT))

    def cloud(
        name: str,
        *,
        east: float = 0.0,
        crs: int | None = 32633,
        lit: bool = True,
        timed: bool = True,
        shape: Array = xyz,
    ) -> None:
        header = laspy.LasHeader(version="1.4", point_format=6)
        header.scales, header.offsets = [0.001] * 3, ORIGIN
        header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
        if crs is not None:
            header.add_crs(pyproj.CRS.from_epsg(crs))
        las = laspy.LasData(header)
        las.xyz = shape + ORIGIN + (east, 0, 0)
        las.return_number = las.number_of_returns = las.classification = np.ones(len(shape), np.uint8)
        if lit:
            las.intensity = np.arange(len(shape)) % 50 + 10
        las.gps_time = time_s[: len(shape)] + GPS_S if timed else np.zeros(len(shape))
        las.write(folder / name)

    cloud("a.laz")
    cloud("b.laz")
    cloud("nocrs.laz", crs=None)
    cloud("dark.laz", lit=False)
    cloud("untimed.laz", timed=False)
    cloud("far.laz", east=FAR_M)
    cloud("utm32.laz", crs=25832)
    cloud("degrees.laz", crs=4326)
    cloud("geocentric.laz", crs=4978)
    cloud("feet.laz", crs=2264)
    cloud("one.laz", shape=xyz[:1])
    cloud("row.laz", shape=np.column_stack([np.linspace(0, SIDE_M, 500), np.full(500, 9.9), np.full(500, 100.0)]))
    cloud("stray.laz", shape=np.concatenate([xyz[1:], xyz[:1] + np.array([9e5, 9e5, 0])]))
    cloud("level.laz", shape=xyz * (1, 1, 0) + (0, 0, 100.0))
    for name, strip in (
        ("t.csv", Strip((0, 20, 130), (2, 0, 0), 0, 20)),
        ("t_far.csv", Strip((2 * FAR_M, 20, 130), (2, 0, 0), 0, 20)),
        ("t_near.csv", Strip((2000, 20, 130), (2, 0, 0), 0, 20)),
        ("t_later.csv", Strip((0, 20, 130), (2, 0, 0), 86_400, 20)),
    ):
        Scene([], [strip]).write_trajectory(folder / name)
    corners = np.array([[5, 5], [10, 5], [10, 10], [5, 10], [5, 5]]) + ORIGIN[:2] + (FAR_M, 0)
    for name, kind, coordinates in (
        ("area_far.geojson", "Polygon", [corners.tolist()]),
        ("path_far.geojson", "LineString", corners[:2].tolist()),
    ):
        one = {
            "type": "Feature",
            "properties": {"reflectance": 0.4},
            "geometry": {"type": kind, "coordinates": coordinates},
        }
        tree = {"type": "FeatureCollection", "crs": CRS_MEMBER, "features": [one]}
        (folder / name).write_text(json.dumps(tree))
    for name, east, crs in (
        ("r.tif", 0.0, "EPSG:32633"),
        ("r_far.tif", FAR_M, "EPSG:32633"),
        ("r_nocrs.tif", 0.0, None),
    ):
        corner = from_origin(ORIGIN[0] + east, ORIGIN[1] + SIDE_M, 1, 1)
        with rasterio.open(
            folder / name, "w", driver="GTiff", width=30, height=30, count=1, dtype="float32", crs=crs, transform=corner
        ) as file:
            file.write(np.full((30, 30), 100, np.float32), 1)
    return folder


ANOTHER_TIME = r"t_later\.csv: 20000 of 20000 points .*when it has no pose .*is it of this flight\?"
ANOTHER_PLACE = r"the sensor would have been .*is the trajectory of this flight"
APART = r"0\.0% of the second lies within 3 m of the first, .*are they of one place\?"
NOT_COMMON = r"have no place in common, expected clouds that lie on each other"
OUTSIDE = r"outside of the clouds?, which spans? 533000 to 533030 E and 647(2000|1999) to 6472030 N"
UNTIMED = r"gps_time is 0 for all points, expected the time of each point"
DIFFERENT = r"utm32\.laz: .*in ETRS89 / UTM zone 32N, but a\.laz in WGS 84 / UTM zone 33N; expected one CRS"
CRS_DIFFER = r"is in .*UTM zone.*, but .* in .*UTM zone.*; expected one CRS"
DEGREES = r"degrees\.laz: .*expected a projected CRS"

REFUSED = [
    (
        "ground geocentric.laz -o o.laz",
        r"geocentric\.laz: .*metres from the middle of the earth; expected a projected CRS",
    ),
    ("orthophoto degrees.laz --attribute intensity -o o.tif", DEGREES),
    ("section degrees.laz --line 533010,6472010,533020,6472020 -o o.laz", DEGREES),
    ("viewshed degrees.laz --at 533010,6472010 --height 2 -o o.tif", DEGREES),
    ("soil a.laz --before utm32.laz -o o.geojson", CRS_DIFFER),
    ("displacement utm32.laz a.laz -o o.geojson", CRS_DIFFER),
    ("banks a.laz --before utm32.laz -o o.geojson", CRS_DIFFER),
    ("change level.laz b.laz -o o", r"level\.laz and b\.laz: "),
    ("displacement level.laz b.laz -o o.geojson", r"level\.laz and b\.laz: "),
    ("ground a.laz --water area_far.geojson -o o.laz", OUTSIDE),
    ("ground degrees.laz -o o.laz", DEGREES),
    ("reflectance nocrs.laz -t t.csv -o o", r"nocrs\.laz: states no CRS; give it with --crs"),
    ("reflectance a.laz -t t_far.csv -o o", ANOTHER_PLACE),
    ("reflectance a.laz -t t_later.csv -o o", ANOTHER_TIME),
    ("reflectance a.laz far.laz -t t.csv -o o", ANOTHER_PLACE),
    ("reflectance a.laz -t t.csv --targets area_far.geojson -o o", OUTSIDE),
    (
        "reflectance dark.laz -t t.csv -o o",
        r"dark\.laz: its points have no intensity, expected the strength of each echo",
    ),
    ("reflectance untimed.laz -t t.csv -o o", UNTIMED),
    ("reflectance degrees.laz -o o", DEGREES),
    ("reflectance feet.laz -o o", r"feet\.laz: is in US survey foot, expected metres; `swath transform` makes them"),
    ("orthophoto dark.laz --attribute intensity -o o.tif", r"dark\.laz: intensity is 0 for all points"),
    ("orthophoto a.laz -o o.tif", r"a\.laz: has no reflectance, .*`swath reflectance` makes it"),
    ("orthophoto a.laz utm32.laz --attribute intensity -o o.tif", DIFFERENT),
    ("detect degrees.laz -o o.geojson", DEGREES),
    ("change a.laz far.laz -o o", APART),
    ("change a.laz far.laz --surface -o o", APART),
    ("change a.laz far.laz --registered -o o", NOT_COMMON),
    ("change a.laz utm32.laz -o o", DIFFERENT),
    ("change a.laz b.laz --trajectory-a t_near.csv --trajectory-b t.csv -o o", ANOTHER_PLACE),
    ("change a.laz b.laz --trajectory-a t.csv --trajectory-b t_later.csv -o o", ANOTHER_TIME),
    ("displacement a.laz far.laz -o o.geojson", APART),
    ("displacement a.laz far.laz --registered -o o.geojson", NOT_COMMON),
    ("soil a.laz --before far.laz -o o.geojson", APART),
    ("soil a.laz --before far.laz --registered -o o.geojson", NOT_COMMON),
    ("fuse a.laz far.laz -o o.laz", APART),
    ("fuse a.laz far.laz --registered -o o.laz", NOT_COMMON),
    ("fuse a.laz utm32.laz -o o.laz", DIFFERENT),
    (
        "viewshed a.laz --at 633010,6472010 --height 2 -o o.tif",
        r"633010\.00,6472010\.00: the surface has no height there",
    ),
    (
        "viewshed a.laz --path path_far.geojson --height 2 -o o.tif",
        r"the surface has no height there, expected a place",
    ),
    ("viewshed a.laz --mode voxels --at 533010,6472010 --height 2 -t t_near.csv -o o.tif", ANOTHER_PLACE),
    ("viewshed a.laz --mode voxels --at 533010,6472010 --height 2 -t t_later.csv -o o.tif", ANOTHER_TIME),
    (
        "section a.laz --line 633010,6472010,633020,6472020 -o o.laz",
        r"a\.laz: no point lies within 0\.25 m of the line",
    ),
    ("windows nocrs.laz -t t.csv -o o.laz", r"nocrs\.laz: states no CRS; give it with --crs"),
    ("windows a.laz -t t_near.csv -o o.laz", ANOTHER_PLACE),
    ("windows a.laz -t t_later.csv -o o.laz", ANOTHER_TIME),
    ("windows untimed.laz -t t.csv -o o.laz", UNTIMED),
    ("wires degrees.laz -o o.geojson", DEGREES),
    ("trees degrees.laz -o o.geojson", DEGREES),
    ("pipes degrees.laz -o o.geojson", DEGREES),
    ("drape a.laz r_far.tif --as temperature -o o.laz", r"not one point of a\.laz lies on a cell with a value"),
    ("moving untimed.laz -o o.geojson", UNTIMED),
    ("passability a.laz -o o --from 633005,6472005 --to 533025,6472005", r"--from 633005.*" + OUTSIDE),
    ("passability a.laz -o o --from 533005,6472005 --to 633035,6472035", r"--to 633035.*" + OUTSIDE),
]


@pytest.mark.parametrize(("words", "sentence"), REFUSED, ids=[words for words, _ in REFUSED])
def test_what_cannot_be_is_one_sentence_and_leaves_nothing(
    place: Path, words: str, sentence: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(place)
    before = sorted(path.name for path in place.iterdir())
    assert main(words.split()) in (1, 2)
    told = capsys.readouterr().err.strip()
    assert re.search(sentence, told), told
    assert "\n" not in told
    assert told.startswith("swath: ")
    assert sorted(path.name for path in place.iterdir()) == before


TAKEN = r"nocrs\.laz states no CRS: its coordinates are taken for metres, and what is made of it states none"
AS_OTHER = r"nocrs\.laz states no CRS, and is taken to be in that of a\.laz"
RAISED = "--at 533010,6472010 --height 2"
TOLD = [
    ("ground nocrs.laz -o o.laz", TAKEN),
    ("orthophoto nocrs.laz --attribute intensity -o o.tif", r"nocrs\.laz states no CRS, and so the raster states none"),
    ("detect nocrs.laz -o o.geojson", TAKEN),
    ("change a.laz nocrs.laz -o o", AS_OTHER),
    ("displacement a.laz nocrs.laz -o o.geojson", AS_OTHER),
    ("soil nocrs.laz --size 1 -o o.geojson", TAKEN),
    ("soil a.laz --before nocrs.laz --size 1 -o o.geojson", AS_OTHER),
    (
        "soil dark.laz --size 1 -o o.geojson",
        r"dark\.laz: no reflectance or intensity on its ground, so that height alone",
    ),
    ("fuse a.laz nocrs.laz -o o.laz", AS_OTHER),
    (f"viewshed nocrs.laz {RAISED} -o o.tif", TAKEN),
    (f"viewshed nocrs.laz --mode voxels {RAISED} -o o.tif", TAKEN),
    (f"viewshed r_nocrs.tif {RAISED} -o o.tif", TAKEN.replace("nocrs.laz", "r_nocrs.tif").replace(r"\.laz", r"\.tif")),
    ("section nocrs.laz --line 533010,6472010,533020,6472020 -o o.laz", TAKEN),
    ("windows nocrs.laz -o o.laz", TAKEN),
    ("wires nocrs.laz -o o.geojson", TAKEN),
    ("trees nocrs.laz -o o.geojson", TAKEN),
    ("pipes nocrs.laz -o o.geojson", TAKEN),
    ("banks nocrs.laz -o o.geojson", TAKEN),
    ("banks nocrs.laz --before a.laz -o o.geojson", AS_OTHER),
    ("smooth nocrs.laz -o o.laz", TAKEN),
    ("moving nocrs.laz -o o.geojson", TAKEN),
    ("passability nocrs.laz -o o", TAKEN),
    (
        "drape nocrs.laz r.tif --as temperature -o o.laz",
        r"nocrs\.laz states no CRS, and is taken to be in that of r\.tif",
    ),
    (
        "drape a.laz r_nocrs.tif --as temperature -o o.laz",
        r"r_nocrs\.tif states no CRS, and is taken to be in that of a",
    ),
]


@pytest.mark.parametrize(("words", "sentence"), TOLD, ids=[words for words, _ in TOLD])
def test_what_is_taken_for_granted_is_told_once(
    place: Path,
    tmp_path: Path,
    words: str,
    sentence: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(place)
    *others, output = words.split()
    assert main([*others, str(tmp_path / output)]) == 0
    told = capsys.readouterr().err.splitlines()
    assert sum(re.search(sentence, line) is not None for line in told) == 1, told
    assert all(line.startswith("swath: warning: ") for line in told)


@pytest.mark.parametrize(
    "words",
    [
        "soil one.laz -o o.geojson", "soil row.laz -o o.geojson", "banks one.laz -o o.geojson", "banks row.laz -o o.geojson",
        "displacement stray.laz b.laz --registered -o o.geojson", "change row.laz b.laz --registered -o o",
    ],
)  # fmt: skip
def test_a_cloud_of_a_point_or_a_row_or_with_one_far_away_is_taken(
    place: Path, tmp_path: Path, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(place)
    *others, output = words.split()
    assert main([*others, str(tmp_path / output)]) == 0
