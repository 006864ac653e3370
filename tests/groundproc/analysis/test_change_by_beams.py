"""`swath change` on a place that beams were followed into: boxes that come and go beside shrubs in the wind, and strips of one flight."""

import json
from pathlib import Path

import laspy
import numpy as np
import numpy.typing as npt
import pytest
from beamworld import ORIGIN, Echoes, Pass, Place, passes, scan, shrubs, write_las, write_track
from scipy.spatial.transform import Rotation

from groundproc.cli import main

Array = npt.NDArray[np.float64]
SIDE_M, EDGE_M, PER_M2 = 6.4, 0.1, 1100.0
WITHOUT = pytest.param(False, marks=pytest.mark.soak)
"""The same clouds once more; in the quick suite: boxes amid shrubs without trajectories (test_change_command)."""


@pytest.fixture(scope="module")
def flown() -> tuple[Array, Array, list[Pass], Echoes, Echoes]:
    """Places of boxes that vanish and that appear, lines, and what came back before and after."""
    rng = np.random.default_rng(21)
    grid = np.stack(np.meshgrid(np.arange(0.8, 6.2, 1.2), np.arange(0.8, 6.2, 1.2)), axis=-1).reshape(-1, 2)
    bushes = shrubs(rng, grid[[6, 13, 21]], leaves=120)
    places = grid[[0, 2, 4, 9, 10, 14, 15, 17, 18, 24]] + rng.uniform(-0.1, 0.1, (10, 2))
    gone, new, stay = places[:4], places[4:8], places[8:]
    lines = passes(SIDE_M, count=4)
    before, after = (
        Place(SIDE_M, boxes=[(x, y, EDGE_M) for x, y in [*own, *stay]], shrubs=bushes) for own in (gone, new)
    )
    return gone, new, lines, scan(before, lines, PER_M2, 1), scan(after, lines, PER_M2, 2)


@pytest.mark.parametrize("beams", [WITHOUT, True])
def test_boxes_that_came_and_went_are_found_beside_shrubs_in_the_wind(
    tmp_path: Path, flown: tuple[Array, Array, list[Pass], Echoes, Echoes], beams: bool
) -> None:
    gone, new, lines, before, after = flown
    turned = (Rotation.from_rotvec(np.radians([0.1, -0.1, 0.3])).as_matrix(), np.array([0.12, -0.08, 0.04]))
    words = ["change", str(write_las(tmp_path / "a.las", before))]
    words += [str(write_las(tmp_path / "b.las", after, None if beams else turned)), "-o", str(tmp_path / "o")]
    if beams:
        track = str(write_track(tmp_path / "t.csv", lines))
        words += ["--trajectory-a", track, "--trajectory-b", track]
    assert main(words) == 0
    found = [each["properties"] for each in json.loads((tmp_path / "o" / "changes.geojson").read_text())["features"]]
    false = 0
    for kind, true in (("appeared", new), ("vanished", gone)):
        place = np.array([[each["x"], each["y"]] for each in found if each["kind"] == kind]).reshape(-1, 2) - ORIGIN[:2]
        apart = np.linalg.norm(place[:, None] - true[None], axis=2)
        assert (apart.min(axis=0, initial=np.inf) < 0.15).all()
        false += int((apart.min(axis=1, initial=np.inf) > 0.2).sum())
    assert false <= 5 * SIDE_M**2 / 100


def test_strips_of_one_flight_differ_by_nothing(
    tmp_path: Path, flown: tuple[Array, Array, list[Pass], Echoes, Echoes]
) -> None:
    _, _, lines, before, _ = flown
    words = ["change", str(write_las(tmp_path / "a.las", before.of_lines([0, 2])))]
    words += [str(write_las(tmp_path / "b.las", before.of_lines([1, 3]))), "-o", str(tmp_path / "o")]
    track = str(write_track(tmp_path / "t.csv", lines))
    assert main([*words, "--trajectory-a", track, "--trajectory-b", track]) == 0
    cloud = laspy.read(tmp_path / "o" / "change.laz")
    voxel = np.floor(np.asarray(cloud.xyz) / EDGE_M).astype(int)
    state = np.asarray(cloud["change"])
    claimed, seen = (len(np.unique(voxel[chosen], axis=0)) for chosen in (np.isin(state, (1, 2)), state != 3))
    assert claimed < 0.001 * seen


@pytest.mark.parametrize("beams", [WITHOUT, True])
def test_sides_that_only_one_flight_saw_are_unseen(tmp_path: Path, beams: bool) -> None:
    # crates that stay, seen from lower lines, there in the one flight and across in the other; strips are off by some millimetres
    grid = np.stack(np.meshgrid(np.arange(1.0, 6.0, 1.4), np.arange(1.0, 6.0, 1.4)), axis=-1).reshape(-1, 2)
    rng = np.random.default_rng(8)
    crates = [(x, y, size) for (x, y), size in zip(grid[::2], rng.uniform(0.3, 0.9, 8), strict=True)]
    gone, new = grid[1::4], grid[3::4]
    words = ["change"]
    for name, own, across in (("a", gone, False), ("b", new, True)):
        place = Place(SIDE_M, boxes=[*crates, *((x, y, EDGE_M) for x, y in own)])
        lines = []
        for n, at in enumerate((1.6, 4.6)):
            ends = ((-6.0, at, 7.0), (SIDE_M + 6.0, at, 7.0))
            if across:
                ends = ((at, -6.0, 7.0), (at, SIDE_M + 6.0, 7.0))
            lines.append(Pass(*ends, 40.0 * n))
        echoes = scan(place, lines, PER_M2, 3 + across)
        echoes.xyz_m += rng.normal(0, 0.007, (2, 3))[echoes.line]
        words += [str(write_las(tmp_path / f"{name}.las", echoes))]
        if beams:
            words += [f"--trajectory-{name}", str(write_track(tmp_path / f"{name}.csv", lines))]
    assert main([*words, "-o", str(tmp_path / "o")]) == 0
    found = [each["properties"] for each in json.loads((tmp_path / "o" / "changes.geojson").read_text())["features"]]
    false, hits = 0, 0
    for kind, true in (("appeared", new), ("vanished", gone)):
        place_m = (
            np.array([[each["x"], each["y"]] for each in found if each["kind"] == kind]).reshape(-1, 2) - ORIGIN[:2]
        )
        apart = np.linalg.norm(place_m[:, None] - true[None], axis=2)
        hits += int((apart.min(axis=0, initial=np.inf) < 0.15).sum())
        false += int((apart.min(axis=1, initial=np.inf) > 0.2).sum())
    assert hits >= 0.9 * (len(gone) + len(new))
    assert false <= 5 * SIDE_M**2 / 100
