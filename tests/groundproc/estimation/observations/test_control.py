"""Control in the adjustment: surfaces, the rows they make, the search for where the map belongs, blunders."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy import sparse

from flightlog import frames
from groundproc.estimation.adjustment.posterior import Posterior, whole_covariance
from groundproc.estimation.adjustment.solve import Wide
from groundproc.estimation.observations.control import control_report, control_warnings
from groundproc.estimation.observations.datum import Datum, find_datum
from groundproc.estimation.observations.held import GATE_M, Held, held_to, spots_of
from groundproc.estimation.observations.rows import Unknowns, turned
from groundproc.estimation.observations.spots import Placing
from groundproc.estimation.observations.surfaces import Surface, near, surfaces
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import SLICE_NS, STEP_NS, STEPS
from groundproc.estimation.odometry.spline import Path
from groundproc.flight.control import ControlPoint

Array = npt.NDArray[np.float64]
INTERVALS = 30
START_NS = 1_779_000_000_000_000_000
NOISE_M = 0.008
SURVEY_M = 0.01


@pytest.fixture(scope="module")
def path() -> Path:
    seconds = np.arange(INTERVALS * STEPS + 1) * STEP_NS * 1e-9
    turn = np.stack([0.1 * np.sin(seconds), 0.1 * np.cos(seconds), 0.3 * seconds], axis=1)
    return Path(
        START_NS, frames.quat_exp(turn), np.stack([10 * seconds - 15, 2 * np.sin(seconds), 12 + 0 * seconds], axis=1)
    )


def face(corner: tuple[float, ...], a: tuple[float, ...], b: tuple[float, ...]) -> Array:
    """Places on a parallelogram, eleven a square metre, at random."""
    one, other = np.array(a, float), np.array(b, float)
    share = np.random.default_rng(7).random((int(11 * np.linalg.norm(np.cross(one, other))), 2))
    return np.asarray(np.array(corner, float) + share @ np.stack([one, other]))


GROUND = face((-40, -30, 0), (80, 0, 0), (0, 60, 0))
SOUTH = face((-10, -6, 0), (20, 0, 0), (0, 0, 6))
NORTH = face((-10, 6, 0), (20, 0, 0), (0, 0, 6))
WEST = face((-10, -6, 0), (0, 12, 0), (0, 0, 6))
EAST = face((10, -6, 0), (0, 12, 0), (0, 0, 6))
ROOF = face((-10, -6, 6), (20, 0, 0), (0, 6, 3))


def clusters_of(points: Array, path: Path, seed: int = 1) -> Clusters:
    """What a sensor on the path would have of points, at any times, with noise of its own."""
    rng = np.random.default_rng(seed)
    time_ns = np.sort(START_NS + rng.integers(1, INTERVALS * SLICE_NS - 1, len(points)))
    step = ((time_ns - START_NS) // STEP_NS).astype(int)
    share = ((time_ns - START_NS) / STEP_NS - step)[:, None]
    low, high = frames.mat_from_quat(path.quat[step]), frames.mat_from_quat(path.quat[step + 1])
    mats = low + share[:, :, None] * (high - low)
    origin = path.position_m[step] + share * (path.position_m[step + 1] - path.position_m[step])
    world = points[rng.permutation(len(points))] + NOISE_M * rng.standard_normal(points.shape)
    body = np.linalg.solve(mats, (world - origin)[:, :, None])[:, :, 0]
    count = len(points)
    return Clusters(time_ns, body.astype(np.float32), np.zeros((count, 6), np.float32), np.full(count, 8, np.int32))


@pytest.fixture(scope="module")
def town(path: Path) -> Clusters:
    return clusters_of(np.concatenate([GROUND, SOUTH, NORTH, WEST, EAST, ROOF]), path)


PLACES = {
    "G1": (-25.0, -20.0, 0.0), "G2": (25.0, -15.0, 0.0), "G3": (5.0, 20.0, 0.0), "G4": (-20.0, 15.0, 0.0),
    "S1": (-7.0, -6.0, 3.0), "S2": (6.0, -6.0, 2.0), "N1": (2.0, 6.0, 3.0), "N2": (-6.0, 6.0, 4.0),
    "W1": (-10.0, 2.0, 3.0), "W2": (-10.0, -3.0, 4.0), "E1": (10.0, -2.0, 3.0), "E2": (10.0, 3.0, 2.0),
}  # fmt: skip


def surveyed(*names: str, seed: int = 3, **blunders: tuple[float, ...]) -> tuple[ControlPoint, ...]:
    """True places of the town with the noise of a survey; blunders by name."""
    rng = np.random.default_rng(seed)
    return tuple(
        ControlPoint(
            name,
            np.add(PLACES[name], blunders.get(name, (0.0, 0.0, 0.0))) + SURVEY_M * rng.standard_normal(3),
            SURVEY_M,
        )
        for name in names or PLACES
    )


def covariance(shift_m: float, turn_deg: float) -> Array:
    """What is known of a map: tilt to 0.02 deg, heading and shift as given."""
    return np.diag(np.square([np.deg2rad(0.02), np.deg2rad(0.02), np.deg2rad(turn_deg), *[shift_m] * 3]))


def displaced(path: Path, shift: tuple[float, ...], heading_deg: float) -> Path:
    return path.turned(turned(np.array([0.0, 0.0, np.deg2rad(heading_deg)])), np.array(shift))


SHIFT, HEADING_DEG = (2.3, -3.1, 4.2), 1.1


def off_of(held: Held) -> tuple[Array, float]:
    """What is left of the displacement: of the house's middle [m], and of the heading [rad]."""
    mat, shift = held.datum.placing.as_turn()
    wrong = turned(np.array([0.0, 0.0, np.deg2rad(HEADING_DEG)]))
    left = mat @ wrong
    return mat @ np.array(SHIFT) + shift, float(np.arctan2(left[1, 0], left[0, 0]))


