"""Runs come over whole, whatever goes wrong on the way; what came is never thrown away."""

import errno
import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time

import msgpack
import pytest
from fake_unit import FakeUnit
from run_folders import contents, make_run

from bricktrack_common.errors import ConfigError, StorageError, TransferError, UnitTimeoutError
from bricktrack_common.wire_codec import encode_message
from bricktrack_common.wire_messages import DescribeRun, FileSummary, Read, RunDescription
from bricktrack_host.transfer import part_folder
from bricktrack_host.transfer.contact import Dialer
from bricktrack_host.transfer.fleet_config import UnitConfig, unit_at
from bricktrack_host.transfer.part_folder import JOURNAL_NAME
from bricktrack_host.transfer.pull import pull_fleet, pull_unit
from bricktrack_host.transfer.run_transfer import pull_run
from bricktrack_host.transfer.unit_client import UnitClient

RUN = "fake_9f31_0001_shake"
MIB = 1024 * 1024
SIZES = {"video.h264": 12 * MIB + 4567, "frames.msgpack": 30_000, "imu_brick.msgpack": 100}


@pytest.fixture
def source(tmp_path):
    return make_run(tmp_path / "card", RUN, SIZES)


@pytest.fixture
def here(tmp_path):
    folder = tmp_path / "runs"
    folder.mkdir()
    return folder


def pull(unit, here, **options):
    return pull_run(lambda: UnitClient(unit.address, timeout_s=0.5), RUN, here, **options)


class Notes:
    def __init__(self):
        self.texts, self.n_bytes, self.total = [], 0, 0

    def unit_started(self, unit): ...

    def unit_done(self, unit): ...

    def unit_listed(self, unit, n_runs, n_bytes):
        self.total += n_bytes

    def bytes_done(self, unit, n_bytes):
        self.n_bytes += n_bytes

    def note(self, unit, text):
        self.texts.append(text)


def test_a_run_comes_whole_and_is_confirmed(source, here):
    notes = Notes()
    with FakeUnit(source.parent) as unit:
        pulled = pull(unit, here, progress=notes)
        assert unit.confirmed == {RUN}
    assert contents(here / RUN) == contents(source)
    assert [p.name for p in here.iterdir()] == [RUN]
    assert pulled.outcome == "pulled"
    assert (
        pulled.n_bytes_fetched == pulled.n_bytes == notes.n_bytes == sum(map(len, contents(source).values()))
    )


def test_a_whole_run_is_not_fetched_again_but_confirmed_again(source, here):
    with FakeUnit(source.parent) as unit:
        pull(unit, here)
        unit.confirmed.clear()
        n_reads = len(unit.reads())
        assert pull(unit, here).outcome == "already here"
        assert unit.confirmed == {RUN}
        assert len(unit.reads()) == n_reads


def test_a_present_run_that_differs_is_neither_confirmed_nor_overwritten(source, here):
    with FakeUnit(source.parent) as unit:
        pull(unit, here)
        unit.confirmed.clear()
        (here / RUN / "frames.msgpack").write_bytes(b"mine")
        with pytest.raises(TransferError, match=r"frames\.msgpack: is not what the unit has"):
            pull(unit, here)
        assert unit.confirmed == set()
    assert (here / RUN / "frames.msgpack").read_bytes() == b"mine"


def test_a_killed_pull_goes_on_where_it_was(source, here):
    """The host process is killed outright in the middle of the video; a new one finishes."""
    killed = threading.Event()

    def stall(request, messages):
        if isinstance(request, Read) and request.offset >= 9 * MIB and not killed.is_set():
            return []
        return messages

    with FakeUnit(source.parent, misbehave=stall) as unit:
        command = [
            sys.executable,
            "-m",
            "bricktrack_host.cli",
            "pull",
            "--address",
            unit.address,
            "-o",
            str(here),
        ]
        host = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        journal = here / f"{RUN}.part" / JOURNAL_NAME
        deadline = time.monotonic() + 30
        while time.monotonic() < deadline and not (
            journal.exists()
            and sum(r["n_bytes"] for r in ranges_of(journal) if r["file"] == "video.h264") >= 4 * MIB
        ):
            threading.Event().wait(0.01)
        host.send_signal(signal.SIGKILL)
        host.wait()
        killed.set()
        kept = sum(r["n_bytes"] for r in ranges_of(journal))
        assert not (here / RUN).exists()
        before = len(unit.reads())
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stderr
        fetched = sum(r.length for r in unit.reads()[before:])
        assert fetched == sum(map(len, contents(source).values())) - kept
        assert unit.confirmed == {RUN}
    assert contents(here / RUN) == contents(source)
    assert kept >= 4 * MIB


