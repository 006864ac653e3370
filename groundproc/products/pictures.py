"""Pictures of a cloud, straight from the points: seen from above by height and by intensity, and from the side."""

from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.cloud.points import Points
from groundproc.files import written_aside
from groundproc.products.product import Context

Array = npt.NDArray[np.float64]

LARGEST_SAMPLE: Final = 500_000
"""Points kept for the pictures, however long the flight."""
PIXELS: Final = 600


class CloudSample:
    """A sample of a stream of points, evenly thinned, of bounded size."""

    def __init__(self) -> None:
        self._parts: list[tuple[npt.NDArray[np.float64], npt.NDArray[np.unsignedinteger]]] = []
        self._step, self._size = 8, 0

    def add(self, xyz_m: Array, intensity: npt.NDArray[np.unsignedinteger]) -> None:
        """Take every n-th of some points, shapes (n, 3) and (n,)."""
        # a step that shares no factor with the 32 lasers, so that none is preferred
        part = slice(None, None, self._step + 1)
        self._parts.append((xyz_m[part].copy(), intensity[part].copy()))
        self._size += len(self._parts[-1][0])
        if self._size > LARGEST_SAMPLE:
            self._parts = [(xyz[::2].copy(), shade[::2].copy()) for xyz, shade in self._parts]
            self._size = sum(len(xyz) for xyz, _ in self._parts)
            self._step *= 2

    def points(self) -> tuple[Array, npt.NDArray[np.unsignedinteger]]:
        """Positions, shape (n, 3), and intensities, shape (n,)."""
        xyz, intensity = zip(*self._parts, strict=True)
        return np.concatenate(xyz), np.concatenate(intensity)


class Pictures:
    """cloud_height.png and cloud_intensity.png."""

    def begin(self, context: Context) -> None:
        """Begin with no points."""
        self._context, self._sample = context, CloudSample()

    def add(self, points: Points) -> None:
        """Keep some of the points."""
        self._sample.add(points.xyz_m, points["intensity"])

    def finish(self) -> None:
        """Draw them."""
        draw_cloud(self._context.folder, self._sample, self._context.projection.crs.name)


def draw_cloud(folder: Path, sample: CloudSample, crs_name: str) -> None:
    """Write cloud_height.png and cloud_intensity.png."""
    xyz, intensity = sample.points()
    low, high = np.percentile(xyz[:, 2], [1, 99.5])
    top = max(float(np.percentile(intensity, 99)), 1.0)
    _draw(folder / "cloud_height.png", xyz, xyz[:, 2], (float(low), float(high)), "height [m]", "viridis", crs_name)
    _draw(folder / "cloud_intensity.png", xyz, intensity.astype(np.float64), (0.0, top), "intensity", "gray", crs_name)


def _draw(
    path: Path, xyz: Array, value: Array, limits: tuple[float, float], label: str, colours: str, crs_name: str
) -> None:
    """A plan above an elevation seen from the south, to one scale."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    low, high = np.percentile(xyz, [0.3, 99.7], axis=0)
    low, high = low - 1.0, high + 1.0
    width, depth, rise = high - low
    pixel = max(width, depth) / PIXELS
    inches = 9.0 / max(width, depth)
    plan, side = (width * inches, depth * inches), (width * inches, rise * inches)
    size = (plan[0] + 2.6, plan[1] + side[1] + 2.2)
    figure = plt.figure(figsize=size, dpi=100)
    left = 1.2 / size[0]
    panels = (
        # from above the highest point of a pixel is seen, from the south the nearest
        ((left, (side[1] + 1.4) / size[1], plan[0] / size[0], plan[1] / size[1]), (0, 1), 2, 1.0, "northing [m]"),
        ((left, 0.6 / size[1], side[0] / size[0], side[1] / size[1]), (0, 2), 1, -1.0, "height [m]"),
    )
    for place, shown, deep, sign, name in panels:
        axes = figure.add_axes(place, facecolor="#10131a")
        order = np.argsort(sign * xyz[:, deep], kind="stable")
        corner = list(shown)
        raster = _raster(xyz[order][:, corner], value[order], low[corner], high[corner], pixel)
        extent = (low[shown[0]], high[shown[0]], low[shown[1]], high[shown[1]])
        image = axes.imshow(
            raster, extent=extent, origin="lower", cmap=colours, vmin=limits[0], vmax=limits[1], interpolation="nearest"
        )
        axes.set(xlabel="easting [m]", ylabel=name)
        axes.ticklabel_format(useOffset=False, style="plain")
    figure.axes[0].set_title(f"from above; below, from the south; {crs_name}")
    bar = figure.add_axes((left + (plan[0] + 0.3) / size[0], panels[0][0][1], 0.2 / size[0], plan[1] / size[1]))
    figure.colorbar(image, cax=bar, label=label)
    with written_aside(path) as aside:
        figure.savefig(aside, format="png")
    plt.close(figure)


def _raster(place: Array, value: Array, low: Array, high: Array, pixel: float) -> Array:
    """Value of the last point in each pixel; empty ones are not a number."""
    width, height = np.ceil((high - low) / pixel).astype(int)
    column, row = ((place - low) / pixel).astype(int).T
    inside = (place >= low).all(axis=1) & (column < width) & (row < height)
    raster = np.full((height, width), np.nan)
    raster[row[inside], column[inside]] = value[inside]
    return raster
