"""The host's client against the device's own file server and run store, without cameras or sensors."""

import errno
import re
import threading
import time

import pytest
from device_fakes import FakeRig
from run_folders import contents, make_run
from saved_runs import save_one, store_in

from bricktrack_common.checksums import crc32
from bricktrack_common.clocks import read_clock_triplet
from bricktrack_common.errors import TransferError, UnitError
from bricktrack_common.run_folder import read_run
from bricktrack_common.wire_messages import (
    Chunk,
    Confirm,
    Confirmed,
    DescribeRun,
    GetStatus,
    Hello,
    HelloReply,
    ListRuns,
    Read,
    RunList,
    StatusReply,
)
from bricktrack_device import unit_service
from bricktrack_device.config import DeviceConfig, ServerTable, StorageTable, UnitTable
from bricktrack_device.daemon import Daemon
from bricktrack_device.network.file_server import FileServer
from bricktrack_device.refusals import RequestRefusedError
from bricktrack_device.storage.disk import storage_error
from bricktrack_device.storage.run_store import RunStore
from bricktrack_device.storage.run_writer import DRAFT_NAME
from bricktrack_host.transfer.fleet_config import UnitConfig
from bricktrack_host.transfer.pull import pull_unit
from bricktrack_host.transfer.unit_client import UnitClient

RUN = "b1_9f31c2_0001_shake"


class StoreHandler:
    """Answers what concerns files, as the daemon does; ``busy`` stands for a recording under way."""

    def __init__(self, store):
        self.store = store
        self.busy = False
        self.is_busy = False

    def handle(self, request, answer):
        match request:
            case Hello():
                answer(HelloReply(unit="b1", software="bricktrack", simulated=True), None)
            case GetStatus():
                answer(
                    StatusReply(
                        unit="b1", state="idle", runs=2, disk_free_bytes=10**9, disk_needed_bytes=0, frames=0,
                        imus=[], edges=0, clocks=read_clock_triplet(),
                    ),
                    None,
                )  # fmt: skip
            case ListRuns():
                answer(RunList(runs=self.store.list_runs()), None)
            case DescribeRun():
                answer(self.store.describe(request.run_id), None)
            case Read():
                if self.busy:
                    raise RequestRefusedError("busy", "the unit is recording; it transfers nothing meanwhile")
                data = self.store.read_chunk(
                    request.run_id, request.file_index, request.offset, request.length
                )
                place = {f: getattr(request, f) for f in ("run_id", "file_index", "offset")}
                answer(Chunk(**place, n_bytes=len(data), crc32=crc32(data)), data)
            case Confirm():
                self.store.confirm(request.run_id, request.sha256)
                answer(Confirmed(run_id=request.run_id), None)
            case _:
                raise RequestRefusedError("bad-message", "not here")


@pytest.fixture
def served(tmp_path):
    store = RunStore(tmp_path / "card", "b1", boot_id="9f31c2")
    make_run(store.runs, RUN, {"video.h264": 1_500_000, "edges.msgpack": 100}, unit="b1")
    make_run(store.runs, "b1_9f31c2_0002", {"video.h264": 10}, unit="b1")
    handler = StoreHandler(store)
    server = FileServer("127.0.0.1", 0, handler)
    server.start()
    yield store, handler, UnitConfig(name="b1", address=f"tcp://127.0.0.1:{server.port}")
    server.stop()


def test_runs_come_over_and_the_store_notes_it(served, tmp_path):
    store, _, unit = served
    result = pull_unit(unit, tmp_path / "runs")
    assert result.errors == []
    assert [r.run_id for r in result.runs] == [RUN, "b1_9f31c2_0002"]
    assert contents(tmp_path / "runs" / RUN) == contents(store.runs / RUN)
    assert all(r.confirmed for r in store.list_runs())
    again = pull_unit(unit, tmp_path / "runs")
    assert [r.outcome for r in again.runs] == ["already here"] * 2


def test_a_file_that_shrank_on_the_card_is_not_confirmed_and_the_next_run_still_comes(served, tmp_path):
    store, _, unit = served
    (store.runs / RUN / "video.h264").write_bytes(b"short")
    result = pull_unit(unit, tmp_path / "runs")
    assert isinstance(result.errors[0], TransferError)
    assert f"{RUN}: video.h264: " in str(result.errors[0])
    assert [r.run_id for r in result.runs] == ["b1_9f31c2_0002"]
    assert {r.run_id: r.confirmed for r in store.list_runs()} == {RUN: False, "b1_9f31c2_0002": True}


