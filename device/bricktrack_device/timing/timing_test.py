"""`bricktrackd timing-test`: switch the LEDs at known instants and find these in the recorded rows.

The camera, the encoder and the joining of packets with metadata are those of a run. Each switching is aimed
at the time when one LED's rows are being exposed, so that every one of them is seen.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from rich.console import Console

from bricktrack_common.arrays import FloatArray
from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import ConfigError, HardwareError
from bricktrack_common.run_manifest import CameraSection
from bricktrack_device.capture.ring import FrameRing, VideoCut, cut_video
from bricktrack_device.config import DeviceConfig
from bricktrack_device.inertial.imu_sampler import sleep_until_ns
from bricktrack_device.interfaces import EncodedPacket, Leds, Rig
from bricktrack_device.timing.decode import decode_luma
from bricktrack_device.timing.result_file import Result, make_result
from bricktrack_device.timing.row_switches import (
    LedWindow,
    RowErrors,
    Switching,
    find_leds,
    row_errors,
    row_light,
)
from bricktrack_device.timing.text_histogram import text_histogram

FRAMES_AHEAD = 5
"""How many frames before a switch it is planned: two of them are whole frames since the last one."""
FRAMES_TO_ARRIVE = 3
MAX_TRIES = 3
"""A switch whose frame was lost is made again, up to this many times what was asked for in all."""
MIN_FOUND = 4
"""Fewer switchings than this, or than a quarter of those asked for, are no measurement."""
_LEARN_S = 0.7
_LEARN_AT_MOST_S = 10.0
_LEARN_FRAMES = 4
_AIM_AHEAD_NS = 25_000_000
_FIRST_FRAME_S = 15.0
_GOLDEN = 0.6180339887498949
_ROW_BANDS = 8

Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class Filmed:
    """What the test recorded: the run's pictures, how they were taken, and when the LEDs were switched.

    ``n_wanted`` is how many switchings were asked for; those whose frame was lost were made again.
    """

    cut: VideoCut
    section: CameraSection
    windows: list[LedWindow]
    switchings: list[Switching]
    n_wanted: int


def film(config: DeviceConfig, rig: Rig, n_switches: int, progress: Progress = lambda share: None) -> Filmed:
    """Record while the LEDs are switched.

    Raises
    ------
    ConfigError
        If the unit's LEDs hang on no pins.
    HardwareError
        If camera or pins do not work, or no LED is seen to change.
    """
    if not config.leds.pins and not rig.simulated:
        raise ConfigError(
            "leds.pins: []: the timing test switches the LEDs; wire them to a pin and name it: "
            'pins = ["GPIO22"]'
        )
    period_s = 1 / config.camera.frame_rate_hz
    frames_a_switch = FRAMES_AHEAD + FRAMES_TO_ARRIVE + 2
    span_s = 20 + 2 * _LEARN_AT_MOST_S + MAX_TRIES * n_switches * frames_a_switch * period_s
    ring = FrameRing(round(span_s * 1e9))
    camera = rig.open_camera()
    with rig.leds(config.leds.pins, active_high=config.leds.active_high) as leds:
        try:
            section = camera.start(ring)
            _check_mode(section)
            windows = _learn(ring, leds, section)
            switchings: list[Switching] = []
            n_seen = 0
            while n_seen < n_switches and len(switchings) < MAX_TRIES * n_switches:
                # Whichever LED, wherever in its rows' exposure: the golden ratio spreads both evenly.
                window = windows[(n_seen // 2) % len(windows)]
                share = 0.2 + 0.6 * (len(switchings) * _GOLDEN % 1)
                on = len(switchings) % 2 == 0
                switching, stamp_ns = _switch(ring, leds, section, window, share, on=on)
                switchings.append(switching)
                time.sleep(FRAMES_TO_ARRIVE * period_s)
                n_seen += _has_arrived(ring, stamp_ns, section)
                progress(n_seen / n_switches)
            time.sleep(6 * period_s)
        finally:
            camera.stop()
    return Filmed(_cut(ring, section), section, windows, switchings, n_switches)


def _has_arrived(ring: FrameRing, stamp_ns: int, section: CameraSection) -> bool:
    """Tell whether the frame with about this stamp came."""
    packets, _ = ring.snapshot()
    return any(abs(p.abs_us - stamp_ns // 1000) < section.frame_duration_us // 2 for p in packets[-30:])


def _check_mode(section: CameraSection) -> None:
    if section.exposure_us > 0.5 * section.frame_duration_us:
        raise HardwareError(
            f"an exposure of {section.exposure_us} µs is too long for this test: more than half of the frame "
            f"period, {section.frame_duration_us} µs. Lower camera.exposure_us"
        )


def _cut(ring: FrameRing, section: CameraSection) -> VideoCut:
    packets, metadata = ring.snapshot()
    if not packets or ring.first_abs_us is None:
        raise HardwareError(f"{section.model} delivers no pictures. Run 'bricktrackd check'")
    return cut_video(
        packets,
        metadata,
        start_ns=packets[0].abs_us * 1000,
        end_ns=packets[-1].abs_us * 1000 + 1000,
        first_abs_us=ring.first_abs_us,
        period_us=section.frame_duration_us,
        default_exposure_us=section.exposure_us,
        default_gain=section.analogue_gain,
    )


def _learn(ring: FrameRing, leds: Leds, section: CameraSection) -> list[LedWindow]:
    """Find the LEDs in pictures of them lit and dark."""
    deadline = time.monotonic() + _FIRST_FRAME_S
    while ring.first_keyframe_us is None:
        if time.monotonic() > deadline:
            raise HardwareError(
                f"{section.model}: no keyframe in {_FIRST_FRAME_S:g} s. Run 'bricktrackd check'"
            )
        time.sleep(0.02)
    intervals = {}
    for on in (True, False):
        _, start_ns = leds.switch(on)
        deadline = time.monotonic() + _LEARN_AT_MOST_S
        time.sleep(_LEARN_S)
        # On a machine that loses frames it takes longer until there are enough.
        while _n_since(ring, start_ns) < _LEARN_FRAMES and time.monotonic() < deadline:
            time.sleep(0.05)
        intervals[on] = start_ns, monotonic_ns()
    time.sleep(5 * section.frame_duration_us * 1e-6)  # until the last ones are encoded
    sums: dict[bool, FloatArray] = {}
    counts = {True: 0, False: 0}
    packets = _from_keyframe(ring.snapshot()[0], intervals[True][0] // 1000)
    read_out_ns = float(section.mode.row_delay_ns(section.mode.height - 1))
    for i, luma in decode_luma(packets):
        stamp_ns = packets[i].abs_us * 1000
        for on, (start_ns, end_ns) in intervals.items():
            if start_ns < stamp_ns - section.exposure_us * 1000 and stamp_ns + read_out_ns < end_ns:
                sums[on] = luma.astype(np.float64) + sums.get(on, 0.0)
                counts[on] += 1
    if not counts[True] or not counts[False]:
        raise HardwareError(
            f"{section.model}: no whole picture came in {_LEARN_AT_MOST_S:g} s. Run 'bricktrackd check'"
        )
    return find_leds(sums[True] / counts[True], sums[False] / counts[False])


def _n_since(ring: FrameRing, start_ns: int) -> int:
    return sum(p.abs_us * 1000 > start_ns for p in ring.snapshot()[0])


def _from_keyframe(packets: list[EncodedPacket], at_us: int) -> list[EncodedPacket]:
    """Return the packets from the last keyframe at or before an instant on."""
    first = max((i for i, p in enumerate(packets) if p.keyframe and p.abs_us <= at_us), default=0)
    return packets[first:]


def _switch(
    ring: FrameRing, leds: Leds, section: CameraSection, window: LedWindow, share: float, *, on: bool
) -> tuple[Switching, int]:
    """Switch some frames later, while ``share`` of the exposure of the LED's middle row has passed.

    Returns
    -------
    switching : Switching
    stamp_ns : int
        Which frame was aimed at.
    """
    newest_us = ring.newest_us
    if newest_us is None:
        raise HardwareError(f"{section.model} delivers no pictures. Run 'bricktrackd check'")
    period_ns = section.frame_duration_us * 1000
    row = 0.5 * (window.v0 + window.v1 - 1)
    exposed_ns = float(section.mode.row_delay_ns(row)) - (1 - share) * section.exposure_us * 1000
    earliest_ns = monotonic_ns() + FRAMES_AHEAD * period_ns
    n = -(-(earliest_ns - newest_us * 1000 - round(exposed_ns)) // period_ns)
    stamp_ns = newest_us * 1000 + n * period_ns
    due_ns = stamp_ns + round(exposed_ns)
    sleep_until_ns(due_ns - _AIM_AHEAD_NS)
    sleep_until_ns(due_ns)
    before_ns, after_ns = leds.switch(on)
    return Switching(before_ns, after_ns, on), stamp_ns


def find_in_rows(filmed: Filmed, progress: Progress = lambda share: None) -> RowErrors:
    """Return what the recorded rows say of each switching."""
    records, packets = filmed.cut.records, filmed.cut.packets
    light = [np.full((len(packets), w.v1 - w.v0), np.nan) for w in filmed.windows]
    for i, luma in decode_luma(packets):
        for values, window in zip(light, filmed.windows, strict=True):
            values[i] = row_light(luma, window)
        progress((i + 1) / len(packets))
    return row_errors(
        light,
        filmed.windows,
        stamps_ns=np.array([r.sensor_timestamp_ns for r in records], dtype=np.int64),
        exposure_ns=np.array([r.exposure_us * 1000 for r in records], dtype=np.int64),
        mode=filmed.section.mode,
        switchings=filmed.switchings,
    )


def figures_of(filmed: Filmed, errors: RowErrors) -> tuple[dict[str, float | int], FloatArray]:
    """Return the summary, and each switching's error, us, shape (n_switches,), NaN where no row saw it.

    Raises
    ------
    HardwareError
        If fewer were seen than `MIN_FOUND`, or than a quarter of those asked for, or of only one kind.
    """
    n = len(filmed.switchings)
    per_switch = np.full(n, np.nan)
    for i in range(n):
        mine = errors.error_us[errors.i_switch == i]
        if mine.size:
            per_switch[i] = np.median(mine)
    found = np.isfinite(per_switch)
    on = np.array([s.on for s in filmed.switchings])
    n_on, n_off = int((found & on).sum()), int((found & ~on).sum())
    if n_on + n_off < max(MIN_FOUND, filmed.n_wanted // 4) or not n_on or not n_off:
        raise HardwareError(
            f"only {n_on + n_off} of {n} switchings were found in the rows, {n_on} on and {n_off} off; "
            f"{filmed.cut.n_dropped} frames were lost. If frames are lost, stop other programs; otherwise "
            "check that leds.pins light the LEDs, and that nothing moves or flickers"
        )
    t_s = np.array([s.t_ns - filmed.switchings[0].t_ns for s in filmed.switchings]) * 1e-9
    # A wrong response curve moves the two kinds in opposite directions; their mean is free of it.
    mean_on, mean_off = (float(np.mean(per_switch[found & kind])) for kind in (on, ~on))
    drift, drift_error = _slope(t_s[found], per_switch[found])
    delay_ms, led_us = _by_led(filmed, errors)
    row_slope, row_slope_error = _slope(delay_ms, led_us)
    widths = [(s.after_ns - s.before_ns) / 1e3 for s in filmed.switchings]
    return {
        "switchings": n,
        "switchings_wanted": filmed.n_wanted,
        "switchings_found": int(found.sum()),
        "rows": int(errors.error_us.size),
        "frames_dropped": filmed.cut.n_dropped,
        "mean_us": 0.5 * (mean_on + mean_off),
        "mean_on_us": mean_on,
        "mean_off_us": mean_off,
        "sd_us": float(np.std(per_switch[found], ddof=1)),
        "worst_us": float(np.max(np.abs(per_switch[found]))),
        "row_sd_us": float(np.std(errors.error_us, ddof=1)),
        "drift_us_per_s": drift,
        "drift_us_per_s_standard_error": drift_error,
        "read_out_us_per_ms": row_slope,
        "read_out_us_per_ms_standard_error": row_slope_error,
        "gpio_write_us": float(np.median(widths)),
    }, per_switch


def _by_led(filmed: Filmed, errors: RowErrors) -> tuple[FloatArray, FloatArray]:
    """Return when the rows of each LED are read, ms, and the LED's errors, one for each switching it saw."""
    delays, means = [], []
    for i_switch in np.unique(errors.i_switch).tolist():
        for i_led in np.unique(errors.i_led[errors.i_switch == i_switch]).tolist():
            mine = (errors.i_switch == i_switch) & (errors.i_led == i_led)
            delays.append(float(np.mean(filmed.section.mode.row_delay_ns(errors.row[mine]))) / 1e6)
            means.append(float(np.mean(errors.error_us[mine])))
    return np.array(delays), np.array(means)


