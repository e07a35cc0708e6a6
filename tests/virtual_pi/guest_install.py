"""The install script and the service's user, inside the virtual Pi: its root is an overlay that vanishes."""

import json
import os
import pwd
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SYSTEMD = Path(__file__).resolve().parents[2] / "systemd"
BOOT = Path("/boot/firmware/config.txt")
BEFORE = "# as it came\n[pi4]\narm_boost=1\n"
UNIT = Path("/etc/systemd/system/bricktrackd.service")
CONFIG = Path("/etc/bricktrack/bricktrackd.toml")
OVERLAY = "dtoverlay=i2c-gpio,bus=3,i2c_gpio_sda=2,i2c_gpio_scl=3,i2c_gpio_delay_us=2"


def install(*arguments, code=0):
    done = subprocess.run(
        [str(SYSTEMD / "install.sh"), *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == code, f"{done.stdout}\n{done.stderr}"
    return done.stdout + done.stderr


def files_in(*folders):
    return {
        str(p): (p.read_bytes() if p.is_file() else b"", p.stat().st_mode, p.owner(), p.group())
        for folder in folders
        for p in [Path(folder), *Path(folder).rglob("*")]
        if p.exists()
    }


@pytest.fixture(scope="module", autouse=True)
def boot_config():
    BOOT.parent.mkdir(parents=True, exist_ok=True)
    BOOT.write_text(BEFORE)
    # What the virtual environment would put there.
    Path("/opt/bricktrack/bin").mkdir(parents=True)
    Path("/opt/bricktrack/bin/bricktrackd").symlink_to(Path(sys.executable).with_name("bricktrackd"))


def test_it_installs_and_says_which_lines_the_bus_needs():
    said = install("--no-apt", "--no-venv")
    assert OVERLAY in said
    assert BOOT.read_text() == BEFORE
    assert 'backend = "hardware"' in CONFIG.read_text()
    user = pwd.getpwnam("bricktrack")
    assert (user.pw_shell, user.pw_dir) == ("/usr/sbin/nologin", "/var/lib/bricktrack")
    groups = subprocess.run(["id", "-Gn", "bricktrack"], capture_output=True, text=True, check=True).stdout
    assert set(groups.split()) >= {"bricktrack", "video", "gpio", "i2c"}
    state = Path("/var/lib/bricktrack")
    assert (state.owner(), state.stat().st_mode & 0o777) == ("bricktrack", 0o750)
    assert (CONFIG.owner(), CONFIG.group(), CONFIG.stat().st_mode & 0o777) == ("root", "bricktrack", 0o640)


def test_a_second_run_changes_nothing_and_keeps_an_edited_configuration():
    CONFIG.write_text(CONFIG.read_text().replace('name = "unit"', 'name = "north-3"'))
    before = files_in("/etc/bricktrack", "/etc/systemd/system", "/etc/sysusers.d", "/boot/firmware")
    install("--no-apt", "--no-venv")
    assert files_in("/etc/bricktrack", "/etc/systemd/system", "/etc/sysusers.d", "/boot/firmware") == before


def test_the_bus_is_enabled_once_and_only_when_asked_for():
    for _ in range(2):
        install("--no-apt", "--no-venv", "--enable-i2c-gpio")
        assert BOOT.read_text() == (
            BEFORE + f"# bricktrack: begin\n[all]\ndtparam=i2c_arm=off\n{OVERLAY}\n# bricktrack: end\n"
        )


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_systemd_finds_no_fault_in_the_unit():
    done = subprocess.run(
        ["systemd-analyze", "verify", str(UNIT)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


def test_the_services_user_reaches_the_hardware_and_a_fixed_priority():
    # The owners that the udev rules of Raspberry Pi OS give these nodes.
    for pattern, group in (("gpiochip*", "gpio"), ("i2c-*", "i2c")):
        for node in Path("/dev").glob(pattern):
            shutil.chown(node, group=group)
            node.chmod(0o660)
    CONFIG.write_text(CONFIG.read_text().replace("/dev/i2c-3", "/dev/i2c-1"))
    as_the_service = [
        "setpriv", "--reuid=bricktrack", "--regid=bricktrack", "--init-groups", "--no-new-privs",
        "--inh-caps=-all,+sys_nice", "--ambient-caps=-all,+sys_nice", "--bounding-set=-all,+sys_nice",
    ]  # fmt: skip
    done = subprocess.run(
        [*as_the_service, "/opt/bricktrack/bin/bricktrackd", "check", "--config", str(CONFIG), "--json"],
        cwd="/var/lib/bricktrack", env=os.environ | {"HOME": "/nonexistent"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    checks = {c["name"]: c for c in json.loads(done.stdout)["checks"]}
    assert checks["trigger"]["ok"], checks["trigger"]
    assert checks["imu brick"]["ok"], checks["imu brick"]
    assert checks["storage"]["name"] == "storage"
    code = (
        "from bricktrack_device.config import SamplerTable\n"
        "from bricktrack_device.inertial.imu_sampler import ask_for_realtime\n"
        "print(ask_for_realtime(SamplerTable(cpu=-1, lock_memory=True)))"
    )
    granted = subprocess.run(
        ["prlimit", "--rtprio=60", "--memlock=unlimited", *as_the_service, sys.executable, "-c", code],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    assert granted.strip() == "SCHED_FIFO 50, memory locked"


def test_uninstalling_leaves_runs_and_configuration_and_purging_leaves_nothing():
    run = Path("/var/lib/bricktrack/runs/a/manifest.json")
    run.parent.mkdir(parents=True, exist_ok=True)
    run.write_text("{}")
    install("--uninstall")
    assert not UNIT.exists()
    assert not Path("/opt/bricktrack").exists()
    assert BOOT.read_text() == BEFORE
    assert run.exists()
    assert CONFIG.exists()
    install("--uninstall")
    install("--uninstall", "--purge")
    assert not run.exists()
    assert not CONFIG.parent.exists()
    with pytest.raises(KeyError):
        pwd.getpwnam("bricktrack")


def test_wrong_use_is_refused():
    assert "unknown option --frobnicate" in install("--frobnicate", code=2)
    assert "--purge goes with --uninstall" in install("--purge", code=2)
    assert "sudo systemd/install.sh" in install("--help")
