"""NMEA of receivers: sentences by hand, with checksums of their own."""

from collections.abc import Callable
from functools import reduce
from pathlib import Path

import numpy as np
import pytest

from flightlog.errors import LogError
from groundproc.flight.positions.nmea import ASSUMED_M, read_nmea
from groundproc.flight.positions.reading import read_solution
from groundproc.flight.positions.solution import Quality


def line(body: str) -> bytes:
    total = reduce(lambda value, character: value ^ ord(character), body, 0)
    return f"${body}*{total:02X}\r\n".encode()


def gga(clock: str, quality: int = 4, height: str = "80.646", undulation: str = "29.354", hdop: str = "0.8") -> bytes:
    return line(f"GNGGA,{clock},5823.4000000,N,01537.2000000,E,{quality},12,{hdop},{height},M,{undulation},M,1.0,0000")


RMC = line("GNRMC,115942.20,A,5823.4000000,N,01537.2000000,E,10.0,90.0,070224,,,R,V")


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    def make(*sentences: bytes) -> Path:
        path = tmp_path / "a.nmea"
        path.write_bytes(b"".join(sentences))
        return path

    return make


def utc(text: str) -> int:
    return int(np.datetime64(text, "ns").astype(np.int64))


def test_position_date_velocity_and_sigma_of_one_epoch(write: Callable[..., Path]) -> None:
    gst = line("GNGST,115942.20,15,0.030,0.010,45.0,0.0224,0.0224,0.040")
    for order in ([gga("115942.20"), RMC, gst], [RMC, gst, gga("115942.20")], [gst, gga("115942.20"), RMC]):
        found = read_nmea(write(*order))
        assert found.time_ns.tolist() == [utc("2024-02-07T11:59:42.2")]
        np.testing.assert_allclose([found.latitude_deg[0], found.longitude_deg[0]], [58.39, 15.62], rtol=1e-12)
        assert found.height_reference == "msl"
        assert found.undulation_m is not None
        assert found.height_m[0] + found.undulation_m[0] == pytest.approx(110.0)
        assert found.velocity_m_s is not None
        np.testing.assert_allclose(found.velocity_m_s[0, :2], [10 * 1852 / 3600, 0.0], rtol=0, atol=1e-12)
        assert np.isnan(found.velocity_m_s[0, 2])
        # the ellipse of 3 and 1 cm lies with its long axis to the north-east
        values, axes = np.linalg.eigh(found.covariance_m2[0, :2, :2])
        np.testing.assert_allclose(np.sqrt(values), [0.01, 0.03], rtol=0.02)
        np.testing.assert_allclose(np.abs(axes[:, 1]), [np.sqrt(0.5)] * 2, rtol=0, atol=1e-6)
        assert found.covariance_m2[0, 2, 2] == pytest.approx(0.04**2)
        assert found.sigma_source == "GST sentences"


@pytest.mark.parametrize(
    ("number", "kind"),
    [(1, Quality.SINGLE), (2, Quality.DGPS), (4, Quality.FIX), (5, Quality.FLOAT), (6, Quality.DEAD_RECKONING)],
)
def test_without_gst_sigmas_are_assumed_and_said_to_be(write: Callable[..., Path], number: int, kind: Quality) -> None:
    found = read_nmea(write(RMC, gga("115942.20", number, hdop="2.0")))
    assert found.quality[0] == kind
    assert found.sigma_m[0, 0] == pytest.approx(2.0 * ASSUMED_M[kind])
    assert found.sigma_m[0, 2] > found.sigma_m[0, 0]
    assert "assumed" in found.sigma_source


def test_midnight_is_passed_with_and_without_a_date_of_its_own(write: Callable[..., Path]) -> None:
    before = line("GNRMC,235959.80,A,5823.4,N,01537.2,E,,,311223,,,R,V")
    found = read_nmea(write(before, gga("235959.80"), gga("000000.00"), gga("000000.20")))
    assert found.time_ns.tolist() == [
        utc(f"202{t}") for t in ("3-12-31T23:59:59.8", "4-01-01T00:00:00", "4-01-01T00:00:00.2")
    ]
    after = line("GNZDA,000000.00,01,01,2024,00,00")
    assert read_nmea(write(gga("235959.80"), after, gga("000000.00"))).time_ns[0] == utc("2023-12-31T23:59:59.8")


