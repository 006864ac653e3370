"""The parts of a strip adjustment against numpy, scipy and textbook formulas."""

from pathlib import Path

import aerial
import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from flightlog.errors import SwathError
from groundproc.cloud.gpstime import Clock
from groundproc.estimation.observations.rows import Unknowns
from groundproc.geodesy import projected_crs
from groundproc.numerics.planerows import TILT_PRIOR
from groundproc.strips.adjust import Linear, Sigmas, constant_prior, wandering
from groundproc.strips.clouds import chunks, look
from groundproc.strips.clusters import CLUSTER, Gatherer
from groundproc.strips.correction import Correction
from groundproc.strips.cutting import BIN_NS, Occupancy
from groundproc.strips.differences import Differences, Patches
from groundproc.strips.options import StripOptions
from groundproc.strips.route import Route, read_route
from groundproc.strips.rows import Bordered, bordered
from groundproc.strips.work import check

Array = npt.NDArray[np.float64]
CONSTANTS = ["boresight_rad", "lever_m", "shift_m"]


@pytest.fixture(scope="module")
def clusters() -> npt.NDArray[np.void]:
    """Two strips, 5 cm apart, over a slope and a wall, from changing attitudes."""
    rng = np.random.default_rng(3)
    n = 3000
    out = np.zeros(n, CLUSTER)
    out["time_ns"] = np.sort(rng.integers(0, 20_000_000_000, n))
    out["strip"] = out["time_ns"] // 10_000_000_000
    x, y = rng.uniform(0, 12, (2, n))
    place = np.stack([x, y, 0.1 * x + 0.05 * out["strip"] + 0.02 * rng.standard_normal(n)], axis=1)
    wall = rng.random(n) < 0.3
    place[wall] = np.stack([x, np.full(n, 6.3) + 0.02 * rng.standard_normal(n), 1 + y], axis=1)[wall]
    out["place"] = place
    out["arm"] = place - [6, 6, 40]
    out["quat"] = Rotation.from_euler("ZXY", rng.normal(0, 1, (n, 3)) * [1, 0.1, 0.1]).as_quat(scalar_first=True)
    out["count"] = rng.integers(1, 6, n)
    return out


def some_correction(scale: float = 1e-3) -> Correction:
    rng = np.random.default_rng(8)
    none = Correction.none(0, 20_000_000_000, 2.0)
    return none.changed(
        scale * rng.standard_normal(none.coefficients.shape),
        {name: scale * rng.standard_normal(3) for name in CONSTANTS},
    )


def rows_of(clusters: npt.NDArray[np.void], correction: Correction) -> Bordered:
    made = bordered(clusters, correction, 2.0, 0.02, True, CONSTANTS, np.zeros(len(clusters)))
    assert made is not None
    return made


def dense(made: Bordered) -> tuple[Array, Array]:
    """All columns of splines and constants, and those of the planes, written out."""
    rows = made.rows
    size = (rows.intervals + 3) * 6
    by_path = np.zeros((len(rows), size))
    for i in range(len(rows)):
        for j in range(4):
            place = slice((rows.knot[i] + j) * 6, (rows.knot[i] + j) * 6 + 6)
            by_path[i, place] = rows.weights[i, j] * rows.jacobian[i]
    voxels = len(rows.first) - 1
    by_plane = np.zeros((len(rows), 3 * voxels))
    for v in range(voxels):
        here = slice(rows.first[v], rows.first[v + 1])
        by_plane[here, 3 * v] = 1.0
        by_plane[here, 3 * v + 1 : 3 * v + 3] = rows.plane[here]
    return np.concatenate([by_path, made.constants], axis=1), by_plane


