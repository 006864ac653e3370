"""Clouds of every version and point format of LAS go through the commands that write them anew: every point, where it was, as it was."""

import struct
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest
import rasterio
from rasterio.transform import from_origin

from groundproc.cli import main

SIDE_M, COUNT = 16.0, 1500
ORIGIN = np.array([533_600.0, 6_472_600.0, 0.0])
FORMATS = (
    ("1.0", 0), ("1.0", 1), ("1.1", 0), ("1.2", 2), ("1.2", 3), ("1.3", 4), ("1.3", 5), ("1.4", 1), ("1.4", 6), ("1.4", 7),
    ("1.4", 8), ("1.4", 9), ("1.4", 10),
)  # fmt: skip
COMMANDS = {
    "ground": ("ground", "IN"),
    "wires": ("wires", "IN", "-o", "wires.geojson", "--clearance", "OUT"),
    "windows": ("windows", "IN"),
    "drape": ("drape", "IN", "image.tif", "--as", "temperature", "--all"),
    "export": ("export", "IN"),
    "fuse": ("fuse", "IN", "IN", "--registered"),
    "merge": ("merge", "IN", "other.laz"),
    "section": ("section", "IN", "--line", "533600,6472608,533616,6472608", "--width", "40"),
    "transform": ("transform", "IN", "--crs", "32633", "--from", "25833"),
}
"""What makes a cloud of a cloud: its own words say where it goes, or -o does."""
ANEW = {"classification", "point_source_id"}
"""What a command gives."""
TOGETHER = ("fuse", "merge")
"""Of several clouds: point formats 6 to 8, without waveforms, and records that each has of its own."""
WAVES = {"wavepacket_index", "wavepacket_offset", "wavepacket_size", "return_point_wave_location", "x_t", "y_t", "z_t"}


