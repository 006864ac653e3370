"""Topics of bags as senders."""

from typing import Final

TOPIC: Final = b"topic "


def topic_sender(topic: str) -> bytes:
    """The sender that a topic of a bag stands for."""
    return TOPIC + topic.encode()
