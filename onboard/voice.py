"""Our own messages on a MAVLink link: frames of the companion computer, in the autopilot's version of MAVLink."""

from typing import Final

from fastcrc.crc16 import mcrf4xx as checksum
from pymavlink.dialects.v20 import ardupilotmega as dialect

COMPONENT: Final = 191
"""MAV_COMP_ID_ONBOARD_COMPUTER, who we are on the link."""
_STATUSTEXT_BYTES: Final = 51
"""MAVLink 1 has no extension fields, but pymavlink sends those of STATUSTEXT."""


_LINK_ID: Final = 191
"""Of our signatures: nobody else's."""


class Voice:
    """Numbers and packs what we send."""

    def __init__(self, key: bytes | None = None) -> None:
        self._mavlink = dialect.MAVLink(None, srcComponent=COMPONENT)
        self._signing = self._mavlink.signing
        self._signing.secret_key, self._signing.link_id = key, _LINK_ID

    def sign_from(self, stamp: int) -> None:
        """Signatures have this time or a later one (see flightlog.signing)."""
        self._signing.timestamp = max(self._signing.timestamp, stamp)

    def frame(self, message: dialect.MAVLink_message, system: int, version: int) -> bytes:
        """Pack a message, as of the autopilot's system."""
        self._mavlink.srcSystem = system
        self._signing.sign_outgoing = version == 2 and self._signing.secret_key is not None
        data = bytes(message.pack(self._mavlink, force_mavlink1=version == 1))
        self._mavlink.seq = (self._mavlink.seq + 1) % 256
        if version == 1 and message.get_msgId() == dialect.MAVLINK_MSG_ID_STATUSTEXT:
            body = bytes((_STATUSTEXT_BYTES,)) + data[2 : 6 + _STATUSTEXT_BYTES]
            sum_ = checksum(body + bytes((message.crc_extra,)))
            data = data[:1] + body + sum_.to_bytes(2, "little")
        return data
