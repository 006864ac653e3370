"""`swath export`: each format read again by somebody else's reader."""

from pathlib import Path

import copclib
import laspy
import numpy as np
import pye57
import pyproj
import pytest
import trimesh

from groundproc.cli import main
from groundproc.cloud import copc, octree, reader
from groundproc.cloud.exports import e57


def cloud(path: Path, point_format: int = 6, count: int = 60_000, epsg: int | None = 32633) -> laspy.LasData:
    """A cloud of another program's, with an attribute that we do not know."""
    header = laspy.LasHeader(version="1.2" if point_format < 4 else "1.4", point_format=point_format)
    header.scales, header.offsets = [0.001] * 3, [533_000.0, 6_472_000.0, 0.0]
    if epsg is not None:
        header.add_crs(pyproj.CRS.from_epsg(epsg))
    header.add_extra_dim(laspy.ExtraBytesParams("theirs", "f8"))
    las = laspy.LasData(header)
    rng = np.random.default_rng(3)
    las.x, las.y = 533_400.0 + rng.uniform(0, 80, count), 6_472_100.0 + rng.uniform(0, 50, count)
    las.z, las.intensity = rng.normal(50, 2, count), rng.integers(0, 255, count)
    las.theirs, las.classification = rng.normal(0, 1, count), rng.integers(0, 19, count)
    las.return_number = las.number_of_returns = np.ones(count, np.uint8)
    if "gps_time" in header.point_format.dimension_names:
        las.gps_time = np.arange(count) * 1e-5
    if "red" in header.point_format.dimension_names:
        las.red = las.green = las.blue = rng.integers(0, 65535, count)
    las.write(path)
    return laspy.read(path)


def in_one_order(las: laspy.LasData, names: list[str]) -> np.ndarray:
    rows = np.rec.fromarrays([np.asarray(las[name]) for name in names], names=names)
    return np.sort(rows, order=names)


