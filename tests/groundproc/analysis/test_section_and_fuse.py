"""`swath section` and `swath fuse`: points come out as they went in."""

import json
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
from matplotlib.axes import Axes
from scipy.spatial.transform import Rotation

from groundproc.analysis.registration import register
from groundproc.cli import main

ORIGIN = np.array([533_000.0, 6_472_000.0, 100.0])


def write(path: Path, xyz: np.ndarray, point_format: int = 6, epsg: int = 32633) -> Path:
    header = laspy.LasHeader(version="1.4" if point_format > 5 else "1.2", point_format=point_format)
    header.scales, header.offsets = [0.001] * 3, ORIGIN
    header.add_crs(pyproj.CRS.from_epsg(epsg))
    header.add_extra_dim(laspy.ExtraBytesParams("own", np.int16, "another program's"))
    las = laspy.LasData(header)
    las.xyz = xyz + ORIGIN
    las.intensity = np.arange(len(xyz)) % 60_000
    las["own"] = np.arange(len(xyz)) % 1000
    las.classification = np.arange(len(xyz)) % 7
    las.return_number = las.number_of_returns = np.ones(len(xyz), np.uint8)
    if "red" in las.point_format.dimension_names:
        las.red = np.arange(len(xyz)) % 65_000
    las.write(path)
    return path


def test_a_section_keeps_what_lies_near_the_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(1)
    xyz = rng.uniform((0, 0, 0), (50, 40, 10), (40_000, 3)).round(3)
    write(tmp_path / "a.laz", xyz)
    line = f"{ORIGIN[0] + 5},{ORIGIN[1] + 5},{ORIGIN[0] + 45},{ORIGIN[1] + 35}"
    words = ["section", str(tmp_path / "a.laz"), "--line", line, "--width", "0.8", "-o", str(tmp_path / "s.laz")]
    assert (
        main(
            [*words, "--picture", str(tmp_path / "s.png"), "--colour", "intensity", "--json", str(tmp_path / "s.json")]
        )
        == 0
    )
    along, across = (xyz[:, :2] - 5) @ (0.8, 0.6), (xyz[:, :2] - 5) @ (-0.6, 0.8)
    inside = (along >= 0) & (along <= 50) & (np.abs(across) <= 0.4)
    found = laspy.read(tmp_path / "s.laz")
    np.testing.assert_allclose(found.xyz, xyz[inside] + ORIGIN, rtol=0, atol=1e-6)
    assert (np.asarray(found["own"]) == np.flatnonzero(inside) % 1000).all()
    np.testing.assert_allclose(found["along"], along[inside], rtol=0, atol=1e-6)
    assert json.loads((tmp_path / "s.json").read_text())["points"] == inside.sum()
    assert (tmp_path / "s.png").stat().st_size > 10_000
    capsys.readouterr()
    for line, expected in (
        ("0,0,10,10", "no point lies within"),
        ("1,1,1,1", "expected more than 0"),
        ("1,2,3", "4 numbers"),
    ):
        assert main(["section", str(tmp_path / "a.laz"), "--line", line, "-o", str(tmp_path / "t.laz")]) in (1, 2)
        assert expected in capsys.readouterr().err
        assert not (tmp_path / "t.laz").exists()


def test_a_picture_of_feet_is_in_metres_and_of_one_station_is_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(3)
    xyz = np.column_stack([rng.uniform(0, 100, 500), np.zeros(500), rng.uniform(0, 50, 500)])  # in feet
    write(tmp_path / "feet.laz", xyz, epsg=2277)
    write(tmp_path / "one.laz", np.zeros((1, 3)))
    drawn: list[np.ndarray] = []
    plain = Axes.scatter
    monkeypatch.setattr(Axes, "scatter", lambda self, x, z, **more: (drawn.append(z), plain(self, x, z, **more))[1])
    for name in ("feet", "one"):
        ends = f"{ORIGIN[0]},{ORIGIN[1]},{ORIGIN[0] + 100},{ORIGIN[1]}"
        words = ["section", str(tmp_path / f"{name}.laz"), "--line", ends, "-o", str(tmp_path / f"{name}_s.laz")]
        assert main([*words, "--picture", str(tmp_path / f"{name}.png")]) == 0
    np.testing.assert_allclose(np.ptp(drawn[0]), np.ptp(xyz[:, 2]) * 1200 / 3937, rtol=0, atol=0.01)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--colour", "nosuch", "--picture", "p.png"], "--colour nosuch: expected one of z, "),
        (["--width", "inf"], "finite"),
        (["--width", "nan"], "finite"),
    ],
)
def test_a_section_that_cannot_be_leaves_nothing(
    tmp_path: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "a.laz", np.zeros((3, 3)))
    line = f"{ORIGIN[0]},{ORIGIN[1]},{ORIGIN[0] + 9},{ORIGIN[1]}"
    words = [str(tmp_path / each) if each.endswith(".png") else each for each in words]
    assert main(["section", str(tmp_path / "a.laz"), "--line", line, "-o", str(tmp_path / "s.laz"), *words]) == 2
    assert said in capsys.readouterr().err
    assert [each.name for each in tmp_path.iterdir()] == ["a.laz"]


