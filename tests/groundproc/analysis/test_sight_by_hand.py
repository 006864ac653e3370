"""What is seen, computed a second time: lines walked in small steps over surfaces and through voxels counted one by one."""

from collections import defaultdict
from pathlib import Path

import laspy
import numpy as np
import numpy.typing as npt
import pyogrio
import pyproj
import pytest
import rasterio
import shapely
from rasterio.transform import from_origin

from groundproc.cli import main

Array = npt.NDArray[np.float64]
EAST, NORTH, EDGE = 400_010.0, 5_200_020.0, 0.5
STEPS = 900
PLACE = np.array([EAST, NORTH, 0.0])


def ground(x: Array, y: Array) -> Array:
    return np.asarray(700.2 + 0.15 * x + 0.05 * y)


def stand(rng: np.random.Generator, side: float, per_m2: float) -> tuple[Array, Array, Array]:
    """Beams from two places above into a slope with round crowns of leaves: echoes, sensors, rank and number of echoes."""
    crowns = np.column_stack([rng.uniform(1, side - 1, (7, 2)), rng.uniform(3.0, 5.0, 7), rng.uniform(1.0, 1.6, 7)])
    echoes, eyes, ranks = [], [], []
    for eye in np.array([[-3.0, side / 2, 730.0], [side + 4.0, side / 3, 733.0]]):
        for x, y in rng.uniform(0, side, (int(side**2 * per_m2 / 2), 2)):
            end = np.array([x, y, float(ground(x, y))])
            way = eye - end
            met = []
            for cx, cy, height, radius in crowns:
                middle = np.array([cx, cy, float(ground(cx, cy)) + height])
                at = np.clip(((middle - end) * way).sum() / (way * way).sum(), 0, 1)
                miss = float(np.linalg.norm(end + at * way - middle))
                if miss < radius and rng.uniform() < 0.8:
                    deep = np.sqrt(radius**2 - miss**2) * rng.uniform(-1, 1) / np.linalg.norm(way)
                    met.append(end + (at + deep) * way)
            several = met if met and rng.uniform() < 0.5 else [*met, end]
            several.sort(key=lambda p: -p[2])
            for n, place in enumerate(several[:3]):
                echoes.append(place)
                eyes.append(eye)
                ranks.append((n + 1, min(len(several), 3)))
    return np.array(echoes), np.array(eyes), np.array(ranks)


def write(path: Path, xyz: Array, ranks: Array, time_s: Array) -> Path:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [1e-4] * 3, [EAST, NORTH, 700.0]
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.add_crs(pyproj.CRS.from_epsg(32632))
    las = laspy.LasData(header)
    las.xyz = xyz + PLACE
    las.return_number, las.number_of_returns = ranks.T
    las.gps_time = 400_000_000.0 + time_s
    las.write(path)
    return path


def track(path: Path, eyes: Array) -> Array:
    """A sensor that stays at one place, then jumps to the other; times of the echoes."""
    to = pyproj.Transformer.from_crs(32632, 4326, always_xy=True)
    second = eyes[:, 0] > 0
    rows = ["utc_ns,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg"]
    for begin, which in ((0.0, ~second), (60.0, second)):
        east, north, up = eyes[which][0] + PLACE
        longitude, latitude = to.transform(east, north)
        for t in np.arange(begin, begin + 20.1, 0.5):
            stamp = round((1_400_000_000 + 315_964_800 - 18 + t) * 1e9)
            rows.append(f"{stamp},{latitude:.11f},{longitude:.11f},{up:.5f},0,0,0")
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return np.where(second, 61.0, 1.0) + np.linspace(0, 15, len(eyes))


def voxels_along(start: Array, end: Array) -> dict[tuple[int, ...], float]:
    """Voxels between two places, and the way in each in edges: by small steps."""
    share = (np.arange(STEPS) + 0.5) / STEPS
    at = np.floor((start + share[:, None] * (end - start)) / EDGE).astype(int)
    begun = np.r_[0, 1 + np.flatnonzero((np.diff(at, axis=0) != 0).any(axis=1)), STEPS]
    long = np.linalg.norm(end - start) / EDGE / STEPS
    return {tuple(map(int, at[k])): float(n) * long for k, n in zip(begun[:-1], np.diff(begun), strict=True)}


def open_share(xyz: Array, eyes: Array, ranks: Array, top: float) -> dict[tuple[int, ...], float]:
    """Share of beams that each voxel lets through; of one that none met, that of the eight beside it taken together, if any was met."""
    hits: dict[tuple[int, ...], int] = defaultdict(int)
    passed: dict[tuple[int, ...], int] = defaultdict(int)
    for place, eye, rank in zip(xyz, eyes, ranks, strict=True):
        own = tuple(map(int, np.floor(place / EDGE)))
        hits[own] += 1
        if rank[0] < rank[1]:
            continue
        # no voxel above the highest point is asked for
        above = place + (eye - place) * min(1.0, (top - place[2]) / (eye[2] - place[2]))
        for key in voxels_along(place, above):
            if key != own:
                passed[key] += 1
    shares = {key: passed[key] / (passed[key] + hits[key]) for key in {*hits, *passed}}
    for i, j, k in {(i + di, j + dj, k) for i, j, k in shares for di in (-1, 0, 1) for dj in (-1, 0, 1)} - {*shares}:
        block = [(i + di, j + dj, k) for di in (-1, 0, 1) for dj in (-1, 0, 1)]
        through, ended = (sum(counts.get(key, 0) for key in block) for counts in (passed, hits))
        shares[i, j, k] = through / (through + ended)
    return shares


