"""Switches of LEDs found in rows: by formulas written out here, and through the whole simulated camera."""

import numpy as np
import pytest

from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_common.errors import ConfigError, HardwareError
from bricktrack_device.backends import open_rig
from bricktrack_device.capture.ring import VideoCut
from bricktrack_device.config import CameraTable, DeviceConfig
from bricktrack_device.sim.led_switch import LedSwitch, SimLeds
from bricktrack_device.sim.settings import SimFaults, SimSettings
from bricktrack_device.sim.sim_rig import SimRig
from bricktrack_device.timing import timing_test
from bricktrack_device.timing.row_switches import (
    LedWindow,
    Switching,
    find_leds,
    linear_light,
    row_errors,
)

PERIOD_NS = 33_326_871
EXPOSURE_NS = 2_000_000
LINE_NS = 18_903.5
STAMPS = np.arange(40, dtype=np.int64) * PERIOD_NS + 10**9


def window(v0: int) -> LedWindow:
    return LedWindow(v0, v0 + 70, 100, 110, np.ones((70, 10), dtype=np.bool_))


def rows_of(
    windows: list[LedWindow], switches: list[Switching], *, late_ns: float = 0.0, line_ns: float = LINE_NS
):
    """What rows see of LEDs that were switched ``late_ns`` after the GPIO; written without the code under test."""
    light = []
    for w in windows:
        seen = np.empty((len(STAMPS), 70))
        for j, stamp in enumerate(STAMPS.tolist()):
            for k in range(70):
                end = stamp + (w.v0 + k) * line_ns
                on, was, lit = False, end - EXPOSURE_NS, 0.0
                for s in switches:
                    t = min(max(s.t_ns + late_ns, end - EXPOSURE_NS), end)
                    lit += (t - was) * on
                    on, was = s.on, t
                lit += (end - was) * on
                seen[j, k] = 0.02 + 0.5 * lit / EXPOSURE_NS
        light.append(seen)
    return light


def switch_at(frame: int, row: int, share: float, *, on: bool) -> Switching:
    t = int(STAMPS[frame] + row * LINE_NS - (1 - share) * EXPOSURE_NS)
    return Switching(t - 2000, t + 2000, on)


WINDOWS = [window(100), window(900)]
SLOW = CameraTable(frame_rate_hz=10.0)
"""Rendering and encoding a picture takes some 30 ms of a core: this rate is kept beside other work, too."""
SWITCHES = [switch_at(5 + 6 * k, (135, 935)[k % 2], 0.4, on=k % 2 == 0) for k in range(5)]


def errors_of(light, *, exposure_ns: int = EXPOSURE_NS):
    return row_errors(
        light,
        WINDOWS,
        stamps_ns=STAMPS,
        exposure_ns=np.full(len(STAMPS), exposure_ns),
        mode=IMX219_1080P,
        switchings=SWITCHES,
    )


def test_exact_rows_give_the_exact_instants_on_and_off() -> None:
    found = errors_of(rows_of(WINDOWS, SWITCHES))
    assert set(found.i_switch.tolist()) == {0, 1, 2, 3, 4} and found.error_us.size > 200
    assert np.abs(found.error_us).max() < 1e-3


def test_a_picture_that_is_late_is_found_late_by_as_much() -> None:
    found = errors_of(rows_of(WINDOWS, SWITCHES, late_ns=250_000.0))
    assert found.error_us == pytest.approx(250, abs=1e-3)


def test_a_wrong_line_time_shows_along_the_read_out() -> None:
    found = errors_of(rows_of(WINDOWS, SWITCHES, line_ns=LINE_NS * 1.01))
    # The camera's rows come 1 % later than believed, 0.189 us a row; read back with the believed line time
    # the switches seem to come earlier by as much.
    assert found.error_us == pytest.approx(-0.189035 * found.row, abs=0.01)


def errors_without(lost: list[int]):
    light = rows_of(WINDOWS, SWITCHES)
    keep = np.delete(np.arange(len(STAMPS)), lost)
    return row_errors(
        [values[keep] for values in light], WINDOWS, stamps_ns=STAMPS[keep],
        exposure_ns=np.full(keep.size, EXPOSURE_NS), mode=IMX219_1080P, switchings=SWITCHES,
    )  # fmt: skip


def test_frames_lost_beside_a_switch_take_nothing_away() -> None:
    # Switch 0 falls into frame 5: its neighbours on both sides, twice, and those of switch 1 in frame 11.
    found = errors_without([3, 4, 6, 7, 10, 12])
    assert set(found.i_switch.tolist()) == {0, 1, 2, 3, 4}
    assert np.abs(found.error_us).max() < 1e-3


def test_a_switch_whose_own_frame_was_lost_is_left_out() -> None:
    found = errors_without([5])
    assert set(found.i_switch.tolist()) == {1, 2, 3, 4}
    assert np.abs(found.error_us).max() < 1e-3


def test_a_switch_without_a_whole_frame_of_its_own_on_either_side_is_left_out() -> None:
    # All frames between switch 0 (frame 5) and switch 1 (frame 11): neither knows its other level.
    found = errors_without([6, 7, 8, 9, 10])
    assert set(found.i_switch.tolist()) == {2, 3, 4}


