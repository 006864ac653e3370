"""Positions of a receiver with a base station, as RTKLIB writes them: of the antenna, above the ellipsoid."""

from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt

from flightlog.constants import NS_PER_MS, NS_PER_S
from simulator.chance import generator
from simulator.clocks import Clocks
from simulator.config import RtkOptions
from simulator.faults import Outage
from simulator.flight import Flight
from simulator.geodesy import Origin, geodetic
from simulator.ins import gauss_markov

Array = npt.NDArray[np.float64]


def solution(
    flight: Flight, options: RtkOptions, clocks: Clocks, origin: Origin, antenna_m: tuple[float, float, float] | None,
    outage: Outage, seed: int,
) -> str:  # fmt: skip
    """The text of a .pos file; epochs without a fix are left out."""
    time_s = np.arange(0.0, flight.duration_s, 1.0 / options.hz)
    rng = generator(seed, "rtk")
    if options.tau_s > 0.0:
        columns = [gauss_markov(rng, len(time_s), sigma, options.tau_s, 1.0 / options.hz) for sigma in options.sigma_m]
        error = np.stack(columns, axis=1)
    else:
        error = rng.standard_normal((len(time_s), 3)) * np.array(options.sigma_m)
    poses = flight.poses(time_s)
    place = poses.position_m + poses.mat_local_ins() @ np.array(antenna_m or (0.0, 0.0, 0.0)) + error
    latitude, longitude, height = geodetic(place, origin)
    east, north, up = options.sigma_m
    lines = [
        "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)",
        "%  UTC  latitude(deg)  longitude(deg)  height(m)  Q  ns  sdn(m)  sde(m)  sdu(m)  sdne(m)  sdeu(m)  sdun(m)  age(s)  ratio",
    ]
    for n, utc_ns in enumerate(clocks.utc.shows_ns(time_s).tolist()):
        if outage.holds(float(time_s[n])):
            continue
        day = datetime.fromtimestamp(utc_ns // NS_PER_S, UTC).strftime("%Y/%m/%d %H:%M:%S")
        lines.append(
            f"{day}.{utc_ns % NS_PER_S // NS_PER_MS:03d} {latitude[n]:.9f} {longitude[n]:.9f} "
            f"{height[n] + origin.undulation_m:.4f} 1 14 {north:.4f} {east:.4f} {up:.4f} 0.0000 0.0000 0.0000 0.00 12.0"
        )
    return "\n".join(lines) + "\n"
