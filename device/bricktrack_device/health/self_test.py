"""What the daemon tries of its hardware before it says that it is ready: the pin, each sensor, a picture.

Quicker than `bricktrackd check`, which also listens, looks at a picture, and measures the card. What failed
stays in the status until the daemon starts again; the unit serves all the same, with what works.
"""

import logging
import time
from collections.abc import Callable, Iterator

import msgspec

from bricktrack_common.errors import BricktrackError, HardwareError
from bricktrack_device.capture.ring import FrameRing
from bricktrack_device.capture.trigger import Trigger
from bricktrack_device.config import DeviceConfig, ImuTable
from bricktrack_device.health.findings import CheckResult, good, tried
from bricktrack_device.health.inertial import check_imu
from bricktrack_device.in_time import in_time
from bricktrack_device.interfaces import Rig

logger = logging.getLogger(__name__)

STEP_LIMIT_S = 30.0
"""No step takes longer on a unit that works; systemd waits for all of them together (TimeoutStartSec)."""
_FIRST_KEYFRAME_S = 10.0
_REMEDY = "See 'bricktrackd check'; when it is mended: sudo systemctl restart bricktrackd"

Step = Callable[[], list[CheckResult]]


def run_self_test(config: DeviceConfig, rig: Rig, *, is_over: Callable[[], bool]) -> list[CheckResult]:
    """Try every part in turn, each for `STEP_LIMIT_S` at most; ends early, with less, when ``is_over``.

    What the configuration does not require fails as a warning.
    """
    results: list[CheckResult] = []
    for name, is_required, step in _steps(config, rig):
        if is_over():
            break
        for found in tried(name, _REMEDY, lambda name=name, step=step: _bounded(name, step)):  # type: ignore[misc]
            level = "warn" if found.level == "fail" and not is_required else found.level
            results.append(
                msgspec.structs.replace(
                    found,
                    name=f"self-test: {found.name}",
                    level=level,
                    detail=f"at the daemon's start: {found.detail}",
                    remedy="" if level == "ok" else _REMEDY,
                )
            )
    return results


def _steps(config: DeviceConfig, rig: Rig) -> Iterator[tuple[str, bool, Step]]:
    """Yield name, whether the unit needs the part, and what to call."""
    yield "trigger", True, lambda: _try_trigger(config, rig)
    for imu in config.imu:
        yield f"imu {imu.name}", imu.required, _imu_step(imu, rig)
    yield "camera", config.camera.required, lambda: _try_camera(rig)


def _imu_step(imu: ImuTable, rig: Rig) -> Step:
    return lambda: check_imu(imu, rig)


def _try_trigger(config: DeviceConfig, rig: Rig) -> list[CheckResult]:
    """Take the pin and give it back."""
    trigger = Trigger(rig.pin_factory(), config.trigger)
    try:
        level = "high" if trigger.line_is_high else "low"
        return [good("trigger", f"{trigger.pin_name} reads {level}")]
    finally:
        trigger.close()


def _try_camera(rig: Rig) -> list[CheckResult]:
    """Start the camera, which checks its controls, and wait for the first picture that can be decoded."""
    ring = FrameRing(round(_FIRST_KEYFRAME_S * 1e9))
    camera = rig.open_camera()
    try:
        section = camera.start(ring)
        deadline = time.monotonic() + _FIRST_KEYFRAME_S
        while ring.first_keyframe_us is None:
            if time.monotonic() > deadline:
                words = camera.problem() or f"{ring.n_packets} pictures came"
                raise HardwareError(f"{section.model}: no keyframe in {_FIRST_KEYFRAME_S:g} s: {words}")
            time.sleep(0.01)
    finally:
        camera.stop()
    return [good("camera", f"{section.model} delivers pictures, {section.mode.name}, {section.encoder}")]


def _bounded(name: str, step: Step) -> list[CheckResult]:
    """Return what a step finds; one that hangs is left to its thread."""

    def run() -> list[CheckResult]:
        try:
            return step()
        except (BricktrackError, OSError):
            raise
        except Exception as e:
            logger.exception("a bug in the self-test of %s", name)
            raise HardwareError(f"a bug in the self-test: {type(e).__name__}: {e}") from e

    return in_time(f"self-test of {name}", run, STEP_LIMIT_S, beat=lambda: None)
