"""The least hardware that the daemon's parts can be tried on: no picture, no motion, only the interfaces."""

import errno
import multiprocessing
import os
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import adafruit_bno055
import gpiozero
from gpiozero.pins.mock import MockFactory

from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import HardwareError
from bricktrack_common.run_manifest import CameraSection
from bricktrack_device.config import DeviceConfig
from bricktrack_device.hardware.led_bank import LedBank
from bricktrack_device.interfaces import (
    BusOpener,
    Camera,
    EncodedPacket,
    FrameMetadata,
    FrameSink,
    I2cBus,
    Leds,
    Still,
)


@dataclass
class FakeBus:
    """A BNO055's two register pages; the accelerometer's x counts bursts, so that no two samples are equal."""

    chip_id: int = 0xA0
    present: bool = True
    hang_after: int | None = None
    hang_s: float = 3600.0
    exit_after: int | None = None
    fail_every: int | None = None
    reset_after: int | None = None
    stuck_registers: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.pages = [bytearray(256), bytearray(256)]
        self.page = 0
        self.n_bursts = 0
        self._locked = False
        self._reset()

    def _reset(self) -> None:
        self.pages[0][:] = bytes(256)
        self.pages[0][0x00] = self.chip_id
        self.pages[0][0x34:0x37] = bytes((25, 0xFF, 0x0F))
        self.pages[0][0x3B], self.pages[0][0x41] = 0x80, 0x24
        self.pages[1][:] = bytes(256)
        self.pages[1][0x08], self.pages[1][0x0A] = 0x0D, 0x38
        self.pages[1][0x50:0x60] = bytes(range(16))
        self.page = 0

    def try_lock(self) -> bool:
        if self._locked:
            return False
        self._locked = True
        return True

    def unlock(self) -> None:
        self._locked = False

    def writeto(self, address: int, buffer: bytes, *, start: int = 0, end: int | None = None) -> None:
        self._answer(address)
        data = bytes(buffer)[start:end]
        for register, value in enumerate(data[1:], start=data[0] if data else 0):
            self._write(register, value)

    def _write(self, register: int, value: int) -> None:
        if register == 0x07:
            self.page = value & 1
        elif self.page == 0 and register == 0x3F and value & 0x20:
            self._reset()
        else:
            self.pages[self.page][register] = value
            for stuck, held in self.stuck_registers.items():
                self.pages[1][stuck] = held

    def readfrom_into(
        self, address: int, buffer: bytearray, *, start: int = 0, end: int | None = None
    ) -> None:
        self._answer(address)

    def writeto_then_readfrom(
        self, address: int, out_buffer: bytes, in_buffer: bytearray, *, out_start: int = 0,
        out_end: int | None = None, in_start: int = 0, in_end: int | None = None,
    ) -> None:  # fmt: skip
        self._answer(address)
        register = out_buffer[out_start]
        n = (len(in_buffer) if in_end is None else in_end) - in_start
        in_buffer[in_start : in_start + n] = self.pages[self.page][register : register + n]

    def read_burst(self, address: int, register: int, n_bytes: int) -> bytes:
        self._answer(address)
        if register == 0x08 and n_bytes == 46:
            self.n_bursts += 1
            if self.hang_after is not None and self.n_bursts == self.hang_after + 1:
                time.sleep(self.hang_s)
            if self.exit_after is not None and self.n_bursts > self.exit_after:
                os._exit(7)
            if self.fail_every is not None and self.n_bursts % self.fail_every == 0:
                raise OSError(errno.EREMOTEIO, "injected")
            if self.n_bursts == self.reset_after:
                self._reset()
            self.pages[0][0x08:0x0A] = (1 + self.n_bursts % 1000).to_bytes(2, "little")
        return bytes(self.pages[self.page][register : register + n_bytes])

    def close(self) -> None:
        self._locked = False

    def _answer(self, address: int) -> None:
        if not self.present or address != 0x28:
            raise OSError(errno.EREMOTEIO, "no acknowledge")


