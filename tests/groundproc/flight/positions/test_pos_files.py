"""RTKLIB's solution files: each of its forms says the same, judged by RTKLIB itself, and by lines written by hand."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flightlog.errors import LogError
from groundproc.flight.positions.rtklib import read_pos
from groundproc.flight.positions.rtklibwriter import write_pos
from groundproc.flight.positions.solution import Quality

HEAD = (
    "% program   : RTKLIB ver.2.4.3\n"
    "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)\n"
    "%  GPST                     latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) "
    "age(s)  ratio\n"
)
ROW = (
    "2024/02/07 12:00:00.200000   58.390000000   15.620000000   110.0000   1   9   0.0300   0.0200   0.0500   0.0100  -0.0150   0.0050"
    "   0.00   5.0\n"
)


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str], Path]:
    def make(text: str) -> Path:
        path = tmp_path / "a.pos"
        path.write_text(text)
        return path

    return make


def test_a_row_is_read_as_the_manual_says(write: Callable[[str], Path]) -> None:
    found = read_pos(write(HEAD + ROW))
    assert len(found) == 1
    # 2024-02-07 12:00:00.2 of GPS is 18 s later than of UTC
    assert found.time_ns[0] == np.datetime64("2024-02-07T11:59:42.2", "ns").astype(np.int64)
    assert (found.latitude_deg[0], found.longitude_deg[0], found.height_m[0]) == (58.39, 15.62, 110.0)
    assert (found.point, found.height_reference) == ("antenna", "ellipsoid")
    assert found.quality[0] == Quality.FIX
    # sdn, sde, sdu, sdne, sdeu, sdun, the last three roots with a sign
    east_north_up = [[4e-4, 1e-4, -2.25e-4], [1e-4, 9e-4, 2.5e-5], [-2.25e-4, 2.5e-5, 2.5e-3]]
    np.testing.assert_allclose(found.covariance_m2[0], east_north_up, rtol=1e-12)


@pytest.mark.parametrize(
    ("scale", "stamp", "utc"),
    [
        ("GPST", "2024/02/07 12:00:00.2", "2024-02-07T11:59:42.2"),
        ("UTC", "2024/02/07 12:00:00.123456789", "2024-02-07T12:00:00.123456789"),
        ("JST", "2024/02/07 12:00:00", "2024-02-07T03:00:00"),
        ("GPST", "2300 302400.200", "2024-02-07T11:59:42.2"),
        ("UTC", "2300 302400.200", "2024-02-07T12:00:00.2"),
        # the leap second of 2016 had the GPS time 2017-01-01 00:00:17; it is written as the second after it
        ("GPST", "2017/01/01 00:00:16.5", "2016-12-31T23:59:59.5"),
        ("GPST", "2017/01/01 00:00:18.0", "2017-01-01T00:00:00"),
    ],
)
def test_times_of_all_scales_become_utc(write: Callable[[str], Path], scale: str, stamp: str, utc: str) -> None:
    text = HEAD.replace("GPST", f"{scale:<4}") + stamp + ROW[26:]
    assert read_pos(write(text)).time_ns[0] == np.datetime64(utc, "ns").astype(np.int64)


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_any_separator_will_do(write: Callable[[str], Path], separator: str) -> None:
    columns = HEAD.splitlines()[-1][1:].split()
    head = "%  GPST                   " + separator + separator.join(columns[1:]) + "\n"
    day, clock, *rest = ROW.split()
    row = f"{day} {clock}" + separator + separator.join(f"  {word}" for word in rest) + "\n"
    found, plain = read_pos(write(head + row)), read_pos(write(HEAD + ROW))
    assert found.time_ns[0] == plain.time_ns[0]
    np.testing.assert_array_equal(found.covariance_m2, plain.covariance_m2)


def test_a_negative_angle_in_minutes_keeps_its_sign(write: Callable[[str], Path]) -> None:
    head = HEAD.replace("latitude(deg) longitude(deg)", "latitude(d'\") longitude(d'\")")
    row = ROW.replace("58.390000000   15.620000000", "-0 30 36.00000   -70 15 18.00000")
    found = read_pos(write(head + row))
    np.testing.assert_allclose([found.latitude_deg[0], found.longitude_deg[0]], [-0.51, -70.255], rtol=1e-12)


def test_heights_above_the_geoid_are_told_by_the_header(write: Callable[[str], Path]) -> None:
    assert read_pos(write(HEAD.replace("ellipsoidal", "geodetic") + ROW)).height_reference == "msl"


def test_what_cannot_be_is_left_out_and_counted(write: Callable[[str], Path]) -> None:
    rows = [
        ROW,
        ROW.replace("00:00.2", "00:00.4").replace(
            "110.0000", "32253715960.9989"
        ),  # as RTKLIB does write when it is lost
        ROW.replace("00:00.2", "00:00.6")[:60] + "\n",
        ROW.replace("00:00.2", "00:00.8").replace("0.0300", "nan"),
        ROW,
        ROW.replace("00:00.2", "00:00.1"),
    ]
    found = read_pos(write(HEAD + "".join(rows)))
    assert len(found) == 2
    assert np.diff(found.time_ns).tolist() == [100_000_000]
    assert found.left_out == {"damaged": 2, "impossible": 1, "repeated": 1}


def test_combined_by_rtklib_is_put_right(write: Callable[[str], Path]) -> None:
    head = "% solution  : Combined\n% val thres : 3.0\n" + HEAD
    contradiction = ROW.replace("00:00.2", "00:00.4").replace("   1   9   ", "   2   9   ")
    honest = contradiction.replace("00:00.4", "00:00.6").replace("   5.0\n", "   1.4\n")
    found, plain = read_pos(write(head + ROW + contradiction + honest)), read_pos(write(HEAD + ROW))
    assert found.left_out == {"contradictory": 1}
    assert found.quality.tolist() == [Quality.FIX, Quality.FLOAT]
    np.testing.assert_allclose(found.covariance_m2[0], 2 * plain.covariance_m2[0])
    assert "root of two" in found.notes[0]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (ROW, "no line of column names"),
        (HEAD, "holds no position"),
        (HEAD + "nonsense\n", "1 lines are damaged"),
        (HEAD.replace("WGS84", "Tokyo") + ROW, "datum is Tokyo"),
        (HEAD + ROW.replace("   1   9   ", "   0   9   "), "holds no position"),
        (HEAD.replace("  ratio", "") + ROW.replace("   5.0\n", "\n"), "nothing in the place of ratio"),
        (
            "%  GPST  e-baseline(m) n-baseline(m) u-baseline(m) Q ns sde sdn sdu sden sdnu sdue age ratio\n" + ROW,
            "no line of the base",
        ),
        (
            "% ref pos : 0 0 0\n%  GPST  e-baseline(m) n-baseline(m) u-baseline(m) Q ns sde sdn sdu a b c age ratio\n"
            + ROW,
            "no line of",
        ),
        (HEAD.replace("longitude(deg)", "altitude(deg)") + ROW, "has altitude in the place of longitude"),
    ],
)
def test_what_is_no_solution_is_one_sentence(write: Callable[[str], Path], text: str, sentence: str) -> None:
    with pytest.raises(LogError, match=sentence):
        read_pos(write(text))


def test_all_forms_of_rtklib_say_the_same(rnx2rtkp: Callable[..., Path]) -> None:
    plain = read_pos(rnx2rtkp("out-solformat=llh"))
    assert len(plain) == 300
    forms = {
        "xyz": ("out-solformat=xyz",),
        "enu": ("out-solformat=enu", "out-timesys=utc", "out-fieldsep=,"),
        "sexagesimal": ("out-degform=dms", "out-fieldsep=;"),
        "week": ("out-timeform=tow",),
        "week of UTC": ("out-timeform=tow", "out-timesys=utc", "out-degform=dms"),
        "enu of Japan": ("out-solformat=enu", "out-timesys=jst", "out-degform=dms"),
    }
    for name, settings in forms.items():
        found = read_pos(rnx2rtkp(*settings))
        assert np.abs(found.time_ns - plain.time_ns).max() <= 1000, name
        # heights have 0.1 mm; degrees 1e-9 deg and seconds 1e-5" are 0.1 and 0.3 mm
        np.testing.assert_allclose(found.latitude_deg, plain.latitude_deg, rtol=0, atol=5e-9, err_msg=name)
        np.testing.assert_allclose(found.longitude_deg, plain.longitude_deg, rtol=0, atol=1e-8, err_msg=name)
        np.testing.assert_allclose(found.height_m, plain.height_m, rtol=0, atol=4e-4, err_msg=name)
        # a root of 0.1 mm's rounding next to sigmas of up to a metre
        np.testing.assert_allclose(found.covariance_m2, plain.covariance_m2, atol=1e-3, rtol=2e-2, err_msg=name)
        np.testing.assert_array_equal(found.quality, plain.quality, err_msg=name)


def test_velocities_are_read_where_rtklib_states_them(rnx2rtkp: Callable[..., Path], world: Any) -> None:
    assert read_pos(rnx2rtkp()).velocity_m_s is None
    found, turned = read_pos(rnx2rtkp("out-outvel=on")), read_pos(rnx2rtkp("out-outvel=on", "out-solformat=xyz"))
    for solution in (found, turned):
        assert solution.velocity_m_s is not None
        assert solution.velocity_covariance_m2_s2 is not None
        error = solution.velocity_m_s - world.velocity_m_s(solution)
        # RTKLIB takes a Doppler shift to be worse than it is here: its sigma is too large, if anything
        squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(solution.velocity_covariance_m2_s2), error)
        assert squared.mean() < 3.0
        assert np.sqrt(np.mean(error**2)) < 0.1
    assert found.velocity_m_s is not None
    np.testing.assert_allclose(turned.velocity_m_s, found.velocity_m_s, rtol=0, atol=1e-4)


def test_a_velocity_of_zero_with_sigma_zero_is_none(write: Callable[[str], Path]) -> None:
    names = "    vn(m/s)    ve(m/s)    vu(m/s)      sdvn     sdve     sdvu    sdvne    sdveu    sdvun\n"
    head = HEAD[:-1] + names
    none = ROW[:-1] + 9 * "   0.00000" + "\n"
    assert read_pos(write(head + none)).velocity_m_s is None
    some = ROW.replace("00:00.2", "00:00.4")[:-1] + "   1.0  2.0  3.0  0.1  0.2  0.3  0.0  0.0  0.0\n"
    found = read_pos(write(head + none + some))
    assert found.velocity_m_s is not None
    assert np.isnan(found.velocity_m_s[0]).all()
    assert found.velocity_m_s[1].tolist() == [2.0, 1.0, 3.0]


def test_rtklib_in_nmea_is_the_same_way(rnx2rtkp: Callable[..., Path]) -> None:
    from groundproc.flight.positions.reading import read_solution

    plain, nmea = read_solution(rnx2rtkp("out-solformat=llh")), read_solution(rnx2rtkp("out-solformat=nmea"))
    assert nmea.format == "NMEA"
    assert nmea.undulation_m is not None
    # its times are cut to 10 ms, and the rover moves at 9.4 m/s
    assert np.abs(nmea.time_ns - plain.time_ns).max() <= 5_100_000
    np.testing.assert_allclose(nmea.height_m + nmea.undulation_m, plain.height_m, rtol=0, atol=2e-3)
    np.testing.assert_array_equal(nmea.quality, plain.quality)


def test_what_is_written_is_read_again(rnx2rtkp: Callable[..., Path], write: Callable[[str], Path]) -> None:
    plain = read_pos(rnx2rtkp("out-solformat=llh"))
    text = io.StringIO()
    write_pos(text, plain, ["program   : a test", "ref pos   : 58.390000000 15.620000000 110.0000"])
    again = read_pos(write(text.getvalue()))
    assert np.abs(again.time_ns - plain.time_ns).max() <= 500
    for name in ("latitude_deg", "longitude_deg", "height_m", "quality", "satellites", "age_s", "ratio"):
        np.testing.assert_array_equal(getattr(again, name), getattr(plain, name), err_msg=name)
    np.testing.assert_allclose(again.covariance_m2, plain.covariance_m2, atol=1e-3, rtol=2e-2)
    assert again.base_ecef_m == pytest.approx(plain.base_ecef_m, abs=1e-3)


@pytest.mark.parametrize("wrong", ["1e300", "1e7", "-1e200"])
@pytest.mark.parametrize("column", range(7, 13))
def test_a_sigma_that_cannot_be_leaves_the_row_out(write: Callable[[str], Path], column: int, wrong: str) -> None:
    words = ROW.replace("00.2", "01.2").split()
    words[column] = wrong
    found = read_pos(write(HEAD + ROW + " ".join(words) + "\n"))
    assert len(found) == 1
    assert found.left_out == {"impossible" if wrong == "1e7" else "damaged": 1}


@pytest.mark.parametrize(
    "day", ["99999999999999999999/02/07", "2024/99/07", "0/0/0", "2024/02/999999999999999999999999"]
)
def test_a_day_that_no_calendar_has_is_a_damaged_row(write: Callable[[str], Path], day: str) -> None:
    found = read_pos(write(HEAD + ROW + ROW.replace("2024/02/07", day)))
    assert len(found) == 1
    assert found.left_out == {"damaged": 1}
