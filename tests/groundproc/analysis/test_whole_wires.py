"""Conductors by all their points, and what is thin beside roofs and trees."""

import numpy as np
import pytest

from groundproc.analysis.corridor import spans
from groundproc.analysis.corridor.catenary import Catenary
from groundproc.analysis.corridor.poles import Pole, upright
from groundproc.analysis.corridor.spans import attached, conductors
from groundproc.analysis.corridor.whole import Whole
from groundproc.analysis.terrain.building import roofs

ALONG = np.array([1.0, 0.0])


def straight(y: float, start: float, end: float, z: float = 8.0) -> Catenary:
    return Catenary(np.array([0.0, y]), ALONG, start, end, 400.0, 0.5 * (start + end), z, 0.05, 100)


def test_a_wire_is_the_mean_of_its_passes_and_ends_at_the_roof() -> None:
    """Seven passes, the first 9 cm high; a roof begins where the wire ends."""
    rng = np.random.default_rng(0)
    true = straight(0.0, 0.0, 40.0)
    s = rng.uniform(0.0, 40.0, 7000)
    wire = np.column_stack([s, np.zeros_like(s), true.height(s)]) + rng.normal(0, 0.02, (7000, 3))
    wire[:1000, 2] += 0.09
    roof = np.column_stack(
        [rng.uniform(40, 46, 4000), rng.uniform(-3, 3, 4000), np.full(4000, true.height(np.array([40.0]))[0])]
    )
    whole = Whole([straight(0.03, 0.2, 43.0, 8.05)])
    for piece in np.array_split(rng.permutation(np.concatenate([wire, roof])), 5):
        whole.add(piece)
    (found,) = whole.fitted()
    assert found.places(1e9)[:, 0].max() == pytest.approx(40.0, abs=0.2)
    at = np.array([2.0, 20.0, 38.0])
    _, off, up = found.local(np.column_stack([at, np.zeros(3), true.height(at)]))
    assert up == pytest.approx([-0.09 / 7] * 3, abs=0.005)
    assert off == pytest.approx([0.0] * 3, abs=0.005)


@pytest.mark.parametrize("a_metre", [5, 64])
def test_an_end_is_on_average_where_the_wire_ends(a_metre: int) -> None:
    """Few hits stop short of it, by 14 cm in the middle; noise of many goes on beyond it."""
    rng = np.random.default_rng(a_metre)
    true, ends = straight(0.0, 0.0, 40.0), []
    for _ in range(60):
        s = rng.uniform(0.0, 40.0, 40 * a_metre)
        whole = Whole([straight(0.03, -0.3, 40.3)])
        whole.add(np.column_stack([s, np.zeros_like(s), true.height(s)]) + rng.normal(0, 0.03, (len(s), 3)))
        (found,) = whole.fitted()
        first, last = np.sort(found.places(1e9)[:, 0])
        ends += [-first, last - 40.0]
    # the sigma of a median is 1.25 times that of a mean
    assert abs(np.median(ends)) < 3.0 * 1.25 * np.std(ends) / np.sqrt(len(ends))


def test_fits_that_fall_together_are_one_wire() -> None:
    """What began as two pieces beside each other."""
    rng = np.random.default_rng(5)
    true = straight(0.0, 0.0, 40.0)
    s = rng.uniform(0.0, 40.0, 2000)
    whole = Whole([straight(0.12, 0.0, 30.0), straight(-0.03, 0.0, 40.0)])
    whole.add(np.column_stack([s, np.zeros_like(s), true.height(s)]) + rng.normal(0, 0.03, (2000, 3)))
    (found,) = whole.fitted()
    assert found.points > 1500
    assert found.length_m == pytest.approx(40.0, abs=4.0 * 0.03 * np.sqrt(2.0))


def test_wires_end_at_the_pole_that_bears_the_others_too() -> None:
    line, lamp = Pole(40.0, 0.0, 0.0, 9.0, 1.0), Pole(42.0, 1.5, 0.0, 7.0, 1.0)
    wires = [straight(0.1 * n, 0.5, 41.3 if n == 1 else 39.7, 8.0 + 0.4 * n) for n in range(3)]
    assert [each.end_m for each in attached(wires, [line, lamp])] == pytest.approx([40.0] * 3)


def test_a_thick_mast_stands_at_its_middle() -> None:
    rng = np.random.default_rng(2)
    turn, up = rng.uniform(0, 2 * np.pi, 3000), rng.uniform(0, 30, 3000)
    xyz = np.column_stack([10 + 0.5 * np.cos(turn), 20 + 0.5 * np.sin(turn), up]) + rng.normal(0, 0.02, (3000, 3))
    (mast,) = upright(xyz, up.astype(np.float32), np.ones(3000, np.bool_))
    assert (mast.x, mast.y) == pytest.approx((10.0, 20.0), abs=0.05)


@pytest.mark.parametrize("over_water", [False, True])
def test_wires_on_the_edges_of_cells_are_no_roof_and_a_house_is_one(over_water: bool) -> None:
    """A wire, or over land three of them a metre apart, that fill two rows each; water answers nowhere."""
    ground, low = np.zeros((60, 80), np.float32), np.full((60, 80), 0.0 if over_water else 4.0, np.float32)
    top = np.full((60, 80), np.nan if over_water else 0.1, np.float32)
    rows = slice(40, 42) if over_water else slice(40, 46)
    top[rows] = 8.0
    top[10:20, 30:45], low[11:19, 31:44] = 6.0, 0.0
    found = roofs(top, ground, low, 0.5)
    assert not found[rows].any()
    assert found[10:20, 30:45].mean() > 0.95


def test_spans_of_a_long_line_are_compared_with_those_near_them_only(monkeypatch: pytest.MonkeyPatch) -> None:
    calls, apart = [], spans._apart

    def counted(wire: Catenary, points_m: np.ndarray) -> np.ndarray:
        calls.append(len(points_m))
        return apart(wire, points_m)

    monkeypatch.setattr(spans, "_apart", counted)
    rng = np.random.default_rng(5)
    chains = []
    for number in range(24):
        s = np.linspace(0.0, 50.0, 60)
        z = 12.0 + 200.0 * (np.cosh((s - 25.0) / 200.0) - 1.0)
        chains.append(np.column_stack([50.0 * number + s, 0.3 * (50.0 * number + s), z]) + rng.normal(0, 0.02, (60, 3)))
    assert len(conductors(chains)) == 24
    # four times each with itself and what is beside it
    assert len(calls) < 4 * 24 * 5
    assert sum(calls) < 4 * 24 * 5 * 60
