"""What a person is told of an adjustment that ended but should not be believed."""

from typing import Any

import numpy as np
import pytest
from imageblock import FRAME

from groundproc.imagery import lasting
from groundproc.imagery.bundle.block import ImagePoints
from groundproc.imagery.measurements import Measurements
from groundproc.imagery.rig import Rig
from groundproc.imagery.session import Session
from groundproc.imagery.work import doubts_of
from groundproc.trajectory.trajectory import Trajectory

NONE = np.empty(0, np.int64)
MEASURED = Measurements(ImagePoints(NONE, NONE, np.empty((0, 2)), np.empty(0), np.empty(0)), (), np.empty(0, np.bool_))


@pytest.fixture
def session() -> Session:
    """On a trajectory, of which nothing is asked but that it is there."""
    three = np.zeros((0, 3))
    trajectory = Trajectory(FRAME, NONE, three, three, np.zeros((0, 4)), three, three, three, np.empty(0, np.bool_))
    return Session([], [], NONE, NONE, Rig(()), trajectory=trajectory)


def told(points: int = 50, rms_px: float = 0.4) -> dict[str, Any]:
    images = [{"image": "a.jpg", "points": 100}, {"image": "b.jpg", "points": points}]
    return {
        "images": images, "counts": {"left_out": {"gross": 0}}, "settled": True, "steps": 5, "residual_rms_px": rms_px,
        "control": [], "check": [], "datum": "observed",
    }  # fmt: skip


def test_a_good_block_raises_no_doubts(session: Session) -> None:
    assert doubts_of(told(), session, MEASURED) == []


def test_an_image_with_too_few_ties_is_named(session: Session) -> None:
    (sentence,) = doubts_of(told(points=2), session, MEASURED)
    assert "fewer than 6 points in common" in sentence
    assert sentence.endswith("b.jpg")


def test_a_wrong_camera_model_shows_in_residuals_or_in_the_trajectory(session: Session) -> None:
    (sentence,) = doubts_of(told(rms_px=7.5), session, MEASURED)
    assert "7.5 px" in sentence
    session.lasting = lasting.Lasting(place=max(lasting.SIZES))
    departing = told() | {"trajectory_departs_sigmas": {"place": 6.2, "turn": 0.8}}
    (sentence,) = doubts_of(departing, session, MEASURED)
    assert "departs from the block by 6.2 times its stated sigmas" in sentence


def test_errors_that_last_for_long_are_no_departure_however_large_their_process(session: Session) -> None:
    session.lasting = lasting.Lasting(place=max(lasting.SIZES), place_s=lasting.LONGEST_S)
    near = told() | {"trajectory_departs_sigmas": {"place": 1.3, "turn": 0.6}}
    assert doubts_of(near, session, MEASURED) == []
