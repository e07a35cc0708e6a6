"""The decoders face the network: whatever comes, they return a checked value or raise one error."""

import msgpack
import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bricktrack_common.clocks import read_clock_triplet
from bricktrack_common.errors import ProtocolError
from bricktrack_common.wire_codec import VersionError, decode_reply, decode_request, encode_message
from bricktrack_common.wire_messages import (
    MAX_HEADER_BYTES,
    PROTOCOL_MINOR,
    Arm,
    Chunk,
    Configure,
    Confirm,
    DeleteRun,
    DescribeRun,
    Disarm,
    GetStatus,
    Hello,
    ImuStatus,
    ListRuns,
    Read,
    Refusal,
    StatusReply,
    TakeStill,
)

run_ids = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,40}", fullmatch=True)
counts = st.integers(0, 2**53)
requests = st.one_of(
    st.builds(Hello, software=st.text(max_size=50)),
    st.just(GetStatus()),
    st.builds(
        Arm, label=st.from_regex(r"[A-Za-z0-9_-]{0,32}", fullmatch=True), duration_s=st.floats(0.1, 600)
    ),
    st.just(Disarm()),
    st.just(ListRuns()),
    st.builds(DescribeRun, run_id=run_ids),
    st.builds(Read, run_id=run_ids, file_index=counts, offset=counts, length=st.integers(1, 1024 * 1024)),
    st.builds(Confirm, run_id=run_ids, sha256=st.lists(st.just("0" * 64), max_size=5)),
    st.builds(DeleteRun, run_id=run_ids, force=st.booleans()),
    st.builds(TakeStill, encoding=st.sampled_from(["png", "jpeg"]), lit=st.booleans()),
    st.builds(
        Configure,
        values=st.dictionaries(
            st.text(max_size=64),
            st.none()
            | st.booleans()
            | st.integers(-(2**60), 2**60)
            | st.floats(allow_nan=False)
            | st.text(max_size=20)
            | st.lists(st.floats(allow_nan=False), max_size=3),
            max_size=8,
        ),
    ),
)
plain = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=20) | st.binary(max_size=20),
    lambda children: st.lists(children, max_size=4) | st.dictionaries(st.text(max_size=10), children, max_size=4),
    max_leaves=20,
)  # fmt: skip


@settings(max_examples=200)
@given(st.integers(0, 2**53), requests)
def test_requests_round_trip(request_id, body):
    assert decode_request(encode_message(request_id, body)) == (request_id, body)


@settings(max_examples=500)
@given(st.binary(max_size=300))
def test_arbitrary_bytes_are_refused(data):
    for decode in (decode_request, decode_reply):
        with pytest.raises(ProtocolError):
            decode(data)


@settings(max_examples=500)
@given(plain)
def test_well_formed_nonsense_is_refused(value):
    for wrapped in (value, {"protocol": 2, "minor": 0, "request_id": 1, "body": value}):
        for decode in (decode_request, decode_reply):
            with pytest.raises(ProtocolError):
                decode(msgpack.packb(wrapped))


@settings(max_examples=200)
@given(requests, st.text(max_size=8), plain)
def test_an_unknown_key_or_a_wrong_type_is_refused(body, key, value):
    fields = msgspec.to_builtins(body)
    if key in fields:
        return
    message = {"protocol": 2, "minor": 0, "request_id": 1, "body": fields | {key: value}}
    with pytest.raises(ProtocolError):
        decode_request(msgpack.packb(message))


def test_another_version_is_told_apart_from_nonsense():
    with pytest.raises(VersionError, match=r"protocol version 9; .* speaks version 2\. Upgrade this one"):
        decode_request(msgpack.packb({"protocol": 9}))
    with pytest.raises(
        VersionError, match=r"protocol version 1; .* speaks version 2\. Upgrade the other end"
    ):
        decode_reply(msgpack.packb({"protocol": 1}))


def test_a_path_is_never_taken_for_a_run():
    for bad in ("../etc", "/etc/passwd", "a/b", "", ".hidden", "x" * 101):
        with pytest.raises(ProtocolError, match="body.run_id"):
            decode_request(encode_message(1, DescribeRun(run_id=bad)))


def test_a_header_is_bounded():
    with pytest.raises(ProtocolError, match="at most 65536"):
        decode_request(b"\0" * (MAX_HEADER_BYTES + 1))


def test_replies_carry_no_bytes_and_a_refusal_has_a_known_code():
    chunk = Chunk(run_id="r", file_index=0, offset=0, n_bytes=5, crc32=1)
    assert decode_reply(encode_message(3, chunk)) == (3, chunk)
    with pytest.raises(ProtocolError, match="body.code"):
        decode_reply(encode_message(1, Refusal(code="because", message="")))


def test_a_reply_of_a_newer_minor_version_is_understood_without_what_it_adds():
    status = StatusReply(
        unit="b1", state="idle", runs=0, disk_free_bytes=1, disk_needed_bytes=1, frames=0, edges=0,
        imus=[ImuStatus(name="brick", samples=1, gaps=0)], clocks=read_clock_triplet(),
    )  # fmt: skip
    message = msgpack.unpackb(encode_message(5, status))
    message["body"]["moon_phase"] = 0.5
    message["body"]["imus"][0]["colour"] = "red"
    message["priority"] = 3
    with pytest.raises(ProtocolError, match="unknown field"):
        decode_reply(msgpack.packb(message))
    assert decode_reply(msgpack.packb(message | {"minor": PROTOCOL_MINOR + 1})) == (5, status)


def test_a_request_of_a_newer_minor_version_is_taken_whole_or_refused():
    message = msgpack.unpackb(encode_message(1, Arm(label="a"))) | {"minor": PROTOCOL_MINOR + 1}
    assert decode_request(msgpack.packb(message)) == (1, Arm(label="a"))
    message["body"]["gently"] = True
    with pytest.raises(ProtocolError, match=rf"gently.*2\.{PROTOCOL_MINOR + 1}.*upgrade"):
        decode_request(msgpack.packb(message))


def test_what_is_at_its_default_stays_out_of_a_message():
    assert msgpack.unpackb(encode_message(1, DeleteRun(run_id="r")))["body"] == {
        "type": "delete",
        "run_id": "r",
    }
