"""Maps of a flight: rasters of the folder as pictures, the path over them, scale and north."""

import base64
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.raster import geotiff
from groundproc.reporting.markup import Html, tag

Array = npt.NDArray[np.float64]
Values = npt.NDArray[np.float32]

_PIXELS: Final = 760
"""Of the longer side."""
_SPAN: Final = (2.0, 98.0)
"""Percentiles between which colours span: single wild cells would take all of them."""
_STOPS: Final = {
    "height": ("2b3a8c", "2b6cb3", "2a9d9b", "4fb86a", "a9cf4c", "f0dc55", "f6b24a", "f4f0e6"),
    "grey": ("101215", "fbfaf7"),
    "warm": ("15224f", "5b2a86", "b5367a", "ee6a50", "fdb863", "fdf5c9"),
    "sides": ("2166ac", "92c5de", "f2f2f0", "f4a582", "b2182b"),
}
_LEVEL: Final = 6
"""Of deflate; the highest takes four times as long."""
_FIRST: Final = ("dsm.tif", "density.tif", "intensity.tif", "sigma.tif", "strip_difference.tif")
_UNITS: Final = {"metre": "", "1/m2": "/m²"}
"""GDAL says "metre", of the heights of the CRS, where a band states no unit."""
SHADE: Final = "hillshade.tif"
_TITLES: Final = {"dsm.tif": "Height", "density.tif": "Density", "intensity.tif": "Intensity", SHADE: "Hillshade"}


@dataclass(frozen=True, slots=True)
class Layer:
    """One map.

    Attributes
    ----------
    name, title, unit : str
    values : ndarray of float32, shape (rows, columns)
        North above; NaN where there is none.
    west_m, north_m, pixel_m : float
        Corner, and side of a pixel.
    colours : str
        Of `_STOPS`.
    """

    name: str
    title: str
    unit: str
    values: Values
    west_m: float
    north_m: float
    pixel_m: float
    colours: str


def layers_of(folder: Path, names: Sequence[str]) -> tuple[list[Layer], Layer | None]:
    """The rasters among some products of a folder, and the shaded relief to lay under heights.

    Raises
    ------
    CaptureError
        One is damaged.
    """
    found = sorted(
        (name for name in names if name.endswith((".tif", ".tiff")) and (folder / name).is_file()),
        key=lambda name: (_FIRST.index(name) if name in _FIRST else len(_FIRST), name),
    )
    layers = [each for each in map(_read, (folder / name for name in found)) if np.isfinite(each.values).any()]
    shade = next((each for each in layers if each.name == SHADE), None)
    return [each for each in layers if each.name != SHADE or len(layers) == 1], shade


def _read(path: Path) -> Layer:
    with geotiff.opened(path) as raster:
        values, pixel_m = geotiff.coarse(raster, _PIXELS)
        if raster.file.nodata is None:
            values = np.where(values == 0.0, np.nan, values)  # a count: nothing was seen
        band, unit = (
            raster.file.descriptions[0] or path.stem,
            _UNITS.get(raster.file.units[0] or "", raster.file.units[0] or ""),
        )
        title = _TITLES.get(path.name, band[:1].upper() + band[1:])
        return Layer(
            path.name, title, unit, values, raster.west_m, raster.north_m, pixel_m, _colours(path.name, values)
        )


def of_points(xyz_m: Array, most: int = 320) -> Layer:
    """Heights of some points, the highest of each pixel: where no raster was made."""
    low, high = np.percentile(xyz_m[:, :2], [0.1, 99.9], axis=0)
    pixel_m = max(float((high - low).max()) / most, 0.05)
    columns, rows = (np.ceil((high - low) / pixel_m).astype(int) + 1).tolist()
    place = np.floor((xyz_m[:, :2] - low) / pixel_m).astype(int)
    inside = (place >= 0).all(axis=1) & (place[:, 0] < columns) & (place[:, 1] < rows)
    values = np.full((rows, columns), -np.inf, np.float32)
    np.maximum.at(values, (rows - 1 - place[inside, 1], place[inside, 0]), xyz_m[inside, 2].astype(np.float32))
    values[np.isinf(values)] = np.nan
    return Layer("points", "Height", "m", values, float(low[0]), float(low[1]) + rows * pixel_m, pixel_m, "height")


def _colours(name: str, values: Values) -> str:
    if name in ("dsm.tif", "dtm.tif"):
        return "height"
    if name in ("intensity.tif", SHADE):
        return "grey"
    known = values[np.isfinite(values)]
    return "sides" if len(known) and known.min() < 0.0 < known.max() else "warm"


def figures(layers: Sequence[Layer], shade: Layer | None, paths: Sequence[Array]) -> Iterator[Html]:
    """A picture for each layer, with path, scale and north, and its scale of colours below."""
    for layer in layers:
        yield _figure(layer, shade if layer.colours == "height" else None, paths)


def _figure(layer: Layer, shade: Layer | None, paths: Sequence[Array]) -> Html:
    rows, columns = layer.values.shape
    low, high = span(layer.values, layer.colours == "sides")
    unit = max(rows, columns) / 100.0
    colours = coloured(layer.values, layer.colours, low, high)
    if shade is not None and shade.values.shape == layer.values.shape:
        colours = lit(colours, shade.values)
    parts = [tag("image", href=png(colours), width=columns, height=rows)]
    for path in paths:
        words = "".join(
            f"{'L' if i else 'M'}{(x - layer.west_m) / layer.pixel_m:.1f} {(layer.north_m - y) / layer.pixel_m:.1f}"
            for i, (x, y, *_) in enumerate(path.tolist())
        )
        parts += [_stroke(words, "#ffffff", 0.9 * unit), _stroke(words, "#d3264f", 0.4 * unit)]
    parts += [_north(columns, unit), *_scale(layer, unit)]
    drawn = tag(
        "svg", parts, viewBox=f"0 0 {columns} {rows}", role="img", aria_label=f"map: {layer.title}", class_="map"
    )
    bar = png(coloured(np.linspace(0.0, 1.0, 256, dtype=np.float32)[None], layer.colours, 0.0, 1.0))
    ends = tag(
        "figcaption",
        tag("span", _value(low)),
        tag("img", src=bar, alt="", class_="bar"),
        tag("span", f"{_value(high)} {layer.unit}".strip()),
    )
    return tag("figure", tag("h3", layer.title), drawn, ends, data_layer=layer.name)