def ranges_of(journal):
    return [json.loads(line) for line in journal.read_bytes().split(b"\n")[1:-1]]


def half_pulled(source, here):
    """Leave a part folder as a lost connection leaves it."""

    def stall(request, messages):
        return [] if isinstance(request, Read) and request.offset >= 9 * MIB else messages

    with (
        FakeUnit(source.parent, misbehave=stall) as unit,
        pytest.raises(UnitTimeoutError, match="pull again"),
    ):
        pull(unit, here, patience_s=0)
    return here / f"{RUN}.part"


def test_a_torn_journal_line_costs_only_its_range(source, here):
    journal = half_pulled(source, here) / JOURNAL_NAME
    n_before = sum(r["n_bytes"] for r in ranges_of(journal))
    journal.write_bytes(journal.read_bytes()[:-20])
    n_kept = sum(r["n_bytes"] for r in ranges_of(journal))
    assert 0 < n_kept < n_before
    with FakeUnit(source.parent) as unit:
        pulled = pull(unit, here)
    assert pulled.n_bytes_fetched == pulled.n_bytes - n_kept
    assert contents(here / RUN) == contents(source)


def test_bytes_that_changed_on_disk_are_fetched_again(source, here):
    part = half_pulled(source, here)
    with (part / "video.h264").open("rb+") as file:
        file.seek(MIB + 1)
        byte = file.read(1)[0]
        file.seek(MIB + 1)
        file.write(bytes([byte ^ 255]))
    notes = Notes()
    with FakeUnit(source.parent) as unit:
        pull(unit, here, progress=notes)
    assert contents(here / RUN) == contents(source)
    assert any("1 ranges noted earlier are not as noted" in t for t in notes.texts)


def test_a_part_of_other_contents_is_kept_aside(source, here):
    half_pulled(source, here)
    (source / "manifest.json").unlink()
    make_run(source.parent, "other", {}, seed=3)
    for path in source.iterdir():
        path.unlink()
    source.rmdir()
    make_run(source.parent, RUN, SIZES, seed=2)
    with FakeUnit(source.parent) as unit:
        pull(unit, here)
    assert contents(here / RUN) == contents(source)
    assert (here / f"{RUN}.part.bad-1" / "video.h264").exists()


def test_a_wrong_file_is_kept_and_fetched_again(source, here):
    """Chunks with right checksums of wrong bytes: only the whole file's hash can tell."""
    rightly = (source / "frames.msgpack").read_bytes()
    (source / "frames.msgpack").write_bytes(b"x" * len(rightly))
    reads = []

    def mend(request, messages):
        if isinstance(request, Read) and request.file_index == 2:
            reads.append(request)
            (source / "frames.msgpack").write_bytes(rightly)  # right from the second time on
        return messages

    notes = Notes()
    with FakeUnit(source.parent, misbehave=mend) as unit:
        pull(unit, here, progress=notes)
    assert len(reads) == 2
    assert (here / f"{RUN}.bad-1.frames.msgpack").read_bytes() == b"x" * len(rightly)
    assert any("frames.msgpack arrived with SHA-256" in t and "again" in t for t in notes.texts)
    assert contents(here / RUN) == contents(source)
    assert notes.n_bytes == sum(map(len, contents(source).values()))


