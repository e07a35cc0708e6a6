"""The service under a real systemd, inside the virtual Pi: ready, confined, watched, started anew.

systemd runs as PID 1 of a namespace of its own, from the unit file as it is installed, on the emulated pins and
bus. There is no picamera2 here, so the camera fails its self-test, and no seccomp in this kernel.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import guest_knobs
import pytest

from bricktrack_common.run_manifest import read_manifest

REPOSITORY = Path(__file__).resolve().parents[2]
SYSTEMD = Path("/lib/systemd/systemd")
CONFIG = Path("/etc/bricktrack/bricktrackd.toml")
DROP_IN = Path("/etc/systemd/system/bricktrackd.service.d/virtual-pi.conf")
BOARD = Path("/opt/virtual-pi-cpuinfo")
HIDDEN_FROM_THE_UNIT = ("root", "home", "tmp")  # ProtectHome= and PrivateTmp=
RUNS = Path("/var/lib/bricktrack/runs")
WATCHDOG_S = 10  # WatchdogSec= of the unit
# A copy of the run lacks what is still under way, 0.3 s: the first one has samples if it looks back further.
SETTINGS = """
backend = "hardware"
unit.name = "virtual"
storage.margin_mb = 1
camera.required = false
recording = {duration_s = 1.0, pre_roll_s = 0.4, post_roll_s = 0.2, auto_arm = true}
trigger = {nominal_hz = 20.0, quiet_gap_ms = 100.0}
[[imu]]
name = "brick"
bus = "/dev/i2c-1"
"""

pytestmark = pytest.mark.skipif(not SYSTEMD.exists(), reason="needs systemd")


class Manager:
    """A systemd of our own, and its systemctl."""

    def __init__(self) -> None:
        # A target without dependencies: nothing of this machine's services is started.
        Path("/etc/systemd/system/nothing.target").write_text(
            "[Unit]\nDefaultDependencies=no\nAllowIsolate=yes\n"
        )
        subprocess.run(["mount", "-t", "cgroup2", "none", "/sys/fs/cgroup"], check=True)
        self.process = subprocess.Popen(
            ["unshare", "--pid", "--fork", "--mount", "--mount-proc", "env", "container=virtual-pi", str(SYSTEMD),
             "--system", "--unit=nothing.target", "--log-target=kmsg"],
        )  # fmt: skip
        deadline = time.monotonic() + 60
        while not Path("/run/systemd/private").exists():
            assert time.monotonic() < deadline and self.process.poll() is None
            time.sleep(0.1)
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        self.inside = ["nsenter", "-t", children[0], "-p", "-m", "-r", "-w"]

    def run(self, *command: str, code: int = 0) -> str:
        # The virtual Pi's root is a chroot, in which systemctl would do nothing.
        done = subprocess.run(
            [*self.inside, *command], env=os.environ | {"SYSTEMD_IGNORE_CHROOT": "1"},
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == code, f"{command}: {done.stdout}\n{done.stderr}\n{self.log()}"
        return done.stdout

    def show(self, name: str) -> str:
        return self.run("systemctl", "show", "bricktrackd", "--value", "--property", name).strip()

    def main_pid(self) -> int:
        """Return the daemon's process id out here."""
        inner = self.show("MainPID")
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                ids = (folder / "status").read_text().split("NSpid:")[1].splitlines()[0].split()
            except (OSError, IndexError):
                continue
            if len(ids) == 2 and ids[1] == inner:
                return int(ids[0])
        raise AssertionError(f"no process {inner}: {self.log()}")

    def log(self) -> str:
        """Return the journal of the service and of systemd about it."""
        done = subprocess.run(
            [*self.inside, "journalctl", "-o", "short-monotonic", "--no-pager", "-u", "bricktrackd"],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        kernel = subprocess.run(["dmesg"], capture_output=True, text=True, check=False).stdout.splitlines()
        told = "\n".join(line for line in kernel if "bricktrackd" in line)
        return f"{done.stdout}{done.stderr}\n{told}"

    def log_once_it_says(self, words: str, timeout_s: float = 60.0) -> str:
        """Return the journal when it holds certain words: it lags behind what happens."""
        deadline = time.monotonic() + timeout_s
        while words not in (log := self.log()):
            assert time.monotonic() < deadline, f"no {words!r} in the journal\n{log}"
            time.sleep(0.25)
        return log

    def wait_for(self, name: str, value: str, timeout_s: float = 60.0) -> None:
        deadline = time.monotonic() + timeout_s
        while (now := self.show(name)) != value:
            assert time.monotonic() < deadline, f"{name} is {now!r}; expected {value!r}\n{self.log()}"
            time.sleep(0.25)


@pytest.fixture(scope="module")
def manager():
    Path("/opt/bricktrack/bin").mkdir(parents=True)
    Path("/opt/bricktrack/bin/bricktrackd").symlink_to(Path(sys.executable).with_name("bricktrackd"))
    subprocess.run(
        [str(REPOSITORY / "systemd/install.sh"), "--no-apt", "--no-venv"], check=True, capture_output=True
    )
    CONFIG.write_text(SETTINGS)
    # The owners that the udev rules of Raspberry Pi OS give these nodes.
    for pattern, group in (("gpiochip*", "gpio"), ("i2c-*", "i2c")):
        for node in Path("/dev").glob(pattern):
            shutil.chown(node, group=group)
            node.chmod(0o660)
    # What differs from a unit: a Python that may live in a home or in /tmp, and a board that is told by a file.
    shutil.copy("/proc/cpuinfo", BOARD)
    binds = [f"{BOARD}:/proc/cpuinfo"]
    binds += [str(p) for p in (Path(sys.base_prefix), REPOSITORY) if p.parts[1] in HIDDEN_FROM_THE_UNIT]
    DROP_IN.parent.mkdir()
    DROP_IN.write_text(f"[Service]\nProtectHome=tmpfs\nBindReadOnlyPaths={' '.join(binds)}\n")
    # Or the kernel drops lines of systemd's when it says many at once.
    Path("/proc/sys/kernel/printk_devkmsg").write_text("on\n")
    made = Manager()
    began = time.monotonic()
    made.run("systemctl", "start", "bricktrackd")
    print(f"ready {time.monotonic() - began:.1f} s after systemctl start")
    yield made
    print(made.log())
    made.process.kill()
    made.process.wait()


def test_it_is_ready_once_the_self_test_has_told_what_works(manager):
    assert (manager.show("ActiveState"), manager.show("SubState")) == ("active", "running")
    log = manager.log_once_it_says("Started")
    failed = [line for line in log.splitlines() if "health: self-test" in line]
    assert len(failed) == 1 and "self-test: camera" in failed[0] and "picamera2" in failed[0], log
    ready = next(i for i, line in enumerate(log.splitlines()) if "Started" in line)
    assert log.splitlines().index(failed[0]) < ready, log


def test_it_runs_as_its_user_with_one_capability_and_sees_a_read_only_system(manager):
    pid = manager.main_pid()
    status = dict(
        line.split(":\t", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if ":\t" in line
    )
    assert Path(f"/proc/{pid}").owner() == "bricktrack"
    assert status["NoNewPrivs"] == "1"
    assert int(status["CapBnd"], 16) == int(status["CapEff"], 16) == 1 << 23  # CAP_SYS_NICE
    for path, fails in (("/etc/x", True), ("/usr/x", True), ("/var/lib/bricktrack/x", False)):
        done = subprocess.run(
            ["nsenter", "-t", str(pid), "-m", "-r", "touch", path], capture_output=True, check=False
        )
        assert (done.returncode != 0) == fails, (path, done.stderr)


def test_it_arms_itself_samples_in_real_time_and_saves_a_run(manager):
    manager.wait_for("StatusText", "armed")
    tasks = Path(f"/proc/{manager.main_pid()}/task").glob("*/children")
    children = [int(child) for path in tasks for child in path.read_text().split()]
    samplers = [c for c in children if os.sched_getscheduler(c) == os.SCHED_FIFO]
    assert len(samplers) == 1 and os.sched_getparam(samplers[0]).sched_priority == 50
    time.sleep(0.3)
    guest_knobs.rises_of(guest_knobs.square_wave(17, hz=20, n_periods=30))
    deadline = time.monotonic() + 30
    while not list(RUNS.glob("*/manifest.json")):
        assert time.monotonic() < deadline, manager.log()
        time.sleep(0.2)
    manifest = read_manifest(next(RUNS.glob("*/manifest.json")))
    assert (manifest.state, manifest.simulated) == ("complete", False)
    assert manifest.quality.edges > 15 and manifest.quality.imu_slots in (160, 161)


def test_progress_feeds_the_watchdog(manager):
    pid = manager.show("MainPID")
    time.sleep(1.5 * WATCHDOG_S)
    assert (manager.show("MainPID"), manager.show("NRestarts")) == (pid, "0")


def test_a_daemon_that_hangs_is_ended_by_the_watchdog_and_started_anew(manager):
    before = {p: p.read_bytes() for p in RUNS.glob("*/manifest.json")}
    pid = manager.show("MainPID")
    os.kill(manager.main_pid(), signal.SIGSTOP)
    manager.wait_for("NRestarts", "1", timeout_s=4 * WATCHDOG_S)
    manager.wait_for("ActiveState", "active")
    assert manager.show("MainPID") != pid
    assert "Watchdog timeout" in manager.log()
    manager.wait_for("StatusText", "armed")
    assert before and {p: p.read_bytes() for p in before} == before


def test_a_daemon_that_is_killed_while_it_records_is_started_anew_and_has_the_run(manager):
    before = set(RUNS.iterdir())
    pid = manager.main_pid()
    in_memory = Path(f"/proc/{pid}/root/run/bricktrack/black-box")
    time.sleep(0.3)
    wave = guest_knobs.square_wave(17, hz=20, n_periods=30)
    deadline = time.monotonic() + 30
    while not list(in_memory.glob("*/edges.msgpack")):
        assert time.monotonic() < deadline, manager.log()
        time.sleep(0.02)
    os.kill(pid, signal.SIGKILL)
    guest_knobs.rises_of(wave)
    manager.wait_for("NRestarts", "2")
    manager.wait_for("ActiveState", "active")
    manager.wait_for("StatusText", "armed")
    (folder,) = set(RUNS.iterdir()) - before
    manifest = read_manifest(folder / "manifest.json")
    assert manifest.state == "interrupted" and manifest.trigger.t0_ns is not None
    assert any("the daemon was killed" in words for words in manifest.missing), manifest.missing
    assert manifest.quality.edges > 0 and manifest.quality.imu_slots > 0


def test_stopping_it_is_clean_and_no_failure(manager):
    manager.run("systemctl", "stop", "bricktrackd")
    assert (manager.show("ActiveState"), manager.show("Result")) == ("inactive", "success")
    assert manager.show("ExecMainStatus") == "0"
    assert "stopping" in manager.log()
    states = {json.loads(p.read_text())["state"] for p in RUNS.glob("*/manifest.json")}
    assert states == {"complete", "interrupted"} and not list(RUNS.glob("*.partial"))