def test_dates_an_era_behind_are_brought_to_the_flight_and_it_is_said(write: Callable[..., Path]) -> None:
    """1024 weeks before 2024-02-07 is 2004-06-23."""
    behind = line("GNRMC,115942.20,A,5823.4,N,01537.2,E,,,230604,,,R,V")
    right = line("GNRMC,115942.40,A,5823.4,N,01537.2,E,,,070224,,,R,V")
    path = write(behind, gga("115942.20"))
    found = read_solution(path, near_utc_ns=utc("2024-02-07T12:30:00"))
    assert found.time_ns[0] == utc("2024-02-07T11:59:42.2")
    assert "1024 GPS weeks" in found.notes[0]
    # without a flight to hold it against a date stands; two dates in one file are held against each other
    assert read_solution(path).time_ns[0] == utc("2004-06-23T11:59:42.2")
    found = read_nmea(write(behind, gga("115942.20"), right, gga("115942.40")))
    assert found.time_ns.tolist() == [utc("2024-02-07T11:59:42.2"), utc("2024-02-07T11:59:42.4")]


def test_a_single_wild_date_is_none(write: Callable[..., Path]) -> None:
    wild = line("GNRMC,115943.20,A,5823.4,N,01537.2,E,,,010199,,,R,V")
    rows = [
        each
        for i in range(4)
        for each in (line(f"GNRMC,11594{i}.00,A,5823.4,N,01537.2,E,,,070224,,,R,V"), gga(f"11594{i}.00"))
    ]
    found = read_nmea(write(*rows, wild, gga("115943.20"), gga("115943.40")))
    assert found.time_ns[-2:].tolist() == [utc("2024-02-07T11:59:43.2"), utc("2024-02-07T11:59:43.4")]


def test_without_a_date_the_flight_gives_it(write: Callable[..., Path]) -> None:
    path = write(gga("115942.20"))
    with pytest.raises(LogError, match="no date"):
        read_nmea(path)
    assert read_nmea(path, near_utc_ns=utc("2024-02-07T23:00:00")).time_ns[0] == utc("2024-02-07T11:59:42.2")
    assert read_nmea(path, near_utc_ns=utc("2024-02-08T00:30:00")).time_ns[0] == utc("2024-02-08T11:59:42.2")


def test_damage_and_binary_between_sentences(write: Callable[..., Path]) -> None:
    wrong = gga("115942.40").replace(b"5823.4", b"5823.5")
    bare = gga("115942.60").partition(b"*")[0] + b"\r\n"
    binary = b"\xb5\x62\x01\x07" + bytes(range(256)).replace(b"$", b"") + b"\n"
    found = read_nmea(write(RMC, gga("115942.20"), wrong, binary, bare, binary, gga("115942.80")))
    assert len(found) == 2
    assert found.left_out == {"damaged": 2}


def test_a_receiver_without_a_fix_is_counted(write: Callable[..., Path]) -> None:
    empty = line("GNGGA,115942.40,,,,,0,00,99.99,,,,,,")
    found = read_nmea(write(RMC, gga("115942.20"), empty))
    assert len(found) == 1
    assert found.left_out == {"without_fix": 1}
    with pytest.raises(LogError, match="no GGA or GNS"):
        read_nmea(write(RMC, empty))


def test_gns_serves_where_there_is_no_gga(write: Callable[..., Path]) -> None:
    gns = line("GNGNS,115942.20,5823.4000000,N,01537.2000000,W,RRNN,12,0.8,80.646,29.354,1.0,0000,V")
    found = read_nmea(write(RMC, gns))
    assert found.quality[0] == Quality.FIX
    assert found.longitude_deg[0] == pytest.approx(-15.62)


@pytest.mark.parametrize("place", ["5860.0000,N,01537.2,E", "5823.4,X,01537.2,E", "-5823.4,N,01537.2,E", "5823.4,N,,E"])
def test_a_place_that_cannot_be_is_damage(write: Callable[..., Path], place: str) -> None:
    bad = line(f"GNGGA,115942.40,{place},4,12,0.8,80.6,M,29.3,M,1.0,0000")
    assert read_nmea(write(RMC, gga("115942.20"), bad)).left_out == {"damaged": 1}


@pytest.mark.parametrize("wrong", ["1e300", "nan", "inf", "-1e10"])
def test_a_number_that_no_receiver_says_is_a_damaged_sentence(write: Callable[..., Path], wrong: str) -> None:
    for bad in (gga("115943.20", height=wrong), gga("115943.20", hdop=wrong), gga("115943.20", undulation=wrong)):
        found = read_nmea(write(gga("115942.20"), RMC, bad))
        assert len(found) == 1
        assert found.left_out["damaged"] == 1
    gst = line(f"GNGST,115942.20,15,{wrong},{wrong},45.0,{wrong},0.0224,0.040")
    assert read_nmea(write(gga("115942.20"), RMC, gst)).left_out == {"damaged": 1}
