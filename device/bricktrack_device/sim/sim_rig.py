"""All simulated hardware of one unit, around one world."""

import json
import platform
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import gpiozero
import msgspec
import numpy as np

from bricktrack_common.arrays import IntArray
from bricktrack_common.rotations import continuous_quaternions, quaternion_from_matrix
from bricktrack_common.run_manifest import TRUTH_NAME
from bricktrack_device.interfaces import BusOpener, Camera
from bricktrack_device.sim.imu_signal import ACC_LAG_S, GYRO_LAG_S, chip_period_s, sensor_biases
from bricktrack_device.sim.led_switch import LedSwitch, SimLeds
from bricktrack_device.sim.lens import lens_of
from bricktrack_device.sim.sim_camera import SimCamera
from bricktrack_device.sim.sim_i2c import SimBusOpener, bus_stream
from bricktrack_device.sim.sim_pins import SquareWave, make_factory
from bricktrack_device.sim.world import CARD_SLIDE_S, SimWorld, make_epoch

if TYPE_CHECKING:
    from bricktrack_device.config import CameraTable, DeviceConfig
    from bricktrack_device.sim.settings import SimSettings

_TRUTH_STEP_NS = 1_000_000


class SimRig:
    """A simulated unit, meeting `interfaces.Rig`."""

    simulated = True

    def __init__(self, settings: "SimSettings", camera: "CameraTable") -> None:
        self._settings = settings
        self._camera = camera
        self._epoch = make_epoch()
        self.world = SimWorld(settings, self._epoch)
        self.led_switch = LedSwitch()
        self._factory = make_factory()
        self._buses: list[str] = []
        self._wave = SquareWave(self.world, self._factory)

    def configure(self, config: "DeviceConfig") -> None:
        """Film by another configuration from the next camera on; the world stays as it is."""
        self._camera = config.camera

    def open_camera(self) -> Camera:
        """Return the camera, not yet started."""
        return SimCamera(self.world, self._camera, self.led_switch)

    def pin_factory(self) -> gpiozero.Factory:
        """Return the mock factory whose pins the square wave drives."""
        return self._factory

    def bus_opener(self, bus: str) -> BusOpener:
        """Return what opens a simulated bus; whatever it is called, a BNO055 is on it."""
        if bus not in self._buses:
            self._buses.append(bus)
        return SimBusOpener(self._settings, self._epoch, bus)

    def leds(self, pins: Sequence[str], *, active_high: bool = True) -> SimLeds:
        """Return the simulated LEDs, switched off; whatever the pins are called, they hang on them."""
        return SimLeds(self.led_switch, lit_afterwards=not pins)

    def on_armed(self, t_armed_ns: int) -> None:
        """Let the table start: schedule the first edge, and drive the line from there on."""
        self._wave.stop()
        self.world.schedule(t_armed_ns)
        self._wave.start()

    def write_truth(self, folder: Path, *, start_ns: int, end_ns: int) -> Path | None:
        """Write the true motion between two instants, 1 kHz, and what else is true, as ``truth.npz``."""
        t_ns = np.arange(start_ns, end_ns + 1, _TRUTH_STEP_NS, dtype=np.int64)
        R, t_mm = self.world.pose(t_ns)
        omega, v = self.world.twist(t_ns)
        settings, names = self._settings, self.world.brick.led_names
        hidden = [(h.start_s, h.duration_s) for h in settings.hidden_leds]
        streams = [bus_stream(bus) for bus in self._buses]
        biases = [sensor_biases(settings, stream) for stream in streams]
        path = folder / TRUTH_NAME
        np.savez_compressed(
            path,
            t_ns=t_ns,
            q_wxyz_camera_brick=continuous_quaternions(quaternion_from_matrix(R)),
            t_camera_brick_mm=t_mm,
            omega_brick_radps=omega,
            v_camera_mmps=v,
            dropouts_ns=self._intervals_ns(settings.dropouts, margin_s=0.0),
            dropouts_partial_ns=self._intervals_ns(settings.dropouts, margin_s=CARD_SLIDE_S),
            hidden_led_index=np.array([names.index(h.name) for h in settings.hidden_leds], dtype=np.int64),
            hidden_led_ns=self._intervals_ns(hidden, margin_s=0.0),
            gravity_camera_mps2=self.world.gravity_camera_mps2,
            imu_lags_s=np.array([ACC_LAG_S, GYRO_LAG_S]),
            imu_buses=np.array(self._buses, dtype=np.str_),
            imu_acc_bias_mps2=np.array([acc for acc, _ in biases]).reshape(-1, 3),
            imu_gyro_bias_dps=np.array([gyro for _, gyro in biases]).reshape(-1, 3),
            imu_sample_period_s=np.array([chip_period_s(settings, stream) for stream in streams]),
            settings_json=np.array(json.dumps(msgspec.to_builtins(settings))),
            lens_json=np.array(json.dumps(asdict(lens_of(settings.seed)))),
        )
        return path

    def _intervals_ns(self, intervals: Sequence[tuple[float, float]], *, margin_s: float) -> IntArray:
        """Return (start, duration) after the first edge, s, as (first, last) instants, ns, shape (k, 2)."""
        first = self.world.first_edge_ns
        if first is None:
            return np.empty((0, 2), dtype=np.int64)
        ends_s = [(start - margin_s, start + length + margin_s) for start, length in intervals]
        return first + np.rint(np.array(ends_s).reshape(-1, 2) * 1e9).astype(np.int64)

    def describe(self) -> dict[str, str]:
        """Return what the manifest says of the hardware: that there is none."""
        return {"model": "simulated unit", "kernel": platform.release(), "machine": platform.machine()}

    def close(self) -> None:
        """Stop the table."""
        self._wave.stop()
