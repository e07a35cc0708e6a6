"""The protocol client against a unit in a thread that keeps to the protocol, and one that does not."""

import contextlib
import sys
import threading
import time
from pathlib import Path

import msgpack
import pytest
import zmq
from fake_unit import FakeUnit
from run_folders import make_run

from bricktrack_common.errors import ConfigError, ProtocolError, TransferError, UnitError, UnitTimeoutError
from bricktrack_common.key_files import make_key_pair
from bricktrack_common.wire_codec import encode_message
from bricktrack_common.wire_messages import (
    MAX_CHUNK_BYTES,
    Arm,
    Confirmed,
    Disarmed,
    GetStatus,
    Read,
    Refusal,
    TakeStill,
)
from bricktrack_host.transfer.unit_client import UnitClient
from bricktrack_host.transfer.unit_connection import Stopped

RUN = "fake_0001_shake"


@pytest.fixture
def runs(tmp_path):
    make_run(tmp_path, RUN, {"video.h264": 100_000, "frames.msgpack": 10})
    return tmp_path


def whole_file(client, *, chunk_bytes=1000, n_bytes=100_000):
    ranges = [(o, min(chunk_bytes, n_bytes - o)) for o in range(0, n_bytes, chunk_bytes)]
    out = bytearray(n_bytes)
    for offset, data, _ in client.read_chunks(RUN, 1, ranges):
        out[offset : offset + len(data)] = data
    return bytes(out)


def once(when, change):
    """Misbehave at the first request for which ``when`` holds."""
    done = []

    def misbehave(request, messages):
        if not done and when(request):
            done.append(True)
            return change(messages)
        return messages

    return misbehave


def is_read_at(offset):
    return lambda request: isinstance(request, Read) and request.offset == offset


def test_each_request_gets_its_reply(runs):
    with FakeUnit(runs) as unit, UnitClient(unit.address) as client:
        assert client.hello().unit == "fake"
        assert client.status().runs == 1
        assert client.arm("shake", duration_s=3.0).run_id == RUN
        assert isinstance(client.disarm(), Disarmed)
        assert [r.run_id for r in client.list_runs().runs] == [RUN]
        description = client.describe_run(RUN)
        assert [f.name for f in description.files] == ["manifest.json", "video.h264", "frames.msgpack"]
        assert isinstance(client.confirm(RUN, [f.sha256 for f in description.files]), Confirmed)


class SlowToArm:
    """Holds the answer to ``arm`` back until the unit was asked how it is so many times."""

    def __init__(self, n_looks):
        self.n_looks = n_looks
        self.held = []

    def __call__(self, request, messages):
        if isinstance(request, Arm):
            self.held = messages
            return []
        if isinstance(request, GetStatus):
            self.n_looks -= 1
            return [*messages, *self.held] if self.n_looks == 0 else messages
        return messages


def test_a_unit_that_arms_for_longer_than_it_may_be_silent_is_waited_for(runs):
    with (
        FakeUnit(runs, misbehave=SlowToArm(8)) as unit,  # two time-outs: four looks in each
        UnitClient(unit.address, timeout_s=0.2) as client,
    ):
        start_s = time.monotonic()
        assert client.arm("shake").run_id == RUN
        assert time.monotonic() - start_s > 0.35
        assert client.counts.stray_replies == 0


def test_a_unit_that_dies_while_it_arms_is_given_up_as_soon_as_any_silent_one(runs):
    with (
        FakeUnit(runs, misbehave=lambda request, messages: []) as unit,
        UnitClient(unit.address, timeout_s=0.3) as client,
    ):
        start_s = time.monotonic()
        with pytest.raises(UnitTimeoutError, match="no answer to arm in time"):
            client.arm("shake")
        assert 0.25 < time.monotonic() - start_s < 10  # a busy machine's; it was a minute


def test_a_unit_that_never_becomes_ready_is_not_waited_for_without_end(runs):
    with (
        FakeUnit(runs, misbehave=SlowToArm(-1)) as unit,
        UnitClient(unit.address, timeout_s=2.0) as client,
        pytest.raises(UnitTimeoutError, match="not ready to record after 0.7 s"),
    ):
        client.arm("shake", patience_s=0.7)


def test_chunks_are_asked_for_ahead_and_make_up_the_file(runs):
    with FakeUnit(runs) as unit, UnitClient(unit.address) as client:
        assert whole_file(client) == (runs / RUN / "video.h264").read_bytes()
        assert len(unit.reads()) == 100
        chunks = client.read_chunks(RUN, 1, [(o, 1000) for o in range(0, 100_000, 1000)], credit=10)
        next(chunks)
        # One was taken, nine are still out: the credit is not exceeded while the receiver is at work.
        deadline = time.monotonic() + 5
        while len(unit.reads()) < 110 and time.monotonic() < deadline:
            threading.Event().wait(0.005)
        assert len(unit.reads()) == 110