def _stroke(words: str, colour: str, width: float) -> Html:
    return tag(
        "path",
        d=words,
        fill="none",
        stroke=colour,
        stroke_width=round(width, 2),
        stroke_linecap="round",
        stroke_linejoin="round",
    )


def _label(text: str, y: float = 0.0) -> Iterator[Html]:
    """Dark on a light edge: read on any map."""
    looks: dict[str, str | float | None] = {
        "y": y,
        "font_size": "2.6",
        "font_family": "sans-serif",
        "font_weight": "bold",
        "text_anchor": "middle",
    }
    yield tag("text", text, fill="none", stroke="#ffffff", stroke_width=0.7, stroke_linejoin="round", **looks)
    yield tag("text", text, fill="#10161c", **looks)


def _north(columns: int, unit: float) -> Html:
    arrow = tag("path", d="M0 -4L1.8 3L0 1.6L-1.8 3Z", fill="#10161c", stroke="#ffffff", stroke_width=0.4)
    return tag(
        "g", arrow, _label("N", 6.6), transform=f"translate({columns - 5 * unit:.1f} {6 * unit:.1f}) scale({unit:.3f})"
    )


def _scale(layer: Layer, unit: float) -> Iterator[Html]:
    rows, columns = layer.values.shape
    long_m = scale_m(columns * layer.pixel_m)
    wide, x, y = long_m / layer.pixel_m, 3.0 * unit, rows - 3.0 * unit
    line = f"M{x:.1f} {y - 1.2 * unit:.1f}v{1.2 * unit:.1f}h{wide:.1f}v{-1.2 * unit:.1f}"
    yield _stroke(line, "#ffffff", 1.1 * unit)
    yield _stroke(line, "#10161c", 0.45 * unit)
    yield tag(
        "g", _label(f"{long_m:g} m"), transform=f"translate({x + wide / 2:.1f} {y - 2.2 * unit:.1f}) scale({unit:.3f})"
    )


def scale_m(width_m: float) -> float:
    """A round length of about a quarter of a map's width."""
    most = max(width_m / 3.5, 1e-3)
    unit = 10.0 ** np.floor(np.log10(most))
    return float(unit * max(factor for factor in (1.0, 2.0, 5.0) if factor * unit <= most * 1.0001))


def span(values: Values, both: bool = False) -> tuple[float, float]:
    """Between which values colours span; `both`: as far to either side of 0."""
    known = values[np.isfinite(values)]
    if not len(known):
        return 0.0, 1.0
    low, high = (float(each) for each in np.percentile(known, _SPAN))
    if both:
        low, high = -max(-low, high), max(-low, high)
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def coloured(values: Values, colours: str, low: float, high: float) -> npt.NDArray[np.uint8]:
    """Colours, shape (rows, columns, 4); what has no value is transparent."""
    known = np.isfinite(values)
    steps = np.clip((np.where(known, values, low) - low) / (high - low), 0.0, 1.0)
    out = np.zeros((*values.shape, 4), np.uint8)
    out[..., :3] = palette(colours)[np.rint(steps * 254).astype(int)] * known[..., None]
    out[..., 3] = 255 * known
    return out


def lit(colours: npt.NDArray[np.uint8], shade: Values) -> npt.NDArray[np.uint8]:
    """Colours of a surface in the light of a shaded relief, 1 to 255 of the same cells; flat ground keeps its own."""
    out = colours.copy()
    light = 0.3 + 0.99 * np.where(np.isfinite(shade), shade, 180.0) / 255.0
    out[..., :3] = np.clip(colours[..., :3] * light[..., None], 0.0, 255.0)
    return out


def png(colours: npt.NDArray[np.uint8]) -> str:
    """A picture as a data URI; one byte a pixel where its colours are few."""
    from PIL import Image

    held = io.BytesIO()
    found, number = np.unique(colours.reshape(-1, 4).view("<u4")[:, 0], return_inverse=True)
    if len(found) > 256:
        Image.fromarray(colours, "RGBA").save(held, "PNG", compress_level=_LEVEL)
    else:
        known = found.view(np.uint8).reshape(-1, 4)
        image = Image.fromarray(number.reshape(colours.shape[:2]).astype(np.uint8), "P")
        image.putpalette(known[:, :3].ravel().tolist())
        image.save(held, "PNG", compress_level=_LEVEL, transparency=known[:, 3].tobytes())
    return "data:image/png;base64," + base64.b64encode(held.getvalue()).decode()


def palette(colours: str) -> npt.NDArray[np.uint8]:
    """255 colours from the first stop to the last, shape (255, 3)."""
    stops = np.array([list(bytes.fromhex(each)) for each in _STOPS[colours]], np.float64)
    at = np.linspace(0.0, len(stops) - 1.0, 255)
    return (
        np.stack([np.interp(at, np.arange(len(stops)), stops[:, i]) for i in range(3)], axis=1).round().astype(np.uint8)
    )


def _value(value: float) -> str:
    return f"{value:.4g}".replace("-", "−") if abs(value) < 1000 else f"{value:.0f}"
