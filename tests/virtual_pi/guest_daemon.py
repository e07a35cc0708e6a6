"""The whole daemon on hardware inside the virtual Pi: armed, triggered by a pin, sampling a real bus.

There is no picamera2 here, so the camera is missing and the run says so; see guest_camera.py for it.
"""

import fcntl
import json
import math
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import guest_knobs
import numpy as np
import pytest

from bricktrack_common.errors import UnitError
from bricktrack_common.imu_records import ImuFlag, decode_imu, read_imu
from bricktrack_common.run_folder import read_edges
from bricktrack_common.run_manifest import read_manifest
from bricktrack_device.hardware.smbus_i2c import SmbusI2c
from bricktrack_host.transfer.unit_client import UnitClient

PORT = 41733
CONFIG = """
backend = "hardware"
unit.name = "virtual"
storage.folder = "/tmp/bricktrack"
storage.margin_mb = 1
server.port = {port}
camera.required = false
recording = {{duration_s = 3.0, pre_roll_s = 0.3, post_roll_s = 0.3}}
trigger = {{nominal_hz = 20.0, quiet_gap_ms = 100.0}}
[[imu]]
name = "brick"
bus = "/dev/i2c-1"
mode = "amg"
"""


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("etc") / "bricktrackd.toml"
    path.write_text(CONFIG.format(port=PORT))
    return path


@pytest.fixture
def unit(config, tmp_path):
    loopback_up()
    with (tmp_path / "log").open("w+") as log:
        daemon = subprocess.Popen(
            [sys.executable, "-m", "bricktrack_device.cli", "run", "--config", str(config)], stderr=log
        )
        client = UnitClient(f"tcp://127.0.0.1:{PORT}", timeout_s=30)
        try:
            client.hello()
            yield client
        finally:
            client.close()
            daemon.send_signal(signal.SIGTERM)
            code = daemon.wait(30)
            log.seek(0)
            print(log.read())
    assert code == 0


def loopback_up():
    """Do what ``ip link set lo up`` does (SIOCSIFFLAGS)."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        fcntl.ioctl(s, 0x8914, struct.pack("16sh", b"lo", 0x1 | 0x8 | 0x40))


def record(client, *, during=lambda: None):
    """Arm, drive a square wave, return the saved run and when its rises were written."""
    run_id = client.arm(patience_s=60).run_id
    time.sleep(0.3)
    wave = guest_knobs.square_wave(17, hz=20, n_periods=50)
    deadline = time.monotonic() + 5
    while client.status().state == "armed":
        assert time.monotonic() < deadline
        time.sleep(0.05)
    during()
    rises = guest_knobs.rises_of(wave)
    deadline = time.monotonic() + 30
    while client.status().state != "idle":
        assert time.monotonic() < deadline
        time.sleep(0.1)
    return Path("/tmp/bricktrack/runs", run_id), rises


def imu_of(folder):
    description, records, _ = read_imu(folder / "imu_brick.msgpack")
    return description, records, decode_imu(description, records)


def test_a_run_holds_the_kernels_edges_and_the_sensors_stated_motion(unit):
    folder, rises = record(unit)
    manifest = read_manifest(folder / "manifest.json")
    assert (manifest.state, manifest.simulated, manifest.camera) == ("complete", False, None)
    assert any("camera" in words and "picamera2" in words for words in manifest.missing)
    assert manifest.hardware["model"] == "Raspberry Pi (virtual)"
    assert manifest.hardware["library.lgpio"]

    edges_ns, _ = read_edges(folder / "edges.msgpack")
    assert manifest.trigger.t0_ns == edges_ns[0]
    assert len(edges_ns) == len(rises) == 50
    assert all(a - 1000 <= t <= b + 1000 for t, (a, b) in zip(edges_ns, rises, strict=True))

    description, records, samples = imu_of(folder)
    assert (description.opr_mode, description.acc_range_g) == (0x07, 16.0)
    usable = samples.flags & ~(ImuFlag.LATE | ImuFlag.REPEAT) == 0
    # One CPU under ptrace skips some slots; a Pi must not.
    assert len(records) > 250
    assert usable.sum() > 250
    # The emulator states its motion for its own 10 ms grid: the sample read at t was latched at most that
    # long before, and the read itself takes a few ms here.
    t_s = samples.t_ns[usable] / 1e9
    latched_s = np.floor(t_s * 100) / 100
    rate_dps = np.degrees(samples.gyro_radps[usable, 2])
    acc_x = samples.acc_mps2[usable, 0]
    steps = [latched_s + k * 0.01 for k in (-1, 0, 1)]
    rate_error = np.min([abs(rate_dps - 90 * math.pi * np.cos(math.pi * s)) for s in steps], axis=0)
    acc_error = np.min([abs(acc_x - 2 * np.sin(math.pi * s)) for s in steps], axis=0)
    assert np.percentile(rate_error, 99) < 0.2
    assert np.percentile(acc_error, 99) < 0.02
    assert samples.acc_mps2[usable, 2] == pytest.approx(9.80, abs=0.011)


def test_a_sensor_that_fails_in_a_run_leaves_gaps_with_their_errno(unit):
    def break_it():
        time.sleep(0.5)
        guest_knobs.set_sensor("fail_errno", 121)
        guest_knobs.set_sensor("fail_next", 5)
        time.sleep(0.5)
        guest_knobs.set_sensor("hang_next_ms", 150)

    folder, _ = record(unit, during=break_it)
    _, records, samples = imu_of(folder)
    errors = [r.errno for r in records if r.errno]
    assert errors.count(121) == 5
    assert errors.count(110) == 1
    # Every tenth slot reads the status too; a failure that hits that read leaves the slot's sample whole.
    whole = [r.slot for r in records if r.errno and r.data is not None]
    assert len(whole) <= 2
    assert all(slot % 10 == 0 for slot in whole)
    slots = [r.slot for r in records]
    assert slots == sorted(set(slots)), "the grid shifted"
    # Fifteen slots passed while the bus was stuck: they are gaps, and what follows is on the grid again.
    assert (samples.flags & ImuFlag.GAP != 0).sum() >= 3 + 14
    assert read_manifest(folder / "manifest.json").quality.imu_gaps >= 3 + 14


def test_a_silent_reset_is_flagged_and_not_believed(unit):
    def reset():
        time.sleep(0.8)
        bus = SmbusI2c("/dev/i2c-1")
        bus.writeto(0x28, bytes([0x3F, 0x20]))
        bus.close()

    folder, _ = record(unit, during=reset)
    _, records, samples = imu_of(folder)
    assert any(r.errno == 121 for r in records), "the chip does not answer while it resets"
    last = samples.flags[-1]
    assert last & (ImuFlag.MODE_CHANGED | ImuFlag.BLANK | ImuFlag.GAP)
    assert np.isnan(samples.acc_mps2[-1]).all()


def test_without_its_only_sensor_a_unit_refuses_to_arm_and_says_why(unit):
    guest_knobs.set_sensor("present", 0)
    try:
        with pytest.raises(UnitError, match=r"no sensor works.*IMU at I2C address 0x28"):
            unit.arm(patience_s=60)
    finally:
        guest_knobs.set_sensor("present", 1)


def test_check_names_what_is_wrong(config):
    done = subprocess.run(
        [sys.executable, "-m", "bricktrack_device.cli", "check", "--config", str(config), "--json"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    checks = {c["name"]: c for c in json.loads(done.stdout)["checks"]}
    assert checks["trigger"]["detail"] == "GPIO17 reads low through KernelStampFactory"
    assert checks["imu brick"]["ok"]
    assert "picamera2 is not installed" in checks["camera"]["detail"]
