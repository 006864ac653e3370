"""Spectra of known materials, and which of them a measured one is like: the spectral angle (Kruse et al. 1993)."""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError, UsageError

Array = npt.NDArray[np.float64]

_MOST: Final = 255
_NUMBER: Final = re.compile(r"\d+(?:\.\d+)?")
_MICROMETRES: Final = 50.0
"""Wavelengths below this are in micrometres."""


@dataclass(frozen=True, slots=True)
class Library:
    """Spectra by name.

    Attributes
    ----------
    names : tuple of str
    spectra : ndarray, shape (materials, bands)
    """

    names: tuple[str, ...]
    spectra: Array

    def nearest(self, measured: Array) -> tuple[npt.NDArray[np.int64], Array]:
        """Number of the material at the least angle and that angle [rad] of spectra, shape (n, bands); -1 and NaN where there is none."""
        length = np.linalg.norm(measured, axis=1)
        good = np.isfinite(length) & (length > 0.0)
        unit = np.where(good[:, None], measured, 1.0) / np.where(good, length, 1.0)[:, None]
        known = self.spectra / np.linalg.norm(self.spectra, axis=1)[:, None]
        cosine = np.clip(unit @ known.T, -1.0, 1.0)
        best = np.argmax(cosine, axis=1)
        angle = np.arccos(cosine[np.arange(len(best)), best])
        return np.where(good, best, -1), np.where(good, angle, np.nan)


def wavelengths(descriptions: Sequence[str | None]) -> Array | None:
    """Of bands, by what they are called, such as "550 nm" or "0.55 Micrometers" [nm]; None where one does not say."""
    found = []
    for each in descriptions:
        numbers = _NUMBER.findall(each or "")
        if not numbers:
            return None
        value = float(numbers[-1])
        found.append(1000.0 * value if value < _MICROMETRES else value)
    return np.array(found)


def read_library(path: Path, bands: int, wavelengths_nm: Array | None) -> Library:
    """Read a table of spectra.

    Parameters
    ----------
    path : Path
        CSV, a row for each material: `name` and a value for each band. Or a row for each wavelength: `wavelength_nm` and a column for each
        material, which is taken at the wavelengths of the bands.
    bands : int
    wavelengths_nm : ndarray or None
        Of the bands.

    Raises
    ------
    CaptureError
        It is no such table, or not of these bands.
    UsageError
        It is by wavelength, and those of the bands are not known.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if any(cell.strip() for cell in row)]
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None
    except (UnicodeDecodeError, csv.Error):
        raise CaptureError(f"{path}: is no table (CSV) of spectra") from None
    head = [cell.strip() for cell in rows[0]] if rows else []
    if len(rows) < 2 or head[0] not in ("name", "wavelength_nm"):
        raise CaptureError(
            f"{path}: begins with {head[0] if head else 'nothing'!r}, expected a table with name and a column for each band, or with "
            "wavelength_nm and a column for each material"
        )
    by_name = head[0] == "name"
    table = _numbers(path, rows[1:], len(head), 1 if by_name else 0)
    if by_name:
        names, spectra = tuple(row[0].strip() for row in rows[1:]), table
    else:
        names, spectra = tuple(head[1:]), _at_bands(path, table, wavelengths_nm)
    if spectra.shape[1] != bands:
        raise CaptureError(
            f"{path}: spectra of {spectra.shape[1]} values found, expected {bands}, one for each band of the raster"
        )
    if len(names) > _MOST or not (np.linalg.norm(spectra, axis=1) > 0.0).all():
        raise CaptureError(f"{path}: {len(names)} materials found, expected 1 to {_MOST}, each with a value above 0")
    return Library(names, spectra)


def _numbers(path: Path, rows: Sequence[Sequence[str]], width: int, skip: int) -> Array:
    found = []
    for number, row in enumerate(rows, 2):
        try:
            values = [float(cell) for cell in row[skip:]]
        except ValueError:
            values = []
        if len(row) != width or not np.isfinite(values).all() or len(values) != width - skip:
            raise CaptureError(f"{path}: line {number}: expected {width - skip} numbers")
        found.append(values)
    return np.array(found, np.float64)


def _at_bands(path: Path, table: Array, wavelengths_nm: Array | None) -> Array:
    if wavelengths_nm is None:
        raise UsageError(
            f"{path}: is by wavelength, but the bands of the raster do not say theirs; expected band descriptions such as 550 nm, or a "
            "table with name and a column for each band"
        )
    order = np.argsort(table[:, 0])
    known = table[order, 0]
    low, high = wavelengths_nm.min(), wavelengths_nm.max()
    if known[0] > low or known[-1] < high:
        raise CaptureError(
            f"{path}: spans {known[0]:g} to {known[-1]:g} nm, expected {low:g} to {high:g} nm, as the bands of the raster"
        )
    return np.array([np.interp(wavelengths_nm, known, table[order, column]) for column in range(1, table.shape[1])])
