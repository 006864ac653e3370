"""The mask against a loop over every single shot."""

from fractions import Fraction
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flightlog.records import SCAN_PACKET_DTYPE
from onboard import fovmask
from onboard.fovmask import Window

Packets = npt.NDArray[np.void]


def packet(azimuths: list[int], mode: int = 0x37) -> Packets:
    """One packet with these block azimuths; ranges and intensities tell block and laser."""
    out = np.zeros(1, SCAN_PACKET_DTYPE)
    out["data"]["blocks"]["flag"] = 0xEEFF
    out["data"]["blocks"]["azimuth"] = azimuths
    out["data"]["blocks"]["returns"]["range"] = 1 + np.arange(12 * 32).reshape(12, 32)
    out["data"]["blocks"]["returns"]["intensity"] = np.arange(12 * 32).reshape(12, 32) % 251
    out["data"]["return_mode"] = mode
    out["data"]["product"] = 0x21
    return out


def sweep(start: int, step: int, mode: int = 0x37) -> list[int]:
    """Block azimuths of a head that turns by `step` from firing to firing."""
    firings = [b // 2 if mode == 0x39 else b for b in range(12)]
    return [(start + step * firing) % 36000 for firing in firings]


def brute_force(azimuths: list[int], mode: int, window: Window) -> list[bool]:
    """Which blocks have a shot inside: one shot after the other, in exact fractions."""
    firings = azimuths[::2] if mode == 0x39 else azimuths
    steps = sorted((after - before) % 36000 for before, after in pairwise(firings))
    step = min(steps[len(steps) // 2], 100)
    kept = []
    for azimuth in azimuths:
        inside = False
        for laser in range(32):
            shot = azimuth + Fraction(step * laser * 1152, 46080)
            rounded = int(shot + Fraction(1, 2)) % 36000
            if window.start <= window.end:
                inside |= window.start <= rounded <= window.end
            else:
                inside |= rounded >= window.start or rounded <= window.end
        kept.append(inside)
    return kept


windows = st.builds(
    lambda start, width: Window(start, (start + width) % 36000), st.integers(0, 35999), st.integers(10, 35990)
)


@st.composite
def sweeps(draw: st.DrawFn) -> tuple[list[int], int, Window]:
    window = draw(windows)
    mode = draw(st.sampled_from([0x37, 0x38, 0x39]))
    step = draw(st.integers(1, 34))
    near = draw(st.sampled_from([window.start, window.end, 0]))
    start = near + draw(st.integers(-14 * step, 3 * step))
    azimuths = sweep(start, step, mode)
    if draw(st.booleans()):  # what the sensor itself does at the end of a turn, now and then
        azimuths = [36000 if azimuth == 0 else azimuth for azimuth in azimuths]
    return azimuths, mode, window


@settings(max_examples=400, deadline=None)
@given(sweeps())
def test_blocks_are_kept_exactly_where_one_of_their_shots_is_inside(case: tuple[list[int], int, Window]) -> None:
    azimuths, mode, window = case
    expected = brute_force(azimuths, mode, window)
    before = packet(azimuths, mode)
    masked = fovmask.apply(before, window)
    assert len(masked.packets) == any(expected)
    assert masked.masked_packets == (not any(expected))
    assert masked.masked_blocks == (expected.count(False) if any(expected) else 0)
    if any(expected):
        ranges = masked.packets["data"]["blocks"]["returns"]["range"][0]
        assert np.array_equal(ranges[expected], before["data"]["blocks"]["returns"]["range"][0][expected])
        assert not ranges[~np.array(expected)].any()


@settings(max_examples=200, deadline=None)
@given(st.lists(st.integers(0, 36000), min_size=12, max_size=12), st.sampled_from([0x37, 0x39, 0]), windows)
def test_azimuths_without_sense_are_masked_as_the_loop_does(azimuths: list[int], mode: int, window: Window) -> None:
    before = packet(azimuths, mode)["data"]
    inside = fovmask.blocks_inside(before["blocks"]["azimuth"], before["return_mode"], window)
    # A window narrower than the gap between two shots may lie between them: such a block is kept.
    assert all(
        kept or not expected for kept, expected in zip(inside[0], brute_force(azimuths, mode, window), strict=True)
    )


@settings(max_examples=100, deadline=None)
@given(sweeps())
def test_only_ranges_change_and_the_input_never(case: tuple[list[int], int, Window]) -> None:
    azimuths, mode, window = case
    before = packet(azimuths, mode)
    original = before.copy()
    masked = fovmask.apply(before, window)
    assert before["data"].tobytes() == original["data"].tobytes()
    if len(masked.packets):
        after = masked.packets.copy()
        after["data"]["blocks"]["returns"]["range"] = original["data"]["blocks"]["returns"]["range"]
        assert after["data"].tobytes() == original["data"].tobytes()


@pytest.mark.parametrize(
    ("azimuth_deg", "kept"),
    [
        (0, True),
        (104.9, True),
        (105.0, True),
        (105.2, False),
        (180, False),
        (254.5, False),
        (255.0, True),
        (359.9, True),
    ],
)
def test_a_window_through_north_keeps_what_lies_ahead(azimuth_deg: float, kept: bool) -> None:
    still = packet([round(azimuth_deg * 100)] * 12)
    assert len(fovmask.apply(still, Window.from_degrees(255, 105)).packets) == kept


def test_azimuth_36000_is_north() -> None:
    assert len(fovmask.apply(packet([36000] * 12), Window.from_degrees(350, 10)).packets) == 1
    assert len(fovmask.apply(packet([36000] * 12), Window.from_degrees(10, 350)).packets) == 0


def test_a_block_that_turns_into_the_window_is_kept() -> None:
    # 254.90 deg, 0.166 deg from firing to firing: the last shot is at 254.90 + 0.775 * 0.17 = 255.03 deg
    azimuths = sweep(25490 - 11 * 17, 17)
    masked = fovmask.apply(packet(azimuths), Window.from_degrees(255, 105))
    assert masked.masked_blocks == 11
    assert masked.packets["data"]["blocks"]["returns"]["range"][0, 11].all()


def test_the_gap_of_a_sensor_that_masks_itself_is_not_taken_for_its_step() -> None:
    azimuths = [10480 + 17 * i for i in range(2)] + [25480 + 17 * i for i in range(10)]
    inside = fovmask.blocks_inside(np.array([azimuths], np.uint16), np.array([0x37], np.uint8), Window(25500, 10500))
    assert inside[0].tolist() == [True, True, False, *[True] * 9]


@pytest.mark.parametrize("edges", [(0, 0), (0, 360), (360, 0), (77.5, 77.5)])
def test_equal_edges_are_the_full_circle(edges: tuple[float, float]) -> None:
    packets = packet(sweep(0, 17))
    masked = fovmask.apply(packets, Window.from_degrees(*edges))
    assert masked.packets is packets
    assert (masked.masked_packets, masked.masked_blocks) == (0, 0)


def test_no_packets_are_no_trouble() -> None:
    assert len(fovmask.apply(np.empty(0, SCAN_PACKET_DTYPE), Window(25500, 10500)).packets) == 0


def test_a_recorded_turn_is_masked_as_the_loop_does(monterey_data: list[bytes]) -> None:
    packets = np.zeros(len(monterey_data), SCAN_PACKET_DTYPE)
    packets["data"] = np.frombuffer(b"".join(monterey_data), packets["data"].dtype)
    window = Window.from_degrees(255, 105)
    inside = fovmask.blocks_inside(packets["data"]["blocks"]["azimuth"], packets["data"]["return_mode"], window)
    for row, one in list(zip(inside, packets, strict=True))[:700]:  # four turns
        assert row.tolist() == brute_force(one["data"]["blocks"]["azimuth"].tolist(), 0x37, window)
    assert 0.57 < inside.mean() < 0.60  # 210 of 360 deg
