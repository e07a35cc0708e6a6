"""How well the inertial sampler keeps its grid beside a 1080p30 encoding run and a busy process.

Run from the repository: ``python scripts/bench_imu_sampler.py [--slots 3000] [--full]``. Three loops read the same
simulated bus in one process, in turn, in blocks: the sampler of a run (absolute deadlines), the naive
``time.sleep(0.01)``, and the source paper's adaptive sleep. Beside them one process encodes simulated 1080p pictures
through libx264, 30 a second, and another does nothing but burn CPU. 3,000 slots a loop by default (two minutes),
10,000 (five minutes) with ``--full``.

The bus takes as long as a 46-byte burst does at 400 kHz, and its sensor is a table of registers: what is measured
is the loops, on a loaded machine's scheduler, not a simulated sensor's arithmetic. Exits with 1 if the grid drifted;
lost slots are counted and said.
"""

import argparse
import multiprocessing
import os
import sys
import time
from dataclasses import dataclass
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event
from pathlib import Path

from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.imu_records import FIRST_REGISTER, N_DATA_BYTES
from bricktrack_device.backends import open_rig
from bricktrack_device.config import CameraTable, DeviceConfig
from bricktrack_device.interfaces import BusOpener, I2cBus
from bricktrack_device.sim.led_renderer import LedRenderer
from bricktrack_device.sim.lens import lens_of
from bricktrack_device.sim.video_encoder import VideoEncoder
from bricktrack_device.timing.imu_test import measure_loops, print_report, summarise

BURST_S = 0.0003 + (N_DATA_BYTES + 3) * 9 / 400_000
MAX_DRIFT_PPM = 5.0
"""Wake-ups get later or earlier with the load: 100 us over 30 s are 3 ppm, and no drift of the grid."""
PERIOD_NS = 33_326_871
N_PICTURES = 24


class SteadyBus:
    """A bus whose set-up is another's, and whose bursts take their time on the wire and nothing else."""

    def __init__(self, bus: I2cBus) -> None:
        self._bus = bus
        self._n = 0

    def __getattr__(self, name: str) -> object:
        return getattr(self._bus, name)

    def read_burst(self, address: int, register: int, n_bytes: int) -> bytes:
        """Return registers; samples count up, so that each is new."""
        if n_bytes < 5 or register < FIRST_REGISTER:
            return self._bus.read_burst(address, register, n_bytes)
        self._n += 1
        time.sleep(BURST_S * n_bytes / N_DATA_BYTES)
        return self._n.to_bytes(4, "little") + bytes(n_bytes - 4)


@dataclass(frozen=True)
class SteadyOpener:
    """Opens a `SteadyBus` in the process that reads."""

    opener: BusOpener

    def __call__(self) -> I2cBus:
        """Return the bus, open."""
        return SteadyBus(self.opener())  # type: ignore[return-value]


class SteadyRig:
    """A simulated rig with steady buses."""

    def __init__(self, config: DeviceConfig) -> None:
        self._rig = open_rig(config)

    def __getattr__(self, name: str) -> object:
        return getattr(self._rig, name)

    def bus_opener(self, bus: str) -> BusOpener:
        """Return what opens a steady bus."""
        return SteadyOpener(self._rig.bus_opener(bus))


def encode(n_frames: "Synchronized[int]", stop: "Event") -> None:
    """Encode 1080p pictures at 30 frames a second until told to stop, as the simulated camera does."""
    rig = open_rig(DeviceConfig(backend="sim"))
    world = rig.world  # type: ignore[attr-defined]
    world.schedule(0)
    renderer = LedRenderer(
        world.settings, world, lens=lens_of(world.settings.seed), mode=IMX219_1080P, exposure_ns=2_000_000
    )
    pictures = [renderer.luma(3_000_000_000 + k * PERIOD_NS) for k in range(N_PICTURES)]
    encoder = VideoEncoder(CameraTable(), IMX219_1080P.width, IMX219_1080P.height)
    due_ns = monotonic_ns()
    while not stop.is_set():
        i = n_frames.value % N_PICTURES
        encoder.encode(n_frames.value, pictures[i], renderer.chroma_u, renderer.chroma_v)
        n_frames.value += 1
        due_ns = max(due_ns + PERIOD_NS, monotonic_ns() - 5 * PERIOD_NS)
        time.sleep(max(0.0, (due_ns - monotonic_ns()) * 1e-9))


def steal_s() -> float:
    """Return for how long a hypervisor has kept this machine's processors from it since boot, s."""
    with Path("/proc/stat").open(encoding="ascii") as file:
        return int(file.readline().split()[8]) / os.sysconf("SC_CLK_TCK")


def burn() -> None:
    """Keep one core busy."""
    while True:
        sum(range(10_000))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--slots", type=int, default=3000, help="slots a loop")
    parser.add_argument("--full", action="store_true", help="10,000 slots a loop")
    parser.add_argument("--idle", action="store_true", help="without camera and stressor")
    arguments = parser.parse_args()
    n_slots = 10_000 if arguments.full else arguments.slots
    config = DeviceConfig(backend="sim")
    rig = SteadyRig(config)
    print(
        f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; {n_slots} slots a loop"
        + ("" if arguments.idle else "; beside libx264 at 1080p30 and one busy process"),
        flush=True,
    )
    context = multiprocessing.get_context("spawn")
    n_frames, stop = context.Value("q", 0), context.Event()
    load = [
        context.Process(target=burn, daemon=True),
        context.Process(target=encode, args=(n_frames, stop), daemon=True),
    ]
    try:
        if not arguments.idle:
            for process in load:
                process.start()
            while n_frames.value < 10:
                time.sleep(0.1)
        imu = config.imu[0]
        start, before, stolen_s = time.monotonic(), n_frames.value, steal_s()
        measured = measure_loops(config, rig, imu, n_slots, block_slots=500)
        stolen_s = steal_s() - stolen_s
        frame_rate_hz = (n_frames.value - before) / (time.monotonic() - start)
    finally:
        stop.set()
        for process in load:
            if process.pid is not None:
                process.join(2 if process is load[1] else 0)
                process.kill()
        rig.close()
    result = summarise("this machine", rig, imu, n_slots, measured)
    print_report(result)
    if not arguments.idle:
        print(
            f"\nmeanwhile {frame_rate_hz:.1f} frames a second were encoded, of {1e9 / PERIOD_NS:.1f} (simulated pictures)"
        )
    print(
        f"the hypervisor kept the processors away for {stolen_s:.2f} s of it; load is now {os.getloadavg()[0]:.1f}"
    )
    grid = result.figures["grid"]
    if grid["slots_lost"]:
        worst_ms = {name: f["interval_error_us_p100"] / 1000 for name, f in result.figures.items()}
        print(
            f"{grid['slots_lost']} slots LOST. Worst interval: "
            + ", ".join(f"{name} {ms:.1f} ms" for name, ms in worst_ms.items())
            + ": where all loops show it, the machine held them off"
        )
    if abs(grid["drift_ppm"]) > MAX_DRIFT_PPM:
        print(f"the grid drifted by {grid['drift_ppm']:.2f} ppm", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