def test_duplicated_and_late_replies_are_counted_and_ignored(runs):
    held = []

    def misbehave(request, messages):
        if isinstance(request, GetStatus) and not held:
            held.extend(messages)
            return []  # comes late, behind the next answer
        return [*messages, *held, *messages]

    with FakeUnit(runs, misbehave=misbehave) as unit, UnitClient(unit.address, timeout_s=0.3) as client:
        with pytest.raises(UnitTimeoutError):
            client.status()
        assert client.hello().unit == "fake"
        assert whole_file(client) == (runs / RUN / "video.h264").read_bytes()
        assert client.counts.stray_replies >= 2


def test_foreign_bytes_are_counted_and_ignored(runs):
    junk = [[b"GET / HTTP/1.1\r\n"], [b""], [msgpack.packb({"protocol": 2})], [b"\xc1", b"x"]]
    with (
        FakeUnit(runs, misbehave=lambda request, messages: [*junk, *messages]) as unit,
        UnitClient(unit.address) as client,
    ):
        assert client.hello().unit == "fake"
        assert client.counts.foreign_messages == len(junk)


def test_only_foreign_bytes_end_in_a_timeout_that_says_so(runs):
    with (
        FakeUnit(runs, misbehave=lambda request, messages: [[b"SSH-2.0-OpenSSH"]]) as unit,
        UnitClient(unit.address, timeout_s=0.3) as client,
        pytest.raises(UnitTimeoutError, match="1 messages came that are not bricktrack's"),
    ):
        client.hello()


def test_a_silent_address_times_out_with_words():
    with (
        UnitClient("tcp://127.0.0.1:9", timeout_s=0.2) as client,
        pytest.raises(UnitTimeoutError, match="no connection in time"),
    ):
        client.hello()


def test_another_protocol_version_is_named(runs):
    def newer(request, messages):
        envelope = msgpack.unpackb(messages[0][0]) | {"protocol": 9}
        return [[msgpack.packb(envelope)]]

    with (
        FakeUnit(runs, misbehave=newer) as unit,
        UnitClient(unit.address) as client,
        pytest.raises(ProtocolError, match="version 2. Upgrade"),
    ):
        client.hello()


def test_a_refusal_carries_code_and_words(runs):
    def refuse(request, messages):
        request_id = msgpack.unpackb(messages[0][0])["request_id"]
        return [[encode_message(request_id, Refusal(code="busy", message="recording"))]]

    with FakeUnit(runs, misbehave=refuse) as unit, UnitClient(unit.address) as client:
        with pytest.raises(UnitError, match="recording") as refused:
            client.list_runs()
        assert refused.value.code == "busy"


def test_an_answer_of_the_wrong_kind_is_a_protocol_error(runs):
    def confuse(request, messages):
        request_id = msgpack.unpackb(messages[0][0])["request_id"]
        return [[encode_message(request_id, Disarmed())]]

    with (
        FakeUnit(runs, misbehave=confuse) as unit,
        UnitClient(unit.address) as client,
        pytest.raises(ProtocolError, match="answered hello with a Disarmed"),
    ):
        client.hello()


@pytest.mark.parametrize(
    "change",
    [
        lambda m: [[m[0][0], bytes([m[0][1][0] ^ 1]) + m[0][1][1:]]],
        lambda m: [[m[0][0], m[0][1][:-1]]],
        lambda m: [],
    ],
    ids=["broken checksum", "cut short", "never sent"],
)
def test_a_bad_or_missing_chunk_is_asked_for_again(runs, change):
    with (
        FakeUnit(runs, misbehave=once(is_read_at(5000), change)) as unit,
        UnitClient(unit.address) as client,
    ):
        assert whole_file(client) == (runs / RUN / "video.h264").read_bytes()
        assert client.counts.repeated_chunks == 1
        assert sum(r.offset == 5000 for r in unit.reads()) == 2


def test_a_chunk_of_another_place_is_not_taken(runs):
    """The reply has the right number but says another offset: bytes would land in the wrong place."""
    other = []

    def misbehave(request, messages):
        if isinstance(request, Read) and request.offset == 4000:
            other.append(messages[0])
        if isinstance(request, Read) and request.offset == 5000 and len(other) == 1:
            envelope = msgpack.unpackb(other[0][0])
            envelope["request_id"] = msgpack.unpackb(messages[0][0])["request_id"]
            other.append([])
            return [[msgpack.packb(envelope), other[0][1]]]
        return messages

    with FakeUnit(runs, misbehave=misbehave) as unit, UnitClient(unit.address) as client:
        assert whole_file(client) == (runs / RUN / "video.h264").read_bytes()
        assert client.counts.repeated_chunks == 1


def test_a_chunk_that_stays_broken_ends_the_transfer(runs):
    def always(request, messages):
        if is_read_at(5000)(request):
            return [[messages[0][0], b"\0" * len(messages[0][1])]]
        return messages

    with (
        FakeUnit(runs, misbehave=always) as unit,
        UnitClient(unit.address) as client,
        pytest.raises(TransferError, match="does not match its checksum, 4 times"),
    ):
        whole_file(client)


