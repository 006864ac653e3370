"""From cloud files to a folder of tiles: written beside it and moved there when all is whole."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path

from flightlog.errors import UsageError
from groundproc.cloud import reader
from groundproc.cloud.layout import Layout
from groundproc.cloud.metres import agreed_metres
from groundproc.cloud.reader import Cloud
from groundproc.cloud.tiling import INDEX, Tile, Tiling
from groundproc.cloud.vpc import write_vpc
from groundproc.files import written_folder


def tile_clouds(
    clouds: Sequence[Cloud], folder: Path, size_m: float, form: str, force: bool, progress: Callable[[int], object]
) -> list[Tile]:
    """Cut clouds of one CRS into tiles.

    Parameters
    ----------
    clouds : sequence of Cloud
    folder : Path
        Not there, or empty; else with `force` the files of an index that is there go, and others stay.
    size_m, form
        See `Tiling`.
    progress : callable
        Told of points done, of each point twice.

    Raises
    ------
    UsageError
        The folder holds files, or the size is none.
    GeodesyError
        Coordinates are angles.
    CaptureError, SourceError
        A cloud cannot be read, or a tile cannot be written.
    """
    _claim(folder, force, [cloud.path for cloud in clouds])
    unit = agreed_metres(clouds)
    with written_folder(folder, INDEX, _named(folder / INDEX)) as aside:
        layout = Layout(clouds)
        header = layout.header()
        tiling = Tiling(header, aside, size_m, unit.across)
        for cloud in clouds:
            for chunk in reader.chunks(cloud, columns=()):
                tiling.add(layout.laid(chunk.record).array)
                progress(len(chunk.record))
        tiles, overview = tiling.write(aside, form, progress)
        write_vpc(aside / INDEX, tiles, overview, header, clouds[0].crs)
    return tiles


def _claim(folder: Path, force: bool, inputs: Sequence[Path]) -> None:
    """See that the folder may be filled."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder}: is a file, expected a folder to write into")
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    if not force:
        raise UsageError(f"{folder}: holds files already; give another folder, or --force to write tiles anew")
    mine = {(folder / name).resolve() for name in _named(folder / INDEX)}
    for path in inputs:
        if path.resolve() in mine:
            raise UsageError(f"{path}: is a tile of {folder}, which is to be written anew; give another folder")


def _named(index: Path) -> set[str]:
    """Files beside an index that it names; empty where there is none, or it is none of ours."""
    try:
        items = json.loads(index.read_text(encoding="utf-8"))["features"]
        hrefs = [asset["href"] for item in items for asset in item["assets"].values()]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return set()
    return {
        href.removeprefix("./") for href in hrefs if href.startswith("./") and "/" not in href[2:] and "\\" not in href
    }
