"""`swath volume`: what heaps and pits hold."""

import argparse
import sys
from pathlib import Path
from typing import Any, Final

_MUCH_EMPTY: Final = 0.1
"""Share of a polygon without points from which on it is said on the terminal: the sigma does not know what lies there."""
HELP = "measure volumes of a cloud within polygons: cut, fill, net, each with its sigma"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="a LAS, LAZ or COPC file")
    parser.add_argument("polygons", type=Path, metavar="POLYGONS", help="GeoPackage or GeoJSON with a CRS")
    parser.add_argument(
        "--base", default="toe", metavar="toe|plane|dtm|FILE.tif",
        help="what volumes are counted from: triangles through the heights along the polygon's edge, the plane through them, the "
        "bare ground (class 2, or as swath ground finds it), or a raster of heights; default: toe",
    )  # fmt: skip
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Measure, and print a table."""
    import json

    from tqdm import tqdm

    from flightlog.errors import UsageError
    from groundproc.analysis import volumes
    from groundproc.commands.figures import warn
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file
    from groundproc.files import written_aside
    from groundproc.machine import screen

    base = arguments.base
    if base not in volumes.BASES and not base.lower().endswith((".tif", ".tiff")):
        raise UsageError(
            f"--base {base}: expected {', '.join(volumes.BASES)} or the name of a raster that ends in .tif"
        )
    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    if arguments.json is not None:
        claim_file(arguments.json, (".json",), arguments.force)
    with tqdm(unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:
        found = volumes.measure(arguments.cloud, arguments.polygons, base, bar.update)
    warn(found.warnings, sys.stderr)
    rows: list[dict[str, Any]] = []
    unmeasured = []
    for each in found.polygons:
        one = each.volume
        if one is None:
            unmeasured.append({"id": each.id, "reason": each.reason})
            print(f"swath: warning: polygon {each.id} is not measured: {each.reason}", file=sys.stderr)
            continue
        if one.empty_m2 > _MUCH_EMPTY * one.area_m2:
            warn(
                [
                    f"polygon {each.id}: {one.empty_m2:.2f} of {one.area_m2:.2f} m2 hold no points, and were interpolated"
                ],
                sys.stderr,
            )
        rows.append(
            {
                "id": each.id, "cut_m3": one.cut_m3, "fill_m3": one.fill_m3, "net_m3": one.net_m3, "sigma_m3": one.sigma_m3,
                "area_m2": one.area_m2, "empty_m2": one.empty_m2,
            }
        )  # fmt: skip
    if arguments.json is not None:
        told = {
            "base": base,
            "crs": None if found.cloud.crs is None else found.cloud.crs.name,
            "polygons": rows,
            "unmeasured": unmeasured,
        }
        with written_aside(arguments.json) as aside:
            aside.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    columns = ("cut_m3", "fill_m3", "net_m3", "sigma_m3", "area_m2")
    screen.table(
        ["polygon", "cut [m3]", "fill [m3]", "net [m3]", "sigma [m3]", "area [m2]"],
        [[row["id"], *(f"{row[name]:.2f}" for name in columns)] for row in rows],
    )
    return 0
