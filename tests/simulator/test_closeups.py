"""What a lidar sees from a few metres: roads under grazing beams, the ground in a wood, trampled grass."""

import numpy as np
import pytest

from simulator import closeups


@pytest.mark.parametrize(("material", "least", "brightness"), [("asphalt", 0.2, 10), ("grass", 0.99, 34)])
def test_at_80_deg_and_30_m_asphalt_is_seen_now_and_then_and_grass_always(
    material: str, least: float, brightness: int
) -> None:
    """FOI-R--4045--SE, appendix B: asphalt is seen there beyond 30 m, grass with a mean intensity of 34."""
    seen = closeups.seen(closeups.road(material), [closeups.Line((0.0, 0.0, 5.2), (0.0, 0.0, 0.0), 0.11)], 1)
    slant = np.rad2deg(np.arccos(np.clip(-seen.direction[:, 2], -1.0, 1.0)))
    some = np.abs(slant - 80.0) < 1.0
    met = seen.range_m[some, 0] > 0.0
    assert some.sum() > 1000
    assert least < met.mean() <= 1.0
    assert seen.intensity[some, 0][met].mean() == pytest.approx(brightness, abs=3)
    assert np.median(seen.range_m[some, 0][met]) == pytest.approx(30.0, abs=2.0)


def test_two_returns_see_more_of_the_ground_in_a_wood_than_one() -> None:
    world, relief = closeups.wood_edge(1)
    line = closeups.Line((-3.0, -3.0, 4.0 + float(relief.at(0.0, -3.0)[2])), (12.0, 0.0, 0.0), 0.5)
    seen = closeups.seen(world, [line], 2, fov_deg=60.0)
    ground = world.names.index("ground")
    count = {}
    for mode in ("strongest", "last", "dual"):
        xyz, kind = seen.points(mode)
        inside = (kind == ground) & (np.abs(xyz[:, 1] - 10.0) < 1.0)
        count[mode] = int(inside.sum())
        off = xyz[inside, 2] - relief.height(xyz[inside, 0], xyz[inside, 1])
        assert abs(np.median(off)) < 0.03
    assert 100 < count["strongest"] < count["dual"]
    assert count["last"] <= count["dual"]


def test_grass_is_the_same_before_and_after_but_where_it_was_trampled() -> None:
    (before, places), (after, same) = (closeups.tall_grass(3, trampled=2, before=each) for each in (True, False))
    assert np.array_equal(places, same)
    moved = np.abs(before.triangles_m - after.triangles_m).max(axis=(1, 2)) > 1e-9
    middle = after.triangles_m[moved].mean(axis=1)[:, :2]
    near = np.abs(middle[:, None] - places[None]).max(axis=2).min(axis=1)
    assert moved.any()
    assert near.max() < closeups.TRAMPLED_M / 2.0 + 0.3
    assert after.triangles_m[moved, :, 2].max() < before.triangles_m[moved, :, 2].max() - 0.3