def test_a_file_wrong_twice_is_a_transfer_error(source, here):
    data = (source / "frames.msgpack").read_bytes()
    (source / "frames.msgpack").write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with FakeUnit(source.parent) as unit:
        with pytest.raises(TransferError, match="Twice: the unit's card"):
            pull(unit, here)
        assert unit.confirmed == set()
    assert not (here / RUN).exists()
    assert (here / f"{RUN}.bad-1.frames.msgpack").exists()
    assert not (here / f"{RUN}.bad-2.frames.msgpack").exists()  # it was the same


def alter_description(change):
    def misbehave(request, messages):
        if not isinstance(request, DescribeRun):
            return messages
        envelope = msgpack.unpackb(messages[0][0])
        files = [FileSummary(**f) for f in envelope["body"]["files"]]
        body = RunDescription(run_id=request.run_id, files=change(files))
        return [[encode_message(envelope["request_id"], body)]]

    return misbehave


def test_a_description_that_is_not_the_manifests_is_refused(source, here):
    """A file left out of the description would be missing here, and yet be confirmed."""
    with (
        FakeUnit(source.parent, misbehave=alter_description(lambda files: files[:-1])) as unit,
        pytest.raises(TransferError, match=r"differ in imu_brick\.msgpack"),
    ):
        pull(unit, here)
    assert not (here / RUN).exists()


def test_a_path_from_the_wire_is_refused(source, here):
    def evil(request, messages):
        if not isinstance(request, DescribeRun):
            return messages
        envelope = msgpack.unpackb(messages[0][0])
        envelope["body"]["files"][1]["name"] = "../evil"
        return [[msgpack.packb(envelope)]]

    with FakeUnit(source.parent, misbehave=evil) as unit:
        client = UnitClient(unit.address, timeout_s=0.5)
        with client, pytest.raises(UnitTimeoutError):
            client.describe_run(RUN, timeout_s=0.5)
        assert client.counts.foreign_messages == 1
    assert list(here.iterdir()) == []


def test_a_unit_that_goes_away_and_comes_back_is_waited_for(source, here):
    gone = threading.Event()

    def dies(request, messages):
        if isinstance(request, Read) and request.offset >= 6 * MIB:
            gone.set()
            return []
        return messages

    first = FakeUnit(source.parent, misbehave=dies)
    port = first.port
    results = []

    def work():
        connect = lambda: UnitClient(f"tcp://127.0.0.1:{port}", timeout_s=0.5)  # noqa: E731
        results.append(pull_run(connect, RUN, here, patience_s=30))

    with first:
        thread = threading.Thread(target=work)
        thread.start()
        assert gone.wait(20)
    with FakeUnit(source.parent, port=port) as second:
        thread.join(30)
        assert second.confirmed == {RUN}
    assert contents(here / RUN) == contents(source)
    # Up to the ten chunks that were under way may have come twice, no more.
    assert results[0].n_bytes_fetched <= results[0].n_bytes + 10 * 256 * 1024


def test_a_full_disk_is_said_and_resumed(source, here, monkeypatch):
    real, left = part_folder.write_at, [5 * MIB]

    def full(handle, offset, data):
        left[0] -= len(data)
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(handle, offset, data)

    with FakeUnit(source.parent) as unit:
        with monkeypatch.context() as patch:
            patch.setattr(part_folder, "write_at", full)
            with pytest.raises(StorageError, match="no space left. What came is kept"):
                pull(unit, here)
        pulled = pull(unit, here)
    assert contents(here / RUN) == contents(source)
    assert pulled.n_bytes_fetched < pulled.n_bytes - 4 * MIB


def test_the_systems_own_refusal_to_write_is_a_storage_error(source, here):
    """A limit of the operating system on file size stands for the full disk, with nothing replaced."""
    limits = (8 * MIB, resource.getrlimit(resource.RLIMIT_FSIZE)[1])
    with FakeUnit(source.parent) as unit:
        command = [
            sys.executable,
            "-m",
            "bricktrack_host.cli",
            "pull",
            "--address",
            unit.address,
            "-o",
            str(here),
        ]
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=60,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limits),
        )  # fmt: skip
        assert done.returncode == 1
        assert "no space left" in done.stderr
        assert "Traceback" not in done.stderr
        pulled = pull(unit, here)
    assert contents(here / RUN) == contents(source)
    assert pulled.n_bytes_fetched < pulled.n_bytes


