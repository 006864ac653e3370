"""A plan as a picture: the area with its lines, and the density across them."""

from pathlib import Path
from typing import Any

import numpy as np
import shapely

from groundproc.files import written_aside
from groundproc.planning.coverage import Coverage
from groundproc.planning.route import Route


def draw(path: Path, area: Any, route: Route, coverage: Coverage) -> None:
    """Draw it.

    Raises
    ------
    SourceError
        It cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 5.5), layout="constrained")
    FigureCanvasAgg(figure)
    plan, across = figure.subplots(1, 2)
    corner = np.floor(shapely.get_coordinates(area).min(axis=0))
    edge = shapely.get_coordinates(area.exterior) - corner
    path_m = route.places_m - corner
    plan.fill(edge[:, 0], edge[:, 1], color="#dfe7d8")
    plan.plot(path_m[:, 0], path_m[:, 1], color="#1f5fa8", linewidth=1.2)
    plan.plot(path_m[0, 0], path_m[0, 1], "o", color="#1f5fa8")
    plan.set_aspect("equal")
    plan.set_xlabel(f"easting - {corner[0]:.0f} [m]")
    plan.set_ylabel(f"northing - {corner[1]:.0f} [m]")
    plan.set_title(f"{route.lines} lines, {route.length_m / 1000:.2f} km, {route.seconds / 60:.1f} min")
    reach = 0.6 * float(np.hypot(*np.ptp(edge, axis=0)))
    away = np.linspace(-reach, reach, 600)
    angle = np.deg2rad(route.heading_deg)
    centre = np.array([area.centroid.x, area.centroid.y])
    cut = centre + away[:, None] * np.array([np.cos(angle), -np.sin(angle)])
    found = coverage.density(cut, route.places_m)
    across.plot(away, found, color="#888888", label="through the middle, across the lines")
    inside = np.where(shapely.contains_xy(area, *cut.T), found, np.nan)
    across.plot(away, inside, color="#1f5fa8", label="of it in the area")
    across.set_ylim(0.0, None)
    across.set_xlabel("from the middle [m]")
    across.set_ylabel("points a square metre")
    across.legend()
    with written_aside(path) as aside:
        figure.savefig(aside, format="png", dpi=110)