def _slope(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return slope and standard error of a straight line; NaN where three points or no spread are all."""
    x = x - x.mean()
    if x.size < 4 or not x @ x > 0:
        return float("nan"), float("nan")
    slope = float(x @ y / (x @ x))
    rest = y - y.mean() - slope * x
    return slope, float(np.sqrt(rest @ rest / (x.size - 2) / (x @ x)))


def run_timing_test(
    config: DeviceConfig, rig: Rig, *, n_switches: int, progress: Progress = lambda share: None
) -> Result:
    """Run the whole test and return its result."""
    filmed = film(config, rig, n_switches, lambda share: progress(0.7 * share))
    errors = find_in_rows(filmed, lambda share: progress(0.7 + 0.3 * share))
    figures, per_switch = figures_of(filmed, errors)
    mode = filmed.section.mode
    return make_result(
        "timing-test",
        config.unit.name,
        rig,
        settings={
            "camera": filmed.section.model,
            "mode": mode.name,
            "line_time_us": mode.line_time_ns / 1000,
            "exposure_us": filmed.section.exposure_us,
            "frame_duration_us": filmed.section.frame_duration_us,
            "encoder": filmed.section.encoder,
            "leds_seen": len(filmed.windows),
            "led_pins": config.leds.pins,
        },
        figures=figures,
        values={
            "switch_t_ns": [s.t_ns for s in filmed.switchings],
            "switch_on": [s.on for s in filmed.switchings],
            "switch_error_us": np.round(per_switch, 2).tolist(),
            "row": errors.row.tolist(),
            "row_switch": errors.i_switch.tolist(),
            "row_led": errors.i_led.tolist(),
            "row_share": np.round(errors.share, 4).tolist(),
            "row_error_us": np.round(errors.error_us, 2).tolist(),
        },
    )


def print_report(result: Result, console: Console | None = None) -> None:
    """Print a test for people."""
    console = console or Console()
    f, s = result.figures, result.settings

    def say(words: str) -> None:
        console.print(words, markup=False, highlight=False)

    simulated = ", SIMULATED: this checks the software, not a camera" if result.simulated else ""
    say(f"timing-test of {result.unit}: {s['camera']}, {s['mode']}{simulated}")
    say(
        f"{f['switchings_found']} of {f['switchings']} switchings found ({f['switchings_wanted']} asked "
        f"for), in {f['rows']} rows of {s['leds_seen']} LEDs; {f['frames_dropped']} frames dropped; "
        f"exposure {s['exposure_us']} µs"
    )
    say(
        f"camera less GPIO: mean {f['mean_us']:+.1f} µs, sd {f['sd_us']:.1f} µs a switching, worst "
        f"{f['worst_us']:.1f} µs; sd {f['row_sd_us']:.1f} µs a row"
    )
    say(
        f"on {f['mean_on_us']:+.1f} µs, off {f['mean_off_us']:+.1f} µs: half their difference is the error "
        "of the assumed response curve, not of time"
    )
    say(
        f"drift {f['drift_us_per_s']:+.2f} ± {f['drift_us_per_s_standard_error']:.2f} µs/s; along the "
        f"read-out {f['read_out_us_per_ms']:+.2f} ± {f['read_out_us_per_ms_standard_error']:.2f} µs a ms "
        "(a wrong line time shows here)"
    )
    say(f"writing the pin took {f['gpio_write_us']:.0f} µs: the instants are known no better")
    say("\nerror of each switching:")
    for line in text_histogram(result.values["switch_error_us"], unit="µs", n_bins=12):
        say(line)
    say("\nerror by row, µs:")
    for line in row_table(result):
        say(line)


def row_table(result: Result) -> list[str]:
    """Return the mean error in bands of rows, as lines of text."""
    rows = np.array(result.values["row"])
    errors = np.array(result.values["row_error_us"])
    edges = np.linspace(rows.min(), rows.max() + 1, _ROW_BANDS + 1)
    lines = []
    for low, high in pairwise(edges.tolist()):
        mine = errors[(rows >= low) & (rows < high)]
        if mine.size:
            lines.append(
                f"rows {low:5.0f} to {high - 1:5.0f}: mean {mine.mean():+7.1f}, sd {mine.std():6.1f}, "
                f"{mine.size} rows"
            )
    return lines