def seen_through(opened: dict[tuple[int, ...], float], start: Array, end: Array) -> float:
    """Not a number where nothing is known of a voxel on the way, unless the others are closed."""
    ends = {tuple(map(int, np.floor(place / EDGE))) for place in (start, end)}
    between = {key: way for key, way in voxels_along(start, end).items() if key not in ends}
    share = float(np.prod([opened.get(key, 1.0) ** way for key, way in between.items()]))
    return share if share <= 1e-6 or all(key in opened for key in between) else np.nan


def test_leaves_hide_as_beams_counted_one_by_one_say(tmp_path: Path) -> None:
    rng, side = np.random.default_rng(3), 9.0
    # three places of a column of cells that ground was met in
    xyz, eyes, ranks = stand(rng, side, 12.0)
    xyz = np.round(xyz, 4)
    time_s = track(tmp_path / "t.csv", eyes)
    cloud = write(tmp_path / "c.las", xyz, ranks, time_s)
    opened = open_share(xyz + PLACE, eyes + PLACE, ranks, float(xyz[:, 2].max()) + EDGE)
    low = np.full((18, 18), np.inf)
    np.minimum.at(low, tuple(np.floor(xyz[:, 1::-1] / EDGE).astype(int).T), xyz[:, 2])
    # where no ground was met in a column, a crown is above it
    x, y = np.meshgrid((np.arange(18) + 0.5) * EDGE, (np.arange(18) + 0.5) * EDGE)
    lowest = np.where(low - ground(x, y) > 1.0, np.nan, low)
    column = int(np.flatnonzero(np.isfinite(lowest[[4, 8, 12]]).all(axis=0))[2])
    places = [((column + 0.6) * EDGE, (row + 0.2) * EDGE) for row in (4, 8, 12)]
    line = shapely.LineString([(EAST + px, NORTH + py) for px, py in (places[0], places[-1])])
    pyogrio.raw.write(
        tmp_path / "p.gpkg", shapely.to_wkb(np.array([line], object)), [], [], geometry_type="LineString",
        crs="EPSG:32632", driver="GPKG",
    )  # fmt: skip

    def looked(*words: str) -> Array:
        made = tmp_path / "o.tif"
        begin = ["viewshed", str(cloud), "--mode", "voxels", "-t", str(tmp_path / "t.csv"), "-o", str(made), "--force"]
        assert main([*begin, *words]) == 0
        with rasterio.open(made) as raster:
            assert raster.transform.c <= EAST
            return np.asarray(raster.read(1, masked=True).filled(np.nan)[::-1], np.float64)

    def by_hand(place: tuple[float, float], above: float, target: float) -> Array:
        out = np.full((18, 18), np.nan)
        j, i = int(place[1] / EDGE), int(place[0] / EDGE)
        start = np.array([place[0] + EAST, place[1] + NORTH, lowest[j, i] + above])
        for row, column in np.argwhere(np.isfinite(lowest)):
            end = np.array([x[row, column] + EAST, y[row, column] + NORTH, lowest[row, column] + target])
            out[row, column] = seen_through(opened, start, end)
        return out

    at = f"{EAST + places[0][0]},{NORTH + places[0][1]}"
    first = by_hand(places[0], 1.6, 2.4)
    for found, expected in (
        (looked("--at", at, "--height", "1.6", "--target-height", "2.4"), first),
        (looked("--at", at, "--height", "2.4", "--target-height", "1.6", "--reverse"), first),
        (
            looked("--path", str(tmp_path / "p.gpkg"), "--step", "2", "--height", "1.6", "--target-height", "2.4"),
            np.ma.masked_invalid([first, *(by_hand(place, 1.6, 2.4) for place in places[1:])])
            .mean(axis=0)
            .filled(np.nan),
        ),
    ):
        both = np.isfinite(expected) & np.isfinite(found)
        assert both.sum() > 250
        # steps of a fiftieth of an edge miss corners as long, and 0.1 to the power of 0.02 is 0.95
        assert np.abs(found - expected)[both].max() < 0.1
        assert np.abs(found - expected)[both].mean() < 0.005
        assert (expected[both] < 0.99).sum() > 50