def test_planes_are_eliminated_as_if_they_were_unknowns(clusters: npt.NDArray[np.void]) -> None:
    made = rows_of(clusters, some_correction())
    columns, planes = dense(made)
    weight = made.rows.weight[:, None]
    prior = np.tile([1e-6, (2.0 * TILT_PRIOR) ** -2, (2.0 * TILT_PRIOR) ** -2], planes.shape[1] // 3)
    inner = planes.T @ (weight * planes) + np.diag(prior)
    cross = columns.T @ (weight * planes)
    wanted = columns.T @ (weight * columns) - cross @ np.linalg.solve(inner, cross.T)
    found = np.tril(made.normal())
    np.testing.assert_allclose(found, np.tril(wanted), rtol=0, atol=2e-5 * np.abs(wanted).max())
    right = columns.T @ (made.rows.weight * made.rows.residual_m)
    right -= cross @ np.linalg.solve(inner, planes.T @ (made.rows.weight * made.rows.residual_m))
    np.testing.assert_allclose(made.right(made.rows.residual_m), right, rtol=0, atol=1e-5 * np.abs(right).max())


def test_columns_are_the_derivatives_of_the_moved_points(clusters: npt.NDArray[np.void]) -> None:
    correction = some_correction(1e-4)
    made = rows_of(clusters, correction)
    columns, _ = dense(made)
    chosen = clusters[made.rows.cluster]
    normal = made.rows.jacobian[:, 3:].astype(float)
    step = 1e-4

    def along(other: Correction) -> Array:
        move, _ = other.moved(
            np.ascontiguousarray(chosen["time_ns"]), chosen["arm"].astype(float), chosen["quat"].astype(float)
        )
        return np.asarray((move * normal).sum(axis=1))

    base = along(correction)
    for column in (0, 8, 16, 27, 35):
        change = np.zeros(correction.coefficients.size)
        change[column] = step
        moved = along(correction.changed(change.reshape(-1, 6), {}))
        np.testing.assert_allclose((moved - base) / step, columns[:, column], rtol=0, atol=0.02)
    for number, name in enumerate(CONSTANTS):
        moved = along(correction.changed(np.zeros_like(correction.coefficients), {name: np.array([0, step, 0])}))
        size = correction.coefficients.size
        np.testing.assert_allclose((moved - base) / step, columns[:, size + 3 * number + 1], rtol=0, atol=0.02)


def test_the_prior_is_the_process_that_it_is_called() -> None:
    """Its inverse is the covariance of a Matern 3/2 process: sigma^2 (1 + a t) exp(-a t)."""
    correction = Correction.none(0, 80_000_000_000, 1.0)
    unknowns = Unknowns(correction.intervals)
    options = StripOptions(position_time_s=20.0, attitude_time_s=10.0)
    factor = wandering(correction, unknowns, Sigmas(0.2, 0.01), options)
    weighted = factor.matrix.toarray() / factor.sigma[:, None]
    covariance = np.linalg.inv(weighted.T @ weighted)
    at_knots = np.zeros((81, unknowns.size))
    for axis, sigma, tau in ((5, 0.2, 20.0), (1, 0.01, 10.0)):
        at_knots[:] = 0
        for k in range(81):
            at_knots[k, (k + np.arange(3)) * 6 + axis] = np.array([1, 4, 1]) / 6
        found = at_knots @ covariance @ at_knots.T
        lag = np.abs(np.subtract.outer(np.arange(81), np.arange(81))) * np.sqrt(3) / tau
        # knots a tenth of the process' time apart: its steps are coarse by some percent
        np.testing.assert_allclose(found, sigma**2 * (1 + lag) * np.exp(-lag), rtol=0, atol=0.08 * sigma**2)


def test_sigmas_are_those_of_the_inverse(clusters: npt.NDArray[np.void]) -> None:
    correction = some_correction()
    made = rows_of(clusters, correction)
    unknowns = Unknowns(correction.intervals)
    for name in CONSTANTS:
        unknowns.add(name, np.full(3, 0.1))
    factors = [wandering(correction, unknowns, Sigmas(0.1, 0.01), StripOptions()), constant_prior(correction, unknowns)]
    linear = Linear(made, factors)
    lower = np.tril(made.normal()) / 4.0
    normal = lower + np.tril(lower, -1).T
    for factor in factors:
        weighted = factor.matrix.toarray() / factor.sigma[:, None]
        normal += weighted.T @ weighted
    covariance = np.linalg.inv(normal)
    wanted = np.sqrt(np.diag(covariance))[-9:]
    found = linear.constant_sigmas()
    np.testing.assert_allclose(np.concatenate([found[name] for name in CONSTANTS]), wanted, rtol=1e-4)


def test_points_move_as_from_the_corrected_pose() -> None:
    """The ray as it was, from the corrected pose with the corrected mount."""
    correction = some_correction(0.02)
    rng = np.random.default_rng(5)
    time = rng.integers(0, 20_000_000_000, 50)
    attitude, place, lever_arm = Rotation.random(50, rng=2), rng.normal(0, 50, (50, 3)), np.array([0.3, -0.2, 0.1])
    ray = rng.normal(0, 30, (50, 3))
    scanner = place + attitude.apply(lever_arm)
    arm = attitude.apply(ray)
    quat = attitude.as_quat(scalar_first=True)
    move, _ = correction.moved(time, arm, quat)
    position, turned = correction.poses(time, place, quat, lever_arm)
    now = Rotation.from_quat(turned, scalar_first=True)
    mount = Rotation.from_rotvec(correction.boresight_rad)
    again = position + now.apply(lever_arm + correction.lever_m) + (now * mount).apply(ray)
    np.testing.assert_allclose(again, scanner + arm + move, rtol=0, atol=1e-9)


def test_clusters_have_the_moments_of_their_points() -> None:
    rng = np.random.default_rng(1)
    xyz, eye = rng.uniform(0, 3, (5000, 3)), rng.normal(0, 10, (5000, 3))
    time = np.sort(rng.integers(0, 1_000_000_000, 5000))
    quat = np.tile([1.0, 0, 0, 0], (5000, 1))
    gatherer = Gatherer(1.0, 10**6)
    gatherer.add(time, xyz, eye, quat, np.zeros(5000, np.int32), time // BIN_NS)
    found = gatherer.clusters()
    assert found["count"].sum() == 5000
    assert len(found) == len(np.unique(np.column_stack([np.floor(xyz), time // BIN_NS]), axis=0))
    one = found[100]
    members = (np.floor(xyz) == np.floor(one["place"])).all(axis=1) & (time // BIN_NS == one["time_ns"] // BIN_NS)
    assert members.sum() == one["count"]
    np.testing.assert_allclose(one["place"], xyz[members].mean(axis=0), rtol=0, atol=1e-9)
    np.testing.assert_allclose(one["arm"], (xyz - eye)[members].mean(axis=0), rtol=0, atol=1e-5)
    off = xyz[members] - xyz[members].mean(axis=0)
    np.testing.assert_allclose(one["scatter"], (off.T @ off)[np.triu_indices(3)], rtol=0, atol=1e-4)


def test_memory_is_bounded_and_what_is_kept_is_kept_in_all_strips() -> None:
    rng = np.random.default_rng(1)
    gatherer = Gatherer(0.5, 4000)
    for strip in range(6):
        xyz = rng.uniform(0, 200, (20_000, 3)) * [1, 1, 0.01]
        time = np.full(20_000, strip * 10**9)
        gatherer.add(time, xyz, xyz, np.ones((20_000, 4)), np.full(20_000, strip, np.int32), time)
    found = gatherer.clusters()
    assert 1000 < len(found) <= 4000
    assert 0 < gatherer.share < 0.2
    # blocks that some strip has, nearly all strips have
    blocks = np.floor(found["place"] / 4.0)
    kept, count = np.unique(blocks[:, :2], axis=0, return_counts=True)
    assert np.median(count) > 20
    # and they are strewn over the whole area
    quarter, _, _ = np.histogram2d(*(kept * 4.0).T, bins=2)
    assert quarter.min() > 0.1 * quarter.sum()


def test_merging_by_strip_keeps_the_moments() -> None:
    rng = np.random.default_rng(1)
    xyz = rng.uniform(0, 2, (4000, 3))
    gatherer = Gatherer(1.0, 10**6, merge=True)
    none = np.zeros((1000, 4))
    for part in xyz.reshape(4, 1000, 3):
        gatherer.add(np.zeros(1000, int), part, none[:, :3], none, np.zeros(1000, np.int32), np.zeros(1000, int))
    found = gatherer.clusters()
    assert len(found) == 8
    for one in found:
        members = xyz[(np.floor(xyz) == np.floor(one["place"])).all(axis=1)]
        assert one["count"] == len(members)
        np.testing.assert_allclose(one["place"], members.mean(axis=0), rtol=0, atol=1e-7)
        off = members - members.mean(axis=0)
        np.testing.assert_allclose(one["scatter"], (off.T @ off)[np.triu_indices(3)], rtol=1e-4, atol=1e-3)


def two_strips(up: float, east: float) -> Differences:
    """Level ground and a wall to the east, the second strip higher by `up` and farther east by `east`."""
    rng = np.random.default_rng(6)
    patches = Patches(1.0)
    for strip, (high, far) in enumerate([(0.0, 0.0), (up, east)]):
        ground = np.stack([*rng.uniform(0, 15, (2, 20_000)), np.full(20_000, 0.3 + high)], axis=1)
        wall = np.stack([np.full(8000, 20.7 + far), *(rng.uniform(0, 10, (2, 8000)))], axis=1)
        xyz = np.concatenate([ground, wall])
        patches.add(xyz + 0.005 * rng.standard_normal(xyz.shape), np.full(len(xyz), strip, np.int32))
    return patches.differences()


def test_differences_have_the_size_and_sign_of_what_strips_differ_by() -> None:
    found = two_strips(0.12, -0.07)
    told = found.summary()
    assert told["height"]["median_m"] == pytest.approx(0.12, abs=0.002)
    assert told["plan"]["median_m"] == pytest.approx(-0.07, abs=0.002)
    # what scatter lets expect is what there is
    level = found.normal[:, 2] > 0.94
    z = (found.along_m[level] - 0.12) / found.sigma_m[level]
    assert 0.8 < z.std() < 1.25
    assert (found.strips == [0, 1]).all()
    assert found.by_pair()[0]["count"] == len(found)


def test_the_self_check_sees_what_got_worse() -> None:
    better, worse = two_strips(0.01, 0.01), two_strips(0.05, 0.01)
    check(worse, better)
    with pytest.raises(SwathError, match=r"differ by 0\.0[45]\d* m .* nothing was written"):
        check(better, worse)
    with pytest.raises(SwathError, match="patches are common"):
        check(better, two_strips(50.0, 50.0))


@pytest.fixture(scope="module")
def route(tmp_path_factory: pytest.TempPathFactory) -> Route:
    path = tmp_path_factory.mktemp("route") / "given.csv"
    aerial.write_csv(path, aerial.flown())
    return read_route(path, projected_crs(aerial.EPSG), near_utc_ns=None, week=None)


def test_a_route_is_on_the_map_with_grid_north(route: Route) -> None:
    flight = aerial.flown()
    np.testing.assert_allclose(route.poses.position_m + route.origin_m, flight.place_m, rtol=0, atol=2e-5)
    found = Rotation.from_quat(route.poses.quat_local_ins_wxyz, scalar_first=True)
    np.testing.assert_allclose((found.inv() * flight.attitude).magnitude(), 0, rtol=0, atol=1e-7)


def occupied(
    route: Route, ids: npt.NDArray[np.int64] | None = None, without_s: tuple[float, float] = (0, 0)
) -> Occupancy:
    occupancy = Occupancy(route)
    time = np.arange(int(route.poses.time_ns[0]), int(route.poses.time_ns[-1]), BIN_NS // 2)
    since = (time - time[0]) * 1e-9
    time = time[(since < without_s[0]) | (since >= without_s[1])]
    occupancy.add(time, np.zeros(len(time), int) if ids is None else ids[: len(time)], 0)
    return occupancy


def test_strips_end_at_turns(route: Route) -> None:
    strips = occupied(route).cut(2.0, 45.0)
    corners = np.array(aerial.LINES, float)
    legs = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    # two turns of 90 deg, 2 or 3 s apart, are one; the last one, 8 s after, is its own
    turns = np.cumsum(legs)[:-1] / 9.0
    cuts = strips.first_bin[1:] * BIN_NS * 1e-9
    np.testing.assert_allclose(
        cuts, [turns[0:2].mean(), turns[2:4].mean(), turns[4:6].mean(), turns[6]], rtol=0, atol=1.5
    )
    assert (strips.of_bin >= 0).all()


def test_arcs_of_a_circle_are_strips(tmp_path: Path) -> None:
    angle = np.linspace(0, 6 * np.pi, 150)
    flight = aerial.flown([(40 * np.cos(a), 40 * np.sin(a)) for a in angle], speed=10)
    aerial.write_csv(tmp_path / "c.csv", flight)
    circle = read_route(tmp_path / "c.csv", projected_crs(aerial.EPSG), near_utc_ns=None, week=None)
    # none turns by more than 100 deg in its inner 60 %
    assert 6 <= len(occupied(circle).cut(2.0, 45.0)) <= 13


def test_strips_end_at_gaps_and_follow_their_ids(route: Route) -> None:
    plain = len(occupied(route).cut(2.0, 45.0))
    # in the middle of the first leg
    assert len(occupied(route, without_s=(5.0, 8.0)).cut(2.0, 45.0)) == plain + 1
    assert len(occupied(route, without_s=(5.0, 6.0)).cut(2.0, 45.0)) == plain
    count = 10**5
    by_id = occupied(route, np.arange(count) // 200).cut(2.0, 45.0)
    assert by_id.by.startswith("point source id")
    # two scanners at once, or tiles: ids that alternate are no strips
    assert occupied(route, np.arange(count) // 2 % 2).cut(2.0, 45.0).by.startswith("turns")


def test_stamps_of_both_kinds_and_of_careless_programs_are_the_same_utc(tmp_path: Path) -> None:
    scan = aerial.scanned(aerial.flown([(-10, 0), (10, 0)]), aerial.Errors(), rate_hz=200)
    wanted = aerial.START_NS + np.rint(scan.time_s * 1e9)
    standard = aerial.START_NS * 1e-9 + aerial.GPS_MINUS_UNIX_S + scan.time_s - 1e9
    for named, weekly in (
        ({}, False),
        ({"week_time": True}, True),
        ({"week_time": True, "gps_s": standard}, False),  # the bit is not set, the times are standard
    ):
        aerial.write_las(tmp_path / "c.laz", scan, scan.placed_m, **named)
        cloud = look(tmp_path / "c.laz")
        assert cloud.week_time == weekly
        (chunk,) = chunks([cloud], Clock(near_utc_ns=aerial.START_NS + 3 * 86_400 * 10**9))
        # a double of adjusted standard time resolves 60 ns, of Unix seconds 240 ns
        np.testing.assert_allclose(chunk.time_ns - aerial.START_NS, wanted - aerial.START_NS, rtol=0, atol=500)


def test_a_bad_control_file_names_its_line(tmp_path: Path) -> None:
    from groundproc.strips.control import read_control

    for text, sentence in (
        ("x,y,z\n1,2,3", "no column sigma"),
        ("x,y,z,sigma\n1,2,3,0.1\n1,2,three,0.1", "line 3"),
        ("x,y,z,sigma\n1,2,3,0", "line 2"),
        ("x,y,z,sigma\n", "holds no points"),
        ("", "no column"),
    ):
        (tmp_path / "c.csv").write_text(text)
        with pytest.raises(SwathError, match=sentence):
            read_control(tmp_path / "c.csv")
    (tmp_path / "c.csv").write_text("name, sigma, z, y, x\na, 0.02, 3, 2, 1\n\n")
    np.testing.assert_allclose(read_control(tmp_path / "c.csv"), [[1, 2, 3, 0.02]])
