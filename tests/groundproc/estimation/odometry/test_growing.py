"""Rows of numbers that grow, used as a list of arrays."""

import numpy as np

from groundproc.estimation.odometry.growing import Growing

ROWS = np.arange(600.0).reshape(200, 3)


def test_rows_are_those_of_a_list() -> None:
    """Rows from either end, some of them, all of them, and as many as were put in."""
    made = Growing(3, ROWS[:100])
    for row in ROWS[100:]:
        made.append(row)
    assert len(made) == 200
    np.testing.assert_array_equal(made[-1], ROWS[-1])
    np.testing.assert_array_equal(made[150:170], ROWS[150:170])
    np.testing.assert_array_equal(np.array(made), ROWS)
    np.testing.assert_array_equal(np.array([made[0], *made]), [ROWS[0], *ROWS])


def test_what_is_taken_out_is_a_copy() -> None:
    """Who keeps a row keeps what it was, as of a list whose array is replaced."""
    made = Growing(3, ROWS[:3])
    before, some = made[1], made[:]
    made[1] = np.full(3, 7.0)
    np.testing.assert_array_equal(before, ROWS[1])
    np.testing.assert_array_equal(some, ROWS[:3])
    np.testing.assert_array_equal(made[1], 7.0)


def test_the_first_rows_are_dropped() -> None:
    """And later ones follow those that are left."""
    made = Growing(3, ROWS)
    del made[:190]
    made.append(ROWS[0])
    np.testing.assert_array_equal(made[:], [*ROWS[190:], ROWS[0]])
