import time
from calendar import timegm
from collections.abc import Iterator

import pytest
import velodyne_decoder
from hypothesis import given
from hypothesis import strategies as st

from flightlog.nmea import Rmc, checksum, format_rmc, parse_rmc

# From the recordings; times and places below are read off by eye.
MONTEREY = "$GPRMC,220632,A,3707.8324,N,12139.2864,W,000.0,144.7,111212,013.8,E,D*09\r\n"
ALMERIA = "$GPRMC,081802.00,A,3649.7478558,N,00224.4542928,W,0.034,212.5,210116,0.0,E,A*2E\r\n"


def sealed(body: str) -> str:
    value = 0
    for letter in body:
        value ^= ord(letter)
    return f"${body}*{value:02X}\r\n"


def test_a_sentence_of_a_velodyne_gives_time_and_place() -> None:
    rmc = parse_rmc(MONTEREY)
    assert rmc is not None
    assert rmc.utc_ns == timegm((2012, 12, 11, 22, 6, 32)) * 10**9
    assert rmc.valid
    assert rmc.latitude_deg == pytest.approx(37 + 7.8324 / 60, abs=1e-12)
    assert rmc.longitude_deg == pytest.approx(-(121 + 39.2864 / 60), abs=1e-12)
    assert rmc.course_deg == 144.7


def test_a_sentence_longer_than_the_72_characters_of_the_manual_is_read_in_full() -> None:
    rmc = parse_rmc(ALMERIA.encode() + b"\x00")
    assert rmc is not None
    assert len(ALMERIA.encode() + b"\x00") == 82
    assert rmc.utc_ns == timegm((2016, 1, 21, 8, 18, 2)) * 10**9
    assert rmc.longitude_deg == pytest.approx(-(2 + 24.4542928 / 60), abs=1e-12)
    assert rmc.speed_m_s == pytest.approx(0.034 * 1852 / 3600)


def test_every_recorded_sentence_is_read_as_velodyne_decoder_reads_it(
    monterey_position: list[tuple[int, bytes]], vlp16_position: list[tuple[int, bytes]]
) -> None:
    for _, payload in monterey_position + vlp16_position:
        rmc = parse_rmc(payload[206:])
        theirs = velodyne_decoder.TelemetryPacket(payload).parse_nmea()
        assert rmc is not None
        date = (2000 + theirs.utc_year % 100, theirs.utc_month, theirs.utc_day)
        clock = (theirs.utc_hours, theirs.utc_minutes, round(theirs.utc_seconds))
        assert rmc.utc_ns == timegm((*date, *clock)) * 10**9
        assert rmc.latitude_deg == pytest.approx(theirs.latitude, abs=1e-9)
        assert rmc.longitude_deg == pytest.approx(theirs.longitude, abs=1e-9)