def written(path: Path, version: str, point_format: int, scale: float = 0.001, offset: Any = ORIGIN) -> Path:
    """A waved slope with a hut and a wire. The CRS is WKT from point format 6 on, and keys of GeoTIFF before."""
    rng = np.random.default_rng(7)
    xyz = np.column_stack([rng.uniform(0, SIDE_M, (COUNT, 2)), rng.normal(0, 0.02, COUNT)])
    xyz[:, 2] += 60.0 + 0.05 * xyz[:, 0] + 0.4 * np.sin(xyz[:, 1] / 4)
    xyz[(np.abs(xyz[:, 0] - 11) < 2) & (np.abs(xyz[:, 1] - 11) < 2), 2] += 3.0
    xyz[:150] = np.column_stack([np.linspace(0, SIDE_M, 150), np.full(150, 4.0), np.full(150, 68.0)])
    header = laspy.LasHeader(version="1.1" if version == "1.0" else version, point_format=point_format)
    header.scales, header.offsets = [scale] * 3, offset
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    if point_format >= 6:
        header.add_crs(pyproj.CRS.from_epsg(25833))
    else:
        keys = struct.pack("<16H", 1, 1, 0, 3, 1024, 0, 1, 1, 3072, 0, 1, 25833, 3076, 0, 1, 9001)
        header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", keys))
    header.vlrs.append(laspy.VLR("somebody", 7, "theirs", b"kept"))
    las = laspy.LasData(header)
    las.xyz = xyz + ORIGIN
    las.intensity, las.point_source_id = np.arange(COUNT) % 200, np.full(COUNT, 3)
    las.classification, las.return_number, las.number_of_returns = np.ones((3, COUNT), np.uint8)
    names = set(header.point_format.dimension_names)
    for name, value in (
        ("gps_time", 463_307_441.0),
        ("red", 900),
        ("nir", 300),
        ("wavepacket_offset", 60),
        ("x_t", 0.5),
    ):
        if name in names:
            las[name] = np.full(COUNT, value)
    las.write(path)
    if version == "1.0":  # laspy writes none: no number of a source in the head, and a signature before the points
        data = bytearray(path.read_bytes())
        start = struct.unpack_from("<I", data, 96)[0]
        data[4:6], data[25:26], data[start:start] = bytes(2), bytes(1), b"\xcc\xdd"
        struct.pack_into("<I", data, 96, start + 2)
        path.write_bytes(data)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where clouds, a second one and an image lie."""
    made = tmp_path_factory.mktemp("formats")
    written(made / "other.laz", "1.4", 6)
    with rasterio.open(
        made / "image.tif", "w", driver="GTiff", width=40, height=40, count=1, dtype="float32", crs="EPSG:25833",
        transform=from_origin(533_598.0, 6_472_618.0, 0.5, 0.5),
    ) as image:  # fmt: skip
        image.write(np.full((40, 40), 20.0, np.float32), 1)
    return made


def through(command: str, folder: Path, path: Path, out: Path) -> int:
    """Run a command; gives its exit code."""
    words = list(COMMANDS[command])
    if "OUT" not in words:
        words += ["-o", "OUT"]
    named = {"IN": path, "OUT": out, "other.laz": folder / "other.laz", "image.tif": folder / "image.tif"}
    named["wires.geojson"] = out.parent / "wires.geojson"
    return main([str(named.get(word, word)) for word in words])


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(("version", "point_format"), FORMATS)
def test_every_point_comes_out_where_it_was(
    version: str, point_format: int, command: str, folder: Path, tmp_path: Path
) -> None:
    path = folder / f"{version}_{point_format}.las"
    if not path.exists():
        written(path, version, point_format)
    out = tmp_path / ("o.las" if command == "export" else "o.laz")
    assert through(command, folder, path, out) == 0
    old, new = laspy.read(path), laspy.read(out)
    assert {each.name for each in tmp_path.iterdir()} <= {"o.laz", "o.las", "wires.geojson"}
    new.points = new.points[:COUNT]
    moved = np.abs(new.xyz - old.xyz).max()
    assert moved < (1e-3 if command == "transform" else 1e-9)
    left = ANEW | {"X", "Y", "Z"} | (WAVES | {"scan_angle_rank"} if command in TOGETHER else set())
    for name in set(old.point_format.dimension_names) - left:
        np.testing.assert_array_equal(np.asarray(new[name]), np.asarray(old[name]), err_msg=name)
    assert new.header.parse_crs() is not None
    if command not in TOGETHER:
        assert [each.record_data for each in new.vlrs if each.user_id == "somebody"] == [b"kept"]


@pytest.mark.parametrize("command", ["export", "wires", "fuse", "merge"])
@pytest.mark.parametrize(
    ("scale", "offset"),
    [(0.01, (0.0, 0.0, 0.0)), (0.0003048, ORIGIN + 0.0007), (0.01, (-1e7, 1e7, -1e4)), (1e-6, ORIGIN + 8.0)],
)
def test_no_scale_and_offset_moves_a_point(
    scale: float, offset: tuple[float, ...], command: str, folder: Path, tmp_path: Path
) -> None:
    path = written(tmp_path / "in.las", "1.4", 6, scale, np.asarray(offset))
    out = tmp_path / "o.laz"
    assert through(command, folder, path, out) == 0
    old, new = laspy.read(path), laspy.read(out)
    np.testing.assert_allclose(new.xyz[:COUNT], old.xyz, rtol=0, atol=1e-8)
    if command not in TOGETHER:
        np.testing.assert_array_equal(np.array([new.X, new.Y, new.Z]), np.array([old.X, old.Y, old.Z]))


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(("version", "point_format"), [("1.2", 1)])
def test_a_cloud_without_points_is_one_sentence(
    version: str, point_format: int, command: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "in.las"
    laspy.LasData(laspy.LasHeader(version=version, point_format=point_format)).write(path)
    assert through(command, folder, path, tmp_path / "o.laz") == 1
    assert capsys.readouterr().err == f"swath: {path}: holds no points\n"
    assert [each.name for each in tmp_path.iterdir()] == ["in.las"]
