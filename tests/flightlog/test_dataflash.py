import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flightlog import dataflash
from flightlog.errors import CaptureError

HEAD = b"\xa3\x95"
# letter -> struct code, a value, the factor that the field's unit asks for (ArduPilot, LogStructure.h)
LETTERS: dict[str, tuple[str, Any, float]] = {
    "b": ("b", -5, 1), "B": ("B", 250, 1), "h": ("h", -30000, 1), "H": ("H", 60000, 1), "i": ("i", -2_000_000_000, 1),
    "I": ("I", 4_000_000_000, 1), "q": ("q", -(2**60), 1), "Q": ("Q", 2**60, 1), "f": ("f", 0.25, 1), "d": ("d", 1e-9, 1),
    "g": ("e", 0.5, 1), "n": ("4s", b"abcd", 1), "N": ("16s", b"sixteen", 1), "Z": ("64s", b"some text", 1), "M": ("B", 3, 1),
    "c": ("h", -1234, 0.01), "C": ("H", 65535, 0.01), "e": ("i", -123456, 0.01), "E": ("I", 123456, 0.01),
    "L": ("i", -354_123_456, 1e-7), "a": ("32h", tuple(range(-16, 16)), 1),
}  # fmt: skip


def declared(number: int, name: str, letters: str, labels: str, size: int | None = None) -> bytes:
    """A FMT message."""
    body = sum(struct.calcsize("<" + LETTERS[c][0]) for c in letters) if size is None else size - 3
    fields = (number, body + 3, name.encode(), letters.encode(), labels.encode())
    return HEAD + b"\x80" + struct.pack("<BB4s16s64s", *fields)


def message(number: int, letters: str, *values: Any) -> bytes:
    flat = [item for value in values for item in (value if isinstance(value, tuple) else (value,))]
    return HEAD + bytes((number,)) + struct.pack("<" + "".join(LETTERS[c][0] for c in letters), *flat)


