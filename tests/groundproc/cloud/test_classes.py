"""What a use classed survives the uses after it, by one rule."""

import numpy as np
import pytest

from groundproc.cloud.classes import GROUND, HIGH, NAMES, OF_USES, PANE, POLE, merged


@pytest.mark.parametrize("given", OF_USES)
def test_another_use_leaves_what_one_found(given: int) -> None:
    assert merged([given], [GROUND]).tolist() == [given]
    assert given in NAMES


def test_a_use_replaces_its_own_classes_and_what_height_alone_told() -> None:
    assert merged([PANE, HIGH, POLE], [POLE, POLE, POLE], (POLE,)).tolist() == [PANE, POLE, POLE]


def test_where_nothing_is_found_the_class_stays() -> None:
    assert merged([HIGH, PANE, 200], [0, 0, 0], (PANE,)).tolist() == [HIGH, PANE, 200]


def test_classes_of_other_programs_are_not_held() -> None:
    assert merged(np.array([12, 70, 255]), np.array([GROUND] * 3)).tolist() == [GROUND] * 3
