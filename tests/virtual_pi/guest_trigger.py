"""The trigger over the real gpiozero, lgpio and a kernel gpiochip: nothing lost, glitches not believed."""

import subprocess
import sys
import time

import guest_knobs
import pytest

from bricktrack_device.capture.edge_report import judge_edges
from bricktrack_device.capture.trigger import Trigger
from bricktrack_device.config import TriggerTable
from bricktrack_device.hardware.lgpio_pins import open_pin_factory


@pytest.fixture(scope="module")
def factory():
    # One for all: a report that comes after a factory was closed ends lgpio's only callback thread.
    made = open_pin_factory()
    yield made
    time.sleep(0.2)
    made.close()


def wave_of_at_most(hz, n_periods):
    """Drive GPIO17 from another process; each level lasts half a period *or more*, never less."""
    code = (
        "import json, sys, time\n"
        "rises, half_ns = [], round(0.5e9 / float(sys.argv[1]))\n"
        "with open('/run/vpi/gpio/sim_gpio17/pull', 'w') as f:\n"
        "    for k in range(2 * int(sys.argv[2])):\n"
        "        before = time.monotonic_ns()\n"
        "        f.write('pull-down' if k % 2 else 'pull-up'); f.flush(); f.seek(0)\n"
        "        after = time.monotonic_ns()\n"
        "        if k % 2 == 0: rises.append((before, after))\n"
        "        while time.monotonic_ns() < after + half_ns: time.sleep(1e-4)\n"
        "json.dump(rises, sys.stdout)\n"
    )
    return subprocess.Popen(
        [sys.executable, "-c", code, str(hz), str(n_periods)], stdout=subprocess.PIPE, text=True
    )


@pytest.mark.parametrize(("hz", "n_periods"), [(100.0, 200), (500.0, 1000), (1000.0, 2000)])
def test_every_rising_edge_is_logged_with_its_stamp(factory, hz, n_periods):
    trigger = Trigger(factory, TriggerTable())  # this wave is no steady one: the first edge is believed
    trigger.arm(lambda: None)
    rises = guest_knobs.rises_of(wave_of_at_most(hz, n_periods))
    time.sleep(0.5)
    train = trigger.disarm()
    trigger.close()
    # What the finder did not take as the first is in the record too: nothing that was driven is lost.
    seen = [*train.rejected_ns, *train.edges_ns]
    mean_hz = (len(rises) - 1) * 1e9 / (rises[-1][0] - rises[0][0])
    print(
        f"half periods of {500 / hz:g} ms or more, {mean_hz:.0f} Hz: {len(seen)} of {len(rises)} rises seen"
    )
    assert len(rises) == n_periods and len(seen) == n_periods
    assert all(a - 1000 <= t <= b + 1000 for t, (a, b) in zip(seen, rises, strict=True))
    assert train.problems == []


def test_a_glitch_before_the_wave_is_not_its_first_edge(factory):
    trigger = Trigger(factory, TriggerTable(nominal_hz=20.0, quiet_gap_ms=100.0))
    firsts = []
    trigger.arm(lambda: firsts.append(1))
    time.sleep(0.2)
    guest_knobs.drive(17, up=True)
    time.sleep(0.007)  # a shorter one may be lost: the level is read in the interrupt's thread
    guest_knobs.drive(17, up=False)
    time.sleep(0.3)
    assert trigger.t0_ns is None and not firsts
    assert "waits for others in step" in trigger.waiting_words()
    rises = guest_knobs.rises_of(guest_knobs.square_wave(17, hz=20, n_periods=30))
    time.sleep(0.3)
    train = trigger.disarm()
    trigger.close()
    assert len(train.rejected_ns) == 1 and firsts == [1]
    assert len(train.edges_ns) == len(rises) == 30
    assert rises[0][0] - 1000 <= train.t0_ns <= rises[0][1] + 1000
    wave, words = judge_edges(
        train.edges_ns, nominal_hz=20.0, end_ns=train.edges_ns[-1], rejected_ns=train.rejected_ns
    )
    assert wave.hz == pytest.approx(20, rel=0.02)  # single edges may be late: one processor under ptrace
    assert "1 rising edges before t = 0" in words[0]


def test_a_line_that_is_high_at_arming_is_said(factory):
    guest_knobs.drive(18, up=True)
    trigger = Trigger(factory, TriggerTable(pin="GPIO18", pull="none"))
    trigger.arm(lambda: None)
    assert trigger.line_is_high and "high all the time" in trigger.waiting_words()
    guest_knobs.drive(18, up=False)
    time.sleep(0.2)
    assert "the line is low" in trigger.waiting_words()
    guest_knobs.drive(18, up=True)
    time.sleep(0.2)
    guest_knobs.drive(18, up=False)
    assert trigger.disarm().t0_ns is not None
    trigger.close()


def test_pins_given_back_while_the_wave_goes_on_leave_the_next_one_hearing(factory):
    wave = wave_of_at_most(500.0, 1500)
    while wave.poll() is None:
        trigger = Trigger(factory, TriggerTable())
        trigger.arm(lambda: None)
        time.sleep(0.01)
        trigger.close()
    guest_knobs.rises_of(wave)
    trigger = Trigger(factory, TriggerTable())
    trigger.arm(lambda: None)
    rises = guest_knobs.rises_of(wave_of_at_most(100.0, 20))
    time.sleep(0.3)
    train = trigger.disarm()
    trigger.close()
    assert len(rises) == 20 and len(train.edges_ns) == 20
