"""Whatever the network, the host and the unit do, what stands under a run's name is the run, byte for byte.

Every test ends by comparing the files' hashes with those on the unit's card. The long form takes more cuts and
kills: ``BRICKTRACK_FAULTS=200 pytest tests/end_to_end/test_pull_faults.py``.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time

import msgpack
import msgspec
import pytest
from bad_network import BadNetwork, BitFlips
from fake_unit import FakeUnit
from light_unit import LightUnit
from run_folders import make_run

from bricktrack_common.checksums import sha256_file
from bricktrack_common.errors import BricktrackError, StorageError, TransferError, UnitError
from bricktrack_common.run_manifest import MANIFEST_NAME, read_manifest, write_manifest
from bricktrack_common.wire_codec import encode_message
from bricktrack_common.wire_messages import Confirm, DescribeRun, Read, RunDescription
from bricktrack_host.transfer.contact import Dialer
from bricktrack_host.transfer.fleet_config import UnitConfig
from bricktrack_host.transfer.pull import PullSettings, pull_unit
from bricktrack_host.transfer.run_transfer import pull_run
from bricktrack_host.transfer.unit_client import UnitClient

RUN = "fake_9f31_0001_shake"
KIB = 1024
N_FAULTS = int(os.environ.get("BRICKTRACK_FAULTS", "8"))
PULL = [sys.executable, "-m", "bricktrack_host.cli", "pull"]


@pytest.fixture
def here(tmp_path):
    (tmp_path / "runs").mkdir()
    return tmp_path / "runs"


def make(tmp_path, n_kib, *, seed=1):
    sizes = {"video.h264": n_kib * KIB + 123, "frames.msgpack": 30_000, "imu_brick.msgpack": 100}
    return make_run(tmp_path / "card" / "runs", RUN, sizes, seed=seed)


def hashes(folder):
    return {p.name: sha256_file(p) for p in folder.iterdir()}


def pull(address, here, *, timeout_s=0.3, patience_s=30.0):
    return pull_run(lambda: UnitClient(address, timeout_s=timeout_s), RUN, here, patience_s=patience_s)


def test_a_connection_cut_at_random_points(tmp_path, here):
    """Each connection carries between nothing and five chunks before it is reset, anywhere in a message."""
    draw = random.Random(17)
    # Two and a half chunks come through a connection, on the average: this file outlasts so many.
    source = make(tmp_path, 4 * 256 * N_FAULTS)

    def budget():
        return draw.randint(1, 5 * 256 * KIB) if network.n_cuts < N_FAULTS else None

    with FakeUnit(source.parent) as unit, BadNetwork(unit.port, draw_budget=budget) as network:
        pulled = pull(network.address, here)
        assert network.n_cuts == N_FAULTS
        assert unit.confirmed == {RUN}
    assert hashes(here / RUN) == hashes(source)
    assert pulled.n_bytes_fetched >= pulled.n_bytes


def test_the_host_killed_at_random_points(tmp_path, here):
    """kill -9, again and again, from before the first byte to after the last; then one that may finish."""
    draw = random.Random(4)
    source = make(tmp_path, 8 * KIB)

    def slowly(request, messages):
        if isinstance(request, Read):
            time.sleep(0.02)  # 33 chunks: a pull takes some 0.7 s behind Python's start
        return messages

    n_killed = 0
    with FakeUnit(source.parent, misbehave=slowly) as unit:
        command = [*PULL, "--address", unit.address, "-o", str(here)]
        for _ in range(max(N_FAULTS // 4, 4)):
            asked = len(unit.requests)
            host = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            until = time.monotonic() + 20
            while len(unit.requests) == asked and host.poll() is None and time.monotonic() < until:
                time.sleep(0.002)
            time.sleep(draw.uniform(0.0, 0.8))
            host.send_signal(signal.SIGKILL)
            n_killed += host.wait() == -signal.SIGKILL
            assert not (here / RUN).exists() or hashes_without_journal(here / RUN) == hashes(source)
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stderr
        assert unit.confirmed == {RUN}
    assert n_killed >= 3
    assert hashes(here / RUN) == hashes(source)


def hashes_without_journal(folder):
    return {name: found for name, found in hashes(folder).items() if not name.startswith(".")}


def test_the_host_killed_between_the_last_byte_and_the_confirmation(tmp_path, here):
    source = make(tmp_path, 300)
    asked = threading.Event()

    def mute(request, messages):
        if isinstance(request, Confirm):
            asked.set()
            return []
        return messages

    with FakeUnit(source.parent, misbehave=mute) as unit:
        unit_confirms = unit.confirmed
        command = [*PULL, "--address", unit.address, "-o", str(here), "--timeout", "30"]
        host = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        assert asked.wait(30)
        host.send_signal(signal.SIGKILL)
        host.wait()
        unit_confirms.clear()
        unit.misbehave = lambda request, messages: messages
        n_reads = len(unit.reads())
        subprocess.run(command, check=True, capture_output=True, timeout=60)
        assert unit.confirmed == {RUN}
        assert len(unit.reads()) == n_reads  # nothing came twice
    assert hashes(here / RUN) == hashes(source)


def test_the_unit_killed_and_started_again(tmp_path, here):
    """The real daemon (simulated sensors), killed in the middle of the video and back on the same port."""
    source = make(tmp_path, 24 * KIB)
    results = []
    with LightUnit(tmp_path / "card") as unit:

        def work():
            # Slow enough that the unit dies in the middle, whatever the machine does.
            with BadNetwork(unit.port, damage=lambda data: time.sleep(0.0005) or data) as network:
                results.append(pull(network.address, here, timeout_s=0.5))

        host = threading.Thread(target=work)
        host.start()
        for share in (0.2, 0.6):
            until = time.monotonic() + 30
            while time.monotonic() < until and journalled(here) < share * 24 * KIB * KIB:
                time.sleep(0.01)
            unit.kill()
            unit.start()
        host.join(60)
    assert hashes(here / RUN) == hashes(source)
    assert (tmp_path / "card" / "confirmed" / f"{RUN}.json").exists()
    assert results[0].n_bytes_fetched < 1.5 * results[0].n_bytes  # it went on, and did not begin anew


def journalled(here):
    try:
        lines = (here / f"{RUN}.part" / ".journal.jsonl").read_bytes().split(b"\n")[1:-1]
    except OSError:
        return 0
    return sum(msgspec.json.decode(line)["n_bytes"] for line in lines)


def test_chunks_that_come_twice_late_damaged_or_never_and_strange_messages_between(tmp_path, here):
    draw = random.Random(8)
    source = make(tmp_path, 6 * KIB)
    late = []

    def shuffle(request, messages):
        if not isinstance(request, Read):
            return messages
        answer = messages[0]
        sent = []
        match draw.choice(
            ["well", "well", "well", "well", "twice", "late", "damaged", "short", "strange", "mute"]
        ):
            case "well":
                sent.append(answer)
            case "twice":
                sent += [answer, answer]
            case "late":
                late.append(answer)
            case "damaged":
                data = bytearray(answer[1])
                if data:
                    data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
                sent.append([answer[0], bytes(data)])
            case "short":
                sent.append([answer[0], answer[1][:-1]])
            case "strange":
                sent += [[draw.randbytes(40)], [answer[0]], [answer[0], b"", b""], answer]
        if late and draw.random() < 0.3:
            sent.append(late.pop(draw.randrange(len(late))))
        return sent

    with FakeUnit(source.parent, misbehave=shuffle) as unit:
        deadline = time.monotonic() + 60
        while True:  # a chunk that came broken four times in a row ends a pull; the next goes on
            try:
                pull(unit.address, here)
                break
            except TransferError as e:
                assert "4 times" in str(e)
                assert time.monotonic() < deadline
        assert unit.confirmed == {RUN}
    assert hashes(here / RUN) == hashes(source)


def test_bits_that_flip_on_the_way(tmp_path, here):
    """Below every checksum of TCP: in lengths, headers, hashes and data alike. Nothing wrong is ever kept."""
    draw = random.Random(21)
    source = make(tmp_path, 3 * KIB)
    damage = BitFlips(draw, every_bytes=200 * KIB)
    with FakeUnit(source.parent) as unit:
        with BadNetwork(unit.port, damage=damage) as network:
            for _ in range(60):
                try:
                    pull(network.address, here, patience_s=5.0)
                    break
                except BricktrackError:  # as a person does: look, and pull again
                    assert not (here / RUN).exists() or hashes(here / RUN) == hashes(source)
        assert damage.n_flips >= 5
        if RUN not in unit.confirmed:
            pull(unit.address, here)
        assert unit.confirmed == {RUN}
    assert hashes(here / RUN) == hashes(source)


LIES = {
    "longer": lambda n: n + 1000,
    "shorter": lambda n: n - 1000,
    "empty": lambda n: 0,
    "vast": lambda n: 2**53,
}


@pytest.mark.parametrize("lie", LIES)
@pytest.mark.parametrize("where", ["description", "both"])
def test_a_unit_that_lies_about_sizes_is_not_believed(tmp_path, here, lie, where):
    """In the description alone, or in the manifest too, so that the two agree."""
    source = make(tmp_path, 600)
    honest = (source / "video.h264").stat().st_size
    if where == "both":
        manifest = read_manifest(source / MANIFEST_NAME)
        files = [
            msgspec.structs.replace(f, n_bytes=LIES[lie](f.n_bytes)) if f.name == "video.h264" else f
            for f in manifest.files
        ]
        (source / MANIFEST_NAME).unlink()
        write_manifest(source / MANIFEST_NAME, msgspec.structs.replace(manifest, files=files))

    def misbehave(request, messages):
        if not isinstance(request, DescribeRun):
            return messages
        envelope = msgpack.unpackb(messages[0][0])
        described = msgspec.convert(envelope["body"], RunDescription)
        files = [
            msgspec.structs.replace(f, n_bytes=LIES[lie](honest)) if f.name == "video.h264" else f
            for f in described.files
        ]
        lying = RunDescription(run_id=RUN, files=files)
        return [[encode_message(envelope["request_id"], lying)]]

    with FakeUnit(source.parent, misbehave=misbehave) as unit:
        with pytest.raises((TransferError, StorageError)):
            pull(unit.address, here, patience_s=1.0)
        assert unit.confirmed == set()
    assert not (here / RUN).exists()


def test_chunks_larger_than_asked_for_do_not_get_in(tmp_path, here):
    source = make(tmp_path, 600)

    def larger(request, messages):
        if isinstance(request, Read) and request.file_index == 1:
            return [[messages[0][0], messages[0][1] + b"more"]]
        return messages

    with FakeUnit(source.parent, misbehave=larger) as unit, pytest.raises(TransferError, match="instead of"):
        pull(unit.address, here)
    assert not (here / RUN).exists()


def test_two_hosts_pull_the_same_run_at_once(tmp_path):
    source = make(tmp_path, 4 * KIB)
    folders = [tmp_path / "host-1", tmp_path / "host-2"]
    with FakeUnit(source.parent) as unit:
        for folder in folders:
            folder.mkdir()
        threads = [threading.Thread(target=pull, args=(unit.address, folder)) for folder in folders]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(30)
    for folder in folders:
        assert hashes(folder / RUN) == hashes(source)


def test_an_armed_unit_that_arms_itself_is_explained_and_disarmed_on_demand(tmp_path, here):
    source = make(tmp_path, 100)
    with FakeUnit(source.parent) as unit:
        unit.state, unit.auto_arm = "armed", True
        config = UnitConfig(name="fake", address=unit.address)
        refused = pull_unit(config, here, dialer=Dialer(timeout_s=1.0))
        assert unit.reads() == []
        assert isinstance(refused.errors[0], UnitError)
        assert "arms itself again after each run (auto_arm)" in str(refused.errors[0])
        assert "'bricktrack pull --disarm'" in str(refused.errors[0])
        result = pull_unit(config, here, dialer=Dialer(timeout_s=1.0), settings=PullSettings(disarm=True))
        assert unit.state == "idle"
    assert result.errors == []
    assert hashes(here / RUN) == hashes(source)


def test_a_unit_that_records_is_waited_for(tmp_path, here):
    source = make(tmp_path, 100)
    with FakeUnit(source.parent) as unit:
        unit.state = "recording"
        threading.Timer(0.7, lambda: setattr(unit, "state", "idle")).start()
        config = UnitConfig(name="fake", address=unit.address)
        result = pull_unit(config, here, dialer=Dialer(timeout_s=1.0))
    assert result.errors == []
    assert hashes(here / RUN) == hashes(source)


IN_NAMESPACE = """
import sys
sys.path[:0] = {path!r}
from fake_unit import FakeUnit
from bricktrack_host.transfer.run_transfer import pull_run
from bricktrack_host.transfer.unit_client import UnitClient
with FakeUnit(Path({card!r})) as unit:
    pull_run(lambda: UnitClient(unit.address, timeout_s=3.0), {run!r}, Path({here!r}), patience_s=60.0)
    assert unit.confirmed == {{{run!r}}}
