"""The trigger's line: which level it has, and which wave is on it."""

import time
from collections.abc import Sequence
from itertools import pairwise
from statistics import median

from bricktrack_device.capture.trigger import Trigger
from bricktrack_device.config import DeviceConfig, TriggerTable
from bricktrack_device.health.findings import CheckResult, good, warning
from bricktrack_device.interfaces import Rig

LISTEN_S = 1.0
_RATE_TOLERANCE = 0.02


def check_trigger(config: DeviceConfig, rig: Rig, *, listen_s: float | None = None) -> list[CheckResult]:
    """Listen to the line for a while; raises `HardwareError` where the pin cannot be had."""
    listen_s = LISTEN_S if listen_s is None else listen_s
    factory = rig.pin_factory()
    # Edges count from the start here, whatever the level and however short the quiet before them.
    listening = TriggerTable(
        pin=config.trigger.pin, pull=config.trigger.pull, require_low=False, quiet_gap_ms=0.0
    )
    trigger = Trigger(factory, listening)
    try:
        level = "high" if trigger.line_is_high else "low"
        pin = good("trigger", f"{trigger.pin_name} reads {level} through {type(factory).__name__}")
        trigger.arm(lambda: None)
        time.sleep(listen_s)
        train = trigger.disarm()
    finally:
        trigger.close()
    wave = judge_wave(train.edges_ns, listen_s=listen_s, level=level, nominal_hz=config.trigger.nominal_hz)
    lost = [warning("trigger stamps", words, "Use kernel 5.7 or newer and lgpio") for words in train.problems]
    return [pin, wave, *lost]


def judge_wave(
    edges_ns: Sequence[int], *, listen_s: float, level: str, nominal_hz: float | None
) -> CheckResult:
    """Say what is on the line, from the rising edges of some seconds."""
    name = "trigger line"
    if not edges_ns:
        words = f"steady {level} for {listen_s:g} s"
        if level == "high":
            remedy = "An open or stuck line: check the cable and the divider. A wave must start from low"
            return warning(name, words, remedy)
        return good(name, f"{words}: no wave now, and none pretended")
    if len(edges_ns) < 3:
        remedy = "Shield the cable, and check that wave and unit share their ground"
        return warning(name, f"{len(edges_ns)} rising edges in {listen_s:g} s: a glitch, no wave", remedy)
    gaps_ns = [b - a for a, b in pairwise(edges_ns)]
    period_ns = median(gaps_ns)
    rate_hz = 1e9 / period_ns
    odd = sum(abs(gap - period_ns) > 0.25 * period_ns for gap in gaps_ns)
    words = f"{len(edges_ns)} rising edges in {listen_s:g} s, {rate_hz:.3f} Hz"
    if odd:
        remedy = "Shield the cable; feed the pin 0 and 3.3 V with steep edges"
        return warning(name, f"{words}, and {odd} intervals off by more than a quarter", remedy)
    if nominal_hz is not None and abs(rate_hz - nominal_hz) > _RATE_TOLERANCE * nominal_hz:
        return warning(name, f"{words}; expected {nominal_hz:g} Hz", "Set trigger.nominal_hz, or the wave")
    return good(name, words)