def test_the_surface_at_a_place_is_the_plane_through_its_clusters(town: Clusters, path: Path) -> None:
    places = np.array([PLACES["G1"], PLACES["S1"], (3.0, -3.0, 7.5), (0.0, 0.0, 30.0)])
    places[0, 2] += 0.05
    ground, wall, roof, nothing = surfaces(near(town, path, places, 2.0), places, [None] * 4, 0.2, 4.0)
    assert nothing is None
    assert ground is not None
    assert wall is not None
    assert roof is not None
    np.testing.assert_allclose(ground.along, [0, 0, 1])
    assert ground.distance_m == pytest.approx(0.05, abs=3.0 * ground.sigma_m)
    assert abs(wall.distance_m) < 3.0 * wall.sigma_m
    assert abs(abs(wall.along[1]) - 1.0) < 0.01
    assert abs(roof.along @ [0.0, -1.0, 2.0]) / np.sqrt(5.0) == pytest.approx(1.0, abs=0.01)
    # 0.3 m apart, 8 mm of noise and what the data sheet says: a centimetre
    assert ground.sigma_m < 0.02
    assert ground.shares.sum() == pytest.approx(1.0, abs=1e-3)


def test_a_stated_normal_chooses_the_surface(town: Clusters, path: Path) -> None:
    """At the foot of the wall: the ground for a normal that is up, the wall for one that is north."""
    place = np.array([[0.0, -6.0, 0.0]])
    seen = near(town, path, place, 2.0)
    up, north = (surfaces(seen, place, [np.eye(3)[axis]], 0.2, 4.0)[0] for axis in (2, 1))
    assert up is not None
    assert north is not None
    assert abs(up.along[2]) > 0.99
    assert abs(north.along[1]) > 0.99


def test_rows_are_the_derivative_of_the_distance(town: Clusters, path: Path) -> None:
    """By the spline's coefficients and the whole's turn and shift; the same clusters, their shares held."""
    points = surveyed("S1", "E2")
    held = held_to(points, town, path, covariance(0.05, 0.05), 4.0)
    assert held is not None
    unknowns = Unknowns(INTERVALS)
    unknowns.add("world.turn", np.ones(3))
    unknowns.add("world.shift", np.ones(3))
    factor = held.factor(town, path, unknowns)
    assert factor is not None
    assert factor.wide
    first = near(town, path, held.spots.place_m, 2.0)
    found = surfaces(first, held.spots.place_m, held.spots.normals, GATE_M, 4.0)

    def distances(moved: Path) -> Array:
        seen = near(town, moved, held.spots.place_m, 3.0)
        told = []
        for surface in found:
            assert isinstance(surface, Surface)
            rows = np.searchsorted(seen.index, first.index[surface.rows])
            told.append(-surface.shares @ (seen.world_m[rows] - first.world_m[surface.rows]) @ surface.along)
        return np.array(told)

    matrix = factor.matrix.toarray()
    size = 1e-4
    busiest = np.argsort(-np.abs(matrix[:, : unknowns.path_size]).max(axis=0))[:12]
    for column in busiest.tolist():
        step = np.zeros(unknowns.path_size)
        step[column] = size
        change = distances(path.corrected(step.reshape(-1, 6))) - distances(path.corrected(-step.reshape(-1, 6)))
        np.testing.assert_allclose(
            matrix[:, column], change / (2 * size), rtol=0, atol=0.02 * np.abs(matrix[:, column]).max()
        )
    for axis in range(3):
        step = size * np.eye(3)[axis]
        turn = distances(path.turned(turned(step), np.zeros(3))) - distances(path.turned(turned(-step), np.zeros(3)))
        shift = distances(path.turned(np.eye(3), step)) - distances(path.turned(np.eye(3), -step))
        at = unknowns.names
        np.testing.assert_allclose(matrix[:, at["world.turn"]][:, axis], turn / (2 * size), rtol=0, atol=0.02)
        np.testing.assert_allclose(matrix[:, at["world.shift"]][:, axis], shift / (2 * size), rtol=0, atol=1e-6)


