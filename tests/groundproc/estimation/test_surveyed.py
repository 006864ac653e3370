"""Files of positions and poses that a survey names: what they state is what the estimators are given."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest

from flightlog.errors import LogError, SwathError
from flightlog.mount import Mount
from groundproc.estimation.method import Given
from groundproc.estimation.observations.outside import outside_track
from groundproc.estimation.surveyed import surveyed
from groundproc.flight.timebase import UtcTie
from groundproc.geodesy import LocalFrame
from groundproc.steps import trajectory
from groundproc.steps.request import Request
from groundproc.survey import Survey
from groundproc.trajectory.covariance import STATES, mat_attitude_turn

Array = npt.NDArray[np.float64]
START_NS = 1_779_272_223_000_000_000
FRAME = LocalFrame(58.394, 15.574, 61.3)
COUNT = 4
TIMES = START_NS + 10 * 10**9 * np.arange(COUNT)
HEADING, PITCH, ROLL = np.array([0.3, 2.0, -1.1, 0.7]), np.array([0.1, -0.4, 0.2, 0.0]), np.array([-0.2, 0.1, 0.3, 0.0])
"""Of images 10 s apart."""


def covariances() -> Array:
    """Any full ones of centimetres and hundredths of a degree."""
    factor = np.random.default_rng(5).normal(size=(COUNT, 6, 6)) * np.repeat([0.02, 3e-4], 3)[:, None]
    return np.asarray(factor @ np.swapaxes(factor, 1, 2))


def write_poses(path: Path, sigma: Array | None = None, times: Sequence[int] = TIMES.tolist()) -> Path:
    """A table of poses some metres about the frame's origin; `sigma` has shape (n, 6), radians at the end."""
    names = "utc_ns,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg"
    if sigma is not None:
        names += ",sigma_east_m,sigma_north_m,sigma_up_m,sigma_roll_deg,sigma_pitch_deg,sigma_heading_deg"
    rows = [names]
    for k, time_ns in enumerate(times):
        angles = np.rad2deg([ROLL[k], PITCH[k], HEADING[k]])
        values: list[Any] = [int(time_ns), 58.394 + 1e-6 * k, 15.574, 61.3 + k, *angles]
        if sigma is not None:
            values += [*sigma[k, :3], *np.rad2deg(sigma[k, 3:])]
        rows.append(",".join(repr(v if isinstance(v, int) else float(v)) for v in values))
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join(rows) + "\n")
    return path


def write_covariance(folder: Path, covariance: Array, times: npt.NDArray[np.int64] = TIMES) -> None:
    np.savez(folder / "covariance.npz", time_ns=times, covariance=covariance, states=np.array(STATES))


def given(**named: Path) -> Given:
    """A flight that lasts from the first image to the last."""
    leg = SimpleNamespace(utc_from_boot=lambda time_ns: time_ns)
    fixes = SimpleNamespace(time_ns=TIMES, latitude_deg=np.full(COUNT, 58.394), longitude_deg=np.full(COUNT, 15.574))
    survey = replace(Survey(), height="ellipsoid", **{name: str(path) for name, path in named.items()})
    fields = {"survey": survey, "placed": [leg], "fixes": [fixes], "frame": FRAME, "mount": Mount()}
    return cast(Given, SimpleNamespace(**fields))


def as_rotation(covariance: Array) -> Array:
    """Of position and small rotation vector, of one of position and roll, pitch, heading: by the inverse of the page's matrix."""
    turn = np.linalg.inv(mat_attitude_turn(HEADING, PITCH))
    whole = np.zeros((COUNT, 6, 6))
    whole[:, :3, :3], whole[:, 3:, 3:] = np.eye(3), turn
    return np.asarray(whole @ covariance @ np.swapaxes(whole, 1, 2))


@pytest.mark.parametrize("states_sigmas", [False, True], ids=["sigmas of the npz", "sigmas of the table"])
@pytest.mark.parametrize("option", ["poses", "positions"])
def test_the_covariance_beside_poses_is_what_the_adjustment_is_given(
    tmp_path: Path, option: str, states_sigmas: bool
) -> None:
    covariance = covariances()
    stated = covariance
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    if states_sigmas:  # somebody has doubled them since: the correlations stay
        stated, sigma = 4.0 * covariance, 2.0 * sigma
    table = write_poses(tmp_path / "images" / "trajectory.csv", sigma if states_sigmas else None)
    write_covariance(table.parent, covariance)
    (fixes,) = surveyed(given(**{option: table}))
    taken = outside_track(fixes, np.eye(3), np.zeros(3), UtcTie(0, 0.0, "gprmc"))
    assert taken.attitude_covariance_rad2 is not None
    assert taken.cross_covariance is not None
    cross = taken.cross_covariance
    found = np.block([[taken.covariance_m2, cross], [np.swapaxes(cross, 1, 2), taken.attitude_covariance_rad2]])
    # metres from the origin the axes differ by less than 1e-6
    expected = as_rotation(stated)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * float(np.abs(expected[:, 3:, 3:]).max()))
    assert np.abs(cross).max() > 0.1 * np.sqrt(np.abs(taken.covariance_m2).max() * np.abs(expected[:, 3:, 3:]).max())


def test_poses_come_beside_positions_each_as_a_source_of_its_own(tmp_path: Path) -> None:
    sigma = np.full((COUNT, 6), 0.01)
    first = write_poses(tmp_path / "ppk" / "trajectory.csv", 2.0 * sigma)
    second = write_poses(tmp_path / "images" / "poses.csv", sigma)
    positions, poses = surveyed(given(positions=first, poses=second))
    np.testing.assert_allclose([positions.sigma_m.mean(), poses.sigma_m.mean()], [0.02, 0.01], rtol=1e-5)
    assert poses.cross_covariance_m_rad is None
    assert surveyed(given()) == []


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda folder: write_covariance(folder, covariances(), TIMES + 3600 * 10**9), "covers .* expected all of"),
        (lambda folder: write_covariance(folder, covariances() + 0.01 * (1 - np.eye(6))), "eigenvalue of -"),
        (lambda folder: (folder / "covariance.npz").write_bytes(b"none"), "no file of arrays"),
        (lambda folder: write_poses(folder / "trajectory.csv"), "states no sigma for 4 of its 4 positions"),
        (lambda folder: (folder / "trajectory.csv").write_text("% program : RTKLIB\n"), "no column utc_ns"),
    ],
    ids=["of another flight", "no covariance", "no arrays", "no sigmas at all", "no table"],
)
def test_what_cannot_be_a_poses_covariance_is_refused(tmp_path: Path, spoil: Any, said: str) -> None:
    table = write_poses(tmp_path / "images" / "trajectory.csv")
    spoil(table.parent)
    with pytest.raises(SwathError, match=said):
        surveyed(given(poses=table))


def test_a_changed_covariance_makes_the_trajectory_anew(tmp_path: Path) -> None:
    table = write_poses(tmp_path / "images" / "trajectory.csv")
    request = Request([], replace(Survey(), poses=str(table)))
    assert trajectory.files(request) == {"poses": table}
    write_covariance(table.parent, covariances())
    assert trajectory.files(request) == {"poses": table, "poses: covariance.npz": table.parent / "covariance.npz"}


def test_poses_of_another_day_are_no_poses_of_the_flight(tmp_path: Path) -> None:
    table = write_poses(tmp_path / "images" / "poses.csv", np.full((COUNT, 6), 0.01), (TIMES + 86400 * 10**9).tolist())
    with pytest.raises(LogError, match="no position between"):
        surveyed(given(poses=table))
