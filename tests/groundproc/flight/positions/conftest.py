"""A rover that circles some hundred metres from a base station, and RTKLIB's own programs where they are installed."""

import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gnss
import numpy as np
import numpy.typing as npt
import pytest

from groundproc.flight.positions.scales import EPOCH_NS, gps_calendar_from_utc
from groundproc.flight.positions.solution import Solution

Array = npt.NDArray[np.float64]

WEEK, START_S = 2300, 302_400.0
BASE_PLACE = (58.39, 15.62, 110.0)


@dataclass(frozen=True)
class World:
    """Files of a flight of 60 s, rover at 5 Hz and base at 1 Hz, and the truth."""

    folder: Path
    rover: gnss.Receiver

    @property
    def base_m(self) -> Array:
        return gnss.ecef(*BASE_PLACE)

    def place_m(self, tow_s: Array) -> Array:
        """True rover positions, ECEF."""
        s = tow_s - START_S
        turn = 2 * np.pi * s / 40
        enu = np.stack(
            [400 + 60 * np.sin(turn), -250 + 60 * np.cos(turn), 25 + 3 * np.sin(2 * np.pi * s / 15)], axis=-1
        )
        return np.asarray(self.base_m + enu @ gnss.mat_enu_ecef(*BASE_PLACE[:2]))

    def velocity_m_s(self, solution: Solution) -> Array:
        """True east, north, up at the times of a solution, shape (n, 3)."""
        tow_s = (gps_calendar_from_utc(solution.time_ns) - EPOCH_NS) * 1e-9 - WEEK * 604_800
        way = self.place_m(tow_s + 0.01) - self.place_m(tow_s - 0.01)
        return np.asarray(way / 0.02 @ gnss.mat_enu_ecef(*BASE_PLACE[:2]).T)

    def errors_m(self, solution: Solution) -> Array:
        """East, north, up from the truth to a solution, shape (n, 3)."""
        tow_s = (gps_calendar_from_utc(solution.time_ns) - EPOCH_NS) * 1e-9 - WEEK * 604_800
        place = gnss.ecef(solution.latitude_deg, solution.longitude_deg, solution.height_m)
        return np.asarray((place - self.place_m(tow_s)) @ gnss.mat_enu_ecef(*BASE_PLACE[:2]).T)


@pytest.fixture(scope="session")
def make_world(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., World]:
    def make(seed: int, *, galileo: bool = False, **worse: Any) -> World:
        world = World(tmp_path_factory.mktemp(f"gnss{seed}"), None)  # type: ignore[arg-type]
        orbits = gnss.constellation(WEEK, START_S, seed, galileo=galileo)
        times_s = START_S + np.arange(0, 60, 0.2)
        rover = gnss.measure(orbits, world.place_m, times_s, seed=seed + 100, clock=(3.1e-4, 2e-7), **worse)
        still = lambda t: np.broadcast_to(world.base_m, (len(t), 3))  # noqa: E731
        base = gnss.measure(orbits, still, START_S - 10 + np.arange(0, 80.0), seed=seed + 200, clock=(-1e-4, -1e-7))
        folder = world.folder
        gnss.write_observations(folder / "rover.obs", rover)
        gnss.write_observations(folder / "base.obs", base, approximate_m=world.base_m)
        marker = world.base_m - 1.5 * gnss.mat_enu_ecef(*BASE_PLACE[:2])[2]
        if not galileo:  # version 2.11 is for GPS here
            gnss.write_observations(folder / "base.24o", base, version="2.11", approximate_m=marker, height_m=1.5)
            gnss.write_navigation(folder / "brdc.24n", orbits, version="2.11")
        gnss.write_observations(folder / "unplaced.obs", base)
        gnss.write_navigation(folder / "brdc.nav", orbits)
        gnss.write_ubx(folder / "rover.ubx", rover)
        gnss.write_ubx(folder / "base.ubx", base)
        return World(folder, rover)

    return make


@pytest.fixture(scope="session")
def world(make_world: Callable[..., World]) -> World:
    return make_world(1)


@pytest.fixture(scope="session")
def rtklib() -> None:
    for name in ("rnx2rtkp", "convbin"):
        if shutil.which(name) is None:
            pytest.skip(f"{name} is not installed (apt-packages.txt has rtklib)")


@pytest.fixture
def rnx2rtkp(rtklib: None, world: World, tmp_path: Path) -> Callable[..., Path]:
    """RTKLIB's own solver on the world's files, with settings: rnx2rtkp("out-solformat=xyz", ...)."""

    def run(*settings: str) -> Path:
        always = [
            "pos1-posmode=kinematic",
            "pos1-frequency=l1",
            "pos1-dynamics=off",
            "ant2-postype=rinexhead",
            "out-timendec=6",
        ]
        (tmp_path / "set.conf").write_text("\n".join([*always, *settings, ""]))
        output = tmp_path / f"out{len(list(tmp_path.iterdir()))}.pos"
        words = ["rnx2rtkp", "-k", "set.conf", "-o", str(output)]
        words += [str(world.folder / name) for name in ("rover.obs", "base.obs", "brdc.nav")]
        subprocess.run(words, cwd=tmp_path, check=True, capture_output=True)
        return output

    return run
