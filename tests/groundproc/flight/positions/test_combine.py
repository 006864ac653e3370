"""Forward and backward made one: each rule by itself."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from groundproc.flight.positions.combine import combined, refuted
from groundproc.flight.positions.solution import Quality, Solution, diagonal_covariance

METRE_DEG = 1 / 111_200.0  # of latitude, about
LASTING = 10


def track(qualities: list[int], north_m: float = 0.0, sigma_m: float | npt.NDArray[np.float64] = 0.01) -> Solution:
    """One position a second, moved north."""
    n = len(qualities)
    return Solution(
        source="a.pos",
        format="RTKLIB .pos",
        point="antenna",
        height_reference="ellipsoid",
        sigma_source="RTKLIB's filter",
        time_ns=np.arange(n) * 10**9,
        latitude_deg=np.full(n, 58.39 + north_m * METRE_DEG),
        longitude_deg=np.full(n, 15.62),
        height_m=np.full(n, 100.0),
        covariance_m2=diagonal_covariance(np.broadcast_to(sigma_m, (3, n)).T.astype(float)),
        quality=np.array(qualities, np.uint8),
        satellites=np.full(n, 9.0),
        age_s=np.zeros(n),
        ratio=np.full(n, 5.0),
    )


def north_m(solution: Solution) -> npt.NDArray[np.float64]:
    return (solution.latitude_deg - 58.39) / METRE_DEG


LONG, SHORT = [1] * 20, [2] * 10 + [1] * 5 + [2] * 5
FLOATS = [2] * 20


def test_fixes_that_agree_are_one_fix_with_the_sigma_of_one() -> None:
    found = combined(track(LONG), track(LONG, 0.004), LASTING)
    assert (found.agreed, found.contradicted, found.unsupported) == (20, 0, 0)
    np.testing.assert_allclose(north_m(found.solution), 0.002, rtol=0, atol=1e-5)
    np.testing.assert_allclose(found.solution.sigma_m, 0.01, rtol=1e-6)


def test_fixes_that_contradict_are_a_float_as_wide_as_their_difference() -> None:
    found = combined(track(LONG), track(LONG, 0.4), LASTING)
    assert (found.agreed, found.contradicted) == (0, 20)
    assert (found.solution.quality == Quality.FLOAT).all()
    np.testing.assert_allclose(north_m(found.solution), 0.2, rtol=0, atol=1e-3)
    np.testing.assert_allclose(found.solution.sigma_m[:, 1], 0.4, rtol=0.01)
    np.testing.assert_allclose(found.solution.sigma_m[:, 0], 0.01, rtol=0.01)


def test_of_two_fixes_the_lasting_one_is_believed() -> None:
    for first, second, place in ((track(LONG), track(SHORT, 0.4), 0.0), (track(SHORT), track(LONG, 0.4), 0.4)):
        found = combined(first, second, LASTING).solution
        assert (found.quality[10:15] == Quality.FIX).all()
        np.testing.assert_allclose(north_m(found)[10:15], place, rtol=0, atol=1e-3)


def test_a_lasting_fix_within_the_others_float_is_kept() -> None:
    found = combined(track(LONG), track(FLOATS, 0.4, 0.3), LASTING).solution
    assert (found.quality == Quality.FIX).all()
    np.testing.assert_allclose(north_m(found), 0.0, rtol=0, atol=1e-6)


def test_a_lasting_fix_against_the_others_float_is_not() -> None:
    found = combined(track(FLOATS, 0.0, 0.05), track(LONG, 0.4), LASTING)
    assert found.contradicted == 20
    assert (found.solution.quality == Quality.FLOAT).all()
    np.testing.assert_allclose(north_m(found.solution), 0.0, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.solution.sigma_m[:, 1], np.hypot(0.05, 0.4), rtol=0.01)


def test_a_short_fix_of_one_run_alone_is_not_believed() -> None:
    found = combined(track(SHORT), track(FLOATS, 0.1, 0.3), LASTING)
    assert found.unsupported == 5
    assert (found.solution.quality == Quality.FLOAT).all()
    np.testing.assert_allclose(north_m(found.solution)[10:15], 0.1, rtol=0, atol=1e-3)
    np.testing.assert_allclose(found.solution.sigma_m[10:15], 0.3, rtol=1e-6)
    assert combined(track(SHORT), track(FLOATS, 0.1, 0.3), 0.0).solution.quality[12] == Quality.FIX


def test_floats_are_weighted_and_grow_where_they_contradict() -> None:
    found = combined(track(FLOATS, 0.0, 0.1), track(FLOATS, 0.1, 0.2), LASTING).solution
    np.testing.assert_allclose(north_m(found), 0.02, rtol=0, atol=1e-4)
    np.testing.assert_allclose(found.sigma_m, 1 / np.hypot(1 / 0.1, 1 / 0.2), rtol=1e-3)
    apart = combined(track(FLOATS, 0.0, 0.1), track(FLOATS, 2.0, 0.2), LASTING).solution
    assert apart.sigma_m[0, 1] == pytest.approx(
        np.sqrt(4 / (0.1**2 + 0.2**2) / 3) / np.hypot(1 / 0.1, 1 / 0.2), rel=0.01
    )


def test_the_better_kind_wins_and_epochs_of_one_run_stay() -> None:
    single, fixed = track([5] * 20, 3.0, 2.0), track([5] * 5 + [1] * 15)
    for pair in ((single, fixed), (fixed, single)):
        found = combined(*pair, LASTING).solution
        assert found.quality.tolist() == [5] * 5 + [1] * 15
        np.testing.assert_allclose(north_m(found)[5:], 0.0, rtol=0, atol=1e-6)
    late = replace(track(LONG), time_ns=np.arange(10, 30) * 10**9)
    found = combined(track(LONG), late, LASTING)
    assert found.agreed == 10
    assert found.solution.time_ns.tolist() == [k * 10**9 for k in range(30)]


def test_runs_that_share_no_epoch_are_put_together() -> None:
    found = combined(track([1]), replace(track([1]), time_ns=np.array([5 * 10**9])), LASTING).solution
    assert found.time_ns.tolist() == [0, 5 * 10**9]


def test_what_the_code_contradicts_is_put_to_where_the_code_has_it() -> None:
    code = track([4] * 40, 0.5, 1.0)
    drift = np.concatenate([np.zeros(20), np.full(20, 30.0)])
    astray = track([1] * 20 + [2] * 20, 0.0, 0.05)
    astray = replace(astray, latitude_deg=astray.latitude_deg + drift * METRE_DEG)
    found, number = refuted(astray, code)
    # over a window of 10 s the step is seen up to 5 s too early
    assert 20 <= number <= 25
    assert (found.quality[:15] == Quality.FIX).all()
    assert (found.quality[20:] == Quality.DGPS).all()
    np.testing.assert_allclose(north_m(found)[20:], 0.5, rtol=0, atol=1e-3)
    np.testing.assert_allclose(found.sigma_m[20:], 2.0)
    assert astray.quality[30] == Quality.FLOAT


def test_one_epoch_far_off_and_a_lost_filter_are_refuted_too() -> None:
    code = track([4] * 40, 0.0, 1.0)
    spike = track([2] * 40, 0.0, 0.05)
    spike.latitude_deg[20] += 20 * METRE_DEG
    found, number = refuted(spike, code)
    assert number == 1
    assert found.quality[20] == Quality.DGPS
    lost = track([2] * 40, 1.0, np.where(np.arange(40) < 30, 0.1, 20.0))
    assert refuted(lost, code)[0].quality.tolist() == [2] * 30 + [4] * 10


def test_metres_of_multipath_and_times_without_witness_refute_nothing() -> None:
    fixes = track([1] * 40)
    assert refuted(fixes, track([4] * 40, 2.0, 1.0)) == (fixes, 0)
    elsewhere = replace(track([4] * 40, 50.0, 1.0), time_ns=np.arange(40) * 10**9 + 10**15)
    assert refuted(fixes, elsewhere) == (fixes, 0)


def test_a_run_of_fixes_ends_where_its_velocities_do_not_explain_a_step() -> None:
    still = {
        "velocity_m_s": np.zeros((20, 3)),
        "velocity_covariance_m2_s2": diagonal_covariance(np.full((20, 3), 0.02)),
    }
    jumping = replace(track(LONG), **still)
    # for five seconds in the middle; at 1 Hz a jerk may explain metres, but not eight
    away = np.where((np.arange(20) >= 8) & (np.arange(20) < 13), 8.0, 0.0)
    jumping = replace(jumping, latitude_deg=jumping.latitude_deg + away * METRE_DEG)
    steady = replace(track(LONG), **still)
    for pair in ((jumping, steady), (steady, jumping)):
        found = combined(*pair, LASTING)
        assert found.contradicted == 5
        assert (found.solution.quality == Quality.FIX).all()
        np.testing.assert_allclose(north_m(found.solution), 0.0, rtol=0, atol=1e-3)
    assert found.solution.velocity_m_s is not None
    # without velocities, nobody can tell
    blind = replace(jumping, velocity_m_s=None, velocity_covariance_m2_s2=None)
    assert (combined(blind, track(LONG), LASTING).solution.quality[8:13] == Quality.FLOAT).all()
