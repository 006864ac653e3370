"""What calibration.json holds."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from groundproc.radiometry import signal
from groundproc.radiometry.calibration import FEWEST, Constant
from groundproc.radiometry.gains import Gains
from groundproc.radiometry.site import Site

RELATIVE: Final = 0.25
"""Median of relative reflectances."""


def told(
    site: Site,
    gain: Gains,
    constants: Sequence[Constant],
    unused: Sequence[str],
    c_cal: tuple[float, float],
    relative: bool,
    strips: list[dict[str, Any]],
) -> dict[str, Any]:
    """The report: plain figures; c_cal with its sigma, gains, targets, strips before and after, warnings."""
    lasers = np.flatnonzero(gain.seen)
    warnings = []
    if relative:
        warnings.append(
            "no targets: reflectances are relative between strips and lasers, on the sensor's own scale; give surfaces of known "
            "reflectance with --targets"
            if site.signal.kind in (signal.COMPENSATED, signal.DECIBEL)
            else f"no targets: reflectances are relative between strips and lasers, and scaled so that their median is {RELATIVE:g}; "
            "give surfaces of known reflectance with --targets"
        )
    if unused:
        warnings.append(
            f"{len(unused)} targets are not used, with less than {FEWEST} echoes from a surface: {', '.join(unused)}"
        )
    unknown = site.survey.points - site.known
    if unknown:
        warnings.append(
            f"{unknown} of {site.survey.points} points have no reflectance: it is not known where the sensor was"
        )
    return {
        "c_cal": c_cal[0], "c_cal_sigma": None if np.isnan(c_cal[1]) else c_cal[1], "relative": relative,
        "intensity": site.signal.kind, "intensity_field": site.signal.field, "recognised_by": site.signal.why,
        "saturated_from": signal.RETRO if site.signal.kind == signal.COMPENSATED
        else site.saturated if site.saturated <= site.survey.largest else None,
        "visibility_km": site.task.visibility_km, "wavelength_nm": site.task.wavelength_nm, "sensor_path": site.path.source,
        "laser_gains": {str(n): {"gain": round(float(gain.gain[n]), 5), "sigma": round(float(gain.sigma[n]), 5)} for n in lasers}
        if len(lasers) > 1 else {},
        "targets": [
            {"id": c.id, "echoes": c.echoes, "c_cal": c.c_cal, "sigma": c.sigma, "incidence_deg": round(c.incidence_deg, 2)}
            for c in constants
        ],
        "strips": strips,
        "points": {"all": site.survey.points, "on_surface": site.on_surface, "without_sensor": unknown},
        "warnings": warnings,
    }  # fmt: skip
