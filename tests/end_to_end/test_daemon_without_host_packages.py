"""The daemon, its samplers and its simulation start and record where no OpenCV and no SciPy is installed."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bricktrack_common.run_manifest import read_manifest

pytestmark = pytest.mark.slow

FORBIDDEN = ("cv2", "scipy", "matplotlib", "pandas", "pyarrow", "jinja2", "bricktrack_host")
# Python imports this module at its start, in the samplers' processes too.
SITE = f"""
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {FORBIDDEN!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}} (kept away by a test)", name=name)
        return None

sys.meta_path.insert(0, Absent())
"""
CONFIG = """
backend = "sim"
server.port = 0
storage = {{folder = "{storage}", margin_mb = 1}}
recording = {{duration_s = 0.5, pre_roll_s = 0.1, post_roll_s = 0.1, auto_arm = true}}
sampler = {{priority = 0, lock_memory = false}}
sim = {{shake_delay_s = 0.2}}
imu = [{{name = "brick"}}]
"""


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    site = tmp_path / "site"
    site.mkdir()
    (site / "sitecustomize.py").write_text(SITE)
    return os.environ | {"PYTHONPATH": str(site)}


def test_the_packages_are_kept_away(environment: dict[str, str]) -> None:
    for name in ("cv2", "scipy.spatial"):
        done = subprocess.run(
            [sys.executable, "-c", f"import {name}"], env=environment, capture_output=True, text=True, check=False
        )  # fmt: skip
        assert done.returncode == 1 and "kept away by a test" in done.stderr


def test_the_daemon_starts_records_and_ends_without_them(tmp_path: Path, environment: dict[str, str]) -> None:
    storage, config, log = tmp_path / "card", tmp_path / "unit.toml", tmp_path / "log"
    config.write_text(CONFIG.format(storage=storage))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel, log.open("wb") as stderr:
        name = f"@bricktrack-imports-{os.getpid()}"
        channel.bind("\0" + name[1:])
        channel.settimeout(30)
        daemon = subprocess.Popen(
            [sys.executable, "-m", "bricktrack_device.cli", "run", "--config", str(config)],
            env=environment | {"NOTIFY_SOCKET": name},
            stderr=stderr,
        )
        try:
            while (told := channel.recv(200)).startswith(b"STATUS="):
                pass
            assert told == b"READY=1"
            deadline = time.monotonic() + 40
            while not (manifests := list(storage.glob("runs/*[0-9]/manifest.json"))):
                assert time.monotonic() < deadline and daemon.poll() is None, log.read_text()
                time.sleep(0.05)
        finally:
            daemon.send_signal(signal.SIGTERM)
            code = daemon.wait(30)
    assert code == 0, log.read_text()
    manifest = read_manifest(manifests[0])
    assert manifest.state == "complete" and manifest.quality.frames > 5 and manifest.quality.imu_slots > 50
    assert [i.name for i in manifest.imus] == ["brick"] and not any("imu" in m for m in manifest.missing)
