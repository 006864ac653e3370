"""Method `adjusted` with what is known of the earth: positions of another program, from the log on, against the simulation's truth."""

import datetime as dt
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyproj
import pytest
import tied
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from flightlog import frames
from flightlog.logfile import LogReader
from groundproc.accuracy.judge import judge
from groundproc.accuracy.truth import Truth, on_lidar_clock, read_truth
from groundproc.cli import main
from groundproc.estimation import methods
from groundproc.estimation.adjustment import adjusted, windows
from groundproc.estimation.method import Given, gather
from groundproc.flight.flight import read_flight
from groundproc.survey import Survey
from groundproc.trajectory.estimate import Estimate

Array = npt.NDArray[np.float64]
EPOCH = dt.datetime(1970, 1, 1, tzinfo=dt.UTC)
UNDULATION_M = 29.354
"""Of the simulator's origin."""
ANTENNA = np.array([0.1, -0.2, 0.3])


@pytest.fixture(scope="module")
def flight(house_flight: Any) -> Any:
    """The flight of the tests of the adjustment itself."""
    return house_flight


@contextmanager
def given_of(truth: Truth, survey: Survey) -> Iterator[Given]:
    with LogReader(truth.log) as reader:
        read = read_flight([reader], "ins")
        mount = replace(truth.nominal_mount, gps_position_m=tuple(ANTENNA.tolist()))
        timeline = tied.timeline(truth.log, read, mount.mat_ins_lidar())
        yield gather([reader], read, timeline, mount, survey)


@dataclass
class Made:
    """An estimate with errors of the sensor's poses in the local frame, unaligned, and its error after alignment."""

    estimate: Estimate
    position_m: Array
    sigma_m: Array
    turn_rad: Array
    relative_m: float


def made(folder: Path, survey: Survey, solved: Estimate | None = None) -> Made:
    truth = read_truth(folder)
    with given_of(truth, survey) as given:
        estimate = solved or methods.estimate(given, lambda stage, size: None)
        lasers = estimate.corrections.table(given.lidar.lasers)
        found = on_lidar_clock(estimate.trajectory, given.timeline[0].lidar_line, truth)
    true, covered = truth.trajectory.where_covered(found.time_ns)
    mat, mat_true = (
        frames.mat_from_quat(q) for q in (found.quat_local_ins_wxyz[covered], true.quat_local_ins_wxyz[covered])
    )
    place = found.position_m[covered] + mat @ estimate.mount.lidar_position_m()
    place_true = true.position_m[covered] + mat_true @ truth.mount.lidar_position_m()
    turn = mat @ estimate.mount.mat_ins_lidar() @ np.swapaxes(mat_true @ truth.mount.mat_ins_lidar(), 1, 2)
    figures = judge([], truth, found, estimate.mount, lasers).figures
    sigma = found.sigma_position_m[covered]
    return Made(
        estimate, place - place_true, sigma, frames.quat_log(frames.quat_from_mat(turn)), float(figures["ate_m"])
    )


@pytest.fixture(scope="module")
def plain(flight: Any, adjustment: Callable[[Any], Estimate]) -> Made:
    return made(flight.folder, Survey(method="adjusted"), adjustment(flight))


