"""The self-check of method adjusted: when what it began from is given instead of what it made of it."""

from types import SimpleNamespace
from typing import Any

import pytest

from groundproc.estimation.adjustment.adjusted import Run
from groundproc.estimation.observations.fixes import SLID_SIGMAS, Fixes


def run_with(restarts: int, slid: float, outside: tuple[str, ...]) -> Run:
    track: Any = SimpleNamespace(restarts=restarts, matched=[500] * 100)
    log = [{"chi_square": 0.2, "moved_m": 0.001, "position_drift": slid, "position_rms": 0.3}]
    windows: Any = [SimpleNamespace(log=log, told={})]
    unused: Any = None
    fixes = Fixes("fixes0", unused, 0, unused)
    sources: Any = SimpleNamespace(observations=[fixes], leads=lambda: bool(outside))
    return Run(windows, unused, track, unused, sources)


@pytest.mark.parametrize(
    ("restarts", "slid", "outside", "misled"),
    [
        (0, 2.0, (), False),
        (1, 2.0, (), False),  # lost, and found again
        (0, 2 * SLID_SIGMAS, (), False),  # a bad fix or two: the lidar was never lost
        (1, 2 * SLID_SIGMAS, (), True),
        (1, 2 * SLID_SIGMAS, ("ppk.pos",), False),  # better positions hold it
    ],
)
def test_misled_is_who_lost_the_way_and_ends_away_from_the_fixes(
    restarts: int, slid: float, outside: tuple[str, ...], misled: bool
) -> None:
    run = run_with(restarts, slid, outside)
    assert run.is_misled() is misled
    if misled:  # is_blind is not asked first: the lidar saw planes enough
        assert "misled" in run.note()
        said = run.warnings()
        assert any("the trajectory is what the adjustment began from" in sentence for sentence in said)
        assert any("lost its way" in sentence for sentence in said)
