"""The picture of the adjustment's residuals."""

import struct
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import frames
from groundproc.estimation.adjustment.figures import changed, outcome_figures
from groundproc.products.adjustment_plot import Sheet, _stretches, _table, draw_sheet, sheet_of, title

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
    seen = {
        "slice_s": np.linspace(0.1, 10.0, 100), "matched": matched, "seen": np.full(100, 3000.0),
        "residual_m": np.where(matched > 50, 0.02, np.nan), "sigma_s": np.arange(0, 10, 0.5),
        "sigma_position_m": rng.uniform(0.5, 1.0, (20, 3)), "sigma_attitude_rad": rng.uniform(1e-4, 1e-3, (20, 3)),
        "moved_m": rng.normal(0, 0.01, (101, 3)), "turned_rad": rng.normal(0, 1e-4, (101, 3)),
        "position_s": np.arange(0, 10, 0.3), "position_off_m": rng.normal(0, 1, (34, 3)), "position_sigma_m": np.ones((34, 3)),
        "heading_rad": rng.uniform(0, 6.28, 99), "heading_off_rad": rng.normal(0, 0.1, 99),
    }  # fmt: skip
    last_round = {"chi_square": 1.02, "moved_m": 0.001, "position_rms": 0.5, "prior_rms": 9.0}
    estimated = {
        "ins.turn_deg": {
            "value": [0.1, 0.2, 0.3], "sigma": [0.2, 0.2, 2.9], "prior_sigma": [3.0, 3.0, 3.0], "held": [False, False, True],
        },
        "ins.delay_s": {"value": [0.0081], "sigma": [0.00002], "prior_sigma": [0.01], "held": [False]},
        "compass_deg": {"value": [1.0, 8.0, 0.0, 0.0, 2.0], "sigma": [1.0] * 5, "prior_sigma": [9.0] * 5, "held": [False] * 5},
    }  # fmt: skip
    figures = {f"adjustment.{name}": values for name, values in seen.items()}
    made = sheet_of(figures | outcome_figures(2, 1, False, last_round, estimated))
    assert made is not None
    return made


def test_a_path_turned_and_moved_as_a_whole_has_notchanged() -> None:
    quat, position = path_of(200, 1)
    turn = frames.quat_exp(np.array([[0.1, -0.3, 2.0]]))
    mat = frames.mat_from_quat(turn)[0]
    moved, turned = changed(
        quat, position, frames.quat_multiply(np.repeat(turn, 200, axis=0), quat), position @ mat.T + [5.0, -3.0, 1.0]
    )
    np.testing.assert_allclose(moved, 0.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(turned, 0.0, rtol=0, atol=1e-9)


def test_one_pose_that_differs_shows_as_itself() -> None:
    quat, position = path_of(1000, 2)
    other = position.copy()
    other[500] += [0.0, 0.0, 0.1]
    moved, _ = changed(quat, position, quat, other)
    assert moved[500, 2] == pytest.approx(0.1, abs=2e-4)
    assert np.abs(np.delete(moved, 500, axis=0)).max() < 2e-4


def test_blind_stretches_are_found_at_both_ends() -> None:
    flags = np.array([True, True, False, True, False, False, True])
    assert _stretches(flags) == [(0, 2), (3, 4), (6, 7)]
    assert _stretches(np.zeros(3, np.bool_)) == []


def test_the_table_has_units_that_people_read_and_tells_what_is_held(sheet: Sheet) -> None:
    rows = _table(sheet)
    assert [held for _, held in rows] == [False, False, True, *[False] * 6]
    assert [rows[i][0][1] for i in (0, 1, 2)] == ["boresight x [deg]", "boresight y [deg]", "boresight z [deg]"]
    assert rows[3][0][1:4] == ["delay  [ms]", "8.1", "0.02"]
    assert rows[8][0][1:4] == ["compass cos2 [deg]", "2", "1"]


def test_the_title_says_how_it_ended(sheet: Sheet) -> None:
    assert title(sheet) == (
        "10 s, 2 window(s), 20 % without planes, 1 restarts\nresiduals in sigma, last round: lidar chi-square 1.02, position 0.50"
    )
    nothing = np.zeros(0)
    causal = replace(
        sheet, windows=np.array(0), round_name=nothing.astype(np.str_), round_value=nothing, is_worse=np.array(True)
    )
    assert (
        title(causal)
        == "10 s, causal, 20 % without planes, 1 restarts; the trajectory is what the adjustment began from"
    )


def test_a_picture_is_drawn_with_and_without_parameters(sheet: Sheet, tmp_path: Path) -> None:
    heights = []
    none, no_rows = np.zeros(0), np.zeros((0, 3))
    bare = replace(
        sheet, estimated_name=none.astype(np.str_), estimated_value=none, curve_rad=none, heading_rad=none, heading_off_rad=none,
        moved_m=no_rows, turned_rad=no_rows,
    )  # fmt: skip
    for one in (sheet, bare):
        draw_sheet(one).savefig(tmp_path / "adjustment.png")
        head = (tmp_path / "adjustment.png").read_bytes()[:24]
        assert head[:8] == b"\x89PNG\r\n\x1a\n"
        heights.append(struct.unpack(">II", head[16:24])[1])
    assert heights[0] > heights[1] > 500


def test_the_figures_survive_a_file_of_arrays(sheet: Sheet, tmp_path: Path) -> None:
    """No array is of objects: what is drawn after years is what was estimated."""
    named = {f"adjustment.{each.name}": getattr(sheet, each.name) for each in fields(sheet)}
    np.savez(tmp_path / "figures.npz", **named)
    with np.load(tmp_path / "figures.npz", allow_pickle=False) as file:
        again = sheet_of(dict(file))
    assert again is not None
    assert title(again) == title(sheet)
    assert _table(again) == _table(sheet)
    assert sheet_of({}) is None
