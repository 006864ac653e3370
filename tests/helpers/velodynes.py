"""Velodyne's packets to points without a line of the decoder under test: by a loop over their bytes, and by velodyne-decoder."""

import itertools
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import velodyne_decoder
from captures import DATA_PORT, read_udp

from flightlog.hdl32e import DATA_DTYPE
from groundproc.sensors.shots import Gate

DUAL = 0x39


def payloads(capture: Path) -> list[bytes]:
    """The data packets of a capture."""
    return [payload for _, payload in read_udp(capture, DATA_PORT)]


def packets_of(content: Sequence[bytes]) -> npt.NDArray[np.void]:
    return np.frombuffer(b"".join(content), DATA_DTYPE)


def by_velodyne_decoder(
    content: Sequence[bytes], model: velodyne_decoder.Model, step_s: float, max_range_m: float = 1000.0
) -> npt.NDArray[np.void]:
    """All points of packets that came so far apart."""
    config = velodyne_decoder.Config(model=model, min_range=0.0, max_range=max_range_m)
    decoder = velodyne_decoder.StreamDecoder(config)
    parts = [part[1] for i, payload in enumerate(content) if (part := decoder.decode(i * step_s, payload, True))]
    rest = decoder.finish(True)
    return np.concatenate([*parts, rest[1]] if rest else parts)


@dataclass(frozen=True)
class Manual:
    """A model's figures, retyped from its manual.

    Attributes
    ----------
    elevation_deg, height_mm : sequence of float
        Of each laser in firing order; where its beam crosses the spin axis.
    laser_ns, firing_ns, block_ns : int
        From laser to laser, from one firing of all lasers to the next, and from block to block.
    """

    elevation_deg: Sequence[float]
    height_mm: Sequence[float]
    laser_ns: int
    firing_ns: int
    block_ns: int


class Return(NamedTuple):
    """One return: azimuth in 0.01 deg, range in 2 mm, and return number and number of returns as LAS has them."""

    time_ns: int
    x_m: float
    y_m: float
    z_m: float
    azimuth_cdeg: float
    range_2mm: int
    intensity: int
    laser: int
    returns: int


class Told(NamedTuple):
    """What a packet holds: its returns, and why its other shots are none, as `Gated` counts them."""

    returns: list[Return]
    outside_fov: int
    no_return: int
    out_of_range: int


def by_hand(manual: Manual, payload: bytes, time_ns: int, gate: Gate) -> Told:
    """The returns of one packet: a loop over its bytes, as the manuals describe them."""
    dual = payload[1204] == DUAL
    blocks = [payload[100 * b : 100 * b + 100] for b in range(12)]
    azimuths = [struct.unpack_from("<H", block, 2)[0] for block in blocks][:: 2 if dual else 1]
    steps = sorted((b - a + 18_000) % 36_000 - 18_000 for a, b in itertools.pairwise(azimuths))
    step = (steps[len(steps) // 2] + steps[(len(steps) - 1) // 2]) / 2
    width_deg = (gate.fov_end_deg - gate.fov_start_deg) % 360 or 360
    found, outside, nothing, beyond = [], 0, 0, 0
    for number, azimuth in enumerate(azimuths):
        pair = blocks[2 * number : 2 * number + 2] if dual else [blocks[number]]
        for cell in range(32):
            firing, laser = divmod(cell, len(manual.elevation_deg))
            since_ns = firing * manual.firing_ns + laser * manual.laser_ns
            here = azimuth % 36_000 + step * since_ns / manual.block_ns
            # the strongest before the last, for two of one range
            echoes = [struct.unpack_from("<HB", block, 4 + 3 * cell) for block in reversed(pair)]
            inside = _inside(echoes, gate)
            if (here / 100 - gate.fov_start_deg) % 360 > width_deg:
                outside += 1
            elif not any(echo[0] for echo in echoes):
                nothing += 1
            elif not inside:
                beyond += 1
            else:
                found += _returns(manual, (time_ns + manual.block_ns * number + since_ns, here, laser), inside)
    return Told(found, outside, nothing, beyond)


def _inside(echoes: Sequence[tuple[int, int]], gate: Gate) -> list[tuple[int, int]]:
    """Range [2 mm] and intensity of the returns within the gate, the nearer first; two that are equal are one."""
    if len(echoes) == 2 and echoes[0] == echoes[1]:
        echoes = echoes[:1]
    near, far = gate.min_range_m - 1e-9, gate.max_range_m + 1e-9
    return sorted((e for e in echoes if e[0] > 0 and near <= e[0] * 0.002 <= far), key=lambda echo: echo[0])


def _returns(manual: Manual, shot: tuple[int, float, int], echoes: Sequence[tuple[int, int]]) -> list[Return]:
    time_ns, here, laser = shot
    elevation, turned = math.radians(manual.elevation_deg[laser]), math.radians(here / 100)
    found = []
    for number, (steps_2mm, intensity) in enumerate(echoes, 1):
        reach = steps_2mm * 0.002
        flat = reach * math.cos(elevation)
        height = reach * math.sin(elevation) + manual.height_mm[laser] * 1e-3
        found.append(
            Return(time_ns, flat * math.sin(turned), flat * math.cos(turned), height, here % 36_000, steps_2mm, intensity, laser,
                   number + 16 * len(echoes))
        )  # fmt: skip
    return found
