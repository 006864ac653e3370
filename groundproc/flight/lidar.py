"""Which lidar a flight was recorded with: the log says so, or its records do."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from flightlog.errors import LogError, WrongSensorError
from flightlog.logfile import LogReader
from groundproc import sensors
from groundproc.sensors.model import Lidar, Records

STATED: Final = ("swath.session", "lidar")
"""Metadata record and key in which a log names its lidar; one that does not is of the recorder, or older: its packets tell."""
_PROBED: Final = 64
"""Records that a model is recognised by."""


def lidar_of(readers: Sequence[LogReader]) -> Lidar:
    """The lidar of a flight's logs; the flown model where they hold no record of any.

    Raises
    ------
    ConfigError
        The log names a model that is not known.
    WrongSensorError
        Its packets are of no model known.
    """
    record, key = STATED
    for reader in readers:
        if name := reader.metadata.get(record, {}).get(key):
            return sensors.lidar(name, str(reader.path))
    for reader in sorted(readers, key=lambda each: each.start_ns):
        for topic in dict.fromkeys(sensors.lidar(name).topic for name in sensors.MODELS):
            head = _head(reader, topic)
            if head is not None:
                return recognised(sensors.of_topic(topic), head, str(reader.path))
    return sensors.lidar(sensors.FLOWN)


def recognised(models: Sequence[Lidar], head: Records, place: str) -> Lidar:
    """The model that sent records.

    Raises
    ------
    WrongSensorError
        None of them; with what the first has against it.
    """
    reasons: list[WrongSensorError] = []
    for model in models:
        try:
            model.check(head, place)
        except WrongSensorError as error:
            reasons.append(error)
            continue
        return model
    if len(models) == 1:
        raise reasons[0]
    raise WrongSensorError(f"{reasons[0]}; nor is it one of {', '.join(model.name for model in models[1:])}")


def _head(reader: LogReader, topic: str) -> Records | None:
    """The first records of a topic."""
    unpack = sensors.of_topic(topic)[0].unpack
    parts: list[Records] = []
    for message in reader.messages((topic,)):
        try:
            records = unpack(message.data)
        except LogError:
            continue
        if parts and records.dtype != parts[0].dtype:
            break
        parts.append(records)
        if sum(len(part) for part in parts) >= _PROBED:
            break
    return np.concatenate(parts) if any(len(part) for part in parts) else None
