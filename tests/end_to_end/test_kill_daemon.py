"""kill -9 at any instant: no run is lost or altered, none is left unmarked, and the unit comes back.

``BRICKTRACK_KILLS`` says how often the daemon is killed; 6 by default.
"""

import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from bricktrack_common.checksums import sha256_file
from bricktrack_common.run_folder import read_run

KILLS = int(os.environ.get("BRICKTRACK_KILLS", "6"))
SUPPORT = Path(__file__).parents[1] / "support"
READY_TIMEOUT_S = 20.0
"""Far above the few seconds that a start takes, for busy machines; the slowest is printed."""

pytestmark = pytest.mark.slow


class Unit:
    """One life of the daemon after the other, on one card."""

    def __init__(self, folder: Path) -> None:
        self.storage = folder / "card"
        self.runs = self.storage / "runs"
        self.black_box = folder / "memory"
        self.log = folder / "log"
        self._mark = f"{folder}-{os.getpid()}"
        self._channel = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket_path = f"@bricktrack-kill-{os.getpid()}"
        self._channel.bind("\0" + self._socket_path[1:])
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> float:
        """Start the daemon; return after how many seconds it said that it is ready."""
        began = time.monotonic()
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, str(SUPPORT / "light_unit.py"), str(self.storage), "--black-box",
                 str(self.black_box)],
                stderr=log,
                env=os.environ
                | {"NOTIFY_SOCKET": self._socket_path, "BRICKTRACK_TEST_MARK": self._mark, "PYTHONPATH":
                   os.pathsep.join([str(SUPPORT), os.environ.get("PYTHONPATH", "")])},
            )  # fmt: skip
        self._channel.settimeout(READY_TIMEOUT_S)
        while self._channel.recv(4096) != b"READY=1":
            pass
        return time.monotonic() - began

    def kill(self) -> None:
        assert self.process is not None and self.process.poll() is None, self.log.read_text()
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        self._channel.setblocking(False)
        try:
            while self._channel.recv(4096):
                pass
        except BlockingIOError:
            pass

    def wait_for(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + READY_TIMEOUT_S
        while not condition():
            assert time.monotonic() < deadline, f"{what} did not come:\n{self.log.read_text()}"
            time.sleep(0.001)

    def says(self, words: str) -> bool:
        return words.encode() in self.log.read_bytes()

    def whole_runs(self) -> dict[str, dict[str, str]]:
        """Return the hash of every file of every run that stands under its final name."""
        folders = [f for f in self.runs.iterdir() if not f.name.endswith(".partial")]
        return {f.name: {p.name: sha256_file(p) for p in sorted(f.iterdir())} for f in folders}

    def partial_runs(self) -> list[str]:
        return [f.name for f in self.runs.glob("*.partial")]

    def copies(self) -> list[str]:
        """Return the runs of which there is a copy in memory."""
        return [p.parent.name for p in self.black_box.glob("*/draft.json")]

    def survivors(self) -> list[int]:
        """Return processes of the daemon that are still there: a sampler must not outlive it."""
        found = []
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                if f"BRICKTRACK_TEST_MARK={self._mark}".encode() in (folder / "environ").read_bytes():
                    found.append(int(folder.name))
            except OSError:
                continue
        return found

    def close(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self._channel.close()


@pytest.fixture
def unit(tmp_path: Path) -> Iterator[Unit]:
    unit = Unit(tmp_path)
    yield unit
    unit.close()


def wait_for_phase(unit: Unit, phase: str, rng: random.Random) -> None:
    """Wait for a random instant within a phase of the unit's cycle."""
    if phase == "arming":
        time.sleep(rng.uniform(0.0, 1.0))
    elif phase == "recording":
        unit.wait_for(lambda: bool(unit.copies()), "the recording")
        time.sleep(rng.uniform(0.0, 0.6))
    elif phase == "saving":
        unit.wait_for(lambda: bool(unit.partial_runs()), "the saving")
        time.sleep(rng.uniform(0.0, 0.025))
    else:
        time.sleep(rng.uniform(0.0, 4.0))


def test_kill_9_at_any_instant_loses_no_run_and_leaves_no_unmarked_one(unit: Unit) -> None:
    rng = random.Random(2026)
    kept: dict[str, dict[str, str]] = {}
    seen: Counter[str] = Counter()
    slowest_ready_s = unit.start()
    for n in range(KILLS):
        wait_for_phase(unit, ("saving", "recording", "arming", "any")[n % 4], rng)
        unit.kill()
        whole, partial, copies = unit.whole_runs(), unit.partial_runs(), unit.copies()
        for run_id, hashes in kept.items():
            assert whole.get(run_id) == hashes, f"kill {n}: {run_id} was lost or altered"
        for run_id in whole.keys() - kept.keys():
            run = read_run(unit.runs / run_id, verify_hashes=True)
            assert run.manifest.state == "complete" and run.problems == [], f"kill {n}: {run_id}"
            seen["saved before the kill"] += 1
        assert len(partial) <= 1, f"kill {n}: {partial}"
        seen[
            "killed while saving" if partial else "with a copy in memory" if copies else "killed otherwise"
        ] += 1

        slowest_ready_s = max(slowest_ready_s, unit.start())
        kept = whole
        for run_id in {name.removesuffix(".partial") for name in partial} | set(copies) - whole.keys():
            assert not (unit.runs / f"{run_id}.partial").exists(), f"kill {n}: {run_id} was not recovered"
            run = read_run(unit.runs / run_id, verify_hashes=True)
            if run.manifest.state == "interrupted":
                assert any("cut off" in words for words in run.manifest.missing), f"kill {n}: {run_id}"
            else:
                assert run.problems == [], f"kill {n}: {run_id}"
            seen[f"recovered as {run.manifest.state}"] += 1
            kept[run_id] = unit.whole_runs()[run_id]
    unit.kill()
    unit.wait_for(lambda: not unit.survivors(), "the samplers' end")
    assert seen["killed while saving"] >= KILLS // 8  # the hardest instants were met
    assert seen["with a copy in memory"] >= KILLS // 8
    assert slowest_ready_s < READY_TIMEOUT_S
    print(f"\n{KILLS} kills; slowest start {slowest_ready_s:.1f} s; {dict(seen)}")