def test_waiting_ends_when_told_to_stop(runs):
    stop = threading.Event()
    with (
        FakeUnit(runs, misbehave=lambda request, messages: []) as unit,
        UnitClient(unit.address, timeout_s=30, stop=stop) as client,
    ):
        threading.Timer(0.1, stop.set).start()
        began = time.monotonic()
        with pytest.raises(Stopped):
            client.hello()
        assert time.monotonic() - began < 5


def test_a_still_comes_whole_in_one_frame_or_in_pieces(runs):
    picture = bytes(range(256)) * 12_000  # 3 MB

    def cut(request, messages):
        if not isinstance(request, TakeStill):
            return messages
        head, data = messages[0]
        return [[head, *(data[i : i + MAX_CHUNK_BYTES] for i in range(0, len(data), MAX_CHUNK_BYTES))]]

    with FakeUnit(runs, misbehave=cut) as unit, UnitClient(unit.address) as client:
        unit.picture = picture
        said, data = client.still(encoding="jpeg", lit=False)
        assert data == picture and said.n_bytes == len(picture)
        assert unit.requests[-1] == TakeStill(encoding="jpeg", lit=False)
        unit.picture = picture[:10]
        assert client.still()[1] == picture[:10]


def test_a_still_that_comes_broken_or_short_is_refused(runs):
    def break_it(request, messages):
        head, data = messages[0]
        return [[head, b"\xff" + data[1:]]]

    def shorten(request, messages):
        return [[messages[0][0], messages[0][1][:-1]]]

    for misbehave in (break_it, shorten):
        with FakeUnit(runs, misbehave=misbehave) as unit, UnitClient(unit.address) as client:
            unit.picture = b"0123456789"
            with pytest.raises(TransferError, match="came broken.*ask again"):
                client.still()


def test_a_still_without_end_is_not_taken_for_one(runs):
    def flood(request, messages):
        return [[messages[0][0], *[b"x"] * 17]]  # sixteen pieces of 1 MiB are the most

    with (
        FakeUnit(runs, misbehave=flood) as unit,
        UnitClient(unit.address, timeout_s=0.5) as client,
        pytest.raises(UnitTimeoutError, match="1 messages came that are not bricktrack's"),
    ):
        unit.picture = b"x"
        client.still(timeout_s=0.5)


def test_deleting_and_configuring_ask_as_they_are_told(runs):
    with FakeUnit(runs) as unit, UnitClient(unit.address) as client:
        with pytest.raises(UnitError, match="no host has run") as e:
            client.delete_run(RUN)
        assert e.value.code == "not-confirmed"
        assert client.delete_run(RUN, force=True).n_bytes > 100_000
        assert client.configure().changed == []
        done = client.configure({"camera.exposure_us": 900})
        assert done.values["camera.exposure_us"] == 900 and done.changed == ["camera.exposure_us"]
        assert client.configure({"camera.exposure_us": None}).changed == []


def test_keys_that_are_none_or_missing_are_an_error_before_anything_is_sent():
    pair = make_key_pair()
    with pytest.raises(ConfigError, match="server_key.*is no key"):
        UnitClient("tcp://127.0.0.1:1", server_key="short", own_keys=pair)
    with pytest.raises(ConfigError, match="bricktrack keys create"):
        UnitClient("tcp://127.0.0.1:1", server_key=pair.public)


def test_many_clients_of_one_context_leave_no_socket_behind(runs):
    with zmq.Context() as context, FakeUnit(runs) as unit:
        context.max_sockets = 150  # closed sockets are reaped later, on a busy machine much later
        for _ in range(300):
            with UnitClient(unit.address, context=context, timeout_s=60) as client:
                assert client.hello().unit == "fake"
        with (
            UnitClient("tcp://127.0.0.1:1", context=context, timeout_s=0.05) as client,
            pytest.raises(UnitTimeoutError),
        ):
            client.hello()


@pytest.mark.skipif(sys.platform != "linux", reason="counts open files in /proc")
def test_the_handshakes_sockets_are_given_back_after_the_first_answer(runs):
    def n_open():
        return sum(1 for _ in Path("/proc/self/fd").iterdir())

    n_clients = 8
    with FakeUnit(runs) as unit, zmq.Context() as context, contextlib.ExitStack() as opened:
        with UnitClient(unit.address, context=context) as warming:
            warming.hello()  # the context's own threads and files are there from now on
        n_before = n_open()
        for _ in range(n_clients):
            opened.enter_context(UnitClient(unit.address, context=context)).hello()
        deadline_s = time.monotonic() + 5.0  # ZeroMQ closes sockets in a thread of its own
        # Each keeps its own socket and both ends of its connection; two more would be the watch's.
        while n_open() > n_before + 3 * n_clients and time.monotonic() < deadline_s:
            time.sleep(0.01)
        assert n_open() <= n_before + 3 * n_clients
