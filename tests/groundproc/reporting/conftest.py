"""A flight that was processed, with its report: twelve seconds on a tripod."""

from pathlib import Path
from typing import Any

import pytest

from groundproc.cli import main

PRODUCTS = "cloud.copc.laz,dsm.tif,hillshade.tif,density.tif,report.html"


@pytest.fixture(scope="session")
def processed(still_flight: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its folder; tests do not change it."""
    folder = tmp_path_factory.mktemp("reported") / "out"
    assert main(["process", str(still_flight.log), "--method", "ins", "--products", PRODUCTS, "-o", str(folder)]) in (
        0,
        3,
    )
    return folder