def write_pos(folder: Path, out: Path, sigma_m: Array, rng: np.random.Generator, wrong: slice = slice(0, 0)) -> None:
    """What RTKLIB would write of an antenna, 5 Hz, in GPS time and ellipsoidal heights; a stretch of it is half a metre off."""
    poses = np.genfromtxt(folder / "truth.csv", delimiter=",", names=True, dtype=None)[137::100]
    angles = np.stack([-poses["heading_deg"], poses["pitch_deg"], poses["roll_deg"]], axis=1)
    local = np.stack([poses["east_m"], poses["north_m"], poses["up_m"]], axis=1)
    local += Rotation.from_euler("ZXY", angles, degrees=True).apply(ANTENNA)
    local += sigma_m * rng.standard_normal(local.shape)
    local[wrong] += [0.3, -0.3, 0.3]
    origin = read_truth(folder).content["local_origin"]
    to_local = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +step +proj=topocentric "
        f"+lat_0={origin['latitude_deg']} +lon_0={origin['longitude_deg']} +h_0={origin['height_msl_m'] + UNDULATION_M}"
    )
    east, north, up = local.T
    longitude, latitude, height = to_local.transform(east, north, up, direction="INVERSE")
    lines = [
        "%  GPST  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio"
    ]
    for i, utc_ns in enumerate(poses["utc_ns"].tolist()):
        stamp = EPOCH + dt.timedelta(microseconds=utc_ns // 1000 + 18_000_000)
        lines.append(
            f"{stamp:%Y/%m/%d %H:%M:%S}.{stamp.microsecond // 1000:03d} {latitude[i]:.10f} {longitude[i]:.10f} {height[i]:.4f} 1 12 "
            f"{sigma_m[1]:.4f} {sigma_m[0]:.4f} {sigma_m[2]:.4f} 0 0 0 0.0 50.0"
        )
    out.write_text("\n".join(lines) + "\n")


SIGMA = np.array([0.01, 0.01, 0.015])


@pytest.fixture(scope="module")
def positioned(flight: Any, tmp_path_factory: pytest.TempPathFactory) -> Made:
    path = tmp_path_factory.mktemp("positions") / "better.pos"
    write_pos(flight.folder, path, SIGMA, np.random.default_rng(4))
    return made(flight.folder, Survey(positions=str(path), geoid=UNDULATION_M))


def test_centimetre_positions_make_the_whole_right_to_centimetres(plain: Made, positioned: Made) -> None:
    assert positioned.estimate.method == "adjusted"
    assert not positioned.estimate.warning
    # without, the GNSS's metres
    assert np.linalg.norm(plain.position_m.mean(axis=0)) > 0.3
    assert np.sqrt(np.mean(np.square(positioned.position_m).sum(axis=1))) < 0.03
    assert (np.abs(positioned.position_m) < 3.0 * positioned.sigma_m).mean() > 0.95
    assert (np.median(positioned.sigma_m, axis=0) < 0.05).all()
    # the heading of the whole is that of the track, 15 m of it known to some millimetres; tilt is gravity's as before
    assert np.abs(np.rad2deg(positioned.turn_rad.mean(axis=0))).max() < 0.15


def test_centimetre_positions_leave_the_shape_to_the_lidar(plain: Made, positioned: Made) -> None:
    assert positioned.relative_m < 1.15 * plain.relative_m + 2e-4


def test_what_the_clocks_differ_by_is_found_with_the_positions(positioned: Made, flight: Any) -> None:
    """The lidar's UTC comes by way of the autopilot, 8 ms late by its gyros."""
    found = positioned.estimate.report["estimated"]["outside.delay_s"]
    assert found["value"][0] == pytest.approx(-0.0084, abs=3.0 * found["sigma"][0])
    assert found["sigma"][0] < 0.7 * found["prior_sigma"][0]
    (source,) = positioned.estimate.report["outside"]
    assert source["positions"] > 90


# one more whole adjustment; in the quick suite: a wild position does no harm (test_filtered), a blundered point is named (below)
@pytest.mark.soak
def test_a_wrong_fix_of_some_seconds_is_not_followed(flight: Any, tmp_path: Path) -> None:
    write_pos(flight.folder, tmp_path / "wrong.pos", SIGMA, np.random.default_rng(4), slice(40, 60))
    found = made(flight.folder, Survey(positions=str(tmp_path / "wrong.pos"), geoid=UNDULATION_M))
    # a fifth of the fixes is 0.52 m off: their mean would be off by 0.1 m
    assert np.sqrt(np.mean(np.square(found.position_m).sum(axis=1))) < 0.05


# --- control ---


def surveyed(
    folder: Path, kinds: tuple[str, ...], count: int, rng: np.random.Generator
) -> list[tuple[str, Array, Array]]:
    """Places on surfaces that the lidar met, with their normals, as a surveyor would choose them: flat around and apart."""
    truth = read_truth(folder)
    hits = np.load(folder / "truth_points.npy", mmap_mode="r")
    hits = np.array(hits[np.sort(rng.integers(0, len(hits), 150_000))])
    hits = hits[~hits["mixed"] & (hits["range_m"] < 20.0)]
    place = np.stack([hits["x"], hits["y"], hits["z"]], axis=1)
    names = np.array(truth.surfaces)[hits["surface"]]
    found: list[tuple[str, Array, Array]] = []
    for i in range(count):
        kind = kinds[i % len(kinds)]
        candidates = np.flatnonzero(np.char.startswith(names, kind) & ~np.char.endswith(names, "reveals"))
        # a wall of eight metres has no place for a fifth point 3 m from all others wherever these lie
        for least_m in (3.0, 2.0, 1.0):
            n = _place_on(
                place, names, hits["normal"], rng.permutation(candidates), [each for _, each, _ in found], least_m
            )
            if n is not None:
                found.append((kind, place[n], hits["normal"][n].astype(np.float64)))
                break
        else:
            raise AssertionError(f"no place left on {kind}")
    return found


def _place_on(
    place: Array, names: npt.NDArray[Any], normal: Array, candidates: npt.NDArray[np.int64], others: list[Array], least_m: float
) -> int | None:  # fmt: skip
    """The first candidate that is flat around and so far from all others."""
    for n in candidates.tolist():
        near = np.linalg.norm(place - place[n], axis=1) < 0.5
        alike = near & (names == names[n]) & (normal @ normal[n] > 0.99)
        apart = all(np.linalg.norm(place[n] - other) > least_m for other in others)
        if apart and alike.sum() >= 12 and alike.sum() > 0.95 * near.sum():
            return int(n)
    return None


def write_control(folder: Path, out: Path, rows: list[tuple[str, Array, str]]) -> None:
    """Name, local place and use of each point, in UTM and heights above sea level, with a sigma of 1 cm."""
    origin = read_truth(folder).content["local_origin"]
    height = origin["height_msl_m"] + UNDULATION_M
    to_local = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +step +proj=topocentric "
        f"+lat_0={origin['latitude_deg']} +lon_0={origin['longitude_deg']} +h_0={height}"
    )
    zone = int((origin["longitude_deg"] + 180.0) // 6.0) + 1
    utm = pyproj.Transformer.from_crs("EPSG:4326", f"EPSG:{32600 + zone}", always_xy=True)
    lines = ["name,x,y,z,sigma,use"]
    for name, place, use in rows:
        east, north, height = place
        longitude, latitude, up = to_local.transform(east, north, height, direction="INVERSE")
        easting, northing = utm.transform(longitude, latitude)
        lines.append(f"{name},{easting:.4f},{northing:.4f},{up - UNDULATION_M:.4f},0.01,{use}")
    out.write_text("\n".join(lines) + "\n")


FACES = ("house south", "house west", "grass", "house roof south")


SEED = 6
"""Of the places and the noise of the control."""


def control_of(flight: Any, folder: Path, seed: int) -> Made:
    """Twelve points with noise of 1 cm, one of them half a metre off its surface, and six to check by."""
    rng = np.random.default_rng(seed)
    rows = []
    for i, (kind, place, normal) in enumerate(surveyed(flight.folder, FACES, 18, rng)):
        noisy = place + 0.01 * rng.standard_normal(3) + (0.5 * normal if i == 1 else 0.0)
        rows.append((f"{kind} {i}", noisy, "check" if i >= 12 else "control"))
    path = folder / "control.csv"
    write_control(flight.folder, path, rows)
    return made(flight.folder, Survey(method="adjusted", control=str(path)))


def normalised(found: Made) -> float:
    """Squared errors of positions in their sigmas, three axes, mean over the flight: the whole is off as one, three degrees of freedom."""
    return float(np.square(found.position_m / found.sigma_m).sum(axis=1).mean())


@pytest.fixture(scope="module")
def controlled(flight: Any, tmp_path_factory: pytest.TempPathFactory) -> Made:
    return control_of(flight, tmp_path_factory.mktemp("control"), SEED)


def test_control_points_lay_the_whole_on_the_earth(plain: Made, controlled: Made) -> None:
    assert np.linalg.norm(plain.position_m.mean(axis=0)) > 0.3
    assert not controlled.estimate.warning
    # off by what is stated: with other places and another noise that is 2 to 6 cm
    assert normalised(controlled) < chi2.ppf(0.999, 3)
    assert (np.abs(controlled.position_m) < 3.0 * controlled.sigma_m).mean() > 0.9
    assert np.median(controlled.sigma_m) < 0.05
    # heading by points 20 m apart to some centimetres, tilt as gravity has it
    assert np.abs(np.rad2deg(controlled.turn_rad.mean(axis=0))).max() < 0.15
    # eleven points with 1 cm of noise bend the shape by no more than their mean is off
    assert controlled.relative_m < plain.relative_m + 0.01 / np.sqrt(11)


# five more adjustments of one flight
@pytest.mark.soak
def test_over_seeds_control_is_off_by_what_is_stated(flight: Any, tmp_path: Path) -> None:
    found = [control_of(flight, tmp_path, seed) for seed in range(SEED + 1, SEED + 6)]
    off = [normalised(each) for each in found]
    assert sum(off) < chi2.ppf(0.999, 3 * len(off)), off
    assert all(np.median(each.sigma_m) < 0.05 for each in found)


def test_a_blundered_point_is_named(controlled: Made) -> None:
    control = controlled.estimate.report["control"]
    assert control["rejected"] == ["house west 1"]
    assert "house west 1 is 0." in control["note"]
    (blunder,) = [point for point in control["points"] if point["name"] == "house west 1"]
    assert abs(blunder["after_m"]) == pytest.approx(0.5, abs=0.06)


def test_check_points_are_the_figure_for_users(controlled: Made) -> None:
    control = controlled.estimate.report["control"]
    assert control["check"]["count"] == 6
    assert control["check"]["before_rms_m"] > 0.3
    assert control["check"]["after_rms_m"] < 3.0 * control["check"]["sigma_m"]
    assert control["used"]["count"] >= 8
    assert control["used"]["after_rms_m"] < 2.0 * control["used"]["sigma_m"]


# in the quick suite: windows that are joined (test_adjusted), and control that holds the whole of one (above)
@pytest.mark.soak
def test_control_holds_a_flight_of_several_windows(flight: Any, tmp_path: Path) -> None:
    """Windows of 8 s, joined: the control is the joining's."""
    rng = np.random.default_rng(8)
    rows = [
        (f"{kind} {i}", place + 0.01 * rng.standard_normal(3), "control")
        for i, (kind, place, _) in enumerate(surveyed(flight.folder, FACES, 16, rng))
    ]
    write_control(flight.folder, tmp_path / "control.csv", rows)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(adjusted, "WINDOW", 80)
        for module in (adjusted, windows):
            patch.setattr(module, "OVERLAP", 30)
        found = made(flight.folder, Survey(method="adjusted", control=str(tmp_path / "control.csv")))
    assert len(found.estimate.report["windows"]) > 2
    assert found.estimate.report["control"]["used"]["count"] > 8
    assert np.sqrt(np.mean(np.square(found.position_m).sum(axis=1))) < 0.08
    assert (np.abs(found.position_m) < 3.0 * found.sigma_m).mean() > 0.9


@pytest.mark.parametrize(
    ("text", "words", "code", "said"),
    [
        (None, ["--control", "nowhere.csv"], 1, "nowhere.csv: cannot be read"),
        ("x,y,z,sigma\n1,2,3,0\n", [], 1, "line 2"),
        (
            "x,y,z,sigma\n500000,6000000,50,0.01\n",
            [],
            1,
            "no point within 1000 m of the flight, expected coordinates of EPSG:32633",
        ),
        ("x,y,z,sigma\n1,2,3,0.01\n", ["--method", "filtered"], 2, "only method adjusted uses it"),
        ("x,y,z,sigma\n1,2,3,0.01\n", ["--causal"], 2, "known after the flight only"),
    ],
)
def test_control_that_cannot_be_used_is_one_sentence(
    flight: Any,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    text: str | None,
    words: list[str],
    code: int,
    said: str,
) -> None:
    if text is not None:
        (tmp_path / "c.csv").write_text(text)
        words = ["--control", str(tmp_path / "c.csv"), *words]
    assert main(["process", str(flight.log), "-o", str(tmp_path / "out"), *words]) == code
    error = capsys.readouterr().err.strip()
    assert said in error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()
