"""The camera: pictures at the right rate with the fixed controls, well exposed, and LEDs in them."""

import time
from collections.abc import Sequence
from contextlib import nullcontext
from itertools import pairwise
from statistics import median

import numpy as np

from bricktrack_common.errors import HardwareError
from bricktrack_common.run_manifest import CameraSection
from bricktrack_device.capture.ring import FrameRing
from bricktrack_device.config import DeviceConfig
from bricktrack_device.health.blobs import Blob, channel_levels, find_blobs
from bricktrack_device.health.findings import CheckResult, failure, good, warning
from bricktrack_device.interfaces import FrameMetadata, Rig, Still

CAMERA_CHECK_S = 2.0
_GAIN_TOLERANCE = 0.03
_EXPOSURE_TOLERANCE_US = 40  # two sensor lines of 18.9 us: exposure is set in whole lines
_PERIOD_TOLERANCE = 0.02
_MAX_SATURATED = 0.05
_MIN_PEAK = 90.0
_MAX_BACKGROUND = 70.0


def check_camera(config: DeviceConfig, rig: Rig, *, stream_s: float | None = None) -> list[CheckResult]:
    """Let the camera stream for a while and look at what comes; the LEDs are lit if the unit can.

    Raises
    ------
    HardwareError
        If it does not start, delivers nothing, or not what it says.
    """
    stream_s = CAMERA_CHECK_S if stream_s is None else stream_s
    ring = FrameRing(round((stream_s + 1) * 1e9))
    camera = rig.open_camera()
    leds = rig.leds(config.leds.pins, active_high=config.leds.active_high) if config.leds.pins else None
    with nullcontext() if leds is None else leds:
        if leds is not None:
            leds.switch(True)
        try:
            section = camera.start(ring)
            time.sleep(stream_s)
            still = camera.still()
        finally:
            camera.stop()
    packets, metadata = ring.snapshot()
    if not packets or not metadata or ring.first_keyframe_us is None:
        raise HardwareError(f"{section.model} delivers no pictures: {len(packets)} in {stream_s:g} s")
    results = [_judge_stream(section, [p.abs_us for p in packets], metadata, stream_s), _judge_mode(section)]
    if still is None:
        remedy = "Look at a recording instead; this camera gives no stills while it streams"
        return [*results, warning("exposure", "no still could be had", remedy)]
    return results + judge_still(still, expected_leds=config.leds.count)


def _judge_stream(
    section: CameraSection, stamps_us: Sequence[int], metadata: Sequence[FrameMetadata], stream_s: float
) -> CheckResult:
    """Say whether pictures come as the camera says; raise `HardwareError` if they do not."""
    for frame in metadata:
        if abs(frame.exposure_us - section.exposure_us) > _EXPOSURE_TOLERANCE_US:
            raise HardwareError(
                f"exposure wanders: {frame.exposure_us} µs; expected {section.exposure_us} µs"
            )
        if abs(frame.analogue_gain - section.analogue_gain) > _GAIN_TOLERANCE * section.analogue_gain:
            raise HardwareError(f"gain wanders: {frame.analogue_gain:g}; expected {section.analogue_gain:g}")
    gaps = [b - a for a, b in pairwise(stamps_us)]
    period_us = median(gaps) if gaps else 0.0
    if abs(period_us - section.frame_duration_us) > _PERIOD_TOLERANCE * section.frame_duration_us:
        raise HardwareError(
            f"{section.model}: a picture every {period_us:.0f} µs; expected {section.frame_duration_us} µs"
        )
    n_missing = sum(round(gap / period_us) - 1 for gap in gaps if gap > 1.5 * period_us)
    words = (
        f"{section.model}: {len(stamps_us)} pictures in {stream_s:g} s, {1e6 / period_us:.4f} Hz, "
        f"{n_missing} dropped, exposure {section.exposure_us} µs and gain {section.analogue_gain:g} held, "
        f"{section.encoder}"
    )
    if n_missing:
        remedy = "Stop other programs, use the Lite system, or lower camera.bitrate_bps"
        return warning("camera", words, remedy)
    return good("camera", words)


def _judge_mode(section: CameraSection) -> CheckResult:
    """Say which part of the sensor is read, and how fast."""
    m = section.mode
    read_out_ms = float(m.row_delay_ns(m.height - 1)) / 1e6
    words = (
        f"{m.name}: {m.width}x{m.height} px from {m.crop_width}x{m.crop_height} at ({m.crop_x}, {m.crop_y}) "
        f"of the sensor, binned by {m.binning}, {m.line_time_ns / 1000:.4f} µs a line, {read_out_ms:.2f} ms "
        "from the first row to the last"
    )
    period_ms = section.frame_duration_us / 1000
    if m.line_time_ns <= 0 or not 0 < abs(read_out_ms) < period_ms:
        return failure(
            "sensor mode",
            f"{words}: that does not fit a frame of {period_ms:.2f} ms",
            "Choose another camera.mode, and report this with the output of 'rpicam-hello --list-cameras'",
        )
    return good("sensor mode", words)


def judge_still(still: Still, *, expected_leds: int) -> list[CheckResult]:
    """Say how one picture is exposed and how many LEDs are in it."""
    levels = channel_levels(still)
    blobs = find_blobs(levels)
    return [_judge_exposure(levels, blobs), _judge_leds(blobs, expected_leds)]


def _judge_exposure(levels: np.ndarray, blobs: Sequence[Blob]) -> CheckResult:
    background = float(np.median(levels))
    if not blobs:
        top = float(np.quantile(levels, 0.9999))
        words = f"brightest pixels at {top:.0f} of 255, background {background:.0f}"
        if top < _MIN_PEAK:
            remedy = "Light the LEDs; then raise camera.exposure_us"
            return warning("exposure", f"{words}: too dark", remedy)
        return good("exposure", words)
    peak = median(b.peak for b in blobs)
    saturated = median(b.saturated for b in blobs)
    words = (
        f"LEDs at {peak:.0f} of 255, {100 * saturated:.0f} % of their pixels saturated, background "
        f"{background:.0f}"
    )
    if background > _MAX_BACKGROUND:
        return warning(
            "exposure", f"{words}: the room is too bright", "Darken the room or shorten camera.exposure_us"
        )
    if saturated > _MAX_SATURATED:
        return warning("exposure", f"{words}: saturated", "Halve camera.exposure_us or dim the LEDs")
    if peak < _MIN_PEAK:
        return warning("exposure", f"{words}: too dark", "Raise camera.exposure_us or camera.analogue_gain")
    return good("exposure", words)


def _judge_leds(blobs: Sequence[Blob], expected: int) -> CheckResult:
    if not blobs:
        remedy = "Light the LEDs, take off the lens cap, turn the camera to them; then look at the focus"
        return warning("leds", f"no round bright spot seen; expected {expected}", remedy)
    size = median(b.diameter_px for b in blobs)
    words = f"{len(blobs)} round bright spots seen, {size:.0f} px across; expected {expected}"
    if len(blobs) != expected:
        remedy = "Look for covered LEDs, reflections and lamps in the view, or set leds.count"
        return warning("leds", words, remedy)
    return good("leds", words)
