"""A map is laid on another from metres away, or not at all."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundproc.estimation.odometry.relocation import laid
from groundproc.estimation.odometry.surfaces import FILLED, GROUND, STANDING, Surfaces

SIGMA = np.array([1.5, 1.5, 0.8, np.deg2rad(1.5)])
TRUE_TURN = Rotation.from_rotvec(np.deg2rad([0.3, -0.2, 3.0]))
TRUE_SHIFT_M = np.array([3.1, -2.2, 0.7])


def ground(size_m: float = 40.0) -> Surfaces:
    """Level ground, a patch for each square metre."""
    side = np.arange(-size_m, size_m, 1.0)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    place = np.stack([x, y, np.zeros(len(x))], axis=1)
    return Surfaces(place, np.tile([0.0, 0.0, 1.0], (len(x), 1)), np.full(len(x), GROUND, np.int8))


def wall(begin: tuple[float, float], end: tuple[float, float], height_m: float = 6.0) -> Surfaces:
    """An upright wall, four patches for each square metre."""
    start, along = np.array(begin), np.subtract(end, begin)
    length = float(np.linalg.norm(along))
    s, z = (axis.ravel() for axis in np.meshgrid(np.arange(0.25, length, 0.5), np.arange(0.25, height_m, 0.5)))
    place = np.column_stack([start + s[:, None] * along / length, z])
    normal = np.append([-along[1], along[0]], 0.0) / length
    return Surfaces(place, np.tile(normal, (len(s), 1)), np.full(len(s), STANDING, np.int8))


def crown(x: float, y: float, seed: int) -> Surfaces:
    """A crown of leaves."""
    place = np.array([x, y, 5.0]) + np.random.default_rng(seed).uniform(-2.0, 2.0, (60, 3))
    return Surfaces(place, np.zeros((60, 3)), np.full(60, FILLED, np.int8))


def together(*parts: Surfaces) -> Surfaces:
    """All of them."""
    return Surfaces(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("place_m", "normal", "kind"))
    )


def yard() -> Surfaces:
    """A house, a wall and two trees."""
    house = [wall((-8, -5), (6, -5)), wall((6, -5), (6, 4)), wall((6, 4), (-8, 4)), wall((-8, 4), (-8, -5))]
    return together(ground(), *house, wall((-20, 15), (5, 18), 2.0), crown(15, 10, 1), crown(-14, -12, 2))


def elsewhere(given: Surfaces, seed: int = 0) -> Surfaces:
    """The same as another flight past has it: some of it, centimetres off, and as far away as the true motion undoes."""
    rng = np.random.default_rng(seed)
    some = given.of(rng.random(len(given)) < 0.7)
    place = some.place_m + rng.normal(0.0, 0.02, some.place_m.shape)
    return Surfaces(TRUE_TURN.inv().apply(place - TRUE_SHIFT_M), TRUE_TURN.inv().apply(some.normal), some.kind)


def test_a_yard_is_found_from_four_metres_away() -> None:
    """Shift and turn to what patches of 2 cm tell, and the covariance says as much."""
    other = yard()
    found = laid(elsewhere(other), other, np.zeros(3), SIGMA)
    assert found is not None
    assert np.abs(found.shift_m - TRUE_SHIFT_M).max() < 0.03
    assert np.rad2deg(Rotation.from_matrix(found.mat @ TRUE_TURN.as_matrix().T).magnitude()) < 0.1
    sigma = np.sqrt(np.diag(found.covariance))
    assert (np.abs(found.shift_m - TRUE_SHIFT_M) < 3.0 * sigma[3:]).all()


def windows(period_m: float) -> Surfaces:
    """A long plain street whose facades repeat: recesses as deep as a window, every so many metres."""
    parts = [ground()]
    for x in np.arange(-60.0, 60.0, period_m).tolist():
        for y in (-8.0, 8.0):
            deep = y + 0.3 * np.sign(y)
            parts += [wall((x, y), (x + 0.6 * period_m, y)), wall((x + 0.6 * period_m, deep), (x + period_m, deep))]
            parts += [wall((x, y), (x, deep), 4.0), wall((x + 0.6 * period_m, y), (x + 0.6 * period_m, deep), 4.0)]
    return together(*parts)


@pytest.mark.parametrize(
    "other",
    [
        pytest.param(together(ground(), wall((-60, -8), (60, -8)), wall((-60, 8), (60, 8))), id="corridor"),
        pytest.param(windows(3.0), id="facades that repeat"),
        pytest.param(ground(), id="field"),
    ],
)
def test_where_it_may_lie_elsewhere_too_it_is_not_laid(other: Surfaces) -> None:
    """False places are worse than none."""
    assert laid(elsewhere(other), other, np.zeros(3), SIGMA) is None


def test_another_place_is_not_taken_for_it() -> None:
    """A house of another size and other walls around it do not fit."""
    here = together(
        ground(), wall((-3, -9), (11, -2)), wall((11, -2), (8, 9)), wall((-18, 2), (-10, 20)), crown(0, 14, 3)
    )
    assert laid(elsewhere(here), yard(), np.zeros(3), SIGMA) is None


def test_who_may_be_farther_off_than_is_sought_is_not_laid() -> None:
    """The true place could lie outside, and a false one inside."""
    assert laid(elsewhere(yard()), yard(), np.zeros(3), np.array([8.0, 8.0, 1.0, 0.1])) is None