FMT = declared(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
ATT = declared(1, "ATT", "QccC", "TimeUS,Roll,Pitch,Yaw")
GPS = declared(2, "GPS", "QBIHLLe", "TimeUS,Status,GMS,GWk,Lat,Lng,Alt")
MSG = declared(3, "MSG", "QZ", "TimeUS,Message")
ROWS = [
    message(1, "QccC", 1000, -1234, 567, 35999),
    message(2, "QBIHLLe", 1100, 3, 252_408_000, 1718, 371_305_400, -1_216_547_733, 1234),
    message(3, "QZ", 1200, b"ArduCopter V3.1.3"),
    message(1, "QccC", 2000, 1, -2, 0),
]
LOG = FMT + ATT + GPS + MSG + b"".join(ROWS)


def theirs(path: Path, data: bytes) -> dict[str, list[Any]]:
    """The messages by name as pymavlink's own reader gives them."""
    from pymavlink import DFReader

    path.write_bytes(data)
    reader = DFReader.DFReader_binary(str(path))
    found: dict[str, list[Any]] = {}
    while (entry := reader.recv_msg()) is not None:
        found.setdefault(entry.get_type(), []).append(entry)
    reader.data_map.close()
    reader.filehandle.close()
    found.pop("FMT", None)
    return found


def same(ours: npt.NDArray[np.void], rows: list[Any]) -> bool:
    assert ours.dtype.names is not None
    assert len(ours) == len(rows)
    for name in ours.dtype.names:
        for value, row in zip(ours[name], rows, strict=True):
            expected = getattr(row, name)
            if isinstance(value, bytes):
                assert value.decode() == expected
            else:
                assert np.allclose(value, expected, rtol=1e-15, atol=0, equal_nan=True)
    return True


def test_messages_read_as_the_log_declares_them() -> None:
    log = dataflash.parse(LOG, "a.bin")
    assert set(log.tables) == {"ATT", "GPS", "MSG"}
    assert log.bad_bytes == 0
    assert log.tables["ATT"]["TimeUS"].tolist() == [1000, 2000]
    assert log.tables["ATT"]["Roll"] == pytest.approx([-12.34, 0.01])
    assert log.tables["ATT"]["Yaw"] == pytest.approx([359.99, 0])
    gps = log.tables["GPS"][0]
    assert (gps["Status"], gps["GMS"], gps["GWk"]) == (3, 252_408_000, 1718)
    assert (gps["Lat"], gps["Lng"], gps["Alt"]) == pytest.approx((37.13054, -121.6547733, 12.34), rel=1e-15)
    assert log.tables["MSG"]["Message"].tolist() == [b"ArduCopter V3.1.3"]


def test_pymavlinks_reader_gives_the_same(tmp_path: Path) -> None:
    log = dataflash.parse(LOG, "a.bin")
    witness = theirs(tmp_path / "a.bin", LOG)
    assert set(witness) == set(log.tables)
    assert all(same(log.tables[name], rows) for name, rows in witness.items())


@pytest.mark.parametrize("letter", LETTERS)
def test_every_letter_is_stored_and_scaled_as_pymavlink_has_it(letter: str, tmp_path: Path) -> None:
    _, value, factor = LETTERS[letter]
    data = FMT + declared(5, "TST", "Q" + letter, "TimeUS,Value") + message(5, "Q" + letter, 7, value)
    table = dataflash.parse(data, "a.bin").tables["TST"]
    if isinstance(value, bytes):
        assert table["Value"][0] == value
    else:
        assert np.allclose(table["Value"][0], np.array(value) * factor, rtol=1e-15, atol=0)
    assert same(table, theirs(tmp_path / "a.bin", data)["TST"])


def test_a_log_cut_at_any_byte_gives_the_messages_before_the_cut() -> None:
    ends = np.cumsum([len(part) for part in (FMT, ATT, GPS, MSG, *ROWS)])[3:]
    for size in range(3, len(LOG)):
        log = dataflash.parse(LOG[:size], "a.bin")
        whole = int((ends[1:] <= size).sum())
        assert sum(len(table) for table in log.tables.values()) == whole
        if size >= ends[0]:
            assert log.bad_bytes == size - ends[whole]


def test_garbage_between_messages_is_stepped_over_and_counted() -> None:
    garbage = b"\x00\xa3\x00\xa3\x95\xc8garbage\xa3"
    log = dataflash.parse(FMT + ATT + GPS + MSG + garbage.join(ROWS), "a.bin")
    assert [len(log.tables[name]) for name in ("ATT", "GPS", "MSG")] == [2, 1, 1]
    assert log.bad_bytes == 3 * len(garbage)


def test_a_type_with_a_field_that_nobody_knows_is_stepped_over_by_its_length() -> None:
    inside = message(1, "QccC", 5, 5, 5, 5)  # must not be taken for a message: it is the body of one
    odd = declared(9, "ODD", "", "A", size=3 + len(inside))
    odd = odd.replace(b"ODD\x00" + bytes(16), b"ODD\x00" + b"y" + bytes(15))
    log = dataflash.parse(FMT + ATT + odd + HEAD + b"\x09" + inside + ROWS[0], "a.bin")
    assert log.tables["ATT"]["TimeUS"].tolist() == [1000]
    assert log.bad_bytes == 3 + len(inside)


def test_a_type_declared_again_goes_on() -> None:
    log = dataflash.parse(FMT + ATT + ROWS[0] + ATT + ROWS[3], "a.bin")
    assert log.tables["ATT"]["TimeUS"].tolist() == [1000, 2000]


def test_of_a_name_declared_with_other_fields_the_last_stands_and_the_rest_is_counted() -> None:
    other = declared(1, "ATT", "Qcc", "TimeUS,Roll,Pitch")
    log = dataflash.parse(FMT + ATT + ROWS[0] + other + message(1, "Qcc", 3000, 1, 2), "a.bin")
    assert log.tables["ATT"]["TimeUS"].tolist() == [3000]
    assert log.bad_bytes == len(ROWS[0])


def test_a_type_without_fields_has_no_table() -> None:
    log = dataflash.parse(FMT + declared(9, "NON", "", "") + HEAD + b"\x09" + ATT + ROWS[0], "a.bin")
    assert set(log.tables) == {"ATT"}


@pytest.mark.parametrize("content", [b"", b"\xa3\x95", b"text", HEAD + b"\x81" + bytes(200)])
def test_another_file_is_refused_in_one_sentence(content: bytes) -> None:
    assert not dataflash.is_dataflash(content)
    with pytest.raises(CaptureError, match=r"^a\.bin: is no ArduPilot dataflash log"):
        dataflash.parse(content, "a.bin")


pieces = st.one_of(
    st.binary(max_size=100),
    st.sampled_from([FMT, ATT, GPS, MSG, *ROWS, HEAD, HEAD + b"\x01"]),
    st.builds(
        lambda number, size, name, letters, labels: (
            HEAD + b"\x80" + struct.pack("<BB4s16s64s", number, size, name, letters, labels)
        ),
        st.integers(0, 255),
        st.integers(0, 255),
        st.binary(max_size=4),
        st.text("".join(LETTERS), max_size=16).map(str.encode),
        st.lists(st.sampled_from(["", "A", "B", "f0", "f1", " "]), max_size=16).map(",".join).map(str.encode),
    ),
)


@given(st.lists(pieces, max_size=12))
def test_any_bytes_behind_the_first_declaration_are_a_log(parts: list[bytes]) -> None:
    data = FMT + b"".join(parts)
    log = dataflash.parse(data, "a.bin")
    assert 0 <= log.bad_bytes <= len(data)


def test_a_message_of_a_single_byte_is_read_and_one_with_two_fields_of_a_name_is_passed_over_by_its_length() -> None:
    one = declared(1, "ONE", "B", "a") + message(1, "B", 7) + message(1, "B", 8)
    twice = declared(2, "TWO", "BB", "a,a") + message(2, "BB", 1, 2)
    nameless = declared(3, "NON", "BB", "a,") + message(3, "BB", 1, 2)
    own = declared(0x80, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
    log = dataflash.parse(own + one + twice + nameless, "x.bin")
    assert {name: table["a"].tolist() for name, table in log.tables.items()} == {"ONE": [7, 8]}
    assert log.bad_bytes == 5 + 5


# Pieces, units, real logs ---------------------------------------------------------------------------------------------


def tables(log: dataflash.Dataflash) -> dict[str, list[Any]]:
    return {name: table.tolist() for name, table in log.tables.items()}


@given(st.lists(pieces, max_size=12), st.lists(st.integers(1, 400), min_size=1, max_size=20))
def test_how_a_log_is_cut_into_pieces_and_windows_changes_nothing(parts: list[bytes], sizes: list[int]) -> None:
    data = FMT + b"".join(parts) + LOG
    whole = dataflash.parse(data, "a.bin")
    stretch, window = dataflash._STRETCH, dataflash._WINDOW
    try:
        dataflash._STRETCH, dataflash._WINDOW = 150, 3  # type: ignore[misc]  # constants, made small for the test
        parser, start = dataflash.Parser(), 0
        for size in sizes:
            parser.feed(data[start : start + size])
            start += size
        parser.feed(data[start:])
        pieced = parser.finish()
    finally:
        dataflash._STRETCH, dataflash._WINDOW = stretch, window  # type: ignore[misc]  # as they were
    assert repr(tables(pieced)) == repr(tables(whole))
    assert (pieced.bad_bytes, pieced.counts) == (whole.bad_bytes, whole.counts)


def test_what_is_not_wanted_is_counted_and_not_kept() -> None:
    log = dataflash.parse(LOG, "a.bin", wanted=["GPS"])
    assert set(log.tables) == {"GPS"}
    assert log.counts == {"ATT": 2, "GPS": 1, "MSG": 1}
    assert log.has("GPS", "GWk", "Lat")
    assert log.has("GPS", *log.tables["GPS"].dtype.names or ())
    assert not log.has("GPS", "T")
    assert not log.has("ATT")


def test_units_and_multipliers_are_the_logs_own() -> None:
    unit = declared(10, "UNIT", "QbZ", "TimeUS,Id,Label")
    multiplier = declared(11, "MULT", "Qbd", "TimeUS,Id,Mult")
    of_fields = declared(12, "FMTU", "QBNN", "TimeUS,FmtType,UnitIds,MultIds")
    field = declared(13, "XYZ", "QcfHhI", "TimeUS,Turn,Rate,Height,Field,Raw")
    rows = [
        *(message(10, "QbZ", 0, ord(i), label) for i, label in (("s", b"s"), ("d", b"deg"), ("k", b"deg/s"), ("m", b"m"), ("G", b"Gauss"))),
        *(message(11, "Qbd", 0, ord(i), float(np.float32(m))) for i, m in (("-", 0.0), ("F", 1e-6), ("B", 1e-2), ("C", 1e-3), ("0", 1.0))),
        message(12, "QBNN", 0, 13, b"sdkmG-", b"FB0BC-"),
        message(13, "QcfHhI", 5_000_000, 9000, 90.0, 1234, -450, 7),
    ]  # fmt: skip
    log = dataflash.parse(FMT + unit + multiplier + of_fields + field + b"".join(rows), "a.bin", wanted=["XYZ"])
    found = {name: float(log.si("XYZ", name)[0]) for name in ("TimeUS", "Turn", "Rate", "Height", "Field", "Raw")}
    assert found == pytest.approx(
        {"TimeUS": 5.0, "Turn": np.pi / 2, "Rate": np.pi / 2, "Height": 12.34, "Field": -0.45, "Raw": 7.0}, rel=1e-12
    )
    assert log.units["XYZ"]["Rate"] == "deg/s"


def test_without_units_hundredths_milliseconds_and_degrees_are_known_by_name() -> None:
    log = dataflash.parse(LOG, "a.bin")
    assert log.si("ATT", "TimeUS").tolist() == pytest.approx([1e-3, 2e-3])
    assert log.si("ATT", "Yaw")[0] == pytest.approx(np.deg2rad(359.99))
    assert log.si("GPS", "GMS")[0] == pytest.approx(252_408.0)
    assert log.si("GPS", "Lat")[0] == pytest.approx(37.13054)


def test_real_logs_read_as_pymavlink_has_them(recordings: Path, tmp_path: Path) -> None:
    found = [path for path in sorted((recordings / "mavlink").iterdir()) if path.suffix.lower() == ".bin"]
    if not found:
        pytest.skip("no dataflash log among the recordings")
    for path in found:
        log = dataflash.parse(path.read_bytes(), path.name)
        witness = theirs(tmp_path / "a.bin", path.read_bytes())
        assert log.counts == {name: len(rows) for name, rows in witness.items()}, path.name
        for name, rows in witness.items():
            every = max(len(rows) // 200, 1)
            assert same(log.tables[name][::every], rows[::every]), (path.name, name)