"""
NETEM = "ip link set lo up && tc qdisc add dev lo root netem delay 20ms 15ms 25% reorder 30% 50% loss 2% duplicate 1%"


def test_bytes_that_trickle_in_with_pauses(tmp_path, here):
    """What delayed and reordered packets look like above TCP: small pieces, and silences between them."""
    draw = random.Random(3)
    source = make(tmp_path, 400)

    def trickle(data):
        if draw.random() < 0.1:
            time.sleep(draw.uniform(0.0, 0.08))
        return data

    with FakeUnit(source.parent) as unit, BadNetwork(unit.port, damage=trickle, piece_bytes=1448) as network:
        pull(network.address, here)
        # No chunk of 256 KiB comes within 0.3 s: smaller ones are asked for, and with those nothing is cut short.
        assert network.n_connections <= 8
        assert unit.confirmed == {RUN}
    assert hashes(here / RUN) == hashes(source)


def test_packets_that_are_delayed_reordered_lost_and_doubled(tmp_path, here):
    if shutil.which("unshare") is None or shutil.which("tc") is None:
        pytest.skip("needs unshare and tc (iproute2)")
    allowed = subprocess.run(["unshare", "-rn", "sh", "-c", NETEM], capture_output=True, text=True)
    if allowed.returncode:
        pytest.skip(f"no network namespace with netem here: {allowed.stderr.strip()[:200]}")
    source = make(tmp_path, 1 * KIB)
    code = IN_NAMESPACE.format(
        path=[p for p in sys.path if p], card=str(source.parent), here=str(here), run=RUN
    )
    done = subprocess.run(
        ["unshare", "-rn", "sh", "-c", f'{NETEM} && exec "$0" -c "$1"', sys.executable, code],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert hashes(here / RUN) == hashes(source)
