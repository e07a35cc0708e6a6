"""What a unit announces of itself in the local network (DNS-SD over mDNS), and how a host reads it.

An announcement is a hint where to look, never a proof: anybody in the network can announce anything. Who a
unit is, is settled by its key.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from bricktrack_common.run_manifest import is_run_id
from bricktrack_common.wire_messages import PROTOCOL_MINOR, PROTOCOL_VERSION

SERVICE_TYPE = "_bricktrack._tcp.local."
KEY_UNIT = "unit"
KEY_PROTOCOL = "protocol"
KEY_FINGERPRINT = "key"


@dataclass(frozen=True, slots=True)
class Announcement:
    """What one unit says of itself.

    Attributes
    ----------
    unit : str
        Its name.
    protocol : (int, int)
        Version and minor version of the wire protocol.
    key_fingerprint : str
        Of its public key, see `bricktrack_common.key_files.fingerprint`; ``""`` for a unit without keys.
    """

    unit: str
    protocol: tuple[int, int] = (PROTOCOL_VERSION, PROTOCOL_MINOR)
    key_fingerprint: str = ""

    def as_txt(self) -> dict[str, str]:
        """Return it as the TXT record's keys and values."""
        return {
            KEY_UNIT: self.unit,
            KEY_PROTOCOL: f"{self.protocol[0]}.{self.protocol[1]}",
            KEY_FINGERPRINT: self.key_fingerprint,
        }

    @property
    def service_name(self) -> str:
        """The service's full name; a DNS label has 63 bytes at most."""
        return f"{self.unit[:63].replace('.', '-')}.{SERVICE_TYPE}"


def parse_announcement(txt: Mapping[bytes, bytes | None]) -> Announcement | None:
    """Return what a TXT record says, or `None` if it is not of a unit; nothing in it is believed unchecked.

    Examples
    --------
    >>> parse_announcement({b"unit": b"brick-01", b"protocol": b"2.0", b"key": b""})
    Announcement(unit='brick-01', protocol=(2, 0), key_fingerprint='')
    >>> parse_announcement({b"unit": b"../etc", b"protocol": b"2.0"}) is None
    True
    """
    try:
        unit = (txt.get(KEY_UNIT.encode()) or b"").decode("ascii")
        key = (txt.get(KEY_FINGERPRINT.encode()) or b"").decode("ascii")
        major, _, minor = (txt.get(KEY_PROTOCOL.encode()) or b"").decode("ascii").partition(".")
    except UnicodeDecodeError:
        return None
    if not is_run_id(unit) or not _is_small_number(major) or not _is_small_number(minor):
        return None
    if len(key) > 64 or not all(c in "0123456789abcdef-" for c in key):
        return None
    return Announcement(unit, (int(major), int(minor)), key)


def _is_small_number(text: str) -> bool:
    return text.isdecimal() and len(text) <= 4