def test_too_little_room_is_said_before_anything_is_fetched(source, here, monkeypatch):
    usage = part_folder.os.statvfs(here)
    monkeypatch.setattr(
        "bricktrack_host.transfer.run_transfer.shutil.disk_usage",
        lambda path: type("U", (), {"free": MIB, "total": usage.f_blocks}),
    )
    with FakeUnit(source.parent) as unit:
        with pytest.raises(StorageError, match="13 MB are to come and 1 MB are free"):
            pull(unit, here)
        assert unit.reads() == []


def test_two_pulls_of_one_run_do_not_mix(source, here):
    part = half_pulled(source, here)
    with (
        FakeUnit(source.parent) as unit,
        UnitClient(unit.address) as client,
        part_folder.PartFolder.open(part, client.describe_run(RUN), note=print),
        pytest.raises(StorageError, match="another pull is at work"),
    ):
        pull(unit, here)


def test_a_unit_of_another_name_is_refused(source, here):
    with FakeUnit(source.parent, name="b2") as unit:
        result = pull_unit(UnitConfig(name="b1", address=unit.address), here, dialer=Dialer(timeout_s=0.5))
    assert isinstance(result.errors[0], ConfigError)
    assert "calls itself 'b2'" in str(result.errors[0])


def test_several_units_come_side_by_side_and_one_that_fails_does_not_stop_the_rest(tmp_path, here):
    for i in range(3):
        make_run(tmp_path / f"card{i}", f"u{i}_0001", {"video.h264": MIB})
        make_run(tmp_path / f"card{i}", f"u{i}_0002", {"video.h264": 1000})
    bad = tmp_path / "card1" / "u1_0001" / "video.h264"
    bad.write_bytes(b"0" * MIB)
    units = [FakeUnit(tmp_path / f"card{i}") for i in range(3)]
    with units[0], units[1], units[2]:
        notes = Notes()
        results = pull_fleet(
            [unit_at(u.address) for u in units], here, progress=notes, dialer=Dialer(timeout_s=0.5)
        )
    assert sorted(p.name for p in here.iterdir() if p.name in {f"u{i}_000{j}" for i in range(3) for j in (1, 2)}) == [
        "u0_0001", "u0_0002", "u1_0002", "u2_0001", "u2_0002",
    ]  # fmt: skip
    assert [len(r.errors) for r in results] == [0, 1, 0]
    assert [len(r.runs) for r in results] == [2, 1, 2]


def test_a_run_that_another_pull_brings_at_the_same_moment_is_here_once_and_whole(source, here, monkeypatch):
    opened = part_folder.PartFolder.open

    def other_is_faster(path, description, *, note):
        monkeypatch.setattr(part_folder.PartFolder, "open", opened)
        with FakeUnit(source.parent) as other:
            assert pull(other, here).outcome == "pulled"
        return opened(path, description, note=note)

    monkeypatch.setattr(part_folder.PartFolder, "open", other_is_faster)
    with FakeUnit(source.parent) as unit:
        pulled = pull(unit, here)
        assert unit.confirmed == {RUN}
    assert pulled.outcome == "already here" and contents(here / RUN) == contents(source)
    assert [p.name for p in here.iterdir()] == [RUN]


def test_a_folder_that_got_its_final_name_while_its_lock_was_waited_for_is_not_taken_for_ours(
    source, here, monkeypatch
):
    locked = part_folder.fcntl.flock

    def renamed_before(descriptor, operation):
        monkeypatch.setattr(part_folder.fcntl, "flock", locked)
        (here / f"{RUN}.part").rename(here / "final")
        locked(descriptor, operation)

    monkeypatch.setattr(part_folder.fcntl, "flock", renamed_before)
    with FakeUnit(source.parent) as unit:
        pull(unit, here)
    assert contents(here / RUN) == contents(source) and list((here / "final").iterdir()) == []
