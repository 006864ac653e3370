"""Every format is told by its content, and what is none of them is named."""

import random
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from flightlog.errors import LogError, SwathError
from groundproc.flight.positions.reading import read_solution
from groundproc.geodesy import LocalFrame
from groundproc.trajectory.table import from_poses, read_trajectory, write_trajectory

POS = (
    "%  GPST  latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s) ratio\n"
    "2300 302400.2 58.39 15.62 110.0 1 9 0.03 0.02 0.05 0.0 0.0 0.0 0.0 5.0\n"
)
NMEA = (
    b"$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A\r\n"
    b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"
)
POSES = (
    "utc_ns,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg,sigma_east_m,sigma_north_m,sigma_up_m,sigma_roll_deg,"
    "sigma_pitch_deg,sigma_heading_deg,covariance_east_north_m2,covariance_roll_heading_deg2\n"
    "1707307200000000000,58.39,15.62,110.0,1.0,2.0,30.0,0.1,0.2,0.3,0.1,0.1,0.2,{cross},0.01\n"
    "1707307210000000000,58.3901,15.62,111.0,1.0,2.0,30.0,0.1,0.2,0.3,0.1,0.1,0.2,0.0,0.01\n"
)


@pytest.fixture
def write(tmp_path: Path) -> Callable[[bytes], Path]:
    def make(content: bytes) -> Path:
        path = tmp_path / "some.file"
        path.write_bytes(content)
        return path

    return make


def sbet(count: int = 20) -> bytes:
    row = [np.deg2rad(58.39), np.deg2rad(15.62), 110.0, *[0.0] * 13]
    return b"".join(struct.pack("<17d", 1000 + k / 200, *row) for k in range(count))


def accuracy(count: int = 17) -> bytes:
    return b"".join(struct.pack("<10d", 1000 + k, *[0.01] * 9) for k in range(count))


def test_each_format_is_told_by_its_content(write: Callable[[bytes], Path]) -> None:
    assert read_solution(write(POS.encode())).format == "RTKLIB .pos"
    assert read_solution(write(POSES.format(cross=0).encode())).format == "poses"
    assert read_solution(write(sbet()), week=2300).format == "SBET"
    nmea = read_solution(write(b"\xb5\x62\x01\x07\x00\xff" + NMEA))
    assert nmea.format == "NMEA"
    # the sentences of the NMEA page that everybody quotes
    assert nmea.time_ns[0] == np.datetime64("1994-03-23T12:35:19", "ns").astype(np.int64)
    assert nmea.latitude_deg[0] == pytest.approx(48 + 7.038 / 60)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "is empty"),
        (b"hello\n", "is no solution that is known"),
        (bytes(1360), "is no solution that is known"),
        (accuracy(), "accuracy file of an SBET"),
        (b"     3.04           OBSERVATION DATA    M: Mixed            RINEX VERSION / TYPE\n", "swath ppk"),
        (b"\xb5\x62\x02\x15" + bytes(100), "swath ppk"),
        (NMEA.replace(b"*", b"*F"), "is no solution that is known"),
    ],
)
def test_what_is_no_solution_is_named(write: Callable[[bytes], Path], content: bytes, sentence: str) -> None:
    with pytest.raises(LogError, match=sentence):
        read_solution(write(content))


@pytest.mark.parametrize("seed", range(4))
def test_damage_is_a_sentence_or_a_count_and_never_a_traceback(write: Callable[[bytes], Path], seed: int) -> None:
    rng = random.Random(seed)
    rows = "".join(POS.splitlines()[1].replace("302400.2", f"{302400 + k}") + "\n" for k in range(10))
    for content in (POS.encode() + rows.encode(), NMEA * 3, POSES.format(cross=0).encode(), sbet(30)):
        for _ in range(60):
            damaged = bytearray(content)
            for _ in range(rng.choice((1, 3, 10, 50))):
                place = rng.randrange(len(damaged))
                if rng.random() < 0.7:
                    damaged[place] = rng.choice((rng.randrange(256), *b"0123456789.-e,:/% \n'*$"))
                else:
                    del damaged[place : place + rng.choice((1, 2, 10, 100))]
                damaged = damaged or bytearray(b"x")
            try:
                found = read_solution(write(bytes(damaged)), near_utc_ns=1_707_307_200 * 10**9)
            except SwathError:
                continue
            assert (np.diff(found.time_ns) > 0).all()
            assert (np.abs(found.latitude_deg) <= 90).all()


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="cannot be read"):
        read_solution(tmp_path / "none.pos")