def test_a_map_that_is_metres_and_a_degree_off_is_laid_on_its_control(town: Clusters, path: Path) -> None:
    held = held_to(surveyed(), town, displaced(path, SHIFT, HEADING_DEG), covariance(3.0, 1.0), 4.0)
    assert held is not None
    assert held.datum.active.all()
    shift, heading = off_of(held)
    # four points a direction, 1 cm each, and a centimetre of the map
    assert np.abs(shift).max() < 0.03
    assert abs(heading) < np.deg2rad(0.15)
    # before: what the displacement moved each surface by
    assert np.abs(held.before_m[held.spots.point < 4]).max() == pytest.approx(4.2, abs=0.1)


def test_a_blunder_is_named_and_not_followed(town: Clusters, path: Path) -> None:
    wrong = displaced(path, SHIFT, HEADING_DEG)
    points = surveyed(N1=(0.0, 0.5, 0.0), G3=(0.0, 0.0, -0.5))
    held = held_to(points, town, wrong, covariance(3.0, 1.0), 4.0)
    assert held is not None
    shift, heading = off_of(held)
    assert np.abs(shift).max() < 0.03
    assert abs(heading) < np.deg2rad(0.15)
    laid = wrong.turned(*held.datum.placing.as_turn())
    report = control_report(points, [held.report(town, laid)])
    assert report is not None
    assert sorted(report["rejected"]) == ["G3", "N1"]
    assert report["used"]["count"] == 10
    assert report["used"]["after_rms_m"] < 0.02
    assert re.search(r"N1 is 0\.(49|50|51)", report["note"])
    assert not control_warnings(points, [held.report(town, laid)])


def test_check_points_are_measured_and_not_used(town: Clusters, path: Path) -> None:
    points = tuple(replace(p, check=p.name in ("S2", "G4", "E1")) for p in surveyed(S2=(0.0, -0.3, 0.0)))
    held = held_to(points, town, path, covariance(0.05, 0.05), 4.0)
    assert held is not None
    told = {each["name"]: each for each in held.report(town, path)}
    assert told["S2"]["state"] == "check"
    assert abs(told["S2"]["after_m"]) == pytest.approx(0.3, abs=0.04)
    assert not held.datum.active[[list(PLACES).index(name) for name in ("S2", "G4", "E1")]].any()
    alone = tuple(replace(p, check=True) for p in surveyed("G1", "S1"))
    held = held_to(alone, town, path, covariance(3.0, 1.0), 4.0)
    assert held is not None
    np.testing.assert_allclose(held.datum.placing.mat, np.eye(3))
    assert held.factor(town, path, Unknowns(INTERVALS)) is None
    assert not control_warnings(alone, [held.report(town, path)])


def test_a_wall_that_no_other_point_foretells_is_not_guessed(town: Clusters, path: Path) -> None:
    """Ground tells height; one point on one wall, metres off, may be on any wall: it must not make the whole sure of itself."""
    points = surveyed("G1", "G2", "G3", "G4", "S1")
    held = held_to(points, town, displaced(path, SHIFT, HEADING_DEG), covariance(3.0, 1.0), 4.0)
    assert held is not None
    assert not held.datum.active[4]
    assert held.datum.doubtful[4] or held.datum.surfaces[4] is None
    shift, _ = off_of(held)
    assert abs(shift[2]) < 0.05
    # the plan stays what it was
    np.testing.assert_allclose(shift[:2], SHIFT[:2], rtol=0, atol=0.1)


def test_a_plane_holds_its_turn(path: Path) -> None:
    """A wall alone, 0.5 deg turned: its control plane says so."""
    clusters = clusters_of(SOUTH, path)
    wrong = path.turned(turned(np.array([0.0, 0.0, np.deg2rad(0.5)])), np.zeros(3))
    plane = ControlPoint("wall", np.array([0.0, -6.0, 3.0]), SURVEY_M, normal=np.array([0.0, 1.0, 0.0]), radius_m=2.5)
    held = held_to([plane], clusters, wrong, covariance(0.05, 1.0), 4.0)
    assert held is not None
    left = held.datum.placing.mat @ turned(np.array([0.0, 0.0, np.deg2rad(0.5)]))
    assert abs(np.rad2deg(np.arctan2(left[1, 0], left[0, 0]))) < 0.2
    (told,) = held.report(clusters, wrong.turned(*held.datum.placing.as_turn()))
    assert told["state"] == "used"
    assert told["tilt_deg"] < 0.3


