"""Points in the world against the source's row-vector equation, written out here with scipy, and against plain geometry."""

import struct
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flightlog import hdl32e
from flightlog.mount import LidarMount, Mount
from groundproc.cloud.georeference import georeference, project
from groundproc.cloud.points import Dropped
from groundproc.geodesy import LocalFrame, Projection, projected_crs
from groundproc.sensors import hdl32e as model
from groundproc.sensors.shots import Gate, Shots
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]

FRAME = LocalFrame(58.394, 15.574, 61.3)
START_NS = 1_779_272_223_000_000_000


def by_the_source(g: float, a: float, b: float) -> Array:
    """R(g, a, b) of FOI-R--4045--SE, step 1, for row vectors: element by element as printed."""
    cg, sg, ca, sa, cb, sb = np.cos(g), np.sin(g), np.cos(a), np.sin(a), np.cos(b), np.sin(b)
    return np.array(
        [
            [cg * cb - sg * sa * sb, cb * sg + cg * sa * sb, -ca * sb],
            [-ca * sg, cg * ca, sa],
            [cg * sb + cb * sg * sa, sg * sb - cg * cb * sa, ca * cb],
        ]
    )


def quat_wxyz(heading: float, pitch: float, roll: float) -> Array:
    """Attitude as scipy composes it: turned left by minus the heading, then nose up, then right side down."""
    x, y, z, w = Rotation.from_euler("ZXY", [-heading, pitch, roll]).as_quat()
    return np.array([w, x, y, z])


def decoded(packets: npt.NDArray[np.void], times: npt.NDArray[np.int64], gate: Gate | None = None) -> Shots:
    """Packets of one return mode as shots."""
    (shots,) = model.LIDAR.decode(packets, times, gate)
    return shots


def at_rest(position: Array, quat: Array, start_ns: int = START_NS, seconds: int = 2) -> Trajectory:
    """A trajectory that stays where it is."""
    times = start_ns + np.arange(-1, seconds + 1, dtype=np.int64) * 1_000_000_000
    many = len(times)
    zero = np.zeros((many, 3))
    covered = np.append(np.ones(many - 1, bool), False)
    return Trajectory(
        FRAME, times, np.tile(position, (many, 1)), zero, np.tile(quat, (many, 1)), zero, zero, zero, covered
    )


def turning(count: int, seed: int = 1, mode: int = 0x37) -> npt.NDArray[np.void]:
    """Packets of a sensor that turns at 10 Hz, with random ranges, a tenth of them empty."""
    rng = np.random.default_rng(seed)
    content = b""
    for packet in range(count):
        for block in range(12):
            firing = packet * 12 + block if mode != 0x39 else packet * 6 + block // 2
            content += struct.pack("<HH", 0xEEFF, round(firing * 16.5888) % 36_000)
            ranges = rng.integers(500, 50_000, 32) * (rng.random(32) > 0.1)
            content += b"".join(
                struct.pack("<HB", int(r), int(i)) for r, i in zip(ranges, rng.integers(0, 256, 32), strict=True)
            )
        content += struct.pack("<IBB", 0, mode, 0x21)
    return np.frombuffer(content, hdl32e.DATA_DTYPE)


ANGLE = st.floats(-np.pi, np.pi)
TILT = st.floats(-1.4, 1.4)
LENGTH = st.floats(-3.0, 3.0)