@pytest.mark.parametrize("point_format", [0, 1, 3, 6, 7])
def test_a_copc_holds_every_point_and_field_as_two_other_readers_see_it(point_format: int, tmp_path: Path) -> None:
    source = cloud(tmp_path / "c.laz", point_format)
    assert main(["export", str(tmp_path / "c.laz"), "-o", str(tmp_path / "c.copc.laz")]) == 0
    with laspy.CopcReader.open(tmp_path / "c.copc.laz") as reader:
        found = reader.query()
        coarse = reader.query(level=0)
        assert reader.header.parse_crs().to_epsg() == 32633
        np.testing.assert_allclose(reader.header.mins, source.header.mins, rtol=0.0, atol=1e-6)
        np.testing.assert_allclose(reader.header.maxs, source.header.maxs, rtol=0.0, atol=1e-6)
    names = ["X", "Y", "Z", "theirs", "intensity", "classification", "return_number"]
    names += [name for name in ("gps_time", "red") if name in source.point_format.dimension_names]
    np.testing.assert_array_equal(in_one_order(found, names), in_one_order(source, names))
    assert 1_000 < len(coarse) < len(source.points)
    other = copclib.FileReader(str(tmp_path / "c.copc.laz"))
    assert sum(node.point_count for node in other.GetAllNodes()) == len(source.points)
    assert other.ValidateSpatialBounds(False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c.copc.laz", "c.laz"]


@pytest.mark.parametrize("point_format", [0, 1, 2, 3])
def test_a_copc_has_the_scan_angles_of_old_point_formats(point_format: int, tmp_path: Path) -> None:
    """Whole degrees there, steps of 0.006 deg here (LAS 1.4 R15, tables 7 and 16): as near as these steps come."""
    source = cloud(tmp_path / "c.las", point_format, 1000)
    source.scan_angle_rank, source.intensity = np.arange(1000) % 181 - 90, np.arange(1000)
    source.write(tmp_path / "c.las")
    assert main(["export", str(tmp_path / "c.las"), "-o", str(tmp_path / "c.copc.laz")]) == 0
    found = laspy.read(tmp_path / "c.copc.laz")
    angle_deg = 0.006 * np.asarray(found.scan_angle)[np.argsort(found.intensity)]
    np.testing.assert_allclose(angle_deg, source.scan_angle_rank, rtol=0, atol=0.003 + 1e-9)


def test_a_copc_is_a_laz_file_for_who_knows_no_copc(tmp_path: Path) -> None:
    source = cloud(tmp_path / "c.laz")
    main(["export", str(tmp_path / "c.laz"), "-o", str(tmp_path / "c.copc.laz")])
    names = ["X", "Y", "Z", "gps_time", "theirs"]
    np.testing.assert_array_equal(in_one_order(laspy.read(tmp_path / "c.copc.laz"), names), in_one_order(source, names))


@pytest.mark.parametrize("ending", ["laz", "las"])
def test_las_and_laz_keep_order_and_every_field(ending: str, tmp_path: Path) -> None:
    source = cloud(tmp_path / "c.laz")
    main(["export", str(tmp_path / "c.laz"), "-o", str(tmp_path / f"d.{ending}")])
    made = laspy.read(tmp_path / f"d.{ending}")
    assert made.header.are_points_compressed == (ending == "laz")
    np.testing.assert_array_equal(made.points.array, source.points.array)


def test_ply_holds_coordinates_in_double_precision_and_the_attributes(tmp_path: Path) -> None:
    source = cloud(tmp_path / "c.laz", 7, 1000)
    main(["export", str(tmp_path / "c.laz"), "-o", str(tmp_path / "c.ply")])
    head, _, body = (tmp_path / "c.ply").read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "element vertex 1000" in lines
    kinds = {"double": "<f8", "float": "<f4", "ushort": "<u2", "uchar": "u1"}
    fields = [line.split()[1:] for line in lines if line.startswith("property")]
    rows = np.frombuffer(body, [(name, kinds[kind]) for kind, name in fields])
    np.testing.assert_array_equal(np.stack([rows["x"], rows["y"], rows["z"]], axis=1), source.xyz)
    np.testing.assert_array_equal(rows["intensity"], source.intensity)
    np.testing.assert_array_equal(rows["red"], np.asarray(source.red) >> 8)
    np.testing.assert_array_equal(rows["gps_time"], source.gps_time)
    np.testing.assert_array_equal(rows["theirs"], source.theirs)


@pytest.mark.parametrize("most", [255, 65535])
def test_colours_of_one_byte_are_no_black(most: int, tmp_path: Path) -> None:
    """Many programs put the byte of a photograph into the two of LAS as it is."""
    source = cloud(tmp_path / "c.las", 7, 1000)
    source.red, source.green, source.blue = np.random.default_rng(1).integers(0, most, (3, 1000), endpoint=True)
    source.green[0] = most
    source.write(tmp_path / "c.las")
    for ending in ("ply", "e57"):
        assert main(["export", str(tmp_path / "c.las"), "-o", str(tmp_path / f"c.{ending}")]) == 0
    mesh = trimesh.load(tmp_path / "c.ply")
    with pye57.E57(str(tmp_path / "c.e57")) as file:
        scan = file.read_scan(0, colors=True, ignore_missing_fields=True)
    for number, name in enumerate(("red", "green", "blue")):
        expected = np.asarray(source[name]) // (1 if most == 255 else 256)
        np.testing.assert_array_equal(mesh.colors[:, number], expected)
        np.testing.assert_array_equal(scan[f"color{name.title()}"], expected)


@pytest.mark.parametrize("ending", ["csv", "ply"])
def test_extra_bytes_of_any_name_and_shape_are_columns(ending: str, tmp_path: Path) -> None:
    las = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    las.header.add_extra_dims(
        [
            laspy.ExtraBytesParams("their own, z", "u2"), laspy.ExtraBytesParams("their_own__z", "i1"),
            laspy.ExtraBytesParams("normal", "3f4"),
            laspy.ExtraBytesParams("scaled", "i4", scales=np.array([0.01]), offsets=np.array([5.0])),
        ]
    )  # fmt: skip
    las.points = laspy.ScaleAwarePointRecord.zeros(3, header=las.header)
    las["their own, z"], las["scaled"] = [1, 2, 65535], [5.01, 4.0, -7.25]
    las["their_own__z"], las["normal"] = [-1, 0, 9], np.arange(9.0).reshape(3, 3) / 4
    las.write(tmp_path / "c.las")
    out = tmp_path / f"c.{ending}"
    assert main(["export", str(tmp_path / "c.las"), "-o", str(out)]) == 0
    if ending == "csv":
        read = np.genfromtxt(out, delimiter=",", names=True, deletechars="")
        rows = {name: read[name] for name in read.dtype.names}
    else:
        rows = trimesh.load(out).metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(rows["their_own__z"], [1, 2, 65535])
    np.testing.assert_array_equal(rows["their_own__z_2"], [-1, 0, 9])
    np.testing.assert_allclose(rows["scaled"], [5.01, 4.0, -7.25], rtol=0, atol=1e-12)
    for part in range(3):
        np.testing.assert_array_equal(rows[f"normal_{part}"], np.arange(9.0).reshape(3, 3)[:, part] / 4)


def test_csv_has_a_header_and_digits_enough(tmp_path: Path) -> None:
    source = cloud(tmp_path / "c.laz", 6, 500)
    main(["export", str(tmp_path / "c.laz"), "-o", str(tmp_path / "c.csv")])
    rows = np.genfromtxt(tmp_path / "c.csv", delimiter=",", names=True)
    np.testing.assert_allclose(np.stack([rows["x"], rows["y"], rows["z"]], axis=1), source.xyz, rtol=0.0, atol=1e-6)
    np.testing.assert_array_equal(rows["classification"], source.classification)
    np.testing.assert_allclose(rows["gps_time"], source.gps_time, rtol=0, atol=1e-9)
    np.testing.assert_allclose(rows["theirs"], source.theirs, rtol=1e-14)


def test_csv_of_degrees_keeps_every_step(tmp_path: Path) -> None:
    """A thousandth of a degree is a hundred metres."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [1e-8, 1e-8, 0.001], [9.0, 50.0, 0.0]
    header.add_crs(pyproj.CRS.from_epsg(4326))
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.random.default_rng(1).uniform([9.0, 50.0, 100.0], [9.001, 50.001, 101.0], (100, 3)).T
    las.write(tmp_path / "c.laz")
    assert main(["export", str(tmp_path / "c.laz"), "-o", str(tmp_path / "c.csv")]) == 0
    rows = np.genfromtxt(tmp_path / "c.csv", delimiter=",", names=True)
    np.testing.assert_allclose(np.stack([rows["x"], rows["y"], rows["z"]], axis=1), las.xyz, rtol=0, atol=1e-9)


def test_a_crowd_that_no_node_can_take_is_refused_with_file_and_place(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    source = cloud(tmp_path / "c.laz", 6, 20_000)
    source.X[1000:], source.Y[1000:], source.Z[1000:] = 412_345, 123_456, 50_007
    source.write(tmp_path / "c.laz")
    monkeypatch.setattr(octree, "_LARGEST_PIECE", 500)
    monkeypatch.setattr(octree, "MOST", 1_200)
    monkeypatch.setattr(copc, "MOST", 1_200)
    assert main(["export", str(tmp_path / "c.laz"), "-o", str(tmp_path / "c.copc.laz")]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    for part in ("c.copc.laz: ", "points of (533412.345, 6472123.456, 50.007)", "expected 1,200 at most", "Leave"):
        assert part in said
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c.laz"]


def test_e57_is_read_by_its_own_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "CHUNK", 1100)
    monkeypatch.setattr(e57, "_AT_ONCE", 500)
    source = cloud(tmp_path / "c.laz", 7, 3000)
    assert main(["export", str(tmp_path / "c.laz"), "-o", str(tmp_path / "c.e57")]) == 0
    with pye57.E57(str(tmp_path / "c.e57")) as file:
        assert file.scan_count == 1
        scan = file.read_scan(0, intensity=True, colors=True, ignore_missing_fields=True)
        header = file.get_header(0)
        limits = [getattr(header, f"{axis}{end}") for axis in "xyz" for end in ("Minimum", "Maximum")]
        assert header.point_count == len(source)
        assert "UTM zone 33N" in file.root["coordinateMetadata"].value()
    found = np.stack([scan["cartesianX"], scan["cartesianY"], scan["cartesianZ"]], axis=1)
    # to the millimetre, not to a share of a northing of thousands of kilometres
    np.testing.assert_allclose(found, source.xyz, rtol=0.0, atol=1e-6)
    np.testing.assert_array_equal(scan["intensity"], source.intensity)
    np.testing.assert_array_equal(scan["colorRed"], np.asarray(source.red) >> 8)
    np.testing.assert_allclose(
        limits, np.stack([source.xyz.min(axis=0), source.xyz.max(axis=0)], axis=1).ravel(), rtol=0.0
    )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["c.laz", "-o", "c.xyz"], "ends in .copc.laz"),
        (["none.laz", "-o", "c.ply"], "none.laz"),
        (["text.laz", "-o", "c.ply"], "text.laz"),
        (["c.laz", "-o", "text.laz"], "--force to write over"),
    ],
)
def test_what_cannot_be_written_is_one_sentence(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    cloud(tmp_path / "c.laz", count=10)
    (tmp_path / "text.laz").write_text("no cloud")
    before = sorted(tmp_path.iterdir())
    assert main(["export", *words]) in (1, 2)
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before
