"""A whole unit in the virtual Pi's camera root: camera, pins and bus through their real libraries at once.

One CPU under ptrace: this shows that the parts work together, and nothing about timing.
"""

import threading
import time
from pathlib import Path

import av
import guest_knobs
import numpy as np
import pytest
from guest_camera import camera
from guest_daemon import loopback_up

from bricktrack_common.run_folder import read_run
from bricktrack_device.config import load_config
from bricktrack_device.daemon import Daemon
from bricktrack_device.hardware.pi_rig import PiRig
from bricktrack_host.transfer.unit_client import UnitClient

CONFIG = """
backend = "hardware"
unit.name = "whole"
storage.folder = "{folder}"
storage.margin_mb = 1
server.port = 0
recording = {{duration_s = 3.0, pre_roll_s = 0.5, post_roll_s = 0.5}}
[[imu]]
name = "brick"
bus = "/dev/i2c-1"
"""


class VirtualCameraRig(PiRig):
    """The Pi's own rig, with the virtual sensor's modest picture."""

    def open_camera(self):
        return camera()


def test_one_run_holds_pictures_samples_and_edges_of_one_clock(tmp_path):
    loopback_up()
    (tmp_path / "config.toml").write_text(CONFIG.format(folder=tmp_path))
    config = load_config(tmp_path / "config.toml")
    daemon = Daemon(config, VirtualCameraRig(config))
    thread = threading.Thread(target=daemon.run)
    thread.start()
    deadline = time.monotonic() + 20
    while not daemon.port:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    client = UnitClient(f"tcp://127.0.0.1:{daemon.port}", timeout_s=60)
    try:
        run_id = client.arm(patience_s=90).run_id
        time.sleep(0.5)
        wave = guest_knobs.square_wave(17, hz=10, n_periods=20)
        rises = guest_knobs.rises_of(wave)
        deadline = time.monotonic() + 60
        while client.status().state != "idle":
            assert time.monotonic() < deadline
            time.sleep(0.2)
    finally:
        client.close()
        daemon.stop()
        thread.join(60)
    assert not thread.is_alive()

    run = read_run(Path(tmp_path, "runs", run_id), verify_hashes=True)
    assert run.manifest.state == "complete"
    assert not run.manifest.simulated
    assert run.manifest.hardware["library.picamera2"]
    assert run.manifest.hardware["library.libcamera"]
    assert run.manifest.camera.encoder == "libx264"
    assert run.manifest.camera.mode.name.endswith("-640x480-virtual")

    t0_ns = run.manifest.trigger.t0_ns
    assert len(run.edges_ns) == len(rises) == 20
    assert rises[0][0] - 1000 <= t0_ns <= rises[0][1] + 1000

    stamps_ns = run.frames.sensor_timestamp_ns
    assert np.all(np.diff(stamps_ns) > 0)
    assert stamps_ns[0] < t0_ns - 0.4e9
    assert stamps_ns[-1] > t0_ns + 2.5e9
    with av.open(str(run.video)) as container:
        n_pictures = sum(1 for _ in container.decode(video=0))
    assert n_pictures == len(stamps_ns) > 10

    _, samples = run.imus["brick"]
    assert np.isfinite(samples.acc_mps2[:, 2]).sum() > 20
    assert np.nanmedian(samples.acc_mps2[:, 2]) == pytest.approx(9.80, abs=0.011)
