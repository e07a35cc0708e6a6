"""The real daemon as a process on the simulated rig: armed over its socket, a whole run folder comes out."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zmq

from bricktrack_common.run_folder import read_run
from bricktrack_common.wire_codec import decode_reply, encode_message
from bricktrack_common.wire_messages import Arm, Armed, GetStatus, Reply, Request, StatusReply

PATIENCE_S = 120.0
"""For a computer that does much else; what works comes far sooner."""
CONFIG = """
[storage]
margin_mb = 1
# A simulated picture costs some 30 ms of a core: this rate is kept beside much other work.
[camera]
frame_rate_hz = 5.0
iperiod = 4
[recording]
duration_s = 1.5
pre_roll_s = 0.3
post_roll_s = 0.2
"""


class Process:
    """bricktrackd, its log, and a host's socket."""

    def __init__(self, folder: Path) -> None:
        config = folder / "unit.toml"
        config.write_text(CONFIG)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "bricktrack_device.cli", "run", "--backend", "sim", "--config", config,
             "--storage", folder / "storage", "--port", "0", "--unit", "unit-7"],
            # These tests may run under nohup, and a daemon that does outlives its terminal.
            preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
            start_new_session=True, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        self.log: list[str] = []
        self._reader = threading.Thread(target=self._read_log)
        self._reader.start()
        self._ids = iter(range(1, 10**6))
        self.context = zmq.Context()
        self.socket = self.context.socket(zmq.DEALER)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.connect(f"tcp://127.0.0.1:{self._wait_for_port()}")

    def _read_log(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.log.append(line.rstrip())

    def _wait_for_port(self) -> int:
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline and self.process.poll() is None:
            found = re.search(r"serves on \S+ port (\d+)", "\n".join(self.log))
            if found:
                return int(found.group(1))
            time.sleep(0.02)
        self.process.kill()
        raise AssertionError("\n".join(self.log))

    def ask(self, request: Request, timeout_ms: int = round(1000 * PATIENCE_S)) -> Reply:
        wanted = next(self._ids)
        self.socket.send(encode_message(wanted, request))
        assert self.socket.poll(timeout_ms), f"no reply to {request}\n" + "\n".join(self.log)
        got, reply = decode_reply(self.socket.recv())
        assert got == wanted
        return reply

    def status(self) -> StatusReply:
        reply = self.ask(GetStatus())
        assert isinstance(reply, StatusReply)
        return reply

    def wait_for(self, state: str, timeout_s: float = PATIENCE_S) -> None:
        deadline = time.monotonic() + timeout_s
        while (status := self.status()).state != state:
            assert time.monotonic() < deadline, f"{status}\n" + "\n".join(self.log)
            time.sleep(0.05)

    def end(self, number: signal.Signals = signal.SIGTERM) -> int:
        if number == signal.SIGHUP:
            os.killpg(self.process.pid, number)  # as a terminal that goes: the samplers get it, too
        else:
            self.process.send_signal(number)
        code = self.process.wait(timeout=PATIENCE_S)
        self._reader.join()
        return code

    def close(self) -> None:
        self.socket.close()
        self.context.term()
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self._reader.join()
        if self.process.stderr is not None:
            self.process.stderr.close()


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Process]:
    made = Process(tmp_path)
    yield made
    made.close()


@pytest.mark.slow
def test_a_short_run_comes_out_whole(daemon: Process, tmp_path: Path) -> None:
    armed = daemon.ask(Arm(label="short"))
    assert isinstance(armed, Armed) and armed.missing == [], "\n".join(daemon.log)
    daemon.wait_for("recording")
    daemon.wait_for("idle")
    assert daemon.end() == 0
    run = read_run(tmp_path / "storage" / "runs" / armed.run_id, verify_hashes=True)
    m = run.manifest
    assert m.state == "complete" and m.simulated and m.unit == "unit-7" and run.problems == []
    assert m.window_ns is not None and m.window_ns[1] - m.window_ns[0] == 2_000_000_000
    assert run.frames is not None and run.video is not None and m.camera is not None
    expected = 2_000_000 / m.camera.frame_duration_us
    # A busy machine may lose simulated frames; the gaps are then told, not hidden.
    assert run.frames.n_frames + m.quality.frames_dropped >= expected - 1
    assert run.frames.sensor_timestamp_ns[0] <= m.window_ns[0]
    assert run.edges_ns.size > 2 and run.edges_ns[0] == m.trigger.t0_ns
    description, samples = run.imus["brick"]
    assert description.opr_mode == 0x07 and m.quality.imu_slots in (200, 201)
    assert np.isfinite(samples.acc_mps2).all(axis=1).sum() > 150
    changes = [line for line in daemon.log if " -> " in line]
    assert [re.search(r"(\w+) -> (\w+)", c).group(2) for c in changes] == [  # type: ignore[union-attr]
        "armed", "recording", "saving", "idle",
    ]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_during_a_recording_saves_it_as_interrupted(
    daemon: Process, tmp_path: Path, number: signal.Signals
) -> None:
    armed = daemon.ask(Arm(label="cut", duration_s=60.0))
    assert isinstance(armed, Armed)
    daemon.wait_for("recording")
    n_frames = daemon.status().frames
    while daemon.status().frames < n_frames + 12:
        time.sleep(0.05)
    assert daemon.end(number) == 0
    run = read_run(tmp_path / "storage" / "runs" / armed.run_id, verify_hashes=True)
    assert run.manifest.state == "interrupted" and run.frames is not None and run.frames.n_frames > 5
    assert any("the daemon was stopped" in words for words in run.manifest.missing)
    assert not any("died" in words for words in run.manifest.missing)  # samplers end when they are told
