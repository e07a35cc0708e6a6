"""How fast one run comes over loopback, beside ``cp`` and a plain TCP copy of the same file.

A real daemon (simulated sensors) in its own process serves a run with one large file; the host's own pull brings
it: chunks with checksums, a journal of what is on the disk, the file's hash, and names that survive a power cut.
The peers do less: ``cp`` with a sync, one TCP connection with a sync, and the latter with the SHA-256 that tells
whether the copy is right. All take turns in one run, on one disk; a ratio is the peer's time by the pull's, so
that 0.5 is half the peer's speed.

    python scripts/bench_transfer.py --megabytes 200 --repeats 5
"""

import argparse
import contextlib
import hashlib
import os
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests" / "support"))

from light_unit import LightUnit, make_keys  # noqa: E402 (the tests' support is no package)
from run_folders import make_run  # noqa: E402

from bricktrack_host.transfer.chunk_reads import CHUNK_BYTES  # noqa: E402
from bricktrack_host.transfer.run_transfer import pull_run  # noqa: E402
from bricktrack_host.transfer.unit_client import UnitClient  # noqa: E402

MB = 1_000_000
RUN = "light_0001"
PULL = "pull"
LOCKED = "pull with CURVE"
TCP_SENDER = (
    "import socket, sys\n"
    "server = socket.create_server(('127.0.0.1', 0))\n"
    "print(server.getsockname()[1], flush=True)\n"
    "while True:\n"
    "    peer, _ = server.accept()\n"
    "    with peer, open(sys.argv[1], 'rb') as file:\n"
    "        peer.sendfile(file)\n"
)


@contextlib.contextmanager
def tcp_sender(path: Path) -> Iterator[int]:
    """Send a file to whoever connects, from another process; yield the port."""
    process = subprocess.Popen(
        [sys.executable, "-c", TCP_SENDER, str(path)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None  # noqa: S101 (it was asked for)
        yield int(process.stdout.readline())
    finally:
        process.kill()
        process.communicate()


def copy_by_cp(source: Path, target: Path) -> None:
    subprocess.run(["cp", source, target], check=True)
    with target.open("rb+") as file:
        os.fsync(file.fileno())


def copy_by_tcp(port: int, target: Path, *, sha256: bool) -> None:
    buffer = memoryview(bytearray(256 * 1024))
    digest = hashlib.sha256()
    with socket.create_connection(("127.0.0.1", port)) as peer, target.open("wb", buffering=0) as file:
        while n := peer.recv_into(buffer):
            file.write(buffer[:n])
            if sha256:
                digest.update(buffer[:n])
        os.fsync(file.fileno())


def read_all(address: str, n_bytes: int) -> None:
    """Let chunks come, checked as in a pull, and forget them: no disk, no hash, no journal."""
    ranges = [(at, min(CHUNK_BYTES, n_bytes - at)) for at in range(0, n_bytes, CHUNK_BYTES)]
    with UnitClient(address) as client:
        for _ in client.read_chunks(RUN, 1, ranges):
            pass


def seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--megabytes", type=int, default=200)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument(
        "--folder", type=Path, help="on the disk to be measured [default: the temporary folder]"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="bench-transfer-", dir=options.folder) as name:
        measure(Path(name), options.megabytes * MB, options.repeats)


def measure(folder: Path, n_bytes: int, repeats: int) -> None:
    source = make_run(folder / "card" / "runs", RUN, {"video.h264": n_bytes}, unit="light") / "video.h264"
    here = folder / "here"
    here.mkdir()
    times: dict[str, list[float]] = {}
    unit_keys, own_keys = make_keys(folder / "keys")
    shutil.copytree(folder / "card", folder / "card-2")
    with (
        LightUnit(folder / "card") as unit,
        LightUnit(folder / "card-2", keys=folder / "keys") as locked,
        tcp_sender(source) as port,
    ):
        ways: dict[str, Callable[[], object]] = {
            PULL: lambda: pull_run(lambda: UnitClient(unit.address), RUN, here),
            LOCKED: lambda: pull_run(
                lambda: UnitClient(locked.address, server_key=unit_keys.public, own_keys=own_keys), RUN, here
            ),
            "the transfer alone": lambda: read_all(unit.address, n_bytes),
            "cp, synced": lambda: copy_by_cp(source, here / "cp"),
            "TCP, synced": lambda: copy_by_tcp(port, here / "tcp", sha256=False),
            "TCP, synced and hashed": lambda: copy_by_tcp(port, here / "tcp", sha256=True),
        }
        for _ in range(repeats):
            for way, work in ways.items():
                times.setdefault(way, []).append(seconds(work))
                for path in here.iterdir():
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
    print(f"{n_bytes / MB:.0f} MB over loopback, {repeats} turns (simulated unit, one machine):")
    print(f"{'':26}{'best':>7}{'median':>8}   speed of the pull, best by best and median turn by turn")
    for way, spent in times.items():
        # Other work on the machine only adds time: the best turn is nearest to what the way itself takes.
        best = min(spent) / min(times[PULL])
        usual = statistics.median(peer / own for peer, own in zip(spent, times[PULL], strict=True))
        speeds = [n_bytes / MB / s for s in (min(spent), statistics.median(spent))]
        words = "" if way == PULL else f"   {best:.2f}, {usual:.2f}"
        print(f"  {way:24}{speeds[0]:7.0f}{speeds[1]:8.0f} MB/s{words}")
    more_s = min(times[LOCKED]) - min(times[PULL])
    print(f"CURVE costs {1e3 * more_s / (n_bytes / MB):.2f} ms for each MB")


if __name__ == "__main__":
    main()
