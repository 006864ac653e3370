"""Figures of soil, moving things, panes, pipes and passability, on places of known truth: a part of `uses.py`.

soil_found, soil_false_per_100m2
                     patches of 0.5 m and 3 cm, 300 points/m2: on even ground in one epoch, and amid stones of 6 cm between two
moving_things_found, moving_speed_sigmas
                     people and cars that are one track each; root mean square of the errors of velocities, in their sigmas
windows_behind_panes, windows_false_percent
                     share of the points behind panes that are classed, beams known; and of walls, ground and hedges that are
windows_behind_panes_no_beams
                     the same share without a trajectory
pipes_diameter_worst_m
                     largest error of two pipes
passability_agreement
                     share of the cells of a yard, 2 m from any edge, where it says what is true
"""

import json
import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any, Final

import laspy
import numpy as np
import rasterio

from groundproc.analysis.tracks import bursts, tracks
from groundproc.cli import main as swath
from groundproc.cloud.classes import PANE

_YARD: Final = ((47, 22, 59, 58, 1), (47, 2, 58, 18, 2), (2, 2, 12, 38, 1), (33, 2, 43, 58, 1))
"""West, south, east, north of what is passable (1) or too steep (2)."""


def run(*words: object) -> None:
    """One command, without its table."""
    with redirect_stdout(StringIO()):
        if swath([str(each) for each in words]) != 0:
            raise SystemExit(f"swath {words[0]} failed")


def soil(folder: Path) -> dict[str, Any]:
    """Twice 25 patches."""
    from simulator import epochs
    from tests.groundproc.analysis import test_soil_command as dug

    found, false = [], 0
    for seed in (1, 2):
        one = dug.ground(folder, "one", dug.smooth, True, seed)
        run("soil", one, "-o", folder / "s.geojson", "--force")
        rough = epochs.rough(seed, (0.1, 0.05), 0.06)
        a, b = dug.ground(folder, "a", rough, False, 10 + seed), dug.ground(folder, "b", rough, True, 20 + seed)
        run("soil", b, "--before", a, "-o", folder / "t.geojson", "--force")
        for name in ("s.geojson", "t.geojson"):
            rate, wrong, _, _ = dug.judge(folder / name)
            found, false = [*found, rate], false + wrong
    return {
        "soil_found": round(float(np.mean(found)), 3),
        "soil_false_per_100m2": round(false / (4 * dug.SIDE_M**2 / 100.0), 3),
    }


def moving(folder: Path) -> dict[str, Any]:
    """Two people and two cars, five times."""
    del folder
    from tests.groundproc.analysis import test_moving_command as moves

    off, whole = [], 0
    for seed in range(5):
        found = tracks(bursts(*moves.seen(seed)))
        met = []
        for each in found:
            apart = [np.hypot(*(each.place_m[0, :2] - thing[:2])) for thing in moves.THINGS]
            met.append(int(np.argmin(apart)))
            off.append((each.velocity_m_s - np.array(moves.THINGS[met[-1]][2:4])) / each.sigma_m_s[:, None])
        whole += sum(met.count(number) == 1 for number in range(len(moves.THINGS)))
    return {
        "moving_things_found": whole / (5 * len(moves.THINGS)),
        "moving_speed_sigmas": round(float(np.sqrt(np.mean(np.concatenate(off) ** 2))), 2),
    }


def windows(folder: Path) -> dict[str, Any]:
    """A house with eight windows."""
    from strips import Scene

    from tests.groundproc.analysis import test_windows_command as panes

    echoes = panes.house()
    cloud = panes.write(folder / "c.laz", echoes)
    Scene([], [panes.STRIP]).write_trajectory(folder / "t.csv")
    run("windows", cloud, "-t", folder / "t.csv", "-o", folder / "w.laz")
    kind = np.asarray(laspy.read(folder / "w.laz").classification) == PANE
    echoes["rank"], echoes["of"] = np.ones_like(echoes["rank"]), np.ones_like(echoes["of"])
    run("windows", panes.write(folder / "p.laz", echoes), "-o", folder / "n.laz")
    blind = np.asarray(laspy.read(folder / "n.laz").classification) == PANE
    room = echoes["kind"] == panes.ROOM
    outside = np.isin(echoes["kind"], [panes.WALL, panes.TREE]) & (echoes["xyz"][:, 1] < 0.1)
    return {
        "windows_behind_panes": round(float(kind[room].mean()), 4),
        "windows_false_percent": round(100.0 * float(kind[outside].mean()), 3),
        "windows_behind_panes_no_beams": round(float(blind[room].mean()), 4),
    }


def pipes(folder: Path) -> dict[str, Any]:
    """One half sunk, one on saddles."""
    from tests.groundproc.analysis import test_ground_command as places
    from tests.groundproc.analysis import test_pipes_command as tubes

    rng = np.random.default_rng(5)
    ground = np.column_stack([rng.uniform((0, 0), (60, 45), (60 * 45 * 60, 2)), np.zeros(60 * 45 * 60)])
    ground[:, 2] += tubes.NOISE_M * rng.standard_normal(len(ground))
    parts = [ground, tubes.tube(rng, tubes.LONG, 0.3, 250), tubes.tube(rng, tubes.SHORT, 0.5, 250)]
    cloud = places.write_cloud(folder / "c.laz", np.concatenate(parts))
    run("pipes", cloud, "-o", folder / "p.geojson", "--json", folder / "f.json")
    found = json.loads((folder / "f.json").read_text())["pipes"]
    true = (0.6, 1.0)
    off = [abs(each["diameter_m"] - by) for each, by in zip(found, true, strict=True)] if len(found) == 2 else [np.inf]
    return {"pipes_diameter_worst_m": round(max(off), 4) if np.isfinite(off).all() else None}


def passability(folder: Path) -> dict[str, Any]:
    """A yard with slopes."""
    from tests.groundproc.analysis import test_ground_command as places
    from tests.groundproc.analysis import test_passability_command as yard

    cloud = places.write_cloud(folder / "c.laz", yard.yard())
    run("passability", cloud, "-o", folder / "out")
    with rasterio.open(folder / "out" / "passability.tif") as file:
        kind, corner = file.read(1), file.transform
    right = cells = 0
    for west, south, east, north, true in _YARD:
        left, top = ~corner * (west + places.ORIGIN[0], north + places.ORIGIN[1])
        end, low = ~corner * (east + places.ORIGIN[0], south + places.ORIGIN[1])
        part = kind[round(top) : round(low), round(left) : round(end)]
        right, cells = right + int((part == true).sum()), cells + part.size
    return {"passability_agreement": round(right / cells, 4)}


def _in_a_folder(use: Callable[[Path], dict[str, Any]]) -> Callable[[], dict[str, Any]]:
    def measured() -> dict[str, Any]:
        with tempfile.TemporaryDirectory(prefix="swath-uses-") as folder:
            return use(Path(folder))

    return measured


FIGURES: Final[dict[str, Callable[[], dict[str, Any]]]] = {
    use.__name__: _in_a_folder(use) for use in (soil, moving, windows, pipes, passability)
}
