"""Compiles or loads what a block adjustment runs, on four pictures of a made-up plain, so that the first block does not wait for it."""

from dataclasses import replace
from typing import Final

import numpy as np

from groundproc.imagery.bundle.block import Block, Stations, image_points
from groundproc.imagery.bundle.covariance import points_covariance
from groundproc.imagery.bundle.intersection import intersect
from groundproc.imagery.bundle.screen import adjust
from groundproc.imagery.camera import Camera
from groundproc.imagery.rig import Rig, RigCamera
from groundproc.imagery.rotations import STRAIGHT_DOWN

_FOCAL_PX: Final = 500.0
_MIDDLE_PX: Final = (319.5, 239.5)
_HIGH_M: Final = 20.0


def warm_up() -> None:
    """Adjust fifteen points in four pictures, without any position known."""
    place_m = np.array([[0.0, 0.0, _HIGH_M], [4.0, 0.0, _HIGH_M + 1.0], [0.0, 4.0, _HIGH_M - 1.0], [4.0, 4.0, _HIGH_M]])
    points_m = np.array([[x, y, 0.1 * x * y] for x in (-2.0, 0.0, 2.0, 4.0, 6.0) for y in (-2.0, 2.0, 6.0)])
    image, point = (grid.ravel() for grid in np.meshgrid(np.arange(len(place_m)), np.arange(len(points_m))))
    ray = points_m[point] - place_m[image]
    # straight down, x of the picture to the east and y to the south
    pixel = np.array(_MIDDLE_PX) + _FOCAL_PX * np.array([1.0, -1.0]) * ray[:, :2] / -ray[:, 2:]
    pixel += np.random.default_rng(0).normal(0.0, 0.3, pixel.shape)
    camera = RigCamera("camera", Camera(640, 480, _FOCAL_PX, _MIDDLE_PX), STRAIGHT_DOWN)
    every = np.arange(len(place_m))
    still = np.zeros((len(place_m), 3))
    level = np.tile(np.eye(3), (len(place_m), 1, 1))
    stations = Stations(every, place_m, level, still, still, np.zeros(len(place_m), np.int64))
    block = Block(
        Rig((camera,)),
        tuple(f"{n}.jpg" for n in every),
        np.zeros(len(place_m), np.int64),
        every,
        stations,
        points_m,
        image_points(image, point, pixel, np.full(len(image), 0.3)),
        mounting=((),),
    )
    block = replace(block, points_m=intersect(block)[0])
    adjusted = adjust(block, (camera,), np.ones(len(block.measured), np.bool_))
    points_covariance(adjusted.solved.block, adjusted.found, 1.0)
