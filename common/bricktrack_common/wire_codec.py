"""The wire protocol's messages as bytes: one msgpack map each, checked before anything believes it.

A message is ``{"protocol": 2, "minor": 0, "request_id": n, "body": {"type": ..., ...}}``; file bytes travel
behind it as raw ZeroMQ frames, never inside.
"""

from typing import Annotated, TypeVar

import msgpack
import msgspec

from bricktrack_common.errors import ProtocolError
from bricktrack_common.newer_fields import without_unknown_fields
from bricktrack_common.typed_data import convert
from bricktrack_common.wire_messages import (
    MAX_HEADER_BYTES,
    PROTOCOL_MINOR,
    PROTOCOL_VERSION,
    Reply,
    Request,
)

T = TypeVar("T")
_Count = Annotated[int, msgspec.Meta(ge=0, le=2**53)]


class VersionError(ProtocolError):
    """The other side speaks another version of the protocol."""


class _RequestEnvelope(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    protocol: int
    minor: _Count
    request_id: _Count
    body: Request


class _ReplyEnvelope(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    protocol: int
    minor: _Count
    request_id: _Count
    body: Reply


def encode_message(request_id: int, body: Request | Reply) -> bytes:
    """Return the msgpack header of one request or reply."""
    envelope = {
        "protocol": PROTOCOL_VERSION,
        "minor": PROTOCOL_MINOR,
        "request_id": request_id,
        "body": msgspec.to_builtins(body),
    }
    packed: bytes = msgpack.packb(envelope)
    return packed


def decode_request(data: bytes) -> tuple[int, Request]:
    """Return the id and body of a request; raise `ProtocolError` on anything else.

    A unit must not half obey: what it does not know in a request is refused, from newer hosts too.
    """
    if len(data) > MAX_HEADER_BYTES:
        raise ProtocolError(f"message header of {len(data)} bytes; at most {MAX_HEADER_BYTES} are allowed")
    message, minor = _unpack(data)
    envelope = _checked(message, _RequestEnvelope, minor)
    return envelope.request_id, envelope.body


def decode_reply(data: bytes) -> tuple[int, Reply]:
    """Return the id and body of a reply; raise `ProtocolError` on anything else.

    A unit of a newer minor version may tell more than this host knows: such fields are left out.
    """
    message, minor = _unpack(data)
    if minor > PROTOCOL_MINOR:
        message = without_unknown_fields(message, _ReplyEnvelope)
    envelope = _checked(message, _ReplyEnvelope, minor)
    return envelope.request_id, envelope.body


def _unpack(data: bytes) -> tuple[object, int]:
    """Return a message as plain values, and its minor version."""
    try:
        value = msgpack.unpackb(data, raw=False, strict_map_key=True, max_ext_len=0)
    except (ValueError, TypeError, OverflowError, msgpack.UnpackException) as e:
        raise ProtocolError(f"not a message of this protocol: {type(e).__name__}: {e}") from e
    if not isinstance(value, dict) or not isinstance(value.get("protocol"), int):
        raise ProtocolError("not a message of this protocol: no version number")
    if value["protocol"] != PROTOCOL_VERSION:
        older = "the other end" if value["protocol"] < PROTOCOL_VERSION else "this one"
        raise VersionError(
            f"protocol version {value['protocol']}; this bricktrack speaks version {PROTOCOL_VERSION}. "
            f"Upgrade {older}"
        )
    minor = value.get("minor")
    return value, minor if isinstance(minor, int) else 0


def _checked(message: object, envelope: type[T], minor: int) -> T:
    """Return a message as what it must be; the error says where a newer version may be the reason."""
    try:
        return convert(message, envelope, where="message", error=ProtocolError)
    except ProtocolError as e:
        if minor <= PROTOCOL_MINOR:
            raise
        raise ProtocolError(
            f"{e}. The message is of protocol {PROTOCOL_VERSION}.{minor}, this bricktrack speaks "
            f"{PROTOCOL_VERSION}.{PROTOCOL_MINOR}: upgrade it"
        ) from e


# msgspec prepares a type when it is first used, and crashes where several threads do that at once: not later.
for _envelope in (_RequestEnvelope, _ReplyEnvelope):
    msgspec.msgpack.Decoder(_envelope)
