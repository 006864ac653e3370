"""Voxels of a stretch's points, kept or looked up again."""

import tempfile
from typing import Any

import numpy as np
import pytest

from groundproc.cloud.points import Points
from groundproc.cloud.surroundings import Surroundings
from groundproc.cloud.voxelnumbers import VoxelNumbers


class Full:
    """A file on a disk that has room for so many bytes."""

    def __init__(self, room: int) -> None:
        self.room, self.closed = room, False

    def write(self, data: memoryview) -> int:
        self.room -= len(data)
        if self.room < 0:
            raise OSError(28, "No space left on device")
        return len(data)

    def close(self) -> None:
        self.closed = True


def pieces() -> list[Points]:
    rng = np.random.default_rng(3)
    sizes = (5_000, 0, 70_000)
    return [Points(np.arange(size, dtype=np.int64), rng.uniform(-6.0, 6.0, (size, 3))) for size in sizes]


def gathered() -> tuple[Surroundings, VoxelNumbers]:
    around = Surroundings()
    voxels = VoxelNumbers(around)
    for each in pieces():
        if len(each):
            voxels.keep(around.add(each.xyz_m, each.time_ns, np.zeros((len(each), 3))))
    return around, voxels


def check(around: Surroundings, voxels: VoxelNumbers) -> None:
    for _ in range(2):  # for the beams, and for what is handed on
        found = list(voxels.beside(pieces()))
        assert [len(points) for points, _ in found] == [5_000, 0, 70_000]
        for points, voxel in found:
            np.testing.assert_array_equal(voxel, around.of(points.xyz_m))


def test_kept_voxels_are_those_that_a_look_finds() -> None:
    check(*gathered())


@pytest.mark.parametrize("room", [0, 40_000])
def test_a_full_disk_costs_a_look(room: int, monkeypatch: pytest.MonkeyPatch) -> None:
    files: list[Full] = []

    def made(**_: Any) -> Full:
        files.append(Full(room))
        return files[-1]

    monkeypatch.setattr(tempfile, "TemporaryFile", made)
    around, voxels = gathered()
    assert files[0].closed  # its room is the products'
    check(around, voxels)


def test_without_a_folder_for_temporary_files_they_are_looked_up(monkeypatch: pytest.MonkeyPatch) -> None:
    def made(**_: Any) -> Full:
        raise FileNotFoundError("no usable temporary directory")

    monkeypatch.setattr(tempfile, "TemporaryFile", made)
    check(*gathered())
