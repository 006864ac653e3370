"""What the user asks of a run."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from flightlog import config
from groundproc.sensors.lasers import ESTIMATE
from groundproc.survey import FILES, Survey


@dataclass(frozen=True, slots=True)
class Request:
    """What the user asks for.

    Attributes
    ----------
    logs : sequence of Path
        One or several logs of one flight.
    survey : Survey
        With the paths in it absolute or relative to the working directory.
    poses : Path or None
        A trajectory made before, to place the points with: an estimate's folder or a trajectory.csv.
    """

    logs: Sequence[Path]
    survey: Survey
    poses: Path | None = None


def absolute(survey: Survey) -> Survey:
    """A survey whose names of files hold from everywhere."""
    tree = config.to_mapping(survey)
    for name in FILES:
        if isinstance(tree[name], str) and tree[name] != ESTIMATE:
            tree[name] = str(Path(tree[name]).resolve())
    if isinstance(tree["geoid"], str) and Path(tree["geoid"]).is_file():
        tree["geoid"] = str(Path(tree["geoid"]).resolve())
    return config.from_mapping(tree, Survey, "survey")
