"""Choosing the header's chip, and lgpio's working directory. Pins themselves are in tests/virtual_pi."""

import os
import subprocess
import sys
import weakref
from pathlib import Path
from typing import ClassVar

import pytest

from bricktrack_common.errors import HardwareError
from bricktrack_device.hardware import lgpio_pins
from bricktrack_device.hardware.lgpio_pins import choose_chip, lgpio_working_directory, sturdy


class FakeLgpio:
    """Chips by number; opening one that is not listed fails as lgpio does."""

    class error(Exception):  # noqa: N801, N818  lgpio's own name
        pass

    labels: ClassVar[dict[int, str]] = {}

    def __init__(self, labels: dict[int, str]) -> None:
        self.known = labels
        self.open: set[int] = set()

    def gpiochip_open(self, number: int) -> int:
        if number not in self.known:
            raise self.error("can not open gpiochip")
        self.open.add(number)
        return 100 + number

    def gpiochip_close(self, handle: int) -> None:
        self.open.remove(handle - 100)

    def gpio_get_chip_info(self, handle: int) -> tuple[int, int, str, str]:
        return 0, 54, f"gpiochip{handle - 100}", self.known[handle - 100]


def dev_with(tmp_path: Path, *numbers: int) -> Path:
    for n in numbers:
        (tmp_path / f"gpiochip{n}").touch()
    return tmp_path


@pytest.mark.parametrize(
    ("labels", "chosen"),
    [
        ({0: "pinctrl-bcm2835", 1: "raspberrypi-exp-gpio"}, 0),
        ({0: "gpio-brcmstb@107d508500", 4: "pinctrl-rp1", 10: "gpio-brcmstb@107d517c00"}, 4),
        ({0: "pinctrl-rp1", 10: "gpio-brcmstb@107d508500"}, 0),
    ],
)
def test_the_chip_is_chosen_by_label_and_no_other_stays_open(
    tmp_path: Path, labels: dict[int, str], chosen: int
) -> None:
    lgpio = FakeLgpio(labels)
    assert choose_chip(lgpio, dev=dev_with(tmp_path, *labels)) == chosen
    assert not lgpio.open


def test_no_chip_at_all_is_told(tmp_path: Path) -> None:
    (tmp_path / "gpiomem").touch()
    with pytest.raises(HardwareError, match=r"/dev/gpiochip\* is missing"):
        choose_chip(FakeLgpio({}), dev=tmp_path)


def test_another_machines_chip_is_not_taken(tmp_path: Path) -> None:
    with pytest.raises(HardwareError, match="none of the GPIO chips.*gpio_aaeon.*expected a label"):
        choose_chip(FakeLgpio({0: "gpio_aaeon"}), dev=dev_with(tmp_path, 0))


def test_a_chip_that_may_not_be_opened_names_the_group(tmp_path: Path) -> None:
    with pytest.raises(HardwareError, match=r"no permission for .*gpiochip0.*usermod -aG gpio"):
        choose_chip(FakeLgpio({}), dev=dev_with(tmp_path, 0))


SCRIPT = """
import os, sys
from pathlib import Path
from bricktrack_device.hardware.lgpio_pins import lgpio_working_directory
folder = Path(sys.argv[1]) if len(sys.argv) > 1 else None
with lgpio_working_directory(folder):
    print(os.environ["LG_WD"])
    os.chdir(os.environ["LG_WD"])  # what lgpio does
print(os.environ.get("LG_WD"), os.getcwd())
"""


def in_a_process(*arguments: str, cwd: Path, **environment: str) -> list[str]:
    env = {k: v for k, v in os.environ.items() if k not in ("LG_WD", "RUNTIME_DIRECTORY")} | environment
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, *arguments],
        cwd=cwd, env=env, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return (done.stdout if done.returncode == 0 else done.stderr).splitlines()


def test_lgpio_gets_a_writable_folder_and_the_process_its_own_back(tmp_path: Path) -> None:
    here = tmp_path / "here"
    runtime = tmp_path / "run"
    here.mkdir()
    runtime.mkdir()
    assert in_a_process(str(runtime), cwd=here) == [str(runtime), f"None {here}"]
    assert in_a_process(cwd=here, RUNTIME_DIRECTORY=f"{runtime}:/x") == [str(runtime), f"None {here}"]
    assert in_a_process(cwd=here, LG_WD=str(runtime)) == [str(runtime), f"{runtime} {here}"]
    chosen, after = in_a_process(cwd=here)
    assert Path(chosen).name.startswith("bricktrack-lgpio-")
    assert not Path(chosen).exists(), "the temporary folder goes with the process"
    assert after == f"None {here}"
    assert not list(here.iterdir())


def test_a_folder_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    assert "expected a folder that can be written" in in_a_process("/nowhere", cwd=tmp_path)[-1]


def test_a_report_of_a_pin_that_was_just_given_back_does_not_end_lgpios_thread(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with lgpio_working_directory(tmp_path):
        pytest.importorskip("lgpio")
        from gpiozero.pins.lgpio import LGPIOPin

    def report(pin_class: type) -> None:
        pin = pin_class.__new__(pin_class)  # neither chip nor line: only what a report goes through
        pin._when_changed = None
        pin._call_when_changed(0, 17, 1, 5_000_000_000)

    with pytest.raises(TypeError):  # gpiozero's own; lgpio's thread does not catch it
        report(LGPIOPin)
    report(sturdy(LGPIOPin, OSError))
    assert caplog.text == ""

    class Listened:
        def hear(self, ticks_s: float, state: int) -> None:
            raise ZeroDivisionError("a bug")

    listened = Listened()
    safe = sturdy(LGPIOPin, OSError)
    pin = safe.__new__(safe)
    pin._when_changed = weakref.WeakMethod(listened.hear)
    pin._call_when_changed(0, 17, 1, 5_000_000_000)
    assert "ZeroDivisionError" in caplog.text and "GPIO17" in caplog.text
    pin._when_changed = None  # nothing to give back when it goes


class BusyPin:
    """A line that is busy for its first attempts, as one that lgpio still listens to."""

    def __init__(self, n_busy: int, words: str = "GPIO busy") -> None:
        self.n_attempts = 0
        self.n_busy = n_busy
        self.words = words

    def close(self) -> None:
        self.n_attempts += 1
        if self.n_attempts <= self.n_busy:
            raise FakeLgpio.error(self.words)


def test_a_line_that_is_busy_for_a_moment_is_given_back_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    pin = sturdy(BusyPin, FakeLgpio.error)(3)
    pin.close()
    assert pin.n_attempts == 4
    other = sturdy(BusyPin, FakeLgpio.error)(1, "bad handle")
    with pytest.raises(FakeLgpio.error, match="bad handle"):
        other.close()
    monkeypatch.setattr(lgpio_pins, "_BUSY_S", 0.05)
    with pytest.raises(FakeLgpio.error, match="busy"):
        sturdy(BusyPin, FakeLgpio.error)(10**6).close()