def surface(rng: np.random.Generator, count: int) -> np.ndarray:
    xy = rng.uniform(0, 25, (count, 2))
    z = 0.8 * np.sin(xy[:, 0] / 3) + 0.5 * np.cos(xy[:, 1] / 2.5)
    wall = np.column_stack([rng.uniform(5, 15, count // 5), np.full(count // 5, 12.0), rng.uniform(1, 5, count // 5)])
    return np.asarray(np.concatenate([np.column_stack([xy, z]), wall]) + rng.normal(0, 0.01, (count + count // 5, 3)))


def test_clouds_of_other_kinds_are_laid_on_the_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(2)
    a, b = surface(rng, 60_000), surface(rng, 40_000)
    turn, shift = Rotation.from_rotvec(np.radians([0.2, 0.1, -0.6])), np.array([0.3, 0.2, -0.1])
    write(tmp_path / "a.laz", a)
    write(tmp_path / "b.laz", turn.apply(b) + shift, 3)
    words = ["fuse", str(tmp_path / "a.laz"), str(tmp_path / "b.laz"), "-o", str(tmp_path / "f.laz")]
    assert main([*words, "--json", str(tmp_path / "f.json")]) == 0
    found = laspy.read(tmp_path / "f.laz")
    assert len(found) == len(a) + len(b)
    np.testing.assert_allclose(found.xyz[: len(a)], a + ORIGIN, rtol=0, atol=0.00051)
    assert np.abs((found.xyz[len(a) :] - b - ORIGIN).mean(axis=0)).max() < 0.003
    assert (np.asarray(found["epoch"]) == np.repeat([0, 1], [len(a), len(b)])).all()
    assert (np.asarray(found.red)[len(a) :] == np.arange(len(b)) % 65_000).all()
    assert (np.asarray(found["own"])[len(a) :] == np.arange(len(b)) % 1000).all()
    assert (np.asarray(found.classification)[len(a) :] == np.arange(len(b)) % 7).all()
    assert json.loads((tmp_path / "f.json").read_text())["clouds"][1]["residual_m"] < 0.02
    write(tmp_path / "c.laz", rng.uniform(0, 25, (30_000, 3)))
    capsys.readouterr()
    assert main(["fuse", str(tmp_path / "a.laz"), str(tmp_path / "c.laz"), "-o", str(tmp_path / "g.laz")]) == 1
    told = capsys.readouterr().err
    assert "of one place" in told or "on surfaces found" in told
    assert not (tmp_path / "g.laz").exists()


def test_a_block_of_a_third_that_moved_as_one_does_not_pull() -> None:
    rng = np.random.default_rng(5)
    a, b = yard(rng, 40_000), yard(rng, 40_000)
    block = (b[:, :2] < 2.0).all(axis=1)
    assert 0.25 < block.mean() < 0.35
    b[block] += (0.1, 0.0, -0.15)
    turn, shift = Rotation.from_rotvec(np.radians([0.1, -0.05, 0.28])), np.array([0.2, -0.18, 0.12])
    found = register(a, turn.inv().apply(b - shift))
    off = Rotation.from_matrix(found.matrix[:3, :3]) * turn.inv()
    assert np.rad2deg(off.magnitude()) < 0.01
    assert np.abs(found.move(turn.inv().apply(-shift)[None])).max() < 0.002


def test_what_fits_moved_along_itself_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Flat roofs on a plain without their walls: any shift puts plain on plain."""
    rng = np.random.default_rng(6)
    for name, shift in (("a", 0.0), ("b", 12.0)):
        xyz = np.column_stack([rng.uniform(0, 40, (30_000, 2)), rng.normal(0, 0.01, 30_000)])
        xyz[(np.abs(xyz[:, :2] - 15.0) < 4.0).all(axis=1), 2] += 4.0
        write(tmp_path / f"{name}.laz", xyz + np.array([shift, 0.0, 0.0]))
    assert main(["fuse", str(tmp_path / "a.laz"), str(tmp_path / "b.laz"), "-o", str(tmp_path / "f.laz")]) == 1
    assert "fit as well moved along each other" in capsys.readouterr().err
    assert not (tmp_path / "f.laz").exists()
    assert main(["fuse", str(tmp_path / "a.laz"), "-o", str(tmp_path / "f.laz")]) == 2
    assert "one cloud given" in capsys.readouterr().err


def yard(rng: np.random.Generator, count: int, sheds: int = 9, seed: int = 4) -> np.ndarray:
    """Uneven ground with sheds at places of their own, their walls too, 1 cm of noise."""
    places = np.random.default_rng(seed)
    xy = rng.uniform(-25, 25, (count, 2))
    z = 0.3 * np.sin(xy[:, 0] / 4) + 0.2 * np.cos(xy[:, 1] / 3)
    walls: list[np.ndarray] = []
    for _ in range(sheds):
        middle, half = places.uniform(-20, 20, 2), places.uniform(1.0, 3.0, 2)
        inside = (np.abs(xy - middle) < half).all(axis=1)
        z[inside] = 2.5 + 0.1 * (xy[inside, 0] - middle[0])
        for axis in (0, 1):
            wall = np.column_stack(
                [middle + half * rng.uniform(-1, 1, (count // 100, 2)), rng.uniform(0.5, 2.3, count // 100)]
            )
            wall[:, axis] = middle[axis] + half[axis]
            walls.append(wall)
    xyz = np.concatenate([np.column_stack([xy, z]), *walls])
    return np.asarray(xyz + rng.normal(0, 0.01, xyz.shape))


def test_a_cloud_of_unknown_place_and_heading_is_found(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    a, b = yard(rng, 60_000), yard(rng, 60_000)
    b = b[b[:, 0] > -12.0]  # three quarters of it
    turn, shift = Rotation.from_euler("ZX", [143.0, 0.3], degrees=True), np.array([-310.0, 95.0, 7.0])
    write(tmp_path / "a.laz", a)
    write(tmp_path / "b.laz", turn.apply(b) + shift)
    words = ["fuse", str(tmp_path / "a.laz"), str(tmp_path / "b.laz"), "-o", str(tmp_path / "f.laz")]
    assert main([*words, "--search", "--json", str(tmp_path / "f.json")]) == 0
    found = laspy.read(tmp_path / "f.laz").xyz[len(a) :] - ORIGIN - b
    assert np.abs(found.mean(axis=0)).max() < 0.002
    told = json.loads((tmp_path / "f.json").read_text())["clouds"][1]
    off = Rotation.from_matrix(np.array(told["matrix"])[:3, :3]) * turn
    assert np.rad2deg(off.magnitude()) < 0.01
    assert told["correlation"] > 0.7


def test_another_place_is_not_taken_for_the_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(3)
    write(tmp_path / "a.laz", yard(rng, 30_000))
    write(tmp_path / "c.laz", yard(rng, 30_000, seed=5))
    not_laid(tmp_path, "c", "no place of the second", capsys)


def not_laid(folder: Path, second: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A search that finds nothing, or too much."""
    words = ["fuse", str(folder / "a.laz"), str(folder / f"{second}.laz"), "-o", str(folder / "g.laz"), "--search"]
    capsys.readouterr()
    assert main(words) == 1
    assert said in capsys.readouterr().err
    assert not (folder / "g.laz").exists()


# one more search through all headings; in the quick suite: what fits moved along itself is refused (above)
@pytest.mark.soak
def test_what_fits_at_two_places_is_not_chosen_between(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(3)
    half = yard(rng, 60_000, sheds=0)
    half[:, 2] = np.where((np.abs(half[:, 0]) < 6) & (np.abs(half[:, 1]) < 3), 3.0, 0.0) + rng.normal(
        0, 0.01, len(half)
    )
    write(tmp_path / "a.laz", half[::2])
    write(tmp_path / "b.laz", half[1::2])
    not_laid(tmp_path, "b", "at two places alike", capsys)