def test_control_that_meets_nothing_is_said(town: Clusters, path: Path) -> None:
    far = tuple(replace(p, place_m=np.add(p.place_m, [0.0, 0.0, 60.0])) for p in surveyed())
    assert held_to(far, town, path, covariance(3.0, 1.0), 4.0) is None
    (warning,) = control_warnings(far, [[]])
    assert "none of the control points" in warning
    report = control_report(far, [[]])
    assert report is not None
    assert {each["state"] for each in report["points"]} == {"not seen"}
    assert control_report((), []) is None


def test_a_slope_under_an_unknown_place_is_no_certain_height(path: Path) -> None:
    """Ground of 5 deg, plan known to 2 m: heights are known to 0.17 m, whatever the survey's sigma."""
    slope = GROUND.copy()
    slope[:, 2] += np.tan(np.deg2rad(5.0)) * slope[:, 0]
    clusters = clusters_of(slope, path)
    names = ("G1", "G2", "G3", "G4")
    points = tuple(
        replace(p, place_m=np.add(p.place_m, [0, 0, np.tan(np.deg2rad(5.0)) * PLACES[p.name][0]]))
        for p in surveyed(*names)
    )
    known = np.diag(np.square([*[np.deg2rad(0.02)] * 3, 2.0, 2.0, 0.05]))
    datum = find_datum(spots_of(points), near(clusters, path, spots_of(points).place_m, 2.0), known, 4.0)
    assert datum is not None
    assert (datum.sigma_m > 0.15).all()
    assert (datum.sigma_m < 0.2).all()


def test_wide_rows_are_added_to_a_preconditioner() -> None:
    """Woodbury's formula against the dense inverse."""
    rng = np.random.default_rng(5)
    inner = rng.standard_normal((30, 30))
    inner = inner @ inner.T + 30 * np.eye(30)
    rows = 5.0 * rng.standard_normal((4, 30))

    class Inner:
        def near(self, right: Array) -> Array:
            return np.asarray(np.linalg.solve(inner, right))

    problem: Any = Inner()
    wide = Wide(sparse.csr_matrix(rows), problem)
    right = rng.standard_normal(30)
    np.testing.assert_allclose(
        wide.bordered(problem.near(right)), np.linalg.solve(inner + rows.T @ rows, right), rtol=1e-9, atol=1e-12
    )


def test_a_placing_undone_is_where_one_was() -> None:
    placing = Placing(np.array([5.0, -3.0, 2.0]), np.eye(3), np.zeros(3)).then(
        np.array([0.02, -0.01, 0.3, 1.0, 2.0, 3.0])
    )
    points = np.random.default_rng(2).standard_normal((20, 3)) * 20
    mat, shift = placing.as_turn()
    np.testing.assert_allclose(placing.back(points @ mat.T + shift), points, rtol=0, atol=1e-9)
    assert isinstance(Datum(placing, [], np.zeros(0, bool), np.zeros(0), np.zeros(0), np.zeros(0, bool)), Datum)


@pytest.mark.parametrize("by_spline", [False, True])
def test_the_whole_is_what_world_and_spline_make_together(path: Path, by_spline: bool) -> None:
    """A turn and shift of known covariance, once in the world's unknowns and once in the spline's coefficients."""
    unknowns = Unknowns(INTERVALS)
    unknowns.add("world.turn", np.ones(3))
    unknowns.add("world.shift", np.ones(3))
    root = np.random.default_rng(3).standard_normal((6, 6))
    wanted = root @ root.T
    motion = np.zeros((unknowns.size, 6))
    if by_spline:
        knots = np.clip(np.arange(-1, INTERVALS + 2) * STEPS, 0, len(path.quat) - 1)
        part = motion[: unknowns.path_size].reshape(-1, 6, 6)
        part[:, :3, :3] = np.swapaxes(frames.mat_from_quat(path.quat[knots]), 1, 2)
        part[:, 3:, :3] = np.cross(np.eye(3), path.position_m[knots][:, None]).swapaxes(1, 2)
        part[:, 3:, 3:] = np.eye(3)
    else:
        motion[unknowns.path_size :] = np.eye(6)

    class Known:
        def solve_all(self, rights: Array, enough: float) -> Array:
            assert enough < 1e-4
            return np.asarray(motion @ (wanted @ (motion.T @ rights)))

    known: Any = Known()
    np.testing.assert_allclose(whole_covariance(Posterior(known, unknowns, []), path), wanted, rtol=1e-9, atol=1e-9)
