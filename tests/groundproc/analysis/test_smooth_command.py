"""`swath smooth` on a place of known shape: a house, a kerb, poles, a wire, grass and leaves, with the sensor's noise."""

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pytest

from groundproc.cli import main
from tests.groundproc.analysis.test_ground_command import write_cloud

Array = npt.NDArray[np.float64]

NOISE_M = 0.015
PER_M2 = 1200
ORIGIN = np.array([533_000.0, 6_472_000.0, 0.0])
HOUSE_M = np.array([3.5, 9.5])


class Place:
    """Things by name, each with true points, measured ones, and the directions in which they scatter."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(11)
        self.names: list[str] = []
        self.true: list[Array] = []
        self.normal: list[Array] = []

    def add(self, name: str, true: Array, normal: Array) -> None:
        self.names.append(name)
        self.true.append(true)
        self.normal.append(np.broadcast_to(normal, true.shape))

    def plane(
        self,
        name: str,
        corner: tuple[float, ...],
        along: tuple[float, ...],
        up: tuple[float, ...],
        per_m2: float = PER_M2,
    ) -> None:
        across = np.cross(along, up)
        area = float(np.linalg.norm(across))
        at = self.rng.random((int(area * per_m2), 2))
        self.add(name, np.array(corner) + at[:, :1] * along + at[:, 1:] * up, across / area)

    def pole(self, name: str, foot: tuple[float, float], radius_m: float) -> None:
        count = int(2 * np.pi * radius_m * 4 * PER_M2)
        angle = self.rng.uniform(0, 2 * np.pi, count)
        normal = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
        self.add(
            name, np.array([*foot, 0.0]) + radius_m * normal + self.rng.uniform(0, 4, (count, 1)) * [0, 0, 1], normal
        )


def village() -> Place:
    place = Place()
    # most of the area, of which little is asked
    place.plane("ground", (0, 0, 0), (14, 0, 0), (0, 12, 0), PER_M2 / 2)
    place.plane("kerb", (0, 12, 0.12), (14, 0, 0), (0, 2, 0))
    place.plane("wall", (4, 4, 0), (6, 0, 0), (0, 0, 3))
    place.plane("gable", (4, 4, 0), (0, 6, 0), (0, 0, 3))
    place.plane("roof", (3.6, 3.6, 3), (6.8, 0, 0), (0, 3.4, 2))
    place.plane("roof", (3.6, 10.4, 3), (6.8, 0, 0), (0, -3.4, 2))
    place.pole("trunk", (12.5, 2.5), 0.3)
    rng = place.rng
    along = rng.uniform(0, 14, 3000)
    across = rng.normal(size=(3000, 3)) * [0, 1, 1]
    wire = np.column_stack([along, np.full(3000, 1.0), 6 + 0.01 * (along - 7) ** 2])
    place.add("wire", wire, across / np.linalg.norm(across, axis=1)[:, None])
    place.add("leaves", np.array([12, 8, 4]) + 0.6 * rng.normal(size=(8000, 3)), np.array([0, 0, 1.0]))
    blades = np.column_stack([rng.uniform(0, 3, 20_000), rng.uniform(4, 10, 20_000), 0.02 + rng.gamma(2, 0.04, 20_000)])
    place.add("grass", blades, np.array([0, 0, 1.0]))
    return place


class Smoothed:
    """The place before and after."""

    def __init__(self, folder: Path) -> None:
        place = village()
        self.what = np.repeat(place.names, [len(each) for each in place.true])
        true, self.normal = np.concatenate(place.true), np.concatenate(place.normal)
        measured = true + self.normal * place.rng.normal(0, NOISE_M, len(true))[:, None]
        write_cloud(folder / "c.laz", measured)
        assert main(["smooth", str(folder / "c.laz"), "--json", str(folder / "f.json")]) == 0
        self.folder, self.true = folder, true + ORIGIN
        self.figures: dict[str, Any] = json.loads((folder / "f.json").read_text())
        self.before, self.after = laspy.read(folder / "c.laz"), laspy.read(folder / "c_smooth.laz")
        self.moved_m = np.asarray(self.after.xyz - self.before.xyz)

    def off_m(self, las: Any, what: str, rows: npt.NDArray[np.bool_] | None = None) -> float:
        """RMS distance from the true surface."""
        some = self.what == what
        some = some if rows is None else some & rows
        away = np.einsum("ni,ni->n", np.asarray(las.xyz)[some] - self.true[some], self.normal[some])
        return float(np.sqrt(np.mean(np.square(away))))

    def write_house(self, path: Path) -> npt.NDArray[np.bool_]:
        """What stands about the house, as it was before: less than half of all. Which points these are."""
        east_m = np.asarray(self.before.x) - ORIGIN[0]
        of_house = (east_m > HOUSE_M[0]) & (east_m < HOUSE_M[1])
        self.before[of_house].write(path)
        return of_house


@pytest.fixture(scope="module")
def smoothed(tmp_path_factory: pytest.TempPathFactory) -> Smoothed:
    return Smoothed(tmp_path_factory.mktemp("smooth"))


def test_the_noise_is_measured_on_the_smoothest_surfaces(smoothed: Smoothed) -> None:
    assert smoothed.figures["sigma_m"] == pytest.approx(NOISE_M, rel=0.1)


@pytest.mark.parametrize("what", ["wall", "gable", "roof", "trunk"])
def test_surfaces_come_nearer_to_the_truth_up_to_their_edges(smoothed: Smoothed, what: str) -> None:
    """A quadric of 100 points whose weights fall to the rim leaves some 0.3 of the noise, one at an edge 0.5 and more."""
    assert smoothed.off_m(smoothed.before, what) == pytest.approx(NOISE_M, rel=0.05)
    rows = np.asarray(smoothed.after.smoothed) == 1
    assert smoothed.off_m(smoothed.after, what, rows) < 0.45 * NOISE_M
    assert np.mean(rows[smoothed.what == what]) > 0.95


def test_the_sigma_of_the_surface_is_what_it_is_off(smoothed: Smoothed) -> None:
    rows = (np.asarray(smoothed.after.smoothed) == 1) & np.isin(smoothed.what, ["wall", "gable", "roof"])
    away = np.einsum("ni,ni->n", np.asarray(smoothed.after.xyz)[rows] - smoothed.true[rows], smoothed.normal[rows])
    told = np.asarray(smoothed.after.smoothing_sigma)[rows]
    assert np.mean(np.abs(away) < told) == pytest.approx(0.68, abs=0.06)
    assert np.mean(np.abs(away) < 2 * told) == pytest.approx(0.95, abs=0.03)


def test_wires_leaves_and_grass_stay_as_they_are(smoothed: Smoothed) -> None:
    share = {what: np.mean(smoothed.after.smoothed[smoothed.what == what]) for what in ("wire", "leaves", "grass")}
    assert share["wire"] == 0.0
    assert share["leaves"] < 0.01
    assert share["grass"] < 0.1  # what lies within the noise of the ground is ground
    untouched = smoothed.after.smoothed == 0
    assert np.all(smoothed.moved_m[untouched] == 0.0)
    assert np.all(np.isnan(smoothed.after.smoothing[untouched]) | (smoothed.after["smoothing"][untouched] < -3))


def test_no_point_is_moved_by_more_than_three_sigmas_and_each_says_by_how_much(smoothed: Smoothed) -> None:
    way = np.linalg.norm(smoothed.moved_m, axis=1)
    rows = np.asarray(smoothed.after.smoothed) == 1
    step = 0.001 * np.sqrt(3) / 2  # coordinates are whole millimetres
    assert way.max() <= smoothed.figures["largest_move_m"] + step
    assert smoothed.figures["largest_move_m"] == pytest.approx(3 * smoothed.figures["sigma_m"], abs=1e-4)
    assert np.abs(way[rows] - np.abs(smoothed.after.smoothing[rows])).max() < 2 * step


def test_the_copy_is_marked_and_else_the_same(smoothed: Smoothed) -> None:
    header = smoothed.after.header
    assert header.system_identifier.startswith("MODIFICATION")
    record = next(each for each in header.vlrs if each.user_id == "swath" and each.record_id == 2)
    told = json.loads(record.record_data_bytes())
    assert told["source"] == "c.laz"
    assert told["sigma_m"] == smoothed.figures["sigma_m"]
    assert sum(told["states"].values()) == len(smoothed.before.points)
    assert np.array_equal(smoothed.after.intensity, smoothed.before.intensity)
    assert header.parse_crs() == smoothed.before.header.parse_crs()


def test_a_smoothed_cloud_is_not_smoothed_again(smoothed: Smoothed, capsys: pytest.CaptureFixture[str]) -> None:
    out = smoothed.folder / "again.laz"
    assert main(["smooth", str(smoothed.folder / "c_smooth.laz"), "-o", str(out)]) == 1
    assert "is smoothed already" in capsys.readouterr().err
    assert not out.exists()


def test_squares_and_the_order_of_points_change_nothing(
    smoothed: Smoothed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Smoothed in one square and in many: a point hangs on its surroundings alone."""
    from groundproc.cloud import tiles

    monkeypatch.setattr(tiles, "AT_ONCE", 10_000)
    of_house = smoothed.write_house(tmp_path / "c.laz")
    assert main(["smooth", str(tmp_path / "c.laz"), "-o", str(tmp_path / "s.laz")]) == 0
    other, whole = laspy.read(tmp_path / "s.laz"), smoothed.after[of_house]
    inside = np.abs(np.asarray(whole.x) - ORIGIN[0] - HOUSE_M.mean()) < 0.5 * np.ptp(HOUSE_M) - 1.0
    # which points of a full voxel take part goes by their number in the square
    apart = np.linalg.norm(other.xyz - whole.xyz, axis=1)[inside]
    assert np.mean((other.smoothed == whole.smoothed)[inside]) > 0.99
    assert np.quantile(apart, 0.95) < 0.5 * NOISE_M


