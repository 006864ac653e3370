"""How brightly the ground was lit when a picture was taken, as the sensor on the roof said it (XMP), and how bands then compare.

Reflectance is proportional to factor light / irradiance, with light as `radiance.light` has it. The factor is the maker's:

    Parrot    1 / (A + C / (t ISO)) of `SensorModel`; irradiance is the count of `IrradianceList` over its time and the gain of its step,
              which `IrradianceCalibrationMeasurement` gives (Parrot's developers: count ~ gain time irradiance)
    MicaSense a1 of `RadiometricCalibration`, whose a2 and a3 say how rows differ; `HorizontalIrradiance`, else `SpectralIrradiance`
    DJI       `SensorGainAdjustment`; `Irradiance`
"""

import base64
import binascii
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.imagery.photos import read_xmp

_XMP_BYTES: Final = 1 << 20
_READING: Final = struct.Struct("<Q4H3f")
"""Of the sunshine sensor: time [us], counts of its two channels, step of the gain, time of integration [ms], yaw, pitch, roll."""
_OLD_READING: Final = struct.Struct("<Q2H2f")
"""Of firmware before 1.1: gain and time of integration were fixed."""
_FULL: Final = 65535
_STATED: Final = ("HorizontalIrradiance", "Irradiance", "SpectralIrradiance")


@dataclass(frozen=True, slots=True)
class Lit:
    """What a picture says of the light on the ground.

    Attributes
    ----------
    irradiance : float
        In a unit of the maker's own, one for all bands.
    factor : float
        By which light over irradiance compares between bands; not a number where the maker does not say.
    """

    irradiance: float
    factor: float


def lit(path: Path, exposure_s: float, iso: float) -> Lit | None:
    """The light on the ground when a picture was taken with an exposure time and a sensitivity; None where it does not say."""
    tags = tags_of(path)
    for name in _STATED:
        found = _numbers(tags.get(name))
        if len(found) == 1 and found[0] > 0.0:
            return Lit(found[0], _factor(tags, exposure_s, iso))
    seen = _sunshine(tags)
    return None if seen is None else Lit(seen, _factor(tags, exposure_s, iso))


def rows(tags: Mapping[str, str], height_px: int, exposure_s: float) -> npt.NDArray[np.float32] | None:
    """By how much more light the rows of a MicaSense picture show, shape (height, 1, 1); None of other pictures."""
    terms = _numbers(tags.get("RadiometricCalibration"))
    if len(terms) != 3:
        return None
    row = np.arange(height_px, dtype=np.float64)
    more = 1.0 + terms[1] * row / exposure_s - terms[2] * row
    return more.astype(np.float32)[:, None, None] if more.min() > 0.1 else None


def tags_of(path: Path) -> dict[str, str]:
    """The XMP of a picture; nothing where it cannot be read."""
    try:
        with path.open("rb") as file:
            return read_xmp(file.read(_XMP_BYTES))
    except OSError:
        return {}


def _factor(tags: Mapping[str, str], exposure_s: float, iso: float) -> float:
    model = _numbers(tags.get("SensorModel"))
    if len(model) == 3:
        slope = model[0] + model[2] / (exposure_s * iso)
        return 1.0 / slope if slope > 0.0 else math.nan
    terms = _numbers(tags.get("RadiometricCalibration"))
    if len(terms) == 3 and terms[0] > 0.0:
        return terms[0]
    gain = _numbers(tags.get("SensorGainAdjustment"))
    return gain[0] if len(gain) == 1 and gain[0] > 0.0 else math.nan


def _sunshine(tags: Mapping[str, str]) -> float | None:
    """Counts a millisecond at one gain: the median of the readings since the picture before."""
    try:
        data = base64.b64decode("".join(tags.get("IrradianceList", "").replace("&#xA;", "").split()), validate=True)
    except (binascii.Error, ValueError):
        return None
    gains = _gains(_numbers(tags.get("IrradianceCalibrationMeasurement")))
    found = []
    if data and len(data) % _READING.size == 0:
        for _, count, _, step, time_ms, *_ in _READING.iter_unpack(data):
            if 0 < count < _FULL and time_ms and gains.get(step):
                found.append(count / (time_ms * gains[step]))
    elif data and len(data) % _OLD_READING.size == 0:
        found = [float(count) for _, count, *_ in _OLD_READING.iter_unpack(data) if 0 < count < _FULL]
    return float(np.median(found)) if found else None


def _gains(table: Sequence[float]) -> dict[int, float]:
    """Gains of the steps of the sensor, that of step 1 being 1: counts under one light, where they are not full."""
    steps = {
        int(step): count / time
        for step, time, count, _ in zip(*[iter(table)] * 4, strict=False)
        if time > 0.0 and 0.0 < count < _FULL
    }
    return {step: value / steps[1] for step, value in steps.items()} if 1 in steps else {1: 1.0}


def _numbers(text: Any) -> list[float]:
    try:
        found = [float(word) for word in str(text).split(",")]
    except ValueError:
        return []
    return found if all(map(math.isfinite, found)) else []
