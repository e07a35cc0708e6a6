"""The hardware modules, unmodified, under the real libraries and a real kernel.

Each ``guest_*.py`` is a set of tests that runs inside the virtual Pi; here they are booted and reported.
"""

import re
from pathlib import Path

import pytest

HERE = Path(__file__).parent

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    "name", ["guest_pins", "guest_trigger", "guest_bus", "guest_subdev", "guest_daemon", "guest_install"]
)
def test_inside(guest, name):
    arguments = ["-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", "/dev/null", "--rootdir", str(HERE)]
    done = guest([*arguments, "-W", "error", str(HERE / f"{name}.py")])
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    assert re.search(r"\d+ passed", done.stdout), done.stdout


def test_the_contract_suite_on_the_emulated_bus(guest, tmp_path):
    config = tmp_path / "bricktrackd.toml"
    config.write_text('backend = "hardware"\n[[imu]]\nname = "brick"\nbus = "/dev/i2c-1"\n')
    suite = str(HERE.parent / "contract/test_rig_contract.py")
    arguments = ["-m", "pytest", "-q", "-p", "no:cacheprovider", suite, "-k", "hardware and I2cBus"]
    done = guest([*arguments, "--rig", str(config)], options=["--share", str(tmp_path)])
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    assert re.search(r"\d+ passed", done.stdout), done.stdout


@pytest.mark.skipif(not Path("/lib/systemd/systemd").exists(), reason="needs systemd, to boot it in there")
def test_the_service_under_a_real_systemd(guest):
    arguments = [
        "-m",
        "pytest",
        "-q",
        "-s",
        "-p",
        "no:cacheprovider",
        "-c",
        "/dev/null",
        "--rootdir",
        str(HERE),
    ]
    done = guest([*arguments, "-W", "error", str(HERE / "guest_systemd.py")], timeout_s=400)
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    assert re.search(r"\d+ passed", done.stdout), done.stdout
    print(done.stdout)  # the journal, for whoever runs this with -s


@pytest.mark.parametrize(
    ("options", "says"),
    [
        # A Pi 4; a Pi 5 with a kernel before 6.6.45, where the header's chip is not the first; one after.
        (["--board", "c03115", "--chips", "pinctrl-bcm2711:58"], "chip 0 4B"),
        (["--board", "d04171", "--chips", "gpio-brcmstb:32,pinctrl-rp1:54"], "chip 1 5B"),
        (["--board", "d04171", "--chips", "pinctrl-rp1:54,gpio-brcmstb:32"], "chip 0 5B"),
        (["--chips", "expander:16"], "HardwareError none of the GPIO chips drives a Raspberry Pi's header"),
        (["--board", "none"], "HardwareError this computer is no Raspberry Pi that gpiozero knows"),
    ],
)
def test_the_headers_chip_is_found_by_its_label(guest, options, says):
    done = guest([str(HERE / "guest_chip.py")], options=options)
    assert done.stdout.startswith(says), f"{done.stdout}\n{done.stderr}"
