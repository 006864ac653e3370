"""A door through which a file comes in: a command, the file's name, and how it is spoilt."""

import random
from collections.abc import Callable
from dataclasses import dataclass

import seeds

Made = Callable[[random.Random], bytes]


@dataclass(frozen=True)
class Door:
    """A command with one spoilt file.

    Attributes
    ----------
    name : str
    file : str
        Name that the spoilt file gets.
    words : tuple of str
        {file} is the spoilt one, {out} the output, {good} a folder with good files.
    made : tuple of callables
        Each makes the bytes of a spoilt file.
    keeps : bool
        Whether what it could not finish is kept for the next time.
    """

    name: str
    file: str
    words: tuple[str, ...]
    made: tuple[Made, ...]
    keeps: bool = False


def spoilt(data: bytes) -> Made:
    return lambda dice: seeds.mutated(data, dice)
