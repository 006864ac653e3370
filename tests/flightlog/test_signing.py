"""Signatures of MAVLink 2, made by pymavlink as ground stations make them."""

from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog.errors import ConfigError
from flightlog.mavlink import Frame, frame_of
from flightlog.signing import EPOCH_S, Checker, Word, is_signed, read_key, time_of

KEY = bytes(range(32))


def said(
    key: bytes | None = KEY, stamp: int = 10_000_000, *, link: int = 3, component: int = 1, v1: bool = False
) -> Frame:
    sender = dialect.MAVLink(None, srcSystem=1, srcComponent=component)
    sender.signing.secret_key, sender.signing.sign_outgoing = key, key is not None and not v1
    sender.signing.timestamp, sender.signing.link_id = stamp, link
    frame = frame_of(
        bytes(dialect.MAVLink_attitude_message(7, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0).pack(sender, force_mavlink1=v1))
    )
    assert frame is not None
    return frame


def test_what_pymavlink_signs_is_believed_once() -> None:
    checker = Checker(KEY)
    assert checker.check(said()) is Word.GOOD
    assert checker.check(said()) is Word.OLD  # recorded, and sent again
    assert checker.check(said(stamp=10_000_001)) is Word.GOOD
    assert checker.check(said(stamp=10_000_000)) is Word.OLD
    assert checker.newest == 10_000_001
    assert checker.counts == {Word.GOOD: 2, Word.UNSIGNED: 0, Word.WRONG: 0, Word.OLD: 2}


def test_unsigned_frames_and_those_of_another_key_are_not() -> None:
    checker = Checker(KEY)
    assert checker.check(said(None)) is Word.UNSIGNED
    assert checker.check(said(None, v1=True)) is Word.UNSIGNED
    assert checker.check(said(bytes(32))) is Word.WRONG
    assert not is_signed(said(None))
    assert checker.newest == 0  # a stranger moves no clock


def test_every_bit_of_a_frame_is_under_its_signature() -> None:
    frame = said()
    for place in range(3, len(frame.data) * 8, 5):
        data = bytearray(frame.data)
        data[place // 8] ^= 1 << place % 8
        changed = frame._replace(data=bytes(data))
        assert Checker(KEY).check(changed) in (Word.WRONG, Word.UNSIGNED)


def test_a_new_sender_may_be_a_minute_behind_and_no_more() -> None:
    checker = Checker(KEY)
    checker.check(said(stamp=100_000_000))
    assert checker.check(said(stamp=100_000_000 - 5_999_999, component=2)) is Word.GOOD
    assert checker.check(said(stamp=100_000_000 - 6_000_002, component=3)) is Word.OLD
    assert checker.check(said(stamp=100_000_000 - 6_000_002, link=9)) is Word.OLD


def test_strangers_with_the_key_fill_no_memory() -> None:
    checker = Checker(KEY)
    for number in range(300):
        checker.check(said(stamp=100_000_000 + number, link=number % 256, component=1 + number // 256))
    assert len(checker._streams) == 64


def test_times_count_from_2015_and_a_clock_that_was_never_set_is_zero() -> None:
    assert time_of(EPOCH_S * 10**9 + 25_000) == 2
    assert time_of(0) == 0


@pytest.mark.parametrize(
    ("text", "key"),
    [
        (KEY.hex(), KEY),
        (KEY.hex().upper() + "\n", KEY),
        # as ground stations make a key of a passphrase: its SHA-256 (FIPS 180-2, the example of "abc")
        ("abc\n", bytes.fromhex("ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad")),
    ],
)
def test_a_key_is_read_from_a_file(text: str, key: bytes, tmp_path: Path) -> None:
    (tmp_path / "key").write_text(text)
    assert read_key(tmp_path / "key") == key


@pytest.mark.parametrize("content", [None, b"", b"\n", b"two\nlines", b"x" * 5000])
def test_what_is_no_key_is_one_sentence(content: bytes | None, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "key").write_bytes(content)
    with pytest.raises(ConfigError, match="key"):
        read_key(tmp_path / "key")
