"""What painting compiles before the first cloud."""

from pathlib import Path

import laspy

from groundproc.imagery.painting import warmup


def test_the_made_up_plain_goes_through_all_that_paints(tmp_path: Path) -> None:
    warmup.warm_up(tmp_path)
    las = laspy.read(tmp_path / "colour.las")
    assert (las.views > 0).any()
    assert {"ortho.tif", "ortho_images.tif", "ndvi.tif", "ndvi.las", "mesh.glb", "wide"} <= {
        path.name for path in tmp_path.iterdir()
    }
