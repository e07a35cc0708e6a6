"""A simulated I2C bus with one BNO055, under the real driver and the real burst read."""

import errno
import os
import time
from dataclasses import dataclass
from zlib import crc32

import numpy as np

from bricktrack_common.clocks import monotonic_ns
from bricktrack_device.sim.bno055_chip import Bno055Chip
from bricktrack_device.sim.following_worker import FollowingWorker
from bricktrack_device.sim.imu_signal import ImuSensors, chip_period_s
from bricktrack_device.sim.settings import SimSettings
from bricktrack_device.sim.world import Epoch, SimWorld

_BUS_BYTE_S = 9 / 400_000
_BUS_OVERHEAD_S = 0.0003


def bus_stream(bus: str) -> int:
    """Return the number that tells the chip on this bus, its biases and its clock from others."""
    return crc32(bus.encode())


@dataclass(frozen=True, slots=True)
class SimBusOpener:
    """Opens a simulated bus in whichever process it is called; passes to that process when it is spawned."""

    settings: SimSettings
    epoch: Epoch  # type: ignore[type-arg]
    bus: str

    def __call__(self) -> "SimI2c":
        """Open the bus."""
        return SimI2c(SimWorld(self.settings, self.epoch), bus=self.bus)


class SimI2c:
    """A bus with one BNO055, meeting `interfaces.I2cBus`.

    Parameters
    ----------
    world : SimWorld
    bus : str
        Its name: another name is another chip, with biases and an identity of its own.
    """

    def __init__(self, world: SimWorld, *, bus: str = "") -> None:
        self._world = world
        self._settings = world.settings
        self._faults = world.settings.faults
        stream = bus_stream(bus)
        sensors = ImuSensors(world, on_camera=bus in world.settings.imu.on_camera, stream=stream)
        self._ahead = FollowingWorker("sim-imu")
        self.chip = Bno055Chip(
            np.random.default_rng([world.settings.seed, 10, stream]).bytes(16),
            sensors.measure,
            period_s=chip_period_s(world.settings, stream),
            ahead=self._ahead,
        )
        self._locked = False
        self._pointer = 0
        self._n_transactions = 0
        self._reset_done = False
        self._stuck: bytes | None = None

    def try_lock(self) -> bool:
        """Take the bus; tell whether that worked."""
        if self._locked:
            return False
        self._locked = True
        return True

    def unlock(self) -> None:
        """Give the bus back."""
        self._locked = False

    def writeto(self, address: int, buffer: bytes, *, start: int = 0, end: int | None = None) -> None:
        """Write a register's number and values behind it."""
        data = bytes(buffer[start : len(buffer) if end is None else end])
        t_ns = self._transfer(address, len(data))
        if data:
            self._pointer = data[0]
            self.chip.write(self._pointer, data[1:], t_ns)
            self._pointer += len(data) - 1

    def readfrom_into(
        self, address: int, buffer: bytearray, *, start: int = 0, end: int | None = None
    ) -> None:
        """Read on from the register last named."""
        end = len(buffer) if end is None else end
        buffer[start:end] = self.read_burst(address, self._pointer, end - start)

    def writeto_then_readfrom(
        self, address: int, out_buffer: bytes, in_buffer: bytearray, *, out_start: int = 0,
        out_end: int | None = None, in_start: int = 0, in_end: int | None = None,
    ) -> None:  # fmt: skip
        """Name a register and read from it with a repeated start."""
        self.writeto(address, out_buffer, start=out_start, end=out_end)
        self.readfrom_into(address, in_buffer, start=in_start, end=in_end)

    def read_burst(self, address: int, register: int, n_bytes: int) -> bytes:
        """Read consecutive registers in one transaction; raise `OSError` with its errno on failure."""
        start_ns = monotonic_ns()
        t_ns = self._transfer(address, n_bytes)
        data = self._corrupted(self.chip.read(register, n_bytes, t_ns), register)
        left_s = self._duration_s(n_bytes) - (monotonic_ns() - start_ns) * 1e-9
        if left_s > 0:
            time.sleep(left_s)
        return data

    def close(self) -> None:
        """Release the bus."""
        self._ahead.shutdown(wait=False, cancel_futures=True)

    @staticmethod
    def _duration_s(n_bytes: int) -> float:
        """Return how long a burst takes at 400 kHz; set-up's single bytes take no time worth a sleep."""
        return _BUS_OVERHEAD_S + (n_bytes + 3) * _BUS_BYTE_S if n_bytes > 8 else 0.0

    def _transfer(self, address: int, n_bytes: int) -> int:
        """Return the instant in the middle of a transaction that begins now, or fail as the bus fails."""
        now = monotonic_ns()
        faults, chip = self._faults, self.chip
        if address != self._settings.imu.address or faults.imu_absent or not chip.answers(now):
            raise OSError(errno.EREMOTEIO, os.strerror(errno.EREMOTEIO))
        since_s = float(self._world.since_first_edge_s(np.array([now]))[0])
        if any(start <= since_s < start + duration for start, duration in faults.imu_bus_down):
            raise OSError(faults.imu_nack_errno, os.strerror(faults.imu_nack_errno))
        if faults.imu_reset_s is not None and since_s > faults.imu_reset_s and not self._reset_done:
            self._reset_done = True  # a brown-out: nothing fails, the sensor just starts anew in CONFIG
            chip.power_up(now)
        if faults.imu_stuck_s is not None and since_s > faults.imu_stuck_s and self._stuck is None:
            self._stuck = chip.latest
        if chip.opr_mode:  # set-up is spared
            self._n_transactions += 1
            if faults.imu_nack_every and self._n_transactions % faults.imu_nack_every == 0:
                raise OSError(faults.imu_nack_errno, os.strerror(faults.imu_nack_errno))
        return now + round(0.5e9 * self._duration_s(n_bytes))

    def _corrupted(self, data: bytes, register: int) -> bytes:
        """Return what arrives of a burst of samples if the chip is stuck or a bit turns over."""
        if len(data) <= 8 or register != 0x08:
            return data
        if self._stuck is not None:
            data = self._stuck[: len(data)]
        every = self._faults.imu_bit_flip_every
        if every and self._n_transactions % every == 0:  # a stretched byte read high, as the BCM's bus does
            data = data[:1] + bytes([data[1] ^ 0x40]) + data[2:]
        return data
