"""The photographs of a flight in its report: figures, the mosaic, and the lidar over a picture of each camera."""

import base64
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.raster import geotiff
from groundproc.reporting.markup import Html, joined, section, table, tag

MOSAICS: Final = ("ortho.tif", "ortho_images.tif")
"""Rasters that are no maps of one quantity."""
_OVERLAYS: Final = "overlays/"
_WIDE_PX: Final = 1100
_QUALITY: Final = 80
_MOST_CAMERAS: Final = 6


def images(quality: Mapping[str, Any], folder: Path, names: Sequence[str]) -> Html:
    """The part about images; empty where there were none.

    Raises
    ------
    CaptureError
        The mosaic is damaged.
    """
    told = quality.get("images")
    if not told:
        return Html("")
    parts: list[Html] = [table((), list(_rows(told)))]
    if MOSAICS[0] in names:
        about = "Ortho mosaic. North is up; grey is what no photograph shows."
        parts.append(_figure(_mosaic(folder / MOSAICS[0]), "ortho mosaic", about))
    shown = [name for name in names if name.startswith(_OVERLAYS)]
    for name in shown[:_MOST_CAMERAS]:
        camera = Path(name).stem
        about = f"Camera {camera}: the lidar's points over the photograph that sees most of them, in colours of their height."
        parts.append(_figure(_picture(folder / name), f"overlay of {camera}", about))
    if len(shown) > _MOST_CAMERAS:
        parts.append(tag("p", f"{len(shown) - _MOST_CAMERAS} more are in {_OVERLAYS}", class_="aside"))
    return section("images", "Photographs", joined(parts))


def _rows(told: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    adjusted, colour, ndvi = told["images"], told["colour"], told["ndvi"]
    counts = adjusted["counts"]
    yield "Adjusted", f"{counts['images']} images, {counts['points']:,} tie points"
    if adjusted["sigma0"] is not None:
        yield "Sigma0", f"{adjusted['sigma0']:.3f}"
    if adjusted["residual_rms_px"] is not None:
        yield "Residuals, RMS", f"{adjusted['residual_rms_px']:.2f} px"
    surface = colour["points"] - colour["no_surface"]
    share = colour["coloured"] / max(surface, 1)
    yield "Points with a colour", f"{colour['coloured']:,} of {surface:,} ({share:.1%})"
    if colour["no_surface"]:
        yield "Noise and what moved, without a colour", f"{colour['no_surface']:,}"
    score = ", ".join(f"{band} {value:.1f} %" for band, value in colour["held_out"].items())
    if score:
        yield "Held out: an image against what the others say, RMS of the full scale", score
    by_image = colour["held_out_images"]
    if by_image:
        name = max(by_image, key=lambda each: (by_image[each], each))
        yield "Most in one image", f"{by_image[name]:.1f} % ({name})"
    if "index" in ndvi:
        how = ", ".join(
            f"{band}: {line['panels']} panels" if line["panels"] else f"{band}: {line['by'] or 'nothing'}"
            for band, line in ndvi["lines"].items()
        )
        yield (
            "Vegetation index",
            f"median {_number(ndvi['median'])}; {'calibrated' if ndvi['calibrated'] else 'not calibrated'} ({how})",
        )
    else:
        yield "Vegetation index", f"none: {ndvi['left_out']}"


def _number(value: float | None) -> str:
    return "not known" if value is None else f"{value:.2f}"


def _figure(picture: npt.NDArray[np.uint8], label: str, about: str) -> Html:
    return tag(
        "figure",
        tag("img", src=_jpeg(picture), alt=label, class_="map"),
        tag("figcaption", about, class_="aside"),
    )


def _jpeg(picture: npt.NDArray[np.uint8]) -> str:
    from PIL import Image

    held = io.BytesIO()
    Image.fromarray(picture).save(held, "JPEG", quality=_QUALITY, optimize=True)
    return "data:image/jpeg;base64," + base64.b64encode(held.getvalue()).decode()


def _picture(path: Path) -> npt.NDArray[np.uint8]:
    """A picture, no wider than the page."""
    from PIL import Image

    with Image.open(path) as file:
        file.thumbnail((_WIDE_PX, _WIDE_PX))
        return np.asarray(file.convert("RGB"))


def _mosaic(path: Path) -> npt.NDArray[np.uint8]:
    """The first three bands of a mosaic, or the first one as grey, no wider than the page."""
    with geotiff.opened(path) as raster:
        file = raster.file
        bands = [1, 2, 3] if file.count >= 3 else [1]
        scale = min(1.0, _WIDE_PX / max(file.width, file.height))
        shape = (len(bands), max(1, round(file.height * scale)), max(1, round(file.width * scale)))
        shown = np.moveaxis(file.read(bands, out_shape=shape), 0, -1)
    seen = (shown > 0).any(axis=-1)
    low, high = np.percentile(shown[seen], (1.0, 99.0)) if seen.any() else (0.0, 1.0)
    if shown.dtype == np.uint8:
        low, high = 0.0, 255.0
    grey = np.clip((shown - low) * (255.0 / max(high - low, 1e-9)), 0.0, 255.0)
    out = np.where(seen[..., None], grey, 128.0).astype(np.uint8)
    return out if len(bands) == 3 else np.repeat(out, 3, axis=-1)
