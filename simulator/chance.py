"""Random streams: one for each purpose and stretch of time, all from one seed."""

import zlib

import numpy as np


def generator(seed: int, purpose: str, chunk: int = 0) -> np.random.Generator:
    """A generator that depends on nothing but its arguments.

    Parameters
    ----------
    seed : int
        Of the whole simulation, not negative.
    purpose : str
        Name of what draws from it.
    chunk : int
        Stretch of time, where a purpose is worked on piece by piece.
    """
    return np.random.default_rng([seed, zlib.crc32(purpose.encode()), chunk])