def test_the_sentences_of_a_recording_follow_its_clock(monterey_position: list[tuple[int, bytes]]) -> None:
    seconds = {rmc.utc_ns // 10**9 for _, payload in monterey_position if (rmc := parse_rmc(payload[206:]))}
    assert seconds == {timegm((2012, 12, 11, 22, 6, second)) for second in (32, 33)}


def test_other_talkers_are_read_too() -> None:
    assert parse_rmc(sealed("GNRMC,120000.5,A,,,,,,,010203,,")) is not None
    assert parse_rmc(sealed("GPGGA,120000.5,,,,,,,,010203,,")) is None


def test_a_receiver_without_a_fix_still_tells_the_time() -> None:
    rmc = parse_rmc(sealed("GPRMC,235959.25,V,,,,,,,311299,,,N"))
    assert rmc == Rmc(timegm((1999, 12, 31, 23, 59, 59)) * 10**9 + 250_000_000, False, 0.0, 0.0, 0.0, 0.0)


def test_a_leap_second_is_the_first_instant_of_the_next_day_as_unix_time_has_it() -> None:
    rmc = parse_rmc(sealed("GPRMC,235960,A,,,,,,,311216,,"))
    assert rmc is not None
    assert rmc.utc_ns == timegm((2017, 1, 1, 0, 0, 0)) * 10**9


@pytest.mark.parametrize("place", range(1, len(MONTEREY) - 5))
def test_one_wrong_character_is_found_by_the_checksum(place: int) -> None:
    wrong = MONTEREY[:place] + chr(ord(MONTEREY[place]) ^ 1) + MONTEREY[place + 1 :]
    assert parse_rmc(wrong) is None


@pytest.mark.parametrize("length", range(len(MONTEREY) - 2))
def test_a_sentence_that_was_cut_gives_the_right_time_or_none(length: int) -> None:
    rmc = parse_rmc(MONTEREY[:length])
    assert rmc is None or rmc.utc_ns == timegm((2012, 12, 11, 22, 6, 32)) * 10**9


@pytest.mark.parametrize(
    "fields",
    [
        "GPRMC,240000,A,,,,,,,010120,,",
        "GPRMC,126000,A,,,,,,,010120,,",
        "GPRMC,1200005,A,,,,,,,010120,,",
        "GPRMC,120000,A,,,,,,,300220,,",
        "GPRMC,120000,A,,,,,,,01012,,",
        "GPRMC,120000,A,,,,,,,0101200,,",
        "GPRMC,,V,,,,,,,,,,N",
        "GPRMC,12 000,A,,,,,,,010120,,",
        "GPRMC",
    ],
)
def test_a_sealed_sentence_without_a_possible_time_is_none(fields: str) -> None:
    assert parse_rmc(sealed(fields)) is None


@pytest.fixture
def far_from_greenwich(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TZ", "Pacific/Auckland")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.usefixtures("far_from_greenwich")
@pytest.mark.parametrize(
    ("place", "valid", "body"),
    [
        ((57.5, 15.25), True, "GPRMC,220632,A,5730.0000,N,01515.0000,E,000.0,000.0,111212,000.0,E"),
        ((-7.125, -100.0), False, "GPRMC,220632,V,0707.5000,S,10000.0000,W,000.0,000.0,111212,000.0,E"),
        ((0.0, 0.0), True, "GPRMC,220632,A,0000.0000,N,00000.0000,E,000.0,000.0,111212,000.0,E"),
    ],
)
def test_a_sentence_is_written_letter_by_letter_as_a_receiver_writes_it(
    place: tuple[float, float], valid: bool, body: str
) -> None:
    utc_ns = timegm((2012, 12, 11, 22, 6, 32)) * 10**9
    written = format_rmc(utc_ns + 999_999_999, *place, valid=valid)
    assert written == sealed(body)
    assert valid is False or written == format_rmc(utc_ns, *place)


def test_the_checksum_of_what_is_no_ascii_takes_it_for_question_marks() -> None:
    assert checksum("GPÄ") == checksum("GP?") == ord("G") ^ ord("P") ^ ord("?")


@given(st.text() | st.binary())
def test_any_text_gives_a_record_or_none(text: str | bytes) -> None:
    parse_rmc(text)


@given(st.lists(st.text(alphabet="0123456789.-+eENWSAVinf ", max_size=12), max_size=14))
def test_any_sealed_fields_give_a_record_or_none(fields: list[str]) -> None:
    parse_rmc(sealed("GPRMC," + ",".join(fields)))


@given(
    st.integers(timegm((1980, 1, 6, 0, 0, 0)), timegm((2079, 12, 31, 23, 59, 59))),
    st.floats(-90, 90),
    st.floats(-180, 180),
    st.booleans(),
)
def test_what_is_written_reads_back(second: int, latitude_deg: float, longitude_deg: float, valid: bool) -> None:
    text = format_rmc(second * 10**9, latitude_deg, longitude_deg, valid=valid)
    rmc = parse_rmc(text)
    assert rmc is not None
    assert (rmc.utc_ns, rmc.valid) == (second * 10**9, valid)
    half_a_digit_deg = 0.5e-4 / 60 * (1 + 1e-6)
    assert rmc.latitude_deg == pytest.approx(latitude_deg, abs=half_a_digit_deg)
    assert rmc.longitude_deg == pytest.approx(longitude_deg, abs=half_a_digit_deg)
    fields = text.split(",")
    assert float(fields[3][2:]) < 60
    assert float(fields[5][3:]) < 60


def test_the_checksum_is_the_one_of_a_recorded_sentence() -> None:
    assert checksum(MONTEREY[1:].split("*")[0]) == 0x09


@pytest.mark.parametrize("place", [3, 5, 7, 8])
@pytest.mark.parametrize("wrong", ["nan", "inf", "1e300", "99999.0", "00nan", "000nan"])
def test_a_sentence_with_a_number_that_cannot_be_is_none(place: int, wrong: str) -> None:
    words = ["GPRMC", "100000.00", "A", "5823.64", "N", "01534.44", "E", "0.1", "84.4", "010524", "", "", "A"]
    assert parse_rmc("$" + ",".join(words)) is not None
    words[place] = wrong
    assert parse_rmc("$" + ",".join(words)) is None