@settings(max_examples=60, deadline=None)
@given(
    mount=st.tuples(ANGLE, TILT, ANGLE),
    lever=st.tuples(LENGTH, LENGTH, LENGTH),
    attitude=st.tuples(st.floats(0.0, 2 * np.pi), TILT, ANGLE),
    position=st.tuples(st.floats(-500, 500), st.floats(-500, 500), st.floats(-50, 200)),
    mode=st.sampled_from([0x37, 0x39]),
)
def test_every_point_is_where_the_sources_equation_puts_it(
    mount: tuple[float, ...],
    lever: tuple[float, float, float],
    attitude: tuple[float, ...],
    position: tuple[float, ...],
    mode: int,
) -> None:
    packets = turning(2, mode=mode)
    times = START_NS + np.array([0, 552_960], np.int64)
    yaw_deg, pitch_deg, roll_deg = np.rad2deg(mount)
    bolted = Mount(LidarMount(lever, float(yaw_deg), float(pitch_deg), float(roll_deg)))
    points = georeference(decoded(packets, times), at_rest(np.array(position), quat_wxyz(*attitude)), bolted)
    shots = decoded(packets, times)
    # step 2: p2 = p1 R(mount) + lever arm; step 3: p3 = p2 R(-heading, pitch, roll) + position
    heading, pitch, roll = attitude
    on_airframe = sensor_xyz(packets, times, shots) @ by_the_source(*mount) + np.array(lever)
    expected = on_airframe @ by_the_source(-heading, pitch, roll) + np.array(position)
    np.testing.assert_allclose(points.xyz_m, expected, rtol=0, atol=2e-5)  # xyz_m as float32: 4e-6 m an axis at 100 m
    assert (points.time_ns == shots.time_ns).all()
    for name in ("intensity", "laser"):
        assert (points[name] == getattr(shots, name)).all()
    assert (points["range"] == shots.range_m).all()
    assert (points["return_number"] == shots.returns & 15).all()
    assert (points["number_of_returns"] == shots.returns >> 4).all()


def sensor_xyz(packets: npt.NDArray[np.void], times: npt.NDArray[np.int64], shots: Shots) -> Array:
    """Step 1 in float64 from the packets' bytes: where the rotor stood when each laser fired (manual, appendix on firing times).

    Of the shots only time, laser and range are taken. A firing lasts 46.08 us, the lasers of it follow each other every 1.152 us, and
    the rotor turns on meanwhile by the packet's own step: the middle one of those from each firing to the next.
    """
    azimuth_deg = np.empty(len(shots))
    packet = np.searchsorted(times, shots.time_ns, side="right") - 1
    for number, payload in enumerate(packets):
        content = payload.tobytes()
        each = 2 if content[1204] == 0x39 else 1  # blocks of a firing
        blocks = [struct.unpack_from("<H", content, 100 * block + 2)[0] for block in range(0, 12, each)]
        steps = sorted((after - before) % 36_000 for before, after in pairwise(blocks))
        mine = packet == number
        firing = (shots.time_ns[mine] - times[number]) // 46_080
        turned = steps[len(steps) // 2] * (1.152 / 46.08) * shots.laser[mine]
        azimuth_deg[mine] = (np.array(blocks)[firing] + turned) / 100.0
    azimuth, elevation = np.deg2rad(azimuth_deg), np.deg2rad(hdl32e.ELEVATION_DEG)[shots.laser]
    reach_m = shots.range_m.astype(np.float64)
    across = np.stack(
        [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)], axis=1
    )
    return np.asarray(reach_m[:, None] * across)


