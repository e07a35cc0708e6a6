"""The pin factory over the real gpiozero, lgpio and a kernel gpiochip."""

import os
import subprocess
import sys
import time
from pathlib import Path

import gpiozero
import guest_knobs
import pytest

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import HardwareError
from bricktrack_device.hardware.led_bank import LedBank
from bricktrack_device.hardware.lgpio_pins import open_pin_factory


class Listener:
    """Keeps what a pin says; gpiozero keeps only a weak reference to it."""

    def __init__(self) -> None:
        self.changes: list[tuple[int, int, int]] = []

    def on_change(self, ticks_s, state):
        self.changes.append((round(ticks_s * 1e9), state, monotonic_ns()))


@pytest.fixture
def factory():
    before = Path.cwd()
    made = open_pin_factory()
    assert Path.cwd() == before, "importing lgpio moved the process"
    assert not list(before.glob(".lgd-nfy*")), "importing lgpio littered the working directory"
    yield made
    made.close()


def test_every_edge_has_the_kernels_stamp(factory):
    device = gpiozero.DigitalInputDevice("GPIO17", pull_up=False, pin_factory=factory)
    listener = Listener()
    device.pin.when_changed = listener.on_change
    rises = guest_knobs.rises_of(guest_knobs.square_wave(17, hz=40, n_periods=60))
    time.sleep(0.2)
    device.close()
    stamps = [t for t, state, _ in listener.changes if state]
    assert len(stamps) == len(rises) == 60
    # The kernel stamps an edge while the write that makes it is under way; gpiozero's ticks are seconds in
    # a float, good to a fraction of a us at these sizes.
    assert all(before - 1000 <= t <= after + 1000 for t, (before, after) in zip(stamps, rises, strict=True))
    assert all(arrival > t for t, _, arrival in listener.changes)


def test_a_line_that_another_program_holds_is_named(factory):
    code = (
        "import lgpio, sys; h = lgpio.gpiochip_open(0); lgpio.gpio_claim_input(h, 18); "
        "print('held', flush=True); sys.stdin.read()"
    )
    holder = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env=os.environ | {"LG_WD": "/tmp"},
    )  # fmt: skip
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(HardwareError, match=r"pin GPIO18: 'GPIO busy'. Another program"):
        gpiozero.DigitalInputDevice("GPIO18", pull_up=False, pin_factory=factory)
    holder.communicate("", timeout=20)
    gpiozero.DigitalInputDevice("GPIO18", pull_up=False, pin_factory=factory).close()


def test_leds_go_on_and_off_together(factory):
    bank = LedBank(["GPIO22", "GPIO27"], factory)
    value = guest_knobs.PINS / "sim_gpio22" / "value", guest_knobs.PINS / "sim_gpio27" / "value"
    for on in (True, False, True):
        before_ns, after_ns = bank.switch(on)
        assert [int(v.read_text()) for v in value] == [int(on)] * 2
        assert 0 < after_ns - before_ns < 1e9
    bank.close()
    bank.close()


def test_a_factory_can_be_made_again():
    for _ in range(2):
        factory = open_pin_factory()
        device = gpiozero.DigitalInputDevice("GPIO17", pull_up=False, pin_factory=factory)
        assert not device.pin.state
        device.close()
        factory.close()
