"""Overhead lines that hang and are scanned as `hanging` has it."""

from collections.abc import Callable

import numpy as np
from hanging import Crown, Hung, Site, poles_at, wavy


def slope() -> Site:
    """Three conductors up a hillside of 30 % and 45 %."""
    site = Site(
        lambda xy: 50.0 + 0.3 * xy[:, 0] + 0.15 * np.maximum(xy[:, 0] - 100.0, 0.0) + 0.6 * np.sin(xy[:, 1] / 13.0),
        above_m=28.0,
    )
    site.strung(
        poles_at(site, [(10, 30), (85, 34), (165, 36), (238, 33)], 11.5), [(-1.2, 11.3), (0.0, 11.9), (1.2, 11.3)], 1.4
    )
    return site


def bundles() -> Site:
    """Two subconductors beside each other and four in a square, 40 cm apart, guards above, spans of 190 m."""
    site = Site(wavy(), above_m=48.0, passes=7)
    poles = poles_at(site, [(10, 40), (200, 44), (385, 40)], 34.0, 0.4)
    two = [(5.8, 26.0), (6.2, 26.0)]
    four = [(-6.2, 26.0), (-5.8, 26.0), (-6.2, 25.6), (-5.8, 25.6)]
    site.strung(poles, two + four, 0.55, 0.014)
    site.strung(poles, [(0.4, 34.2)], 0.4, 0.007)
    return site


def dead_end() -> Site:
    """A line that ends at its last pole, and a drop from there to the eaves of a house."""
    site = Site(wavy(0.03), houses=[(128.0, 52.0, 140.0, 62.0, 5.0)], above_m=30.0)
    poles = poles_at(site, [(5, 30), (60, 32), (118, 33)], 9.5)
    site.strung(poles, [(-0.5, 9.3), (0.0, 9.6), (0.5, 9.3)], 1.1)
    eaves = float(site.ground(np.array([[134.0, 57.0]]))[0]) + 4.6
    top = float(site.ground(np.array([[118.0, 33.0]]))[0]) + 8.6
    site.wires.append(Hung(np.array([[118.0, 33.0, top], [131.0, 52.0, eaves]]), 60.0, 0.012))
    return site


def angle() -> Site:
    """Bends of 60 and of 25 deg, with crossarms that halve them."""
    site = Site(wavy(0.05), above_m=32.0, passes=7)
    poles = poles_at(site, [(5, 20), (80, 22), (118, 86), (168, 128)], 13.0, 0.2)
    site.strung(poles, [(-1.6, 12.6), (1.6, 12.6), (0.0, 13.4)], 1.6)
    return site


def low_voltage() -> Site:
    """Four bare wires above each other, 30 cm apart, and an insulated bundle on the other side."""
    site = Site(wavy(), above_m=25.0)
    poles = poles_at(site, [(5, 30), (43, 31), (82, 33), (119, 32)], 8.2)
    site.strung(poles, [(0.15, 8.0), (0.15, 7.7), (0.15, 7.4), (0.15, 7.1)], 1.2, 0.006)
    site.strung(poles, [(-0.2, 6.6)], 1.6, 0.02)
    return site


def trees() -> Site:
    """Crowns a metre and less from the outer conductor, some below the wires."""
    site = Site(wavy(), above_m=30.0)
    poles = poles_at(site, [(5, 30), (70, 31), (138, 33)], 10.0)
    site.strung(poles, [(-1.1, 9.8), (0.0, 10.3), (1.1, 9.8)], 1.3)
    rng = np.random.default_rng(7)
    for x in np.arange(12.0, 135.0, 6.5):
        radius, side = rng.uniform(1.6, 2.6), (-1.0 if rng.random() < 0.5 else 1.0)
        ground = float(site.ground(np.array([[x, 31.0]]))[0])
        y = 30.0 + 0.02 * x + side * (1.1 + radius + rng.uniform(0.4, 1.2))
        site.crowns.append(Crown(float(x), float(y), ground + 7.5, float(radius), 4.0))
    for x in (33.0, 55.0, 96.0, 115.0):
        ground = float(site.ground(np.array([[x, 31.0]]))[0])
        site.crowns.append(Crown(x, 30.5, ground + 4.0, 2.2, 3.2))
    return site


