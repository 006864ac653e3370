"""Loops around points: which are meant, and a copy that differs in its classes only."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from matplotlib.path import Path as Outline

from flightlog.errors import UsageError
from groundproc.cloud.reader import look
from groundproc.viewer.edits import apply, edits_of, write_edited

Clouds = Callable[[int], tuple[Path, Path]]
FROM_ABOVE = np.diag([1 / 40.0, 1 / 40.0, 0.0, 1.0])
"""A picture of 80 x 80 m around the origin."""


def edit(loop: Any, to: int = 9, matrix: Any = FROM_ABOVE, **more: Any) -> dict[str, Any]:
    return {
        "matrix": np.asarray(matrix).T.ravel().tolist(),
        "loop": np.asarray(loop).tolist(),
        "to": to,
        "of": None,
        "slab": None,
    } | more


def test_the_points_within_a_loop_are_meant() -> None:
    rng = np.random.default_rng(6)
    place = rng.uniform(-40, 40, (20_000, 3))
    turn = np.sort(rng.uniform(0, 2 * np.pi, 40))
    loop = np.stack([np.cos(turn), np.sin(turn)], axis=1) * rng.uniform(0.2, 0.9, (40, 1))
    found = apply(edits_of([edit(loop)]), place, np.zeros(20_000, np.uint8)) == 9
    np.testing.assert_array_equal(found, Outline(loop).contains_points(place[:, :2] / 40.0))
    assert 1000 < found.sum() < 19_000


def test_what_lies_behind_the_eye_outside_a_section_or_in_a_hidden_class_is_not_meant() -> None:
    # an eye in the origin that looks along x
    matrix = np.array([[0, -1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0], [1.0, 0, 0, 0]])
    place = np.array([[10.0, 0, 0], [-10, 0, 0], [10, 20, 0], [10, 0.5, 0], [10, 1.2, 0]])
    square = [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]
    classes = np.array([1, 1, 1, 2, 1], np.uint8)
    assert apply(edits_of([edit(square, matrix=matrix)]), place, classes).tolist() == [9, 1, 1, 9, 9]
    assert apply(edits_of([edit(square, matrix=matrix, of=[2])]), place, classes).tolist() == [1, 1, 1, 9, 1]
    slab = {"plane": [0, 1, 0, 1.0], "ends": [1, 0, 10, 5]}
    assert apply(edits_of([edit(square, matrix=matrix, slab=slab)]), place, classes).tolist() == [9, 1, 1, 9, 1]
    two = [edit(square, 7, matrix), edit(square, 3, matrix, of=[7])]
    assert apply(edits_of(two), place, classes).tolist() == [3, 1, 1, 3, 3]  # one after the other


@pytest.mark.parametrize("kind", [0, 1], ids=["laz", "copc"])
def test_the_copy_differs_in_its_classes_only(clouds: Clouds, kind: int, tmp_path: Path) -> None:
    path = clouds(3_000)[kind]
    cloud, out = look(path), tmp_path / "out.laz"
    origin = np.array([533_040.0, 6_472_030.0, 60.0])
    square = np.array([[-0.3, -0.3], [0.3, -0.3], [0.3, 0.3], [-0.3, 0.3]])
    changed = write_edited(cloud, origin, edits_of([edit(square)]), out)
    before, after = laspy.read(path), laspy.read(out)
    assert before.point_format == after.point_format
    for name in before.point_format.dimension_names:
        if name != "classification":
            np.testing.assert_array_equal(before[name], after[name], err_msg=name)
    inside = (abs(before.xyz[:, :2] - origin[:2]) < 12).all(axis=1)
    np.testing.assert_array_equal(after.classification, np.where(inside, 9, before.classification))
    assert changed == inside.sum() > 0
    assert (after.header.scales == before.header.scales).all()
    assert after.header.parse_crs() == before.header.parse_crs()


def test_an_old_point_format_cannot_hold_a_large_class(tmp_path: Path) -> None:
    header = laspy.LasHeader(version="1.2", point_format=1)
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.arange(5.0), np.zeros(5), np.zeros(5)
    las.gps_time = np.arange(5.0)
    las.write(tmp_path / "old.las")
    square = [[-0.9, -0.9], [0.9, -0.9], [0.9, 0.9], [-0.9, 0.9]]
    with pytest.raises(UsageError, match="class 64 found, but its points can hold 31 at most"):
        write_edited(look(tmp_path / "old.las"), np.zeros(3), edits_of([edit(square, 64)]), tmp_path / "new.las", False)
    assert (
        write_edited(look(tmp_path / "old.las"), np.zeros(3), edits_of([edit(square, 31)]), tmp_path / "new.las", False)
        == 5
    )
    assert np.asarray(laspy.read(tmp_path / "new.las").classification).tolist() == [31] * 5


@pytest.mark.parametrize(
    "tree",
    [
        None, {}, [None], [{}], [edit([[0, 0], [1, 1]])], [edit([[0, 0], [1, 1], [1, float("nan")]])], [edit(np.zeros((3, 3)))],
        [edit(np.zeros((3, 2)), 256)], [edit(np.zeros((3, 2)), True)], [edit(np.zeros((3, 2)), of=["a"])],
        [edit(np.zeros((3, 2)), slab={"plane": [1, 2]})], [edit(np.zeros((3, 2)), slab=[1])], [edit(np.zeros((3000, 2)))],
        [edit(np.zeros((3, 2))) | {"matrix": [1] * 15}], [edit(np.zeros((3, 2)))] * 10_001, [edit(np.zeros((3, 2)), to="2")],
    ],
)  # fmt: skip
def test_what_is_no_edit_is_refused(tree: Any) -> None:
    with pytest.raises(UsageError, match=r"^edits: "):
        edits_of(tree)
