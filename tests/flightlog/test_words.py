"""Nothing from outside acts on a terminal, forges a line, or hides one."""

import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flightlog.words import clean, clean_bytes, clean_lines, clean_output


@pytest.mark.parametrize(
    ("hostile", "harmless"),
    [
        ("\x1b[2J\x1b[31mGOOD", r"\x1b[2J\x1b[31mGOOD"),
        ("$GPRMC\nJun 1 swathd[1]: all is well", r"$GPRMC\nJun 1 swathd[1]: all is well"),
        ("\x07\x08\x7f\x9b0m", r"\x07\x08\x7f\x9b0m"),
        ("a\u202egpj.exe", r"a\u202egpj.exe"),
        ("zero\u200bwidth\u2028line", r"zero\u200bwidth\u2028line"),
        ("\ud800", r"\ud800"),
        ("Höhe über Geoid, 高度 3 m", "Höhe über Geoid, 高度 3 m"),
        ("plain words, 1.5 m", "plain words, 1.5 m"),
    ],
)
def test_what_a_terminal_would_act_on_is_spelled_out(hostile: str, harmless: str) -> None:
    assert clean(hostile) == harmless


@given(st.text())
def test_any_text_becomes_one_printable_line_and_cleaning_twice_changes_nothing(text: str) -> None:
    found = clean(text)
    assert found.isprintable()
    assert len(found.splitlines()) <= 1
    assert all(unicodedata.category(c) not in ("Cc", "Cf", "Cs", "Zl", "Zp") for c in found)
    assert clean(found) == found


@given(st.binary())
def test_any_bytes_become_ascii(raw: bytes) -> None:
    found = clean_bytes(raw)
    assert found.isascii()
    assert found.isprintable()


def test_a_text_of_fixed_length_ends_at_its_first_zero_byte() -> None:
    """As C pads it: MAVLink's and the HDL-32E's texts."""
    assert clean_bytes(b"GPS_TYPE\x00old name\x00") == "GPS_TYPE"
    assert clean_bytes(b"\x00GPS_TYPE") == ""


def test_length_is_bounded() -> None:
    assert len(clean("x" * 10_000)) < 2010
    assert clean("x" * 30, most=10) == "x" * 10 + "..."
    assert clean("x" * 10, most=10) == "x" * 10, "what just fits is left whole"
    assert clean_bytes(b"x" * 30, most=10) == "x" * 10 + "..."
    assert len(clean_lines("a line\n" * 50)) == 20, "a screen is not filled by another machine's shell"
    assert clean_lines("a\nb\x1b\nc", most=2) == [r"b\x1b", "c"]


def test_output_keeps_its_lines_and_nothing_else_that_acts() -> None:
    text = "a\tb\nprogress\rdone\x1b[2J\x07\u202e \u00e5"
    assert clean_output(text) == "a\tb\nprogress\rdone\\x1b[2J\\x07\\u202e \u00e5"
    assert clean_output("x" * 100_000) == "x" * 100_000