def test_luma_becomes_linear_by_bt709() -> None:
    # ITU-R BT.709: V = 1.099 L^0.45 - 0.099; L = 0.5 gives V = 0.7055, in limited range 16 + 219 V = 170.5.
    assert linear_light(np.array([16, 170, 171, 235], dtype=np.uint8)) == pytest.approx(
        [0, 0.4975, 0.504, 1], abs=0.003
    )


def test_leds_are_found_where_the_picture_changes_and_nowhere_else() -> None:
    v, u = np.mgrid[0:400, 0:600]
    dark = np.full((400, 600), 20.0)
    dark[300:340, 300:340] = 200  # a lamp that is on all the time
    lit = dark.copy()
    lit[np.hypot(u - 100, v - 100) < 30] = 180
    (led,) = find_leds(lit, dark)
    assert led.v0 <= 71 and led.v1 >= 130 and led.u0 <= 71 and led.u1 >= 130 and led.v1 < 150
    with pytest.raises(HardwareError, match=r"leds\.pins"):
        find_leds(dark, dark)


class TestSwitchInTheSimulation:
    def test_shares_are_overlaps_with_the_time_lit(self) -> None:
        switch = LedSwitch()
        switch.set(False, 100)
        switch.set(True, 200)
        switch.set(False, 260)
        start = np.array([0.0, 50, 150, 190, 240, 300])
        # Lit until 100 and from 200 to 260; intervals of 100.
        assert switch.share_lit(start, start + 100) == pytest.approx([1, 0.5, 0.5, 0.6, 0.2, 0])
        assert switch.share_lit(np.array([0.0]), np.array([90.0])) is None

    def test_an_interval_that_spans_two_changes_has_both(self) -> None:
        switch = LedSwitch()
        switch.set(False, 100)
        switch.set(True, 120)
        assert switch.share_lit(np.array([50.0]), np.array([150.0])) == pytest.approx([0.8])

    def test_time_does_not_go_back(self) -> None:
        switch = LedSwitch()
        switch.set(False, 100)
        with pytest.raises(ValueError, match="before the last"):
            switch.set(True, 99)

    def test_closing_leaves_them_lit(self) -> None:
        switch = LedSwitch()
        with SimLeds(switch) as leds:
            leds.switch(True)
            leds.switch(False)
        assert [on for _, on in switch.changes] == [False, True, False, True]


def test_without_pins_there_is_nothing_to_switch() -> None:
    rig = open_rig(DeviceConfig(backend="sim"))
    rig.simulated = False  # type: ignore[misc]
    with pytest.raises(ConfigError, match=r"leds\.pins"):
        timing_test.film(DeviceConfig(), rig, 8)
    rig.close()


@pytest.mark.slow
def test_recorded_mid_exposure_times_err_by_less_than_a_tenth_of_a_millisecond() -> None:
    """The whole way: world, rolling shutter, H.264, ring, join by stamps, decode; against the world's instants."""
    config = DeviceConfig(backend="sim", camera=SLOW)
    rig = open_rig(config)
    assert isinstance(rig, SimRig)
    try:
        filmed = timing_test.film(config, rig, 8)
        truth = dict(rig.led_switch.changes)
        errors = timing_test.find_in_rows(filmed)
    finally:
        rig.close()
    # Every instant that the tool believes is the world's own, to what writing the pin took.
    assert all(truth.get(s.before_ns) == s.on for s in filmed.switchings)
    figures, per_switch = timing_test.figures_of(filmed, errors)
    # A busy machine drops frames, and switches beside a dropped one are left out.
    assert figures["switchings_found"] >= 4
    true_us = per_switch + np.array([(s.t_ns - s.before_ns) / 1e3 for s in filmed.switchings])
    assert np.nanmax(np.abs(true_us)) < 100
    # H.264 at 12 Mbit/s on the edge rows of an LED; single rows are noisier than a switch's median.
    assert np.percentile(np.abs(errors.error_us), 95) < 100


@pytest.mark.slow
def test_a_camera_that_loses_every_fourth_frame_is_measured_all_the_same() -> None:
    config = DeviceConfig(backend="sim", camera=SLOW, sim=SimSettings(faults=SimFaults(drop_frame_every=4)))
    rig = open_rig(config)
    try:
        result = timing_test.run_timing_test(config, rig, n_switches=8)
    finally:
        rig.close()
    f = result.figures
    # Switches whose frame was lost are made again, so that about as many are found as were asked for.
    assert f["frames_dropped"] > 10 and f["switchings_found"] >= 5 and f["switchings"] >= 8
    assert abs(f["mean_us"]) < 100


def test_too_few_switchings_are_no_measurement_and_the_words_say_what_was_lost() -> None:
    filmed = timing_test.Filmed(
        cut=VideoCut([], [], 31, 0, []), section=None,  # type: ignore[arg-type]
        windows=WINDOWS, switchings=SWITCHES, n_wanted=5,
    )  # fmt: skip
    with pytest.raises(HardwareError, match=r"only 3 of 5 switchings.* 2 on and 1 off; 31 frames were lost"):
        timing_test.figures_of(filmed, errors_without([5 + 6, 5 + 12]))
