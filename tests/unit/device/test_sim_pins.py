"""The simulated trigger line through real gpiozero devices: stamps, levels and faults."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import gpiozero
import numpy as np
import pytest

from bricktrack_common.clocks import monotonic_ns
from bricktrack_device.sim.settings import SimFaults, SimSettings
from bricktrack_device.sim.sim_pins import SquareWave, make_factory
from bricktrack_device.sim.world import SimWorld, make_epoch


class Listener:
    """Hears changes of a pin, until it has heard enough."""

    def __init__(self, enough: int) -> None:
        self.changes: list[tuple[int, int]] = []
        self.done = threading.Event()
        self._enough = enough

    def on_change(self, ticks_s: float, level: int) -> None:
        self.changes.append((round(ticks_s * 1e9), level))
        if len(self.changes) >= self._enough:
            self.done.set()

    @property
    def rising_ns(self) -> np.ndarray:
        return np.array([t for t, level in self.changes if level])


@contextmanager
def listening(
    settings: SimSettings, n: int
) -> Iterator[tuple[SimWorld, Listener, gpiozero.DigitalInputDevice]]:
    world = SimWorld(settings, make_epoch())
    factory = make_factory()
    wave = SquareWave(world, factory)
    listener = Listener(n)
    device = gpiozero.DigitalInputDevice("GPIO17", pull_up=False, bounce_time=None, pin_factory=factory)
    device.pin.when_changed = listener.on_change
    world.schedule(monotonic_ns())
    wave.start()
    try:
        yield world, listener, device
    finally:
        wave.stop()
        device.close()
        factory.close()


FAST = SimSettings(shake_delay_s=0.03, square_wave_hz=500.0, clock_ppm=100.0, edge_jitter_us=0.0)


def test_edges_carry_the_wave_s_instants_however_late_they_are_heard() -> None:
    with listening(FAST, 60) as (world, listener, device):
        assert not device.value and not listener.changes  # low until the shake
        assert listener.done.wait(60)
        expected = world.edge_times_ns(0, 20)
        # gpiozero's ticks are float seconds: 1e-7 s at most after a year of up-time.
        np.testing.assert_allclose(listener.rising_ns[:20], expected, atol=200)
        levels = [level for _, level in listener.changes[:40]]
        assert levels == [1, 0] * 20
        falling = np.array([t for t, level in listener.changes if not level])[:20]
        np.testing.assert_allclose(falling - expected, 1_000_000, atol=300)


def test_stamps_jitter_as_much_as_told() -> None:
    settings = SimSettings(shake_delay_s=0.02, square_wave_hz=1000.0, clock_ppm=0.0, edge_jitter_us=20.0)
    with listening(settings, 400) as (world, listener, _):
        assert listener.done.wait(60)
        # By the nearest edge, not by number: a computer that stands still misses some.
        heard_ns, true_ns = np.array(listener.rising_ns[:200]), world.edge_times_ns(0, 2000)
        jitter_us = np.array([t - true_ns[np.abs(true_ns - t).argmin()] for t in heard_ns]) / 1e3
    assert 16 < jitter_us.std() < 24 and abs(jitter_us.mean()) < 5


def test_a_missed_edge_is_never_heard_and_a_late_one_is_stamped_late() -> None:
    faults = SimFaults(missed_edges=[0, 3], late_edges=[(5, 700.0)])
    with listening(SimSettings(shake_delay_s=0.03, edge_jitter_us=0.0, faults=faults), 14) as (
        world,
        listener,
        _,
    ):
        assert listener.done.wait(60)
        true = world.edge_times_ns(0, 7)
        np.testing.assert_allclose(
            listener.rising_ns[:5], true[[1, 2, 4, 5, 6]] + [0, 0, 0, 700_000, 0], atol=200
        )


def test_the_line_is_low_after_the_wave_stops_and_before_it_starts_anew() -> None:
    world = SimWorld(FAST, make_epoch())
    factory = make_factory()
    wave = SquareWave(world, factory)
    listener = Listener(3)
    with gpiozero.DigitalInputDevice("GPIO4", pull_up=False, pin_factory=factory) as device:
        device.pin.when_changed = listener.on_change
        for _ in range(2):
            listener.done.clear()
            world.schedule(monotonic_ns())
            wave.start()
            assert not device.value
            listener.changes.clear()
            assert listener.done.wait(60)
            assert listener.rising_ns[0] == pytest.approx(world.edge_times_ns(0, 1)[0], abs=200)
            wave.stop()
            assert not device.value
    factory.close()


def test_outputs_are_not_driven_by_the_wave() -> None:
    with listening(FAST, 10) as (_, listener, device):
        led = gpiozero.DigitalOutputDevice("GPIO22", pin_factory=device.pin_factory, initial_value=True)
        assert listener.done.wait(60)
        assert led.value == 1
        led.close()


def test_who_listens_late_hears_the_edges_of_that_time() -> None:
    world = SimWorld(FAST, make_epoch())
    factory = make_factory()
    wave = SquareWave(world, factory)
    world.schedule(monotonic_ns() - 2_000_000_000)
    wave.start()
    listener = Listener(4)
    with gpiozero.DigitalInputDevice("GPIO4", pull_up=False, pin_factory=factory) as device:
        before = monotonic_ns()
        device.pin.when_changed = listener.on_change
        assert listener.done.wait(10)
        assert listener.changes[-1][0] > before - 1_000_000_000
    wave.stop()
    factory.close()
