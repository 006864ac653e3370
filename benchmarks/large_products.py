"""How much memory and time products of a large cloud take, and whether other programs read them.

    benchmarks/large_products.py CLOUD -o DIR [--copies 10] [WORK ...]

The cloud of a flight is laid out again and again, side by side, with all its attributes: each copy is a flight line of its own, later
than the one before. They do not overlap: strips have nothing to differ in. Half of the copies lie in one file, half in another, and
`merge` joins them for what comes after it. Each command is a process of its own; for each, a line of JSON says `million` points, `cpu_s`
with its children's, `peak_mb` (the highest resident memory of the process and of its children together, looked at each fifth of a
second), and `read_by`, what an outside reader found in it. Files stay in DIR, so that a WORK may be done alone.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import laspy
import numpy as np

SIDE: Final = 4
"""Copies in a row."""
GAP_M: Final = 10.0
RASTERS: Final[dict[str, list[str]]] = {
    "dsm": ["dsm"],
    "median": ["dsm", "--statistic", "median"],
    "intensity": ["intensity"],
    "density": ["density"],
    "hillshade": ["hillshade"],
    "local-relief": ["local-relief"],
    "sky-view": ["sky-view"],
    "sigma": ["sigma"],
}
SWATH: Final = "import sys; from groundproc.cli import main; sys.exit(main())"


def main() -> int:
    """Do what is asked for, in the order in which one needs the other."""
    parser = argparse.ArgumentParser(description="Memory, time and validity of products of a large cloud.")
    parser.add_argument("cloud", type=Path)
    parser.add_argument("works", nargs="*", metavar="WORK", help=f"default: all of {', '.join(works(Path()))}")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--copies", type=int, default=10)
    asked = parser.parse_args()
    asked.output.mkdir(parents=True, exist_ok=True)
    parts = [asked.output / name for name in ("one.laz", "other.laz")]
    if not all(part.exists() for part in parts):
        half = (asked.copies + 1) // 2
        for part, which in zip(parts, (range(half), range(half, asked.copies)), strict=True):
            lay_out(asked.cloud, part, which)
    points = sum(count_las(part) for part in parts)
    todo, failed = works(asked.output), False
    for name in asked.works or todo:
        words, read = todo[name]
        told = measured([*words, "--force"])
        failed |= told["code"] != 0
        line = {"work": name, "million": round(points / 1e6, 1), **told, "read_by": None if told["code"] else read()}
        print(json.dumps(line), flush=True)
    return int(failed)


def works(folder: Path) -> dict[str, tuple[list[str], Callable[[], Any]]]:
    """Words of each command, and what reads its output."""
    whole = str(folder / "all.laz")
    found: dict[str, tuple[list[str], Callable[[], Any]]] = {
        "merge": (
            ["merge", str(folder / "one.laz"), str(folder / "other.laz"), "-o", whole],
            lambda: {"laspy points": count_las(folder / "all.laz")},
        ),
        "tile": (["tile", whole, "-o", str(folder / "tiles"), "--size", "100"], lambda: read_tiles(folder / "tiles")),
    }
    for ending, read in (("copc.laz", read_copc), ("e57", read_e57), ("ply", read_ply), ("csv", read_csv)):
        out = folder / f"exported.{ending}"
        found[f"export {ending}"] = (["export", whole, "-o", str(out)], lambda read=read, out=out: read(out))
    for name, what in RASTERS.items():
        out = folder / f"{name}.tif"
        words = ["raster", whole, "--what", *what, "-o", str(out)]
        found[f"raster {name}"] = (words, lambda out=out: read_raster(out))
    return found


def lay_out(cloud: Path, path: Path, copies: range) -> None:
    """Copies of a cloud side by side."""
    with laspy.open(cloud) as source:
        header, las = source.header, source.read()
    pitch = np.ceil(header.maxs - header.mins)[:2] + GAP_M
    steps = np.rint(pitch / header.scales[:2]).astype(np.int32)
    times, lasting_s = np.array(las.gps_time), float(np.ptp(las.gps_time)) + 60.0
    x, y = las.X.copy(), las.Y.copy()
    with laspy.open(path, "w", header=header, laz_backend=laspy.LazBackend.LazrsParallel, do_compress=True) as out:
        for number in copies:
            row, column = divmod(number, SIDE)
            las.X, las.Y = x + np.int32(column) * steps[0], y + np.int32(row) * steps[1]
            las.gps_time = times + number * lasting_s
            las.point_source_id[:] = number + 1
            out.write_points(las.points)


def measured(words: list[str]) -> dict[str, Any]:
    """Run a command; its CPU time and memory, those of its children included."""
    before, begun = os.times(), time.monotonic()
    process = subprocess.Popen(
        [sys.executable, "-c", SWATH, *words], stdout=subprocess.DEVNULL, start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[1])},
    )  # fmt: skip
    peak = 0
    while process.poll() is None:
        peak = max(peak, resident_kb(process.pid))
        time.sleep(0.2)
    after = os.times()
    cpu_s = after.children_user - before.children_user + after.children_system - before.children_system
    return {
        "code": process.returncode,
        "cpu_s": round(cpu_s, 1),
        "wall_s": round(time.monotonic() - begun, 1),
        "peak_mb": round(peak / 1024),
    }


def resident_kb(group: int) -> int:
    """Of all processes of a group together; shared pages of files count for each."""
    total = 0
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if os.getpgid(int(folder.name)) == group:
                total += int(next(line for line in (folder / "status").open() if line.startswith("VmRSS")).split()[1])
        except (OSError, StopIteration):  # ended meanwhile
            continue
    return total


def count_las(path: Path) -> int:
    """Points that laspy finds in the file, not in its header."""
    with laspy.open(path) as source:
        found = sum(len(points) for points in source.chunk_iterator(5_000_000))
        assert found == source.header.point_count, (path, found)
    return found


def read_copc(path: Path) -> dict[str, Any]:
    """By copclib, and by laspy at its coarsest level."""
    import copclib

    reader = copclib.FileReader(str(path))
    nodes = reader.GetAllNodes()
    with laspy.CopcReader.open(path) as other:
        coarse = len(other.query(level=0))
    return {
        "copclib points": sum(node.point_count for node in nodes),
        "nodes": len(nodes),
        "in bounds": bool(reader.ValidateSpatialBounds(False)),
        "laspy level 0": coarse,
    }


def read_tiles(folder: Path) -> dict[str, Any]:
    """Items of the index by pystac and its schema; each tile by copclib."""
    import copclib
    import pystac
    from pystac.validation.stac_validator import JsonSchemaSTACValidator

    items, schema, points = pystac.ItemCollection.from_file(str(folder / "cloud.vpc")), JsonSchemaSTACValidator(), 0
    for item in items:
        plain = item.to_dict()
        assert schema.validate_core(plain, pystac.STACObjectType.ITEM, plain["stac_version"])
        reader = copclib.FileReader(str(folder / Path(item.assets["data"].href).name))
        own = sum(node.point_count for node in reader.GetAllNodes())
        assert own == item.properties["pc:count"]
        points += own
    return {"pystac items": len(items), "copclib points": points}


def read_e57(path: Path) -> dict[str, Any]:
    """By pye57: what its header says, and that its points can be read."""
    import pye57

    with pye57.E57(str(path)) as file:
        header = file.get_header(0)
        return {"pye57 points": header.point_count, "x": [header.xMinimum, header.xMaximum]}


def read_ply(path: Path) -> dict[str, Any]:
    """Its header, and that the file is as long as that says."""
    with path.open("rb") as file:
        head = []
        while (line := file.readline().decode().strip()) != "end_header":
            head.append(line.split())
        begin = file.tell()
    size = {"double": 8, "float": 4, "int": 4, "uint": 4, "short": 2, "ushort": 2, "char": 1, "uchar": 1}
    count = next(int(words[2]) for words in head if words[:2] == ["element", "vertex"])
    each = sum(size[words[1]] for words in head if words[0] == "property")
    assert path.stat().st_size == begin + count * each
    return {"points by header and size": count}


def read_csv(path: Path) -> dict[str, Any]:
    """Lines of it."""
    with path.open("rb") as file:
        return {"lines": sum(block.count(b"\n") for block in iter(lambda: file.read(1 << 24), b"")) - 1}


def read_raster(path: Path) -> dict[str, Any]:
    """By rasterio: that every block can be read, and its overviews are there; by GDAL's own test of a COG where there is one."""
    import rasterio

    with rasterio.open(path) as source:
        filled = 0
        for _, window in source.block_windows(1):
            filled += int(source.read_masks(1, window=window).astype(bool).sum())
        return {
            "rasterio size": [source.width, source.height], "filled": filled, "layout": source.tags(ns="IMAGE_STRUCTURE").get("LAYOUT"),
            "overviews": len(source.overviews(1)),
        }  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