def telephone() -> Site:
    """Two thin slack wires at low poles."""
    site = Site(wavy(), above_m=25.0, answers=0.5)
    poles = poles_at(site, [(5, 30), (52, 31), (97, 29), (146, 32)], 6.8)
    site.strung(poles, [(0.15, 6.6), (-0.15, 6.3)], 2.6, 0.004)
    return site


def double_circuit() -> Site:
    """Six conductors on three arms of thick masts, and a guard, spans of 190 m."""
    site = Site(wavy(0.02), above_m=60.0, passes=7)
    places = poles_at(site, [(10, 40), (190, 44), (380, 50)], 38.0, 0.5)
    arms = [(side * off, up) for side in (-1, 1) for off, up in ((4.5, 35.0), (6.0, 29.0), (5.0, 23.0))]
    site.strung(places, arms, 0.7, 0.015)
    site.strung(places, [(0.0, 38.2)], 0.5, 0.008)
    return site


def road() -> Site:
    """Four wires above each other, and lamp posts 1.5 m beside them, some near the poles."""
    site = Site(wavy(), above_m=26.0)
    places = poles_at(site, [(5, 30), (45, 30.6), (85, 31), (125, 31.2)], 8.4)
    site.strung(places, [(0.0, 8.2), (0.0, 7.8), (0.0, 7.4), (0.0, 7.0)], 0.9, 0.006)
    poles_at(site, [(x + off, 32.0 + 0.01 * x) for x in (5, 45, 85) for off in (2.5, 20.0, 37.5)], 6.8, 0.08)
    return site


def walls() -> Site:
    """Two drops that end at walls below the eaves, from poles whose arms they cross under."""
    site = Site(
        wavy(), above_m=30.0, walled=True,
        houses=[(128.0, 40.0, 140.0, 52.0, 6.2), (60.0, 50.0, 72.0, 60.0, 5.0)],
    )  # fmt: skip
    site.strung(poles_at(site, [(5, 30), (50, 31), (100, 32)], 9.0), [(-0.3, 8.8), (0.3, 8.8)], 1.1, 0.008)
    for pole, wall, up in (((100.0, 32.0), (128.0, 46.0), 4.6), ((50.0, 31.0), (66.0, 50.0), 3.8)):
        top, end = site.ground(np.array([pole, wall])) + np.array([8.4, up])
        site.wires.append(Hung(np.array([[*pole, top], [*wall, end]]), 70.0, 0.012))
    return site


def below_trees() -> Site:
    """Wires between rows of crowns that are higher."""
    site = Site(wavy(), above_m=35.0, passes=7)
    site.strung(poles_at(site, [(5, 30), (60, 31), (118, 32)], 8.5), [(-0.6, 8.2), (0.0, 8.5), (0.6, 8.2)], 1.2)
    rng = np.random.default_rng(3)
    for x in np.arange(8.0, 118.0, 5.0):
        for side in (-1, 1):
            radius = float(rng.uniform(1.8, 3.0))
            ground = float(site.ground(np.array([[x, 31.0]]))[0])
            site.crowns.append(
                Crown(float(x), 31 + side * (0.6 + radius + rng.uniform(0.5, 2.0)), ground + 10.0, radius, 5.5)
            )
    return site


def across() -> Site:
    """Three wires that are crossed at 75 deg, pass by pass."""
    site = Site(wavy(), above_m=32.0, turned_deg=75.0)
    site.strung(poles_at(site, [(5, 30), (70, 31), (140, 33)], 12.0), [(-1.3, 11.8), (0.0, 12.5), (1.3, 11.8)], 1.4)
    return site


SITES: dict[str, Callable[[], Site]] = {
    each.__name__: each
    for each in (
        slope,
        bundles,
        dead_end,
        angle,
        low_voltage,
        trees,
        telephone,
        double_circuit,
        road,
        walls,
        below_trees,
        across,
    )
}
