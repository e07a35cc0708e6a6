"""The virtual Pi's knobs: pins to drive and a sensor to break. Used inside it only."""

import json
import subprocess
import sys
from pathlib import Path

PARAMETERS = Path("/sys/module/i2c_bno055_emu/parameters")
PINS = Path("/run/vpi/gpio")
BUS = "/dev/i2c-1"
ADDRESS = 0x28

_SQUARE = """
import json, sys, time
pin, hz, n = sys.argv[1], float(sys.argv[2]), int(sys.argv[3])
rises = []
with open(f"/run/vpi/gpio/sim_gpio{pin}/pull", "w") as f:
    t = time.monotonic() + 0.05
    for _ in range(n):
        for level in ("pull-up", "pull-down"):
            time.sleep(max(0.0, t - time.monotonic()))
            before = time.monotonic_ns()
            f.write(level); f.flush(); f.seek(0)
            if level == "pull-up":
                rises.append((before, time.monotonic_ns()))
            t += 0.5 / hz
json.dump(rises, sys.stdout)
"""


def set_sensor(name: str, value: int) -> None:
    """Turn one of the sensor's fault knobs."""
    (PARAMETERS / name).write_text(str(value))


def count(name: str) -> int:
    """Return one of the sensor's counters."""
    return int((PARAMETERS / name).read_text())


def drive(pin: int, *, up: bool) -> None:
    """Set the level of a pin."""
    (PINS / f"sim_gpio{pin}" / "pull").write_text("pull-up" if up else "pull-down")


def square_wave(pin: int, *, hz: float, n_periods: int) -> "subprocess.Popen[str]":
    """Drive a pin from another process."""
    return subprocess.Popen(
        [sys.executable, "-c", _SQUARE, str(pin), str(hz), str(n_periods)],
        stdout=subprocess.PIPE,
        text=True,
    )


def rises_of(wave: "subprocess.Popen[str]") -> list[tuple[int, int]]:
    """Return when each rising write of a finished wave began and ended, CLOCK_MONOTONIC, ns."""
    out, _ = wave.communicate(timeout=60)
    return [(before, after) for before, after in json.loads(out)]
