"""The picture of the adjustment's residuals."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import frames
from groundproc.products.adjustment_plot import Sheet, _changed, _stretches, _table, draw_adjustment

Array = npt.NDArray[np.float64]


def path_of(count: int, seed: int) -> tuple[Array, Array]:
    """Attitudes, shape (count, 4), and positions, shape (count, 3), of a winding flight."""
    rng = np.random.default_rng(seed)
    return frames.quat_exp(rng.normal(0.0, 0.5, (count, 3)).cumsum(axis=0) * 0.1), rng.normal(0.0, 3.0, (count, 3))


@pytest.fixture
def sheet() -> Sheet:
    rng = np.random.default_rng(5)
    matched = np.full(100, 2000.0)
    matched[40:60] = 3.0
    return Sheet(
        "a flight", np.linspace(0.1, 10.0, 100), matched, np.full(100, 3000.0), np.where(matched > 50, 0.02, np.nan),
        np.arange(0, 10, 0.5), rng.uniform(0.5, 1.0, (20, 3)), rng.uniform(1e-4, 1e-3, (20, 3)), rng.normal(0, 0.01, (101, 3)),
        rng.normal(0, 1e-4, (101, 3)), np.arange(0, 10, 0.3), rng.normal(0, 1, (34, 3)), np.ones((34, 3)), rng.uniform(0, 6.28, 99),
        rng.normal(0, 0.1, 99), np.deg2rad([1.0, 8.0, 0.0, 0.0, 2.0]),
        {
            "ins.turn_deg": {
                "value": [0.1, 0.2, 0.3], "sigma": [0.2, 0.2, 2.9], "prior_sigma": [3.0, 3.0, 3.0], "held": [False, False, True],
            },
            "ins.delay_s": {"value": [0.0081], "sigma": [0.00002], "prior_sigma": [0.01], "held": [False]},
        },
    )  # fmt: skip


def test_a_path_turned_and_moved_as_a_whole_has_not_changed() -> None:
    quat, position = path_of(200, 1)
    turn = frames.quat_exp(np.array([[0.1, -0.3, 2.0]]))
    mat = frames.mat_from_quat(turn)[0]
    moved, turned = _changed(
        quat, position, frames.quat_multiply(np.repeat(turn, 200, axis=0), quat), position @ mat.T + [5.0, -3.0, 1.0]
    )
    np.testing.assert_allclose(moved, 0.0, atol=1e-9)
    np.testing.assert_allclose(turned, 0.0, atol=1e-9)


def test_one_pose_that_differs_shows_as_itself() -> None:
    quat, position = path_of(1000, 2)
    other = position.copy()
    other[500] += [0.0, 0.0, 0.1]
    moved, _ = _changed(quat, position, quat, other)
    assert moved[500, 2] == pytest.approx(0.1, abs=2e-4)
    assert np.abs(np.delete(moved, 500, axis=0)).max() < 2e-4


def test_blind_stretches_are_found_at_both_ends() -> None:
    flags = np.array([True, True, False, True, False, False, True])
    assert _stretches(flags) == [(0, 2), (3, 4), (6, 7)]
    assert _stretches(np.zeros(3, np.bool_)) == []


def test_the_table_has_units_that_people_read_and_tells_what_is_held(sheet: Sheet) -> None:
    rows = _table(sheet.estimated)
    assert [held for _, held in rows] == [False, False, True, False]
    assert rows[0][0][1] == "boresight x [deg]"
    assert rows[3][0][1:4] == ["delay  [ms]", "8.1", "0.02"]


def test_a_picture_is_drawn_with_and_without_parameters(sheet: Sheet, tmp_path: Path) -> None:
    heights = []
    none, no_rows = np.zeros(0), np.zeros((0, 3))
    bare = replace(
        sheet, estimated={}, curve_rad=None, heading_rad=none, heading_off_rad=none, moved_m=no_rows, turned_rad=no_rows
    )
    for one in (sheet, bare):
        draw_adjustment(tmp_path / "adjustment.png", one)
        head = (tmp_path / "adjustment.png").read_bytes()[:24]
        assert head[:8] == b"\x89PNG\r\n\x1a\n"
        heights.append(struct.unpack(">II", head[16:24])[1])
    assert heights[0] > heights[1] > 500
    assert [path.name for path in tmp_path.iterdir()] == ["adjustment.png"]
