"""A kind of observation that no file of the package knows: ranges to beacons, registered here alone, in adjustment and smoother."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import frames
from groundproc.estimation import observations
from groundproc.estimation.adjustment.batch import Batch
from groundproc.estimation.inertial.readings import Readings
from groundproc.estimation.inertial.smoother import solve
from groundproc.estimation.observations import observations_of
from groundproc.estimation.observations.lidar import DEFLATION, Lidar
from groundproc.estimation.observations.measured import Heard, Learnt, Measured, Rows
from groundproc.estimation.observations.observation import Flown, Observation, State, Stretch
from groundproc.estimation.observations.rows import Factor, RowBuilder, Unknowns, cross
from groundproc.estimation.observations.states import POSITION
from groundproc.estimation.odometry.grid import STEPS
from groundproc.estimation.odometry.spline import Path
from tests.helpers.circling import INTERVALS, circle, room

Array = npt.NDArray[np.float64]
BEACONS = np.array([[15.0, 3.0, 1.0], [-14.0, 6.0, 8.0], [2.0, -18.0, 3.0], [1.0, 2.0, 25.0]])
SIGMA_M = 0.02
OFFSET_M, OFFSET_SIGMA_M = 0.15, 0.5
KNOTS = np.arange(5, INTERVALS - 5)


@dataclass(slots=True)
class Beacons(Observation):
    """Ranges from knots of the path to beacons, with an offset of their own."""

    range_m: Array
    offset_m: Array = field(default_factory=lambda: np.zeros(1))
    name: str = "beacon"

    def unknowns(self, unknowns: Unknowns) -> None:
        unknowns.add("beacon.offset", np.array([OFFSET_SIGMA_M]), self.offset_m, unit="m")

    def factors(self, state: State, unknowns: Unknowns) -> list[Factor]:
        away = state.path.position_m[KNOTS * STEPS, None] - BEACONS
        distance = np.linalg.norm(away, axis=2)
        towards = (away / distance[:, :, None]).reshape(-1, 1, 3)
        builder, row, knot = (
            RowBuilder(towards.shape[0], unknowns),
            np.arange(towards.shape[0]),
            np.repeat(KNOTS, len(BEACONS)),
        )
        builder.at_knots(row, knot, 3, towards)
        builder.by(row, "world.shift", towards)
        builder.by(row, "world.turn", -towards @ cross(state.path.position_m[knot * STEPS]))
        builder.by(row, "beacon.offset", np.ones((len(row), 1, 1)))
        residual = (distance + self.offset_m - self.range_m).ravel()
        return [Factor(self.name, residual, builder.matrix(), np.full(len(residual), SIGMA_M))]

    def take(self, part: Mapping[str, Array], path: Path) -> None:
        del path
        self.offset_m = self.offset_m + part["beacon.offset"]


def true_ranges() -> Array:
    return np.asarray(np.linalg.norm(circle().position_m[KNOTS * STEPS, None] - BEACONS, axis=2) + OFFSET_M)


def of_run(flown: Flown) -> list[Observation]:
    del flown
    return [Beacons(true_ranges())]


@dataclass(frozen=True, slots=True)
class BeaconRows(Measured):
    """The same in the smoother, of a vehicle that hovers."""

    time_s: Array
    range_m: Array
    learnt: Mapping[str, Learnt] = field(default_factory=dict)

    def rows(self, rows: Rows) -> None:
        place, inside = rows.at(self.time_s)
        for beacon, stated in zip(BEACONS, self.range_m.T, strict=True):
            away = place.position_m - beacon
            distance = np.linalg.norm(away, axis=1)
            columns = [(POSITION + axis, away[:, axis] / distance) for axis in range(3)]
            rows.add("beacon", place.node, columns, stated[inside] - distance, SIGMA_M)


HOVER_M = np.array([1.0, -2.0, 10.0])


def of_leg(heard: Heard) -> list[Measured]:
    time_s: Array = np.arange(0.0, heard.stated.nodes_s[-1], 0.5)
    return [BeaconRows(time_s, np.tile(np.linalg.norm(HOVER_M - BEACONS, axis=1), (len(time_s), 1)))]


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "kind_of_a_test", sys.modules[__name__])
    monkeypatch.setitem(observations.KINDS, "beacon", "kind_of_a_test")


def by_hand(path: Path, own: Beacons, found: Unknowns) -> tuple[Array, Array]:
    """Ranges by every unknown, through differences of the path itself; and what is left of them."""

    def modelled(x: Array) -> Array:
        moved = path.corrected(x[: found.path_size].reshape(-1, 6))
        whole = x[found.names["world.turn"]]
        mat = frames.mat_from_quat(frames.quat_exp(whole[None]))[0]
        moved = moved.turned(mat, x[found.names["world.shift"]])
        ranges = np.linalg.norm(moved.position_m[KNOTS * STEPS, None] - BEACONS, axis=2)
        return np.asarray((ranges + own.offset_m + x[found.names["beacon.offset"]]).ravel())

    size = 1e-4
    columns = [(modelled(size * unit) - modelled(-size * unit)) / (2 * size) for unit in np.eye(found.size)]
    return np.stack(columns, axis=1), modelled(np.zeros(found.size)) - own.range_m.ravel()


def test_one_more_kind_pulls_the_path_as_least_squares_says(registered: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lidar, beacons and priors, all dense, against one step of the batch; the path came in 0.3 m off, which the lidar cannot know."""
    del registered
    monkeypatch.setattr(observations, "KINDS", {"beacon": observations.KINDS["beacon"]})
    anything: Any = None
    started = circle().turned(np.eye(3), np.array([0.25, -0.1, 0.15]))
    stretch = Stretch(started, "", np.zeros(3), whole=True)
    beacons = [each.begin(stretch) for each in observations_of(Flown(anything, [], {}))]
    (own,) = beacons
    assert isinstance(own, Beacons)
    batch = Batch(started, Lidar(room(circle())), beacons, np.eye(3))
    found = batch.unknowns()
    rows = batch.lidar.rows(started, 1.0, cut=True)
    normal = np.zeros((found.size, found.size))
    normal[: rows.size, : rows.size] = np.stack([rows.apply(unit) for unit in np.eye(rows.size)], axis=1) / DEFLATION
    right = np.zeros(found.size)
    right[: rows.size] = rows.gradient() / DEFLATION
    matrix, left = by_hand(started, own, found)
    normal += matrix.T @ matrix / SIGMA_M**2
    right += matrix.T @ left / SIGMA_M**2
    sigma = np.concatenate([np.tile([np.deg2rad(10.0)] * 3 + [5.0] * 3, INTERVALS + 3), *found.sigma.values()])
    expected = np.linalg.solve(normal + np.diag(sigma**-2.0), -right)
    batch.step(1.0, cut=True, learn=False)
    # the step stops where the cost is known to a thousandth of a sigma squared or so
    path = started.corrected(expected[: found.path_size].reshape(-1, 6))
    mat = frames.mat_from_quat(frames.quat_exp(expected[found.names["world.turn"]][None]))[0]
    path = path.turned(mat, expected[found.names["world.shift"]])
    np.testing.assert_allclose(batch.path.position_m, path.position_m, rtol=0, atol=2e-3)
    np.testing.assert_allclose(own.offset_m, expected[found.names["beacon.offset"]], rtol=0, atol=2e-3)
    assert batch.log[0]["beacon_rms"] == pytest.approx(np.sqrt(np.mean(np.square(left / SIGMA_M))))
    batch.step(1.0, cut=True, learn=False)
    off = np.linalg.norm(batch.path.position_m - circle().position_m, axis=1)
    assert np.linalg.norm(started.position_m - circle().position_m, axis=1).min() > 0.3
    assert off.mean() < 0.02
    assert own.offset_m[0] == pytest.approx(OFFSET_M, abs=0.02)


