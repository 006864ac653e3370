"""What moved, noise and mixed echoes in a made-up world whose truth is plain; and that thin things survive."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pytest

from flightlog.mount import LidarMount, Mount
from groundproc.cloud import attributes
from groundproc.cloud.cleaning import HIGH_NOISE, LOW_NOISE, MOVING, UNCLASSIFIED
from groundproc.cloud.points import Points
from groundproc.cloud.pointsigma import MountErrors
from groundproc.geodesy import LocalFrame
from groundproc.sensors.model import Ranging
from groundproc.trajectory.trajectory import Trajectory
from groundproc.verdict import warnings_in

Array = npt.NDArray[np.float64]

START_NS = 1_779_272_223_000_000_000
SECONDS = 6.0
SHOTS_S = 240_000
"""To 60 deg either way of north: the density of an HDL-32E, 32 lasers every 0.16 deg, 10 turns a second."""
GROUND, WALL, PANE, ROOM, WIRE, MAST, FENCE, WALKER, STANDER, EAVES = range(10)
BEAM_RAD = 1.4e-3
"""Half the width of a beam."""


@dataclass(frozen=True)
class World:
    points: Points
    what: npt.NDArray[np.int8]


def position(seconds: Array) -> Array:
    """To and fro along a wall in the north, 8 m up, at 5 m/s."""
    along = (
        20.0 - np.abs(20.0 - 5.0 * (seconds % 16.0)) if False else np.where(seconds < 8, 5 * seconds, 80 - 5 * seconds)
    )
    return np.stack([along - 20.0, np.zeros_like(along), np.full_like(along, 8.0)], axis=-1)


def trajectory(slip_m: float = 0.0) -> Trajectory:
    """The way flown; on the way back it may be believed to lie so much farther north."""
    seconds = np.arange(0, SECONDS + 1.01, 0.1)
    place = position(seconds)
    place[:, 1] += np.where(seconds > 3.0, slip_m, 0.0)
    many = len(seconds)
    zero, quat = np.zeros((many, 3)), np.tile([1.0, 0, 0, 0], (many, 1))
    velocity = np.zeros((many, 3))
    velocity[:, 0] = np.where(seconds < 3, 5.0, -5.0)
    covered = np.append(np.ones(many - 1, bool), False)
    time_ns = START_NS - 10**8 + np.rint(seconds * 1e9).astype(np.int64)
    return Trajectory(
        LocalFrame(58.4, 15.5, 60.0), time_ns, place, velocity, quat, zero, zero + 0.02, zero + 1e-3, covered
    )


def met(origin: Array, unit: Array, seconds: Array, rng: np.random.Generator) -> tuple[Array, npt.NDArray[np.int8]]:
    """Range and kind of what each beam meets first; not-a-number where nothing."""
    best, kind = np.full(len(unit), np.inf), np.full(len(unit), -1, np.int8)

    def offer(away: Array, where: npt.NDArray[np.bool_], what: int) -> None:
        nonlocal best
        nearer = where & (away > 1.0) & (away < best)
        best[nearer], kind[nearer] = away[nearer], what

    with np.errstate(divide="ignore", invalid="ignore"):
        offer(-origin[:, 2] / unit[:, 2], unit[:, 2] < 0, GROUND)
        # a wall with a window: glass that answers within 12 deg of straight on, a room 3 m deep behind it
        away = (20.0 - origin[:, 1]) / unit[:, 1]
        at = origin + away[:, None] * unit
        window = (np.abs(at[:, 0] % 8.0 - 4.0) < 0.8) & (at[:, 2] > 2.5) & (at[:, 2] < 5.0)
        offer(away, (unit[:, 1] > 0) & (at[:, 2] < 12.0) & ~window, WALL)
        through = (unit[:, 1] > 0) & window
        shiny = np.arccos(np.clip(unit[:, 1], -1, 1)) < np.deg2rad(12.0)
        offer(away, through & shiny & (rng.random(len(unit)) < 0.7), PANE)
        offer((23.0 - origin[:, 1]) / unit[:, 1], through, ROOM)
        # eaves 0.4 m before the wall: a beam on their edge answers in between
        front = (19.6 - origin[:, 1]) / unit[:, 1]
        below = origin[:, 2] + front * unit[:, 2] - 6.0
        offer(front, (unit[:, 1] > 0) & (below > 0.0) & (below < 1.0), EAVES)
    # thin things: answered by half of the beams that touch them
    touched = rng.random(len(unit)) < 0.5
    for what, place, way, radius in (
        (WIRE, (0.0, 12.0, 6.0), (1.0, 0.0, 0.0), 0.006),
        (MAST, (5.0, 14.0, 0.0), (0.0, 0.0, 1.0), 0.03),
        *((FENCE, (x, 9.0, 0.0), (0.0, 0.0, 1.0), 0.01) for x in np.arange(-9, -5, 0.4)),
    ):
        cross = np.cross(unit, way)
        size = np.linalg.norm(cross, axis=1)
        miss = np.abs(((np.array(place) - origin) * cross).sum(axis=1)) / np.maximum(size, 1e-9)
        away = (np.cross(np.array(place) - origin, way) * cross).sum(axis=1) / np.maximum(size**2, 1e-9)
        height = origin[:, 2] + away * unit[:, 2]
        top = {WIRE: 99.0, MAST: 9.0, FENCE: 1.5}[what]
        offer(away, touched & (miss < radius + BEAM_RAD * away) & (height < top) & (height > 0.0), what)
    for what, x in ((WALKER, -3.0 + 1.4 * seconds), (STANDER, np.full(len(seconds), 3.0))):
        here = np.ones(len(unit), bool) if what == WALKER else seconds < 2.0
        centre = np.stack([x, np.full(len(x), 16.5 if what == WALKER else 11.0)], axis=1) - origin[:, :2]
        level = np.linalg.norm(unit[:, :2], axis=1)
        along = (centre * unit[:, :2]).sum(axis=1) / level
        aside = np.abs(centre[:, 0] * unit[:, 1] - centre[:, 1] * unit[:, 0]) / level
        away = (along - np.sqrt(np.maximum(0.25**2 - aside**2, 0))) / level
        height = origin[:, 2] + away * unit[:, 2]
        offer(away, here & (aside < 0.25) & (height < 1.75) & (height > 0.0), what)
    return best, kind


@pytest.fixture(scope="module")
def world() -> World:
    rng = np.random.default_rng(8)
    count = int(SECONDS * SHOTS_S)
    seconds = np.arange(count) / SHOTS_S
    turn = np.deg2rad(120.0) * ((np.arange(count) // 32 * 32 / SHOTS_S * 10.0) % 1.0 - 0.5)
    lean = np.deg2rad(-45.0 + 1.33 * (np.arange(count) % 32) + 2.0 * np.sin(3.0 * seconds))
    unit = np.stack([np.cos(lean) * np.sin(turn), np.cos(lean) * np.cos(turn), np.sin(lean)], axis=1)
    origin = position(seconds)
    away, kind = met(origin, unit, seconds, rng)
    seen = np.isfinite(away) & (away < 60.0) & (unit[:, 1] > 0)
    noisy = away + rng.normal(0, 0.015, count)
    xyz = origin + noisy[:, None] * unit
    time_ns = START_NS + np.rint(seconds * 1e9).astype(np.int64)
    columns = {"range": noisy[seen].astype(np.float32)}
    return World(Points(time_ns[seen] - 10**8, xyz[seen], columns), kind[seen])


def described(points: Points, path: Trajectory, found: attributes.Found | None = None) -> Points:
    def stream() -> Iterator[Points]:
        for part in np.array_split(np.arange(len(points)), 32):
            yield points.masked(part)

    mount = Mount(LidarMount((0.0, 0.0, 0.0), 0.0, 0.0, 0.0))
    scene = attributes.Scene(path, mount, MountErrors(np.zeros(3), np.zeros(3)), Ranging(0.015, 2.8e-3, 0.6))
    made = list(attributes.described(stream, scene, attributes.wanted(("classes",)), found))
    columns = {name: np.concatenate([some[name] for some in made]) for name in made[0].columns}
    return replace(points, columns=columns)


def with_noise(world: World, rng: np.random.Generator) -> tuple[Points, npt.NDArray[np.bool_]]:
    """The points with some echoes of nothing in the air, and where these are."""
    strange = np.zeros(len(world.points), bool)
    strange[rng.choice(len(world.points), 60, replace=False)] = True
    xyz, seconds = world.points.xyz_m.copy(), (world.points.time_ns - START_NS + 10**8) * 1e-9
    origin = position(seconds)
    xyz[strange] = origin[strange] + (xyz[strange] - origin[strange]) * rng.uniform(0.3, 0.7, (60, 1))
    return replace(world.points, xyz_m=xyz), strange


@pytest.fixture(scope="module")
def cleaned(world: World) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_], attributes.Found]:
    found = attributes.Found()
    points, strange = with_noise(world, np.random.default_rng(1))
    return described(points, trajectory(), found)["classification"], strange, found


def test_people_who_walk_and_who_leave_are_a_class_of_their_own(
    world: World, cleaned: tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_], attributes.Found]
) -> None:
    classes, strange, found = cleaned
    for who in (WALKER, STANDER):
        theirs = (world.what == who) & ~strange
        assert theirs.sum() > 200
        assert (classes[theirs] == MOVING).mean() > 0.6, (
            who
        )  # what beams cannot pass below 0.6 m above the ground is left
    assert found.tell()["classes"][str(MOVING)] == (classes == MOVING).sum()
    assert found.tell()["warning"] == ""


@pytest.mark.parametrize("what", [WIRE, MAST, FENCE, PANE, ROOM])
def test_thin_things_panes_and_what_is_behind_them_survive(
    world: World, cleaned: tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_], attributes.Found], what: int
) -> None:
    classes, strange, _ = cleaned
    theirs = (world.what == what) & ~strange
    assert theirs.sum() > 50
    assert (classes[theirs] == UNCLASSIFIED).mean() > 0.99


def test_what_stands_still_is_not_said_to_move(
    world: World, cleaned: tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_], attributes.Found]
) -> None:
    classes, strange, _ = cleaned
    still = np.isin(world.what, [GROUND, WALL, EAVES]) & ~strange
    assert (classes[still] == UNCLASSIFIED).mean() > 0.998


def test_echoes_of_nothing_are_noise(
    cleaned: tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_], attributes.Found],
) -> None:
    classes, strange, _ = cleaned
    assert np.isin(classes[strange], [LOW_NOISE, HIGH_NOISE]).mean() > 0.7  # some fall beside a wire or a person
    assert (classes[strange] == HIGH_NOISE).sum() > (classes[strange] == LOW_NOISE).sum()


def test_a_path_that_comes_back_beside_itself_classes_nothing_as_moving(world: World) -> None:
    """Points of the way back lie a metre farther north: every wall is there twice, and beams pass through the first."""
    slipped = world.points.xyz_m.copy()
    slipped[world.points.time_ns > START_NS - 10**8 + 3 * 10**9, 1] += 1.0
    found = attributes.Found()
    made = described(replace(world.points, xyz_m=slipped), trajectory(1.0), found)
    assert not (made["classification"] == MOVING).any()
    assert not made["mixed"].any()
    # said at the end of `swath process`, as all that stands under `warning` is
    (said,) = warnings_in({"points": found.tell()})
    assert "does not come back to where it was" in said
    assert "is the mount that of this flight" in said


def test_an_echo_between_eaves_and_wall_is_mixed(world: World) -> None:
    rng = np.random.default_rng(5)
    place = world.points.xyz_m.copy()
    edge = (world.what == WALL) & (np.abs(place[:, 2] - 7.0) < 0.1)
    some = np.flatnonzero(edge)[::4]
    seconds = (world.points.time_ns - START_NS + 10**8) * 1e-9
    way = place[some] - position(seconds[some])
    back_m = rng.uniform(0.12, 0.28, len(some))
    place[some] -= way / np.linalg.norm(way, axis=1)[:, None] * back_m[:, None]
    told = described(replace(world.points, xyz_m=place), trajectory())["mixed"] > 0
    assert len(some) > 30
    assert told[some].mean() > 0.6
    plain = np.isin(world.what, [GROUND, WALL, ROOM]) & ~edge
    assert told[plain].mean() < 0.002
