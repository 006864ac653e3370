"""One flight over one town, placed with true poses and with wrong ones."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import aerial
import pytest

from groundproc.cli import main

WRONG = aerial.Errors(0.15, 0.05, (0.2, -0.15, 0.25))


@dataclass
class Outcome:
    """What a run of the command left."""

    folder: Path
    code: int

    @property
    def told(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads((self.folder / "adjustment.json").read_text())
        return content


@pytest.fixture(scope="session")
def wrong_scan() -> aerial.Scan:
    return aerial.scanned(aerial.flown(), WRONG)


@pytest.fixture(scope="session")
def true_scan() -> aerial.Scan:
    return aerial.scanned(aerial.flown(), aerial.Errors())


@pytest.fixture(scope="session")
def adjust() -> Callable[..., Outcome]:
    """Write a scan as files, and adjust it."""

    def run(folder: Path, scan: aerial.Scan, *words: str, config: str = "", **named: Any) -> Outcome:
        folder.mkdir(exist_ok=True)
        aerial.write_las(folder / "cloud.laz", scan, scan.placed_m, **named)
        aerial.write_csv(folder / "given.csv", scan.wrong)
        (folder / "options.yaml").write_text(config)
        line = ["adjust", str(folder / "cloud.laz"), "-t", str(folder / "given.csv"), "-o", str(folder / "out"), *words]
        return Outcome(folder / "out", main([*line, "--config", str(folder / "options.yaml")]))

    return run


@pytest.fixture(scope="session")
def adjusted(
    wrong_scan: aerial.Scan, adjust: Callable[..., Outcome], tmp_path_factory: pytest.TempPathFactory
) -> Outcome:
    """The wrong cloud, adjusted with what is known of its errors."""
    return adjust(tmp_path_factory.mktemp("strips"), wrong_scan, config=KNOWN)


KNOWN = "{position_sigma_m: 0.15, attitude_sigma_deg: 0.05, position_time_s: 15, attitude_time_s: 15}"