@dataclass(frozen=True)
class FakeBusOpener:
    """Picklable, as an opener must be."""

    present: bool = True
    hang_at_opening: bool = False
    hang_after: int | None = None
    hang_s: float = 3600.0
    exit_after: int | None = None
    fail_every: int | None = None
    reset_after: int | None = None

    def __call__(self) -> I2cBus:
        if self.hang_at_opening:
            time.sleep(3600)
        if multiprocessing.parent_process() is not None:
            # In a sampler's process the driver need not wait 0.7 s for a table of registers.
            adafruit_bno055.time = SimpleNamespace(sleep=lambda seconds: None)
        return FakeBus(
            present=self.present, hang_after=self.hang_after, hang_s=self.hang_s, exit_after=self.exit_after,
            fail_every=self.fail_every, reset_after=self.reset_after,
        )  # fmt: skip


class FakeCamera:
    """Emits small packets on CLOCK_MONOTONIC from its own thread."""

    def __init__(
        self,
        *,
        period_us: int = 33_327,
        iperiod: int = 6,
        fail: str = "",
        silent_after: int | None = None,
        n_bytes: int = 9,
    ) -> None:
        self.period_us = period_us
        self.iperiod = iperiod
        self.fail = fail
        self.silent_after = silent_after
        self.n_bytes = n_bytes
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.n_stops = 0
        self.picture: Still | None = None
        self.trouble: str | None = None
        self.stop_error: Exception | None = None

    def start(self, sink: FrameSink) -> CameraSection:
        if self.fail:
            raise HardwareError(self.fail)
        self._stop.clear()
        self._thread = threading.Thread(target=self._stream, args=(sink,), daemon=True)
        self._thread.start()
        return CameraSection(
            model="fake", mode=IMX219_1080P, exposure_us=2000, analogue_gain=1.0, colour_gains=(1.0, 1.0),
            frame_duration_us=self.period_us, encoder="none", encoder_settings={},
        )  # fmt: skip

    def still(self) -> Still | None:
        return self.picture

    def problem(self) -> str | None:
        return self.trouble

    def stop(self) -> None:
        self.n_stops += 1
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        if self.stop_error is not None:
            raise self.stop_error

    def _stream(self, sink: FrameSink) -> None:
        t_ns = monotonic_ns()
        n = 0
        while not self._stop.wait(max(0.0, (t_ns - monotonic_ns()) / 1e9)):
            if self.silent_after is not None and n >= self.silent_after:
                self._stop.wait()
                return
            sink.on_metadata(FrameMetadata(t_ns, 2000, 1.0, self.period_us))
            data = (b"\0\0\0\1\x65" + n.to_bytes(4, "big")).ljust(self.n_bytes, b"\x5a")
            sink.on_packet(EncodedPacket(t_ns // 1000, n % self.iperiod == 0, data))
            t_ns += self.period_us * 1000
            n += 1


class FakeRig:
    """A camera, a mock pin and fake buses; `pulse` drives the trigger's line."""

    simulated = True

    def __init__(
        self, *, camera: FakeCamera | None = None, buses: dict[str, BusOpener] | None = None
    ) -> None:
        self.camera = camera or FakeCamera()
        self.buses = buses or {}
        self.factory = MockFactory()
        self.armed_ns: list[int] = []
        self.truth_error: OSError | None = None
        self.closed = False

    def configure(self, config: DeviceConfig) -> None:
        self.config = config

    def open_camera(self) -> Camera:
        return self.camera

    def pin_factory(self) -> gpiozero.Factory:
        return self.factory

    def bus_opener(self, bus: str) -> BusOpener:
        return self.buses.get(bus, FakeBusOpener())

    def leds(self, pins: Sequence[str], *, active_high: bool = True) -> Leds:
        return LedBank(pins, self.factory, active_high=active_high)

    def on_armed(self, t_armed_ns: int) -> None:
        self.armed_ns.append(t_armed_ns)

    def write_truth(self, folder: Path, *, start_ns: int, end_ns: int) -> Path | None:
        if self.truth_error is not None:
            raise self.truth_error
        path = folder / "truth.npz"
        path.write_bytes(f"{start_ns} {end_ns}".encode())
        return path

    def describe(self) -> dict[str, str]:
        return {"model": "fake"}

    def close(self) -> None:
        self.closed = True

    def pulse(self, n: int = 1, *, pin: str = "GPIO17", half_period_s: float = 0.01) -> None:
        mock = self.factory.pin(pin)
        for _ in range(n):
            mock.drive_high()
            time.sleep(half_period_s)
            mock.drive_low()
            time.sleep(half_period_s)
