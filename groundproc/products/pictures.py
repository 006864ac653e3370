"""Pictures of a cloud, straight from the points: seen from above by height and by intensity, and from the side."""

from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.files import written_aside

Array = npt.NDArray[np.float64]

LARGEST_SAMPLE: Final = 2_000_000
"""Points kept for the pictures, however long the flight."""
PIXELS: Final = 1000


class CloudSample:
    """A sample of a stream of points, evenly thinned, of bounded size."""

    def __init__(self) -> None:
        self._parts: list[tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8]]] = []
        self._step, self._size = 8, 0

    def add(self, xyz_m: Array, intensity: npt.NDArray[np.uint8]) -> None:
        """Take every n-th of some points, shapes (n, 3) and (n,)."""
        # a step that shares no factor with the 32 lasers, so that none is preferred
        part = slice(None, None, self._step + 1)
        self._parts.append((xyz_m[part].copy(), intensity[part].copy()))
        self._size += len(self._parts[-1][0])
        if self._size > LARGEST_SAMPLE:
            self._parts = [(xyz[::2].copy(), shade[::2].copy()) for xyz, shade in self._parts]
            self._size = sum(len(xyz) for xyz, _ in self._parts)
            self._step *= 2

    def points(self) -> tuple[Array, npt.NDArray[np.uint8]]:
        """Positions, shape (n, 3), and intensities, shape (n,)."""
        xyz, intensity = zip(*self._parts, strict=True)
        return np.concatenate(xyz), np.concatenate(intensity)


def draw_cloud(folder: Path, sample: CloudSample, crs_name: str) -> None:
    """Write cloud_height.png and cloud_intensity.png."""
    xyz, intensity = sample.points()
    low, high = np.percentile(xyz[:, 2], [1, 99.5])
    _draw(folder / "cloud_height.png", xyz, xyz[:, 2], (float(low), float(high)), "height [m]", "viridis", crs_name)
    top = float(max(np.percentile(intensity, 99), 1))
    _draw(folder / "cloud_intensity.png", xyz, intensity.astype(np.float64), (0.0, top), "intensity", "gray", crs_name)


def _draw(
    path: Path, xyz: Array, value: Array, limits: tuple[float, float], label: str, colours: str, crs_name: str
) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    low, high = np.percentile(xyz, [0.2, 99.8], axis=0)
    low, high = low - 1.0, high + 1.0
    size = high - low
    figure, (plan, side) = plt.subplots(
        2, 1, figsize=(12, 12 * min(2.0, (size[1] + size[2] + 4) / size[0] + 0.15)), constrained_layout=True,
        height_ratios=[size[1], max(size[2] * 1.5, 0.15 * size[1])],
    )  # fmt: skip
    image: Any = None
    for axes, across, up, depth, names in (
        (plan, 0, 1, 2, ("easting [m]", "northing [m]")),
        (side, 0, 2, 1, ("easting [m]", "height [m]")),
    ):
        pixel = max(size[across], size[up]) / PIXELS
        # from above the highest point is seen, from the south the nearest
        order = np.argsort(xyz[:, depth] if axes is plan else -xyz[:, depth], kind="stable")
        raster = _raster(xyz[order][:, [across, up]], value[order], low[[across, up]], high[[across, up]], pixel)
        extent = (low[across], high[across], low[up], high[up])
        image = axes.imshow(raster, extent=extent, origin="lower", cmap=colours, vmin=limits[0], vmax=limits[1])
        axes.set(xlabel=names[0], ylabel=names[1], facecolor="#10131a")
        axes.ticklabel_format(useOffset=False, style="plain")
    plan.set_title(f"from above and from the south, {crs_name}")
    figure.colorbar(image, ax=(plan, side), label=label, shrink=0.6)
    with written_aside(path) as aside:
        figure.savefig(aside, format="png", dpi=100)
    plt.close(figure)


def _raster(place: Array, value: Array, low: Array, high: Array, pixel: float) -> Array:
    """Value of the last point in each pixel; empty ones are not a number."""
    width, height = np.ceil((high - low) / pixel).astype(int)
    column, row = ((place - low) / pixel).astype(int).T
    inside = (place >= low).all(axis=1) & (column < width) & (row < height)
    raster = np.full((height, width), np.nan)
    raster[row[inside], column[inside]] = value[inside]
    return raster