@pytest.mark.parametrize("heading_deg", [0.0, 90.0, 180.0, 270.0, 33.0])
@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(0.0, 0.0), (12.0, 0.0), (0.0, -15.0), (-9.0, 20.0)])
def test_level_ground_is_level_in_every_attitude(heading_deg: float, pitch_deg: float, roll_deg: float) -> None:
    """Ranges to a plane 10 m below are computed by intersecting rays; a transposed matrix tilts it by 40 deg."""
    airframe = Rotation.from_euler("ZXY", [-heading_deg, pitch_deg, roll_deg], degrees=True)
    tilt = Rotation.from_euler("X", -20.0, degrees=True)
    lidar_up_m = airframe.apply([0.0, 0.0, -0.16])[2]
    azimuth = np.rint(np.arange(163 * 12) * 18.4).astype(int) % 36_000  # one turn
    turned = np.deg2rad(azimuth[:, None] / 100 + 0.184 * np.arange(32) * 1.152 / 46.08)
    up = np.deg2rad(hdl32e.ELEVATION_DEG)
    rays = np.stack([np.cos(up) * np.sin(turned), np.cos(up) * np.cos(turned), np.sin(up) + 0 * turned], axis=-1)
    down = airframe.apply(tilt.apply(rays.reshape(-1, 3)))[:, 2].reshape(-1, 32)
    packets = np.zeros(163, hdl32e.DATA_DTYPE)
    packets["return_mode"], packets["product"] = 0x37, 0x21
    packets["blocks"]["azimuth"] = azimuth.reshape(163, 12)
    reach_m = np.where(down < -0.15, -(10.0 + lidar_up_m) / np.minimum(down, -0.15), 0.0)
    packets["blocks"]["returns"]["range"] = np.rint(reach_m / 0.002).reshape(163, 12, 32)
    attitude = quat_wxyz(*np.deg2rad([heading_deg, pitch_deg, roll_deg]))
    points = georeference(
        decoded(packets, np.full(163, START_NS)), at_rest(np.array([3.0, 4.0, 110.0]), attitude), Mount()
    )
    assert len(points) > 10_000
    # half a range step, and the difference between the median step (18 or 19) and 18.4 over a firing, under 67 m of range
    np.testing.assert_allclose(points.xyz_m[:, 2], 100.0, rtol=0, atol=0.001 + np.deg2rad(0.006) * 67.0)
    # forward is where the heading points: tilted forward, the lidar sees more ground ahead
    ahead = (points.xyz_m[:, :2] - [3.0, 4.0]) @ [np.sin(np.deg2rad(heading_deg)), np.cos(np.deg2rad(heading_deg))]
    assert ahead.mean() > 1.0 or pitch_deg > 0


def test_each_shot_has_the_pose_of_its_own_instant() -> None:
    """Spinning at 100 deg/s and flying at 10 m/s, against scipy's slerp at the instant of each shot."""
    packets = turning(60)
    times = START_NS + np.arange(60, dtype=np.int64) * 552_960
    knots = START_NS + np.arange(-10, 10, dtype=np.int64) * 10_000_000
    seconds = (knots - START_NS) * 1e-9
    spin = np.deg2rad([3.0, -2.0, 100.0])
    base = Rotation.from_euler("ZXY", [0.3, 0.1, -0.2])
    turned = base * Rotation.from_rotvec(seconds[:, None] * spin)
    speed = np.array([10.0, -4.0, 1.0])
    quat = np.roll(turned.as_quat(), 1, axis=1)
    many = (len(knots), 3)
    trajectory = Trajectory(
        FRAME, knots, seconds[:, None] * speed, np.tile(speed, (len(knots), 1)), quat, np.tile(spin, (len(knots), 1)),
        np.zeros(many), np.zeros(many), np.append(np.ones(len(knots) - 1, bool), False),
    )  # fmt: skip
    points = georeference(decoded(packets, times), trajectory, Mount())
    shots = decoded(packets, times)
    own_s = (shots.time_ns - START_NS) * 1e-9
    tilt = Rotation.from_euler("X", -20.0, degrees=True)
    on_airframe = tilt.apply(sensor_xyz(packets, times, shots)) + np.array([0.0, 0.0, -0.16])
    expected = (base * Rotation.from_rotvec(own_s[:, None] * spin)).apply(on_airframe) + own_s[:, None] * speed
    # chord of 0.5 ms at 100 deg/s: (8.7e-4 rad)^2 / 8 of 100 m is 1e-5 m; xyz_m as float32: 8e-6 m; the trajectory's spline: 2e-6 m
    np.testing.assert_allclose(points.xyz_m, expected, rtol=0, atol=2e-5)


