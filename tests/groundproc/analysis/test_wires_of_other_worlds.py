"""`swath wires` on lines that another generator hangs and scans: slopes, bends, bundles, racks, slack wires, crowns beside wires."""

import json
from itertools import pairwise
from pathlib import Path

import hanging
import hangingsites
import laspy
import numpy as np
import pytest
from scipy.spatial import cKDTree

from groundproc.cli import main
from tests.groundproc.analysis.test_wires_command import ORIGIN, write_cloud

SOAK = pytest.mark.soak
FINE = 0.98
"""Of the points near wires: two sigma of a pass and of the noise, on the way to one of five passes, is 5 cm."""


def told(folder: Path) -> list[tuple[np.ndarray, float]]:
    tree = json.loads((folder / "w.geojson").read_text())
    return [
        (np.array(each["geometry"]["coordinates"]) - ORIGIN, each["properties"]["sag_m"])
        for each in tree["features"]
        if each["properties"]["kind"] in ("conductor", "guard")
    ]


def found(wire: hanging.Hung, lines: list[tuple[np.ndarray, float]]) -> int | None:
    """Number of the line that lies within 15 cm of nearly all of a wire."""
    places = wire.places(np.linspace(0.02, 0.98, 200))
    for number, (line, _) in enumerate(lines):
        dense = np.concatenate([a + np.linspace(0, 1, 10)[:, None] * (b - a) for a, b in pairwise(line)])
        if np.mean(cKDTree(dense).query(places)[0] < 0.15) > 0.95:
            return number
    return None


def unmet(site: hanging.Site, xyz: np.ndarray, of: np.ndarray) -> np.ndarray:
    """How much of each wire's ends was met by no beam and is told by no pole [m], shape (wires, 2)."""
    poles = np.array([each[:2] for each in site.poles])
    gap = np.zeros((len(site.wires), 2))
    for number, wire in enumerate(site.wires):
        for end in range(2):
            place = wire.ends_m[end]
            if np.linalg.norm(poles - place[:2], axis=1).min() > 2.0:
                gap[number, end] = np.linalg.norm(xyz[of == number] - place, axis=1).min()
    return gap


@pytest.mark.parametrize(
    ("name", "answers", "between_m"),
    [
        # a world of many: one in the quick suite
        pytest.param("angle", 0.03, 0.04, marks=SOAK),
        ("telephone", 0.5, 0.02),
        *(pytest.param(name, answers, 0.03, marks=SOAK) for name in hangingsites.SITES for answers in (0.06, 0.7)),
    ],
)
def test_every_span_is_found_with_its_sag_and_its_clearance(
    name: str, answers: float, between_m: float, tmp_path: Path
) -> None:
    site = hangingsites.SITES[name]()
    site.answers = answers
    xyz, of = hanging.scanned(site, 1, between_m=between_m, beams=12_000)
    cloud = write_cloud(tmp_path / "c.laz", xyz)
    assert main(["wires", str(cloud), "-o", str(tmp_path / "w.geojson"), "--clearance", str(tmp_path / "o.laz")]) == 0
    lines = told(tmp_path)
    numbers = [found(wire, lines) for wire in site.wires]
    assert None not in numbers
    assert len(set(numbers)) == len(lines)
    for wire, number in zip(site.wires, numbers, strict=True):
        assert number is not None
        assert lines[number][1] == pytest.approx(wire.sag_m, abs=0.05)
        ends = lines[number][0][[0, -1]]
        apart = [np.linalg.norm(ends - each, axis=1).max() for each in (wire.ends_m, wire.ends_m[::-1])]
        assert min(apart) < 0.3
    true, place = cKDTree(np.concatenate([each.places(np.linspace(0, 1, 3000)) for each in site.wires])).query(xyz)
    near = (true > 0.5) & (true < 30.0)
    off = np.abs(np.asarray(laspy.read(tmp_path / "o.laz")["clearance"]) - true)
    wire, along = place // 3000, place % 3000
    open_m = unmet(site, xyz, of)
    allowed = 0.05 + np.where(along == 0, open_m[wire, 0], 0.0) + np.where(along == 2999, open_m[wire, 1], 0.0)
    assert np.mean(off[near] < allowed[near]) > FINE
