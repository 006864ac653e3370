"""Lidars: one file a model, from a log's records to shots; and the corrections of single lasers.

Another model is another file with a `LIDAR` in it (`model.Lidar`), and one line here.
"""

from importlib import import_module
from typing import Final

from flightlog.errors import ConfigError
from groundproc.sensors.model import Lidar

MODELS: Final = {
    "HDL-32E": "groundproc.sensors.hdl32e",
    "VLP-16": "groundproc.sensors.vlp16",
    "line scanner": "groundproc.sensors.linescan",
}
"""Module of each model by its name; imported when asked for."""
FLOWN: Final = "HDL-32E"
"""What `swathd` records and `swath live` listens to; a log without any lidar is taken to be of it."""


def lidar(name: str, place: str = "") -> Lidar:
    """The model of a name; ConfigError where there is none, with the `place` that names it."""
    if name not in MODELS:
        raise ConfigError(f"{place or 'lidar'}: model {name!r} is not known; known are {', '.join(MODELS)}")
    found: Lidar = import_module(MODELS[name]).LIDAR
    return found


def of_topic(topic: str) -> list[Lidar]:
    """The models whose records are in a topic of the log."""
    return [model for model in map(lidar, MODELS) if model.topic == topic]