def test_a_held_pose_grid_gives_each_shot_the_nearest_pose() -> None:
    packets = turning(60)
    times = START_NS + np.arange(60, dtype=np.int64) * 552_960
    resting = at_rest(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    knots = START_NS + np.arange(-5, 10, dtype=np.int64) * 10_000_000
    many = len(knots)
    zero = np.zeros((many, 3))
    where = np.stack([np.arange(many) * 1.0, np.zeros(many), np.zeros(many)], axis=1)
    held = Trajectory(
        FRAME, knots, where, zero, np.tile([1.0, 0, 0, 0], (many, 1)), zero, zero, zero,
        np.append(np.ones(many - 1, bool), False), interpolation="hold",
    )  # fmt: skip
    shots = decoded(packets, times)
    moved = georeference(shots, held, Mount()).xyz_m - georeference(shots, resting, Mount()).xyz_m
    late = shots.time_ns - knots[0]
    nearest = -(-(late - 5_000_000) // 10_000_000)  # halfway between two poses the earlier one holds
    np.testing.assert_allclose(moved[:, 0], nearest, rtol=0, atol=1e-5)


def test_what_makes_no_point_is_counted_by_its_first_reason() -> None:
    packets = turning(400)
    times = START_NS + np.arange(400, dtype=np.int64) * 552_960
    whole = at_rest(np.zeros(3), np.array([1.0, 0, 0, 0]))
    gate = Gate(255.0, 105.0, 5.0, 60.0)
    points = georeference(decoded(packets, times, gate), whole, Mount())
    shots = decoded(packets, times, Gate(255.0, 105.0))
    filled = packets.copy()
    filled["blocks"]["returns"]["range"] = 1
    lost = points.dropped
    assert len(points) + lost.no_pose + lost.outside_fov + lost.no_return + lost.out_of_range == 400 * 384
    assert len(points) == ((shots.range_m > 4.9999) & (shots.range_m < 60.0001)).sum()
    assert lost.out_of_range == len(shots) - len(points)
    assert lost.no_return == len(decoded(filled, times, Gate(255.0, 105.0))) - len(shots)
    assert lost.no_pose == 0
    short = at_rest(np.zeros(3), np.array([1.0, 0, 0, 0]), START_NS - 2_000_000_000 + 100 * 552_960)
    cut = georeference(decoded(packets, times, gate), short, Mount())
    # the end of the trajectory falls on the stamp of packet 100, the instant of its first shot, which is covered still
    assert len(cut) == np.count_nonzero(points.time_ns <= times[100])
    assert cut.dropped.no_pose == len(points) - len(cut)
    assert Dropped(1, 2, 3, 4) + Dropped(10, 20, 30, 40) == Dropped(11, 22, 33, 44)


def test_two_returns_of_a_pair_lie_on_one_line_from_the_lidar(data_payload: Callable[..., bytes]) -> None:
    payload = bytearray(data_payload(0, [100 * (b // 2) for b in range(12)], mode=0x39))
    for block in range(12):
        for laser in range(32):
            struct.pack_into("<HB", payload, 100 * block + 4 + 3 * laser, 3000 if block % 2 else 4500, laser)
    packets = np.frombuffer(bytes(payload), hdl32e.DATA_DTYPE)
    where = np.array([10.0, 20.0, 30.0])
    quat = quat_wxyz(1.0, 0.2, -0.1)
    points = georeference(decoded(packets, np.array([START_NS])), at_rest(where, quat), Mount())
    assert points["return_number"].tolist() == [1, 2] * 192
    assert (points["number_of_returns"] == 2).all()
    lidar = where + Rotation.from_euler("ZXY", [-1.0, 0.2, -0.1]).apply([0.0, 0.0, -0.16])
    near, far = points.xyz_m[::2] - lidar, points.xyz_m[1::2] - lidar
    # xyz_m as float32 at 9 m: 5e-7 m an axis
    np.testing.assert_allclose(far, near * 1.5, rtol=0, atol=2e-6)
    np.testing.assert_allclose(np.linalg.norm(near, axis=1), 6.0, rtol=0, atol=2e-6)


def test_projecting_in_place_is_what_the_polynomial_says() -> None:
    projection = Projection(FRAME, projected_crs(32633))
    rng = np.random.default_rng(3)
    local = rng.uniform([-150, -150, -10], [150, 150, 30], (5000, 3))
    projected = local.copy()
    project(projected, projection.polynomial(local.min(axis=0), local.max(axis=0)))
    np.testing.assert_allclose(projected, projection.exact(local), rtol=0, atol=1e-4)
