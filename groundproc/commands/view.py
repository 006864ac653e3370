"""`swath view`: a cloud of any size in the browser; its classes may be changed, into a copy."""

from __future__ import annotations

import argparse
import contextlib
import shlex
import signal
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import FrameType

    import numpy as np
    import numpy.typing as npt

    from flightlog.stopflag import StopFlag
    from groundproc.cloud.reader import Cloud
    from groundproc.viewer.edits import Edit
    from groundproc.viewer.served import Served
    from groundproc.viewer.server import Save

HELP = "look at a cloud of any size in the browser, measure in it, and change classes into a copy"

DEFAULT_PORT = 8090
INDEX = ".vpc"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument(
        "cloud",
        type=Path,
        metavar="CLOUD|DIR",
        help="a COPC, LAZ or LAS file, tiles by their index (.vpc), or a folder of `swath process` or `swath tile`",
    )
    parser.add_argument(
        "--port", type=int, metavar="PORT", help=f"of the page on this machine; default: {DEFAULT_PORT}, or a free one"
    )
    parser.add_argument(
        "--edited",
        type=Path,
        metavar="FILE",
        help="classes may be changed with a lasso; `save` writes the cloud to this LAZ or LAS file, other in its classes only",
    )
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Serve until SIGINT or SIGTERM."""
    from flightlog.errors import UsageError
    from flightlog.stopflag import StopFlag
    from groundproc.commands.outputs import claim_file
    from groundproc.viewer.server import ViewServer

    if arguments.port is not None and not 0 <= arguments.port < 65536:
        raise UsageError(f"--port {arguments.port}: expected 0 (any free one) to 65535")
    if arguments.force and arguments.edited is None:
        raise UsageError("--force given, but nothing uses it: without --edited nothing is written")
    cloud, paths = _chosen(arguments.cloud)
    if arguments.edited is not None:
        if _is_index(cloud):
            made = "`swath merge` makes one of them, `swath view` of that takes --edited"
            raise UsageError(
                f"--edited {arguments.edited}: classes are changed in one file, and {cloud} has tiles; {made}"
            )
        claim_file(arguments.edited, (".laz", ".las"), arguments.force, [cloud])
    over, at_once = StopFlag(), StopFlag()

    def end(number: int, frame: FrameType | None) -> None:
        (at_once if over.is_set() else over).set()

    with (_tiled if _is_index(cloud) else _served)(cloud, paths) as served:
        page = _page(ViewServer, served, arguments.port, _saver(cloud, served, arguments.edited, at_once))
        before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            print(f"look at http://127.0.0.1:{page.port}/ (Ctrl-C ends it)", flush=True)
            over.wait()
            if page.saving:
                told = f"swath: {arguments.edited} is saved first; Ctrl-C again breaks it off"
                print(told, file=sys.stderr, flush=True)
        finally:
            page.close()
            for number, handler in before.items():
                signal.signal(number, handler)
        if page.unsaved:
            print(f"swath: warning: {page.unsaved} loop(s) of the lasso were not saved", file=sys.stderr)
    return 130 if at_once.is_set() else 0


def _is_index(path: Path) -> bool:
    return path.suffix.lower() == INDEX


def _chosen(path: Path) -> tuple[Path, list[npt.NDArray[np.float64]]]:
    """The cloud, and the path of the flight where a folder of products is given."""
    from flightlog.errors import UsageError
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect

    if not path.is_dir():
        if not (_is_index(path) and path.is_file()):
            expect([path], CLOUD, CLOUD_WORDS)
        return path, []
    names = ("cloud.copc.laz", "cloud.laz", "cloud.vpc", "tiles/cloud.vpc")
    found = next((path / name for name in names if (path / name).is_file()), None)
    if found is None:
        raise UsageError(
            f"{path}: holds no cloud.copc.laz, cloud.laz or cloud.vpc, expected a cloud or a folder of `swath process`"
        )
    return found, _flown(path)


def _flown(folder: Path) -> list[npt.NDArray[np.float64]]:
    """Pieces of the trajectory in the CRS of the points; none where the folder does not say what it was made with."""
    from groundproc.steps.place import projection_of
    from groundproc.steps.process import remembered
    from groundproc.trajectory.estimate import is_estimate, read_estimate
    from groundproc.vectors.tracks import pieces

    request = remembered(folder)
    if request is None or not is_estimate(folder):
        return []
    trajectory = read_estimate(folder).trajectory
    projection = projection_of(trajectory.frame, request.survey)
    return [projection.exact(trajectory.position_m[some]) for some in pieces(trajectory)]


@contextlib.contextmanager
def _served(path: Path, paths: list[npt.NDArray[np.float64]]) -> Iterator[Served]:
    """The cloud as nodes; one without an index gets a temporary one aside."""
    from tqdm import tqdm

    from groundproc.cloud import exports, nodes, reader
    from groundproc.viewer.served import Served

    cloud = reader.look(path)
    _expect_lengths(path, cloud)
    with contextlib.ExitStack() as stack:
        octree = path
        if not nodes.is_copc(path):
            keeps = f"`swath export {shlex.quote(str(path))} -o NAME.copc.laz` keeps one"
            told = f"{path}: has no index; one is made aside, and removed at the end ({keeps})"
            print(told, file=sys.stderr, flush=True)
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="swath-view-")))
            octree = folder / "cloud.copc.laz"
            bar = tqdm(total=cloud.points, unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty())
            with bar:
                exports.write(cloud, octree, octree, bar.update)
        yield stack.enter_context(Served([octree], path, paths))


@contextlib.contextmanager
def _tiled(path: Path, paths: list[npt.NDArray[np.float64]]) -> Iterator[Served]:
    """All tiles of an index as nodes."""
    from flightlog.errors import UsageError
    from groundproc.cloud import nodes, reader
    from groundproc.cloud.vpc import read_vpc
    from groundproc.viewer.served import Served

    tiles, overview = read_vpc(path)
    if (plain := next((tile for tile in tiles if not nodes.is_copc(tile)), None)) is not None:
        makes = f"`swath tile {shlex.quote(str(plain))} ... -o DIR` makes such tiles"
        raise UsageError(f"{plain}: a tile without an index, expected COPC; {makes}")
    _expect_lengths(tiles[0], reader.look(tiles[0]))
    if overview is not None and not nodes.is_copc(overview):
        overview = None
    with Served(tiles, path, paths, overview) as served:
        yield served


def _expect_lengths(path: Path, cloud: Cloud) -> None:
    """Refuse angles."""
    from flightlog.errors import GeodesyError
    from groundproc.viewer.scene import units_of

    try:
        units_of(cloud.crs)
    except GeodesyError as error:
        raise GeodesyError(f"{path}: {error}") from None


def _saver(path: Path, served: Served, output: Path | None, at_once: StopFlag) -> Save | None:
    """What writes the copy."""
    from flightlog.errors import SourceError
    from groundproc.cloud import reader
    from groundproc.files import written_aside
    from groundproc.viewer.edits import write_edited

    if output is None:
        return None

    def go_on() -> None:
        if at_once.is_set():
            raise SourceError(f"{output}: saving was broken off")

    def save(edits: list[Edit]) -> dict[str, Any]:
        cloud = reader.look(path)
        with written_aside(output) as aside:
            changed = write_edited(cloud, served.origin_m, edits, aside, output.suffix.lower() == ".laz", go_on)
        print(f"{changed:,} of {cloud.points:,} points have another class in {output}", flush=True)
        return {"changed": changed, "points": cloud.points, "file": str(output)}

    return save


def _page(server: Any, served: Served, port: int | None, save: Save | None) -> Any:
    """The page; a port that was asked for must be free."""
    from flightlog.errors import SourceError

    try:
        return server(served, DEFAULT_PORT if port is None else port, save)
    except SourceError:
        if port is not None:
            raise
        return server(served, 0, save)