def test_noise_and_what_moves_lie_on_no_surface(smoothed: Smoothed, tmp_path: Path) -> None:
    smoothed.write_house(tmp_path / "h.laz")
    las = laspy.read(tmp_path / "h.laz")
    some = np.arange(len(las.points)) % 7 == 0
    las.classification[some] = 69
    las.write(tmp_path / "m.laz")
    assert main(["smooth", str(tmp_path / "m.laz"), "-o", str(tmp_path / "s.laz"), "--sigma", "0.02"]) == 0
    found = laspy.read(tmp_path / "s.laz")
    assert not found.smoothed[some].any()
    assert np.mean(found.smoothed[~some]) > 0.7


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--sigma", "3"], "--sigma 3 m: expected 0.0005 to 1 m"),
        (["-o", "o.copc.laz"], "this command writes no octree; expected o.laz"),
    ],
)
def test_what_cannot_be_is_refused(
    words: list[str], sentence: str, smoothed: Smoothed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main(["smooth", str(smoothed.folder / "c.laz"), "-o", "o.laz", *words]) == 2
    assert sentence in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.iterdir())


def test_a_cloud_without_surfaces_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_cloud(tmp_path / "c.laz", 3 * np.random.default_rng(3).normal(size=(5000, 3)))
    assert main(["smooth", str(tmp_path / "c.laz")]) == 1
    assert "nothing tells noise from shape" in capsys.readouterr().err
    assert [each.name for each in tmp_path.iterdir()] == ["c.laz"]
