"""What `bricktrackd check` looks at: every part the daemon needs, each with a remedy where it fails."""

import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from statistics import median

from bricktrack_common.clocks import check_monotonic_is_boottime, read_clock_triplet
from bricktrack_common.errors import BricktrackError, HardwareError
from bricktrack_device.bno055 import CHIP_ID, read_chip_id
from bricktrack_device.config import DeviceConfig, ImuTable
from bricktrack_device.interfaces import FrameMetadata, Rig
from bricktrack_device.ring import FrameRing
from bricktrack_device.run_store import RunStore
from bricktrack_device.trigger import Trigger

CAMERA_CHECK_S = 2.0
_GAIN_TOLERANCE = 0.03
_EXPOSURE_TOLERANCE_US = 40  # two sensor lines of 18.9 us: exposure is set in whole lines
_PERIOD_TOLERANCE = 0.02


@dataclass(frozen=True, slots=True)
class CheckResult:
    """One line of the check; ``remedy`` is empty where ``ok``."""

    name: str
    ok: bool
    detail: str
    remedy: str = ""


def run_checks(config: DeviceConfig, rig: Rig) -> list[CheckResult]:
    """Try every part in turn; a failure stops none of the others."""
    checks: list[tuple[str, str, Callable[[], str]]] = [
        ("clocks", "Reboot the unit and disable suspend", _check_clocks),
        (
            "storage",
            "Free space, or set storage.folder or storage.margin_mb",
            lambda: _check_storage(config),
        ),
        (
            "port",
            "Stop the program that holds it, or set server.port",
            lambda: _check_port(config),
        ),
        (
            "trigger",
            "Check trigger.pin and that no other program holds it",
            lambda: _check_trigger(config, rig),
        ),
        (
            "camera",
            "Check the camera's cable and the [camera] settings",
            lambda: _check_camera(config, rig),
        ),
    ]
    checks += [
        (
            f"imu {imu.name}",
            "Check wiring, supply, [[imu]] bus and address (0x28 or 0x29)",
            lambda imu=imu: _check_imu(imu, rig),  # type: ignore[misc]
        )
        for imu in config.imu
    ]
    results = []
    for name, remedy, check in checks:
        try:
            results.append(CheckResult(name, ok=True, detail=check()))
        except (BricktrackError, OSError) as e:
            results.append(CheckResult(name, ok=False, detail=str(e), remedy=remedy))
    return results


def _check_clocks() -> str:
    triplet = read_clock_triplet()
    check_monotonic_is_boottime(triplet)
    return f"BOOTTIME - MONOTONIC = {(triplet.boottime_ns - triplet.monotonic_ns) / 1000:.1f} us"


def _check_storage(config: DeviceConfig) -> str:
    store = RunStore(config.storage_folder, config.unit.name)
    needed = 2 * config.video_bytes() + config.storage.margin_mb * 1_000_000
    free = store.free_bytes()
    words = f"{free / 1e6:.0f} MB free in {store.folder}, {needed / 1e6:.0f} MB needed for a run"
    if free < needed:
        raise HardwareError(words)
    return f"{words}; {store.count_runs()} runs"


def _check_port(config: DeviceConfig) -> str:
    address, port = config.server.address, config.server.port
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except OSError as e:
            raise HardwareError(f"{address} port {port}: {e.strerror}") from e
    return f"{address} port {port} is free"


def _check_trigger(config: DeviceConfig, rig: Rig) -> str:
    trigger = Trigger(rig.pin_factory(), config.trigger)
    try:
        level = "high" if trigger.line_is_high else "low"
        return f"{trigger.pin_name} reads {level} through {type(rig.pin_factory()).__name__}"
    finally:
        trigger.close()


def _check_camera(config: DeviceConfig, rig: Rig) -> str:
    ring = FrameRing(round((CAMERA_CHECK_S + 1) * 1e9))
    camera = rig.open_camera()
    try:
        section = camera.start(ring)
        time.sleep(CAMERA_CHECK_S)
    finally:
        camera.stop()
    packets, metadata = ring.snapshot()
    if not packets or not metadata or ring.first_keyframe_us is None:
        raise HardwareError(f"{section.model} delivers no pictures: {len(packets)} in {CAMERA_CHECK_S:g} s")
    _check_controls(metadata, section.exposure_us, section.analogue_gain)
    stamps = [p.abs_us for p in packets]
    gaps = [b - a for a, b in pairwise(stamps)]
    period_us = median(gaps) if gaps else 0.0
    if abs(period_us - section.frame_duration_us) > _PERIOD_TOLERANCE * section.frame_duration_us:
        raise HardwareError(
            f"{section.model}: a picture every {period_us:.0f} us; expected {section.frame_duration_us} us"
        )
    n_gaps = sum(gap > 1.5 * period_us for gap in gaps)
    return (
        f"{section.model}, {section.mode.name}: {len(packets)} pictures in {CAMERA_CHECK_S:g} s, "
        f"{1e6 / period_us:.4f} Hz, {n_gaps} gaps, exposure {section.exposure_us} us and gain "
        f"{section.analogue_gain:g} held, {section.encoder}"
    )


def _check_controls(metadata: list[FrameMetadata], exposure_us: int, gain: float) -> None:
    """Raise if exposure or gain of a frame is not the one the camera said it holds."""
    for frame in metadata:
        if abs(frame.exposure_us - exposure_us) > _EXPOSURE_TOLERANCE_US:
            raise HardwareError(f"exposure wanders: {frame.exposure_us} us; expected {exposure_us} us")
        if abs(frame.analogue_gain - gain) > _GAIN_TOLERANCE * gain:
            raise HardwareError(f"gain wanders: {frame.analogue_gain:g}; expected {gain:g}")


def _check_imu(imu: ImuTable, rig: Rig) -> str:
    bus = rig.bus_opener(imu.bus)()
    try:
        chip_id = read_chip_id(bus, imu.address)
    finally:
        bus.close()
    if chip_id != CHIP_ID:
        raise HardwareError(
            f"chip id 0x{chip_id:02X} at address 0x{imu.address:02X} on {imu.bus}; expected 0xA0"
        )
    return f"BNO055 at address 0x{imu.address:02X} on {imu.bus} answers with id 0xA0"