def test_poses_have_sigmas_and_what_lies_between_them(write: Callable[[bytes], Path]) -> None:
    found = read_solution(write(POSES.format(cross=0.01).encode()))
    assert found.point == "ins"
    np.testing.assert_allclose(
        found.covariance_m2[0], [[0.01, 0.01, 0], [0.01, 0.04, 0], [0, 0, 0.09]], rtol=0, atol=1e-15
    )
    assert found.attitude_covariance_rad2 is not None
    np.testing.assert_allclose(
        np.rad2deg(np.rad2deg(found.attitude_covariance_rad2[0])),
        [[0.01, 0, 0.01], [0, 0.01, 0], [0.01, 0, 0.04]],
        rtol=0,
        atol=1e-12,
    )
    with pytest.raises(LogError, match="larger than the sigmas allow"):
        read_solution(write(POSES.format(cross=0.03).encode()))
    with pytest.raises(LogError, match="line 2: a covariance is no number"):
        read_solution(write(POSES.format(cross="x").encode()))


def test_our_own_trajectory_comes_back(tmp_path: Path) -> None:
    frame = LocalFrame(58.39, 15.62, 100.0)
    n = 50
    rng = np.random.default_rng(1)
    position = rng.normal(0, 50, (n, 3))
    quat = rng.normal([4, 0, 0, 0], 1, (n, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    sigma, sigma_rad = np.full((n, 3), 0.02), np.full((n, 3), 0.001)
    path = tmp_path / "trajectory.csv"
    write_trajectory(
        path, from_poses(frame, 1_707_307_200 * 10**9 + np.arange(n) * 10**7, position, quat, sigma, sigma_rad)
    )
    found = read_solution(path, poses_height="msl")
    assert found.height_reference == "msl"
    np.testing.assert_allclose(
        frame.from_geodetic(found.latitude_deg, found.longitude_deg, found.height_m), position, rtol=0, atol=2e-4
    )
    np.testing.assert_allclose(found.sigma_m, 0.02, rtol=0, atol=1e-9)
    assert found.quat_place_ins_wxyz is not None
    np.testing.assert_allclose(np.abs(np.sum(found.quat_place_ins_wxyz * quat, axis=1)), 1.0, rtol=0, atol=1e-12)


def test_a_sigma_below_zero_in_a_table_of_poses_is_named(write: Callable[[bytes], Path]) -> None:
    """Squared, it would pass for one above zero."""
    text = POSES.format(cross=0)
    wrong = text.replace("0.1,0.2,0.3,0.1,0.1,0.2,0,", "0.1,-0.2,0.3,0.1,0.1,0.2,0,")
    assert wrong != text
    for read in (read_solution, read_trajectory):
        with pytest.raises(LogError, match=r"line 2: .*no sigma below 0"):
            read(write(wrong.encode()))


def test_a_variance_below_zero_leaves_the_row_out(write: Callable[[bytes], Path]) -> None:
    """In geocentric axes no sigma is negative, but turned to east, north and up covariances that are too large make one."""
    head = "%  GPST  x-ecef(m) y-ecef(m) z-ecef(m) Q ns sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m) age(s) ratio\n"
    good = "2300 302400.2 3226000.0 902000.0 5409000.0 1 9 0.03 0.02 0.05 0.0 0.0 0.0 0.0 5.0\n"
    bad = "2300 302401.2 3226000.0 902000.0 5409000.0 1 9 0.03 0.02 0.05 9.0 9.0 9.0 0.0 5.0\n"
    found = read_solution(write((head + good + bad).encode()))
    assert (len(found), found.left_out) == (1, {"impossible": 1})