def test_a_unit_that_records_is_left_alone_and_says_so(served, tmp_path):
    _, handler, unit = served
    handler.busy = True
    result = pull_unit(unit, tmp_path / "runs")
    assert len(result.errors) == 1  # the second run would be refused in the same way: not tried
    assert "recording; it transfers nothing meanwhile" in str(result.errors[0])
    handler.busy = False
    assert pull_unit(unit, tmp_path / "runs").errors == []


def test_refusals_of_the_real_server_have_their_codes(served):
    _, _, unit = served
    with UnitClient(unit.address) as client:
        for ask, code in (
            (lambda: client.describe_run("b1_none"), "no-such-run"),
            (lambda: list(client.read_chunks(RUN, 9, [(0, 10)])), "no-such-file"),
            (lambda: list(client.read_chunks(RUN, 1, [(9_999_999, 10)])), "out-of-range"),
            (lambda: client.confirm(RUN, ["0" * 64]), "hash-mismatch"),
            (client.disarm, "bad-message"),
        ):
            with pytest.raises(UnitError) as refused:
                ask()
            assert refused.value.code == code
        assert client.hello().unit == "b1"


@pytest.fixture
def daemon(tmp_path):
    """A card with two runs, and what serves it."""
    store = store_in(tmp_path / "card")
    run_ids = [save_one(store), save_one(store)]
    config = DeviceConfig(
        unit=UnitTable(name="unit-1"), storage=StorageTable(folder=str(store.folder)),
        server=ServerTable(port=0), imu=[],
    )  # fmt: skip
    daemon = Daemon(config, FakeRig())
    thread = threading.Thread(target=daemon.run)
    thread.start()
    while not daemon.port:
        assert thread.is_alive()
        time.sleep(0.01)
    yield store.runs, run_ids, UnitConfig(name="unit-1", address=f"tcp://127.0.0.1:{daemon.port}")
    daemon.stop()
    thread.join()


def flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 8
    path.write_bytes(data)


def shorten(path):
    path.write_bytes(path.read_bytes()[:50])


@pytest.mark.parametrize("damage", [flip, shorten, lambda path: path.unlink()])
def test_a_run_that_the_card_has_altered_comes_as_it_is_and_says_so(daemon, tmp_path, damage):
    runs, (altered, whole), unit = daemon
    damage(runs / altered / "video.h264")
    result = pull_unit(unit, tmp_path / "here")
    assert result.errors == [] and [r.run_id for r in result.runs] == [altered, whole]
    run = read_run(tmp_path / "here" / altered, verify_hashes=True)
    assert run.manifest.state == "interrupted"
    assert any("video.h264: the card altered it" in words for words in run.manifest.missing)
    assert run.imus and run.edges_ns.size and run.manifest.camera is not None
    on_card = contents(runs / altered)
    on_card.pop(DRAFT_NAME)
    assert contents(tmp_path / "here" / altered) == on_card
    with UnitClient(unit.address) as client:
        assert all(r.confirmed for r in client.list_runs().runs)
    assert [r.outcome for r in pull_unit(unit, tmp_path / "here").runs] == ["already here"] * 2


@pytest.mark.parametrize(
    ("refusal", "words"),
    [
        (
            storage_error("the card", OSError(errno.ENOSPC, "No space left on device")),
            "suspect; .*No space left",
        ),
        (RequestRefusedError("busy", "the unit is armed"), "the unit is armed. What came is kept"),
    ],
)
def test_a_unit_that_cannot_look_at_an_altered_run_says_why(daemon, tmp_path, monkeypatch, refusal, words):
    runs, (run_id, _), unit = daemon

    def refuse(*_):
        raise refusal

    monkeypatch.setattr(unit_service, "describe_anew_if_altered", refuse)
    flip(runs / run_id / "video.h264")
    result = pull_unit(unit, tmp_path / "here")
    assert len(result.errors) == 1 and re.search(words, str(result.errors[0]))


def test_hashes_that_are_merely_wrong_are_refused_and_change_nothing(daemon):
    runs, (run_id, _), unit = daemon
    before = contents(runs / run_id)
    with UnitClient(unit.address) as client:
        n_files = len(client.describe_run(run_id).files)
        with pytest.raises(UnitError) as refused:
            client.confirm(run_id, ["0" * 64] * n_files)
        assert refused.value.code == "hash-mismatch" and "pull it again" not in str(refused.value)
        assert not any(r.confirmed for r in client.list_runs().runs)
    assert contents(runs / run_id) == before