def hovering(seconds: float = 20.0) -> Readings:
    """A vehicle that stands in the air, with fixes of 2 m that are 1 m off, and no inertial sensors."""
    nodes_s: Array = np.arange(0.0, seconds, 0.01)
    fix_s, attitude_s = np.arange(0.0, seconds, 0.2), np.arange(0.0, seconds, 0.1)
    level = np.tile([1.0, 0.0, 0.0, 0.0], (len(attitude_s), 1))
    place = np.tile(HOVER_M + np.array([0.6, -0.6, 0.5]), (len(fix_s), 1))
    return Readings(
        10**18, 10_000_000, nodes_s, fix_s, place, np.full((len(fix_s), 3), 2.0), np.zeros((len(fix_s), 3)), True, attitude_s, level,
        np.empty(0), np.empty(0), np.zeros(3), [], 9.81, 0, None, None,
    )  # fmt: skip


def test_one_more_kind_pulls_the_smoother(registered: None) -> None:
    """Four ranges of 2 cm twice a second, where the fixes have a lasting error of 2 m: they say where it is."""
    del registered
    found = solve(hovering())
    assert found.rows["beacon"] == 4 * 40
    assert np.abs(found.position_m - HOVER_M).max() < 0.03
    assert found.residual_rms["beacon"] < SIGMA_M


def test_without_it_the_fixes_are_believed() -> None:
    found = solve(hovering())
    assert "beacon" not in found.rows
    assert np.linalg.norm(found.position_m - HOVER_M, axis=1).min() > 0.8