def test_one_stands_on_the_ground_below_a_crown_and_on_a_roof(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    xy = rng.uniform(0, 30, (9_000, 2))
    z = ground(*xy.T)
    roof = (np.abs(xy - (22, 22)) < 5).all(axis=1)
    z[roof] = 706.5
    crown = (np.hypot(*(xy - (10, 10)).T) < 2.5) & (rng.uniform(size=len(xy)) < 0.9)
    z[crown] += rng.uniform(5, 9, int(crown.sum()))
    cloud = write(tmp_path / "c.las", np.column_stack([xy, z]), np.ones((len(xy), 2), int), np.zeros(len(xy)))
    words = ["viewshed", str(cloud), "--mode", "voxels", "--height", "1.7", "--target-height", "1.7", "--force"]
    for (x, y), (to_x, to_y) in (((10.2, 10.2), (10.2, 3.2)), ((22.2, 22.2), (20.2, 24.2))):
        made = tmp_path / "o.tif"
        assert main([*words, "--at", f"{EAST + x},{NORTH + y}", "-o", str(made)]) == 0
        with rasterio.open(made) as raster:
            value = raster.read(1, masked=True).filled(np.nan)
            row, column = raster.index(EAST + to_x, NORTH + to_y)
        assert np.nanmedian(value[row - 1 : row + 2, column - 1 : column + 2]) == pytest.approx(1.0)


@pytest.mark.parametrize("mode", ["exact", "fast", "voxels"])
def test_birds_hide_nothing_and_a_post_does(tmp_path: Path, mode: str, capsys: pytest.CaptureFixture[str]) -> None:
    """On a plain; one bird is before the observer, one over him, and a post of twelve points stands to the north."""
    x, y = np.meshgrid(np.arange(0.25, 40, 0.5), np.arange(0.25, 40, 0.5))
    plain = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 700.2)])
    post = np.column_stack([np.full(12, 20.25), np.full(12, 25.25), np.linspace(700.4, 704.0, 12)])
    birds = np.array([[23.25, 20.25, 707.0], [20.25, 20.25, 712.0]])
    xyz = np.concatenate([plain, post, birds])
    cloud = write(tmp_path / "c.las", xyz, np.ones((len(xyz), 2), int), np.zeros(len(xyz)))
    made = tmp_path / "o.tif"
    words = ["viewshed", str(cloud), "--mode", mode, "--height", "1.7", "--at", f"{EAST + 20.25},{NORTH + 20.25}"]
    assert main([*words, "--target-height", "1.7", "-o", str(made)]) == 0
    assert "2 points that are alone" in capsys.readouterr().err
    with rasterio.open(made) as raster:
        value = raster.read(1, masked=True).filled(0)
        east, north = (value[raster.index(EAST + x, NORTH + y)] for x, y in ((36.25, 20.25), (20.25, 36.25)))
    assert east == pytest.approx(1.0)
    if mode != "voxels":  # beams from above go past most of a post
        assert north == 0.0


@pytest.mark.parametrize("way", ["there", "back"])
def test_a_path_over_a_surface_counts_the_places_that_see_a_cell(tmp_path: Path, way: str) -> None:
    rng = np.random.default_rng(8)
    z = 6.0 * rng.uniform(size=(14, 17)) + 400.0
    with rasterio.open(
        tmp_path / "z.tif", "w", driver="GTiff", width=17, height=14, count=1, dtype="float64", crs="EPSG:32632",
        transform=from_origin(EAST, NORTH, 2.0, 2.0),
    ) as file:  # fmt: skip
        file.write(z, 1)
    places = np.array([[3.3, 4.2], [7.8, 6.7], [12.3, 9.2]])  # columns and rows from the centre of the first cell
    line = shapely.LineString((EAST, NORTH) + (places + 0.5) * (2.0, -2.0))
    pyogrio.raw.write(
        tmp_path / "p.gpkg", shapely.to_wkb(np.array([line], object)), [], [], geometry_type="LineString",
        crs="EPSG:32632", driver="GPKG",
    )  # fmt: skip
    words = ["viewshed", str(tmp_path / "z.tif"), "--path", str(tmp_path / "p.gpkg"), "--step", "10.4"]
    own, far = (2.5, 0.7) if way == "there" else (0.7, 2.5)
    words += ["--height", "2.5", "--target-height", "0.7", *(["--reverse"] if way == "back" else [])]
    assert main([*words, "-o", str(tmp_path / "o.tif")]) == 0
    with rasterio.open(tmp_path / "o.tif") as raster:
        found = raster.read(1)

    def height(u: Array, v: Array) -> Array:
        i, j = np.clip(u.astype(int), 0, 15), np.clip(v.astype(int), 0, 12)
        p, q = u - i, v - j
        return np.asarray(
            (1 - q) * ((1 - p) * z[j, i] + p * z[j, i + 1]) + q * ((1 - p) * z[j + 1, i] + p * z[j + 1, i + 1])
        )

    share = np.linspace(0, 1, 8_001)
    wrong = unsure = 0
    for row in range(14):
        for column in range(17):
            least = np.array(
                [
                    (
                        (height(u[None], v[None]) + own) * (1 - share)
                        + (z[row, column] + far) * share
                        - height(u + (column - u) * share, v + (row - v) * share)
                    ).min()
                    for u, v in places
                ]
            )
            if np.abs(least).min() < 1e-3:
                unsure += 1
            else:
                wrong += int(found[row, column] != (least > 0).sum())
    assert wrong == 0
    assert unsure < 5
