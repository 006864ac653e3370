"""Products by name: chosen, told of the flight, made whole or not at all; and a product of a toy through the public door."""

import subprocess
import sys
import weakref
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from flightlog import config
from flightlog.errors import ConfigError, SourceError
from flightlog.mount import Mount
from groundproc import products
from groundproc.cloud.points import Points
from groundproc.cloud.writer import CloudWriter
from groundproc.geodesy import LocalFrame, Projection, projected_crs
from groundproc.products import Entry, chosen, longest_first, plain
from groundproc.products.product import Context, draw, streamed
from groundproc.survey import Survey
from groundproc.trajectory.estimate import Estimate
from groundproc.trajectory.trajectory import Trajectory

START_NS = 1_779_272_223_000_000_000
FRAME = LocalFrame(58.394, 15.574, 61.3)

TOY = """
from dataclasses import dataclass
from flightlog.config import option
from flightlog.errors import CoverageError


@dataclass(frozen=True, slots=True)
class Options:
    every: int = option(1, "points counted", minimum=1)
    fail: str = option("", "where to fail")


class Toy:
    def __init__(self, options):
        self.options, self.count = options, 0

    def begin(self, context):
        self.path = context.aside("toy.txt")
        self.path.write_text("begun")

    def add(self, points):
        if self.options.fail == "outside":
            raise CoverageError("no luck")
        if self.options.fail == "disk":
            raise OSError(28, "No space left on device")
        if self.options.fail == "bug":
            raise ValueError("a mistake")
        self.count += len(points["range"][:: self.options.every])

    def finish(self):
        self.path.write_text(str(self.count))


def after(context, options):
    context.aside("after.txt").write_text(f"{context.estimate.method} {context.quality['points']} {options.every}")
"""


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One file and one line in the registry: all that a product takes."""
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "toy_product.py").write_text(TOY)
    monkeypatch.syspath_prepend(str(tmp_path / "code"))
    monkeypatch.setitem(products.REGISTRY, "toy.txt", Entry("toy_product", "Toy", "a count", by_default=False))
    monkeypatch.setitem(
        products.REGISTRY, "after.txt", Entry("toy_product", "after", "what was found", by_default=False)
    )
    monkeypatch.delitem(sys.modules, "toy_product", raising=False)


@pytest.fixture
def context(tmp_path: Path) -> Context:
    times = START_NS + np.arange(3) * 10**9
    zero = np.zeros((3, 3))
    quat = np.tile([1.0, 0, 0, 0], (3, 1))
    trajectory = Trajectory(FRAME, times, zero, zero, quat, zero, zero, zero, np.array([True, True, False]))
    (tmp_path / "out").mkdir()
    estimate = Estimate(trajectory, Mount(), "none", method="toyed")
    return Context(tmp_path / "out", tmp_path, Survey(), estimate, Projection(FRAME, projected_crs(32633)))


def some(count: int = 100) -> Points:
    rng = np.random.default_rng(2)
    columns = {"intensity": rng.integers(0, 256, count).astype(np.uint8), "range": rng.random(count).astype(np.float32)}
    place = rng.uniform([533_000, 6_472_000, 0], [533_100, 6_472_100, 30], (count, 3))
    return Points(START_NS + np.arange(count), place, columns)


def make(wanted: list[Any] | None, context: Context, pieces: int = 2) -> None:
    with streamed(chosen(wanted), context) as sinks:
        for sink in sinks:
            sink.begin()
        for _ in range(pieces):
            for sink in sinks:
                sink.add(some())
        for sink in sinks:
            sink.finish()


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.usefixtures("toy")
def test_a_product_is_one_file_and_one_line(context: Context) -> None:
    wanted = config.loads("products: [cloud.laz, {toy.txt: {every: 10}}, quality.json]", Survey, "s").products
    assert wanted is not None
    make(list(wanted), context)
    assert names(context.folder) == ["cloud.laz", "toy.txt"]
    assert (context.folder / "toy.txt").read_text() == "20"
    assert plain(chosen(wanted)) == {"cloud.laz": [], "toy.txt": [{"every": 10, "fail": ""}]}


@pytest.mark.usefixtures("toy")
def test_a_function_of_a_finished_flight_is_a_product_too(context: Context) -> None:
    context.quality["points"] = 7
    draw(chosen(["after.txt", "toy.txt"]), context)
    assert names(context.folder) == ["after.txt"]
    assert (context.folder / "after.txt").read_text() == "toyed 7 1"


@pytest.mark.usefixtures("toy")
@pytest.mark.parametrize(
    ("fail", "error", "said"),
    [
        ("outside", Exception, r"^toy\.txt: no luck$"),
        ("disk", SourceError, r"^toy\.txt: cannot be made \(No space left on device\)$"),
        ("bug", ValueError, "^a mistake"),
    ],
)
def test_an_error_names_the_product_and_leaves_nothing_of_any(
    context: Context, fail: str, error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said) as caught:
        make(["cloud.laz", {"toy.txt": {"fail": fail}}], context)
    if fail == "bug":
        assert caught.value.__notes__ == ["while the product toy.txt was made"]
    assert names(context.folder) == []


@pytest.mark.usefixtures("toy")
@pytest.mark.parametrize(
    ("wanted", "said"),
    [
        (["cloud.las"], r"'cloud.las' found, expected some of cloud.laz, pictures"),
        (["pictures", "pictures"], "'pictures' stands there twice"),
        ([{"cloud.laz": {"cell_m": 1}}], r"cloud.laz: \{'cell_m': 1\} found, but it has no options"),
        ([{"toy.txt": {"evry": 1}}], r"products: toy.txt: unknown key 'evry'; known are every, fail"),
        ([{"toy.txt": {"every": 0}}], r"products: toy.txt: every: 0 found, expected at least 1"),
        ([3], "3 found"),
    ],
)
def test_a_wish_that_cannot_be_met_is_refused_by_name(wanted: list[Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        chosen(wanted)


@pytest.mark.usefixtures("toy")
def test_without_a_wish_all_defaults_are_made_in_the_order_of_the_registry() -> None:
    assert [each.name for each in chosen(None)] == [
        "cloud.laz", "pictures", "cloud.copc.laz", "dsm.tif", "intensity.tif", "density.tif", "hillshade.tif",
        "trajectory.gpkg", "report.html", "adjustment.png", "lasers.png", "trims.csv", "trims.png",
    ]  # fmt: skip
    assert [each.name for each in chosen(["pictures", "cloud.laz"])] == ["cloud.laz", "pictures"]
    assert chosen(["quality.json", "trajectory.csv"]) == []


def test_what_takes_longest_is_finished_first_and_the_others_keep_their_order() -> None:
    every = chosen(None)
    names = [each.name for each in longest_first(every)]
    assert names[:2] == ["cloud.copc.laz", "report.html"]
    assert names[2:] == [each.name for each in every if each.name not in names[:2]]


def test_the_cloud_states_where_it_is_and_what_its_points_have(context: Context) -> None:
    make(["cloud.laz"], context, pieces=3)
    cloud = laspy.read(context.folder / "cloud.laz")
    assert len(cloud.points) == 300
    crs = cloud.header.parse_crs()
    assert [part.to_epsg() for part in crs.sub_crs_list] == [32633, 5773]
    # hundreds of metres around the beginning of the flight
    assert cloud.header.offsets.tolist() == [
        np.floor(v / 100) * 100 for v in context.projection.exact(np.zeros((1, 3)))[0][:2]
    ] + [0]
    assert [each.name for each in cloud.point_format.extra_dimensions] == ["range"]


def test_the_buffers_of_the_cloud_are_gone_before_the_next_product_is_finished(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    # tens of megabytes, and matplotlib would need its own beside them
    writers: list[weakref.ref[CloudWriter]] = []
    opened = CloudWriter.__init__

    def remembered(writer: CloudWriter, *args: Any, **options: Any) -> None:
        opened(writer, *args, **options)
        writers.append(weakref.ref(writer))

    monkeypatch.setattr(CloudWriter, "__init__", remembered)
    with streamed(chosen(["cloud.laz"]), context) as [cloud]:
        cloud.begin()
        cloud.add(some())
        assert [writer() is None for writer in writers] == [False]
        cloud.finish()
        assert [writer() is None for writer in writers] == [True]


def test_pictures_of_methods_that_did_not_run_are_not_drawn(context: Context) -> None:
    draw([each for each in chosen(None) if each.name != "report.html"], context)  # that is of every flight
    assert names(context.folder) == ["trajectory.gpkg"]


def test_the_registry_imports_no_product() -> None:
    script = "import sys, groundproc.products; print([m for m in sys.modules if m.startswith(('numpy', 'matplotlib', 'laspy'))])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert "laspy" not in done.stdout
    assert "matplotlib" not in done.stdout


def test_choosing_all_products_imports_nothing_that_only_drawing_needs() -> None:
    # the trajectory is estimated between the two, and 27 MB of matplotlib would be beside it all the time
    script = "import sys; from groundproc.products import REGISTRY, chosen; chosen(list(REGISTRY)); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert "groundproc.products.adjustment_plot" in done.stdout.split()
    assert "matplotlib" not in done.stdout


def test_tiles_hold_the_points_of_the_cloud(context: Context) -> None:
    make(["cloud.laz", {"tiles": {"size_m": 20, "format": "laz"}}], context)
    whole = laspy.read(context.folder / "cloud.laz")
    tiles = [laspy.read(path) for path in (context.folder / "tiles").glob("*_*.laz")]
    assert sum(len(each.points) for each in tiles) == len(whole.points)
    found = np.concatenate([each.xyz for each in tiles])
    np.testing.assert_allclose(np.sort(found, axis=0), np.sort(whole.xyz, axis=0), rtol=0, atol=1e-9)
    assert (context.folder / "tiles" / "cloud.vpc").is_file()


def test_a_smoothed_cloud_is_made_of_the_finished_one(context: Context) -> None:
    rng = np.random.default_rng(4)
    count = 6_000
    place = rng.uniform([533_000, 6_472_000, 0], [533_004, 6_472_004, 0], (count, 3))
    place[:, 2] = rng.normal(5.0, 0.015, count)
    crs = context.crs
    with CloudWriter(context.finished / "cloud.laz", [], crs=crs, offset_m=(533_000, 6_472_000, 0)) as writer:
        writer.write(Points(START_NS + np.arange(count), place, {}))
    draw(chosen(["cloud_smooth.laz"]), context)
    made = laspy.read(context.folder / "cloud_smooth.laz")
    assert np.std(made.z) < 0.5 * 0.015
    assert np.mean(made.smoothed) > 0.9


def test_a_smoothed_cloud_needs_a_cloud(context: Context) -> None:
    with pytest.raises(SourceError, match=r"cloud_smooth.laz: no product holds the points; expected cloud.laz"):
        draw(chosen(["cloud_smooth.laz"]), context)
    assert names(context.folder) == []
