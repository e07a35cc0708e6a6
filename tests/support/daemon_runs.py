"""Runs as a simulated unit records them, without video and without waiting: chip registers and LED centroids.

The inertial samples come from the simulated chip, read burst by burst on a punctual grid that beats with the
chip's own clock, and are decoded as a run's are. The LEDs are seen by a pinhole camera with distortion, each
over its own rows' exposures, with white noise and, where asked for, errors that stand still.
"""

from dataclasses import dataclass

import numpy as np
from pinhole import PinholeCamera

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel, ProfileEntry
from bricktrack_common.imu_records import (
    FIRST_REGISTER,
    N_DATA_BYTES,
    STANDARD_GRAVITY_MPS2,
    ImuDescription,
    ImuRecord,
    decode_imu,
)
from bricktrack_device.sim.bno055_chip import Bno055Chip
from bricktrack_device.sim.imu_signal import ImuSensors, chip_period_s
from bricktrack_device.sim.settings import HiddenLed, SimImu, SimSettings
from bricktrack_device.sim.world import SimWorld
from bricktrack_host.fusion.pose_by_pose.moving_camera import CameraImu
from bricktrack_host.tracking.led_model.led_profile import LedPrediction, predict_brick
from bricktrack_host.tracks import ImuTrack, LedObservations

EPOCH_NS = 50_000_000_000
_COLLAR_MM = 0.7
_OWN_SHARE = 0.5  # of the profile's doubt, of each LED for itself
_SIZE_SD = 5e-5
_FRAME_PERIOD_NS = 33_326_890
_EXPOSURE_NS = 2_000_000
_PERIOD_NS = 10_000_000
_ACC_CONFIG_16G_62HZ, _AMG = 0x0F, 0x07


class _FixedEpoch:
    """The first edge where no process needs to be told of it."""

    value = EPOCH_NS


@dataclass(frozen=True, slots=True, eq=False)
class DaemonRun:
    """What a unit recorded, and the world that it was recorded in.

    ``camera_imu``: what moves with the camera, where it does.
    """

    observations: LedObservations
    imu: ImuTrack
    camera: PinholeCamera
    brick: BrickModel
    world: SimWorld
    stamp_offset_ns: int
    camera_imu: CameraImu | None = None

    def truth(self, t_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return true rotations and positions, mm, at camera times."""
        return self.world.pose(t_ns)

    @property
    def lever_arm_mm(self) -> FloatArray:
        """From the origin LED to the IMU, brick axes."""
        if self.brick.imu_lever_arm_mm is None:
            raise ValueError("the simulated brick has no IMU")
        return self.brick.imu_lever_arm_mm

    def hidden(self, t_ns: IntArray) -> FloatArray:
        """Return whether instants lie in a dropout."""
        since = self.world.since_first_edge_s(t_ns)
        return np.any([(since > a) & (since < a + d) for a, d in self.world.settings.dropouts], axis=0)


def simulate_run(
    seed: int,
    *,
    motion: str = "impacts",
    amplitude_mm: float = 3.0,
    amplitude_deg: float = 2.0,
    impact_mps: float = 0.1,
    dropouts: tuple[tuple[float, float], ...] = (),
    hidden_leds: tuple[tuple[str, float, float], ...] = (),
    duration_s: float = 15.0,
    stamp_offset_ns: int = 0,
    centroid_sd_px: float = 0.05,
    clock_ppm: float | None = None,
    acc_range_g: int = 16,
    outlier_share: float = 0.0,
    late_share: float = 0.0,
    standing_px: float | None = None,
    camera_acc_g: float = 0.0,
    camera_rocking_deg: float = 0.0,
    has_camera_imu: bool = False,
) -> DaemonRun:
    """Return one run: a second of rest, a shake, a second of rest.

    Parameters
    ----------
    hidden_leds : tuple of (name, start_s, duration_s)
    stamp_offset_ns : int, ns
        Added to the inertial stamps: what the alignment has to find, beside the sensors' lags.
    clock_ppm : float, optional
        By how much the chip's clock is slow; else the seed says.
    outlier_share : float
        Of LED centroids that are up to 8 px off.
    late_share : float
        Of inertial reads that an overloaded machine makes up to 35 ms late; slots gone by are skipped.
    standing_px : float, px, optional
        Standard deviation of an error of each LED that stands still over the run; with it come those of the
        LEDs' profile, as the layout states it, and of the picture's size. Without: none of them.
    camera_acc_g, camera_rocking_deg : float
        How the camera's component is shaken and rocked, rms along and about each axis; what the camera sees
        of the brick stays the same.
    has_camera_imu : bool
        Whether a chip is on the camera's component.
    """
    settings = SimSettings(
        seed=seed,
        motion=motion,
        amplitude_mm=amplitude_mm,
        amplitude_deg=amplitude_deg,
        impact_mps=impact_mps,
        quiet_s=1.0,
        shake_s=duration_s - 2.0,
        dropouts=list(dropouts),
        hidden_leds=[HiddenLed(name=n, start_s=a, duration_s=d) for n, a, d in hidden_leds],
        camera_acc_g=camera_acc_g,
        camera_rocking_deg=camera_rocking_deg,
        imu=SimImu(clock_ppm=clock_ppm),
    )
    world = SimWorld(settings, _FixedEpoch())
    rng = np.random.default_rng([seed, 77])
    camera = PinholeCamera()
    brick = world.brick
    brick = BrickModel(
        name=brick.name,
        led_names=brick.led_names,
        led_positions_mm=brick.led_positions_mm,
        led_axes=brick.led_axes,
        led_radii_mm=brick.led_radii_mm,
        imu_lever_arm_mm=brick.imu_lever_arm_mm,
        R_brick_imu=brick.R_brick_imu,
        led_profile=ProfileEntry(collar_mm=_COLLAR_MM, source="simulated"),
    )
    observations = _observe(world, camera, brick, rng, duration_s, centroid_sd_px, outlier_share, standing_px)
    shared = duration_s, stamp_offset_ns, acc_range_g, late_share
    imu = _sample(world, rng, *shared, on_camera=False)
    camera_imu = None
    if has_camera_imu:
        samples = _sample(world, np.random.default_rng([seed, 80]), *shared, on_camera=True)
        camera_imu = CameraImu(samples, -np.array(settings.imu.on_camera_mm))
    return DaemonRun(observations, imu, camera, brick, world, stamp_offset_ns, camera_imu)


def _observe(
    world: SimWorld,
    camera: PinholeCamera,
    brick: BrickModel,
    rng: np.random.Generator,
    duration_s: float,
    sd_px: float,
    outlier_share: float,
    standing_px: float | None,
) -> LedObservations:
    n = int(duration_s * 1e9 / _FRAME_PERIOD_NS)
    stamp = (
        EPOCH_NS + round(rng.uniform(0, _FRAME_PERIOD_NS)) + np.arange(n, dtype=np.int64) * _FRAME_PERIOD_NS
    )
    mode = camera.sensor_mode
    v = np.full((n, brick.n_leds), 0.5 * mode.height)
    for _ in range(4):  # the row decides the instant, and the instant the row
        t_ns = stamp[:, None] - _EXPOSURE_NS // 2 + np.rint(mode.row_delay_ns(v)).astype(np.int64)
        R, t_mm = world.pose(t_ns.ravel())
        pose = R.reshape(n, -1, 3, 3), t_mm.reshape(n, -1, 3)
        prediction, _ = predict_brick(*pose, camera, brick, collar_mm=_COLLAR_MM)
        v = prediction.uv_px[..., 1]
    uv = _gathered_px(world, camera, brick, t_ns, prediction.area_px2)
    uv += rng.normal(0, sd_px, uv.shape)
    if standing_px is not None:
        uv += _standing_px(prediction, camera, standing_px, np.random.default_rng([world.settings.seed, 79]))
    far = rng.random(uv.shape[:2]) < outlier_share
    uv[far] += rng.uniform(-8, 8, (int(far.sum()), 2))
    gone = world.leds_hidden(t_ns[:, 0]) | (world.card_cover(t_ns[:, 0]) > 0)[:, None]
    uv[gone] = np.nan
    return LedObservations(
        sensor_timestamp_ns=stamp,
        exposure_ns=np.full(n, _EXPOSURE_NS, dtype=np.int64),
        uv_px=uv,
        cov_px2=np.broadcast_to(sd_px**2 * np.eye(2), (*uv.shape, 2)).copy(),
        area_px2=prediction.area_px2,
        led_flags=np.zeros(uv.shape[:2], dtype=np.int64),
        frame_flags=np.zeros(n, dtype=np.int64),
    )


def _gathered_px(
    world: SimWorld, camera: PinholeCamera, brick: BrickModel, t_ns: IntArray, area_px2: FloatArray
) -> FloatArray:
    """Return the mean picture of LEDs whose light is gathered over the exposure, and over a disc's rows."""
    even, chords = np.sqrt(0.6) * np.array([-1, 0, 1]), np.sqrt(0.5) * np.array([-1, 0, 1])
    of_even, of_chords = np.array([5, 8, 5]) / 18, np.array([1, 2, 1]) / 4
    radius_ns = np.sqrt(area_px2 / np.pi) * camera.sensor_mode.line_time_ns
    uv = np.zeros((*t_ns.shape, 2))
    for a, weight_a in zip(even, of_even, strict=True):
        for b, weight_b in zip(chords, of_chords, strict=True):
            at_ns = t_ns + np.rint(a * _EXPOSURE_NS / 2 + b * radius_ns).astype(np.int64)
            R, t_mm = world.pose(at_ns.ravel())
            pose = R.reshape(*t_ns.shape, 3, 3), t_mm.reshape(*t_ns.shape, 3)
            prediction, _ = predict_brick(*pose, camera, brick, collar_mm=_COLLAR_MM)
            uv += weight_a * weight_b * prediction.uv_px
    return uv


def _standing_px(
    prediction: LedPrediction, camera: PinholeCamera, sd_px: float, rng: np.random.Generator
) -> FloatArray:
    """Return errors that stand still: of the profile, of the picture's size, and of each LED, which see."""
    shift, n_leds = prediction.model_shift_px, prediction.uv_px.shape[1]
    from_centre = prediction.uv_px - 0.5 * np.array([camera.sensor_mode.width, camera.sensor_mode.height])
    profile = rng.normal() + _OWN_SHARE * rng.normal(size=(n_leds, 1))
    return profile * shift + _SIZE_SD * rng.normal() * from_centre + rng.normal(0, sd_px, (n_leds, 2))


def _sample(
    world: SimWorld,
    rng: np.random.Generator,
    duration_s: float,
    stamp_offset_ns: int,
    acc_range_g: int,
    late_share: float,
    *,
    on_camera: bool,
) -> ImuTrack:
    t0_ns = EPOCH_NS - 400_000_000 + round(rng.uniform(0, _PERIOD_NS))
    description = imu_description(t0_ns, acc_range_g=acc_range_g, on_camera=on_camera)
    n_slots = int((duration_s + 0.8) * 100)
    on_ns = EPOCH_NS - 2_000_000_000
    records = read_chip(world, description, rng, n_slots, on_ns=on_ns, late_share=late_share)
    samples = decode_imu(description, records)
    return ImuTrack(
        t_ns=samples.t_ns + stamp_offset_ns,
        acc_mps2=samples.acc_mps2,
        gyro_radps=samples.gyro_radps,
        flags=samples.flags,
        acc_range_mps2=acc_range_g * STANDARD_GRAVITY_MPS2,
    )


def imu_description(t0_ns: int, *, acc_range_g: int = 16, on_camera: bool = False) -> ImuDescription:
    """Return what a unit says of a chip whose grid begins at this instant."""
    return ImuDescription(
        name="camera" if on_camera else "brick",
        chip_id="",
        bus="sim",
        address=0x28,
        opr_mode=_AMG,
        fusion=False,
        acc_range_g=float(acc_range_g),
        period_ns=_PERIOD_NS,
        t0_ns=t0_ns,
    )


def read_chip(
    world: SimWorld,
    description: ImuDescription,
    rng: np.random.Generator,
    n_slots: int,
    *,
    on_ns: int,
    late_share: float = 0.0,
) -> list[ImuRecord]:
    """Return the bursts that a unit reads, slot by slot, from a simulated chip switched on at an instant."""
    on_camera = description.name == "camera"
    stream, t0_ns = 2 if on_camera else 1, description.t0_ns
    sensors = ImuSensors(world, on_camera=on_camera, stream=stream)
    chip = Bno055Chip(bytes(16), sensors.measure, period_s=chip_period_s(world.settings, stream))
    range_code = {2: 0, 4: 1, 8: 2, 16: 3}[round(description.acc_range_g)]
    for register, value in (
        (0x07, 1),
        (0x08, _ACC_CONFIG_16G_62HZ & ~3 | range_code),
        (0x07, 0),
        (0x3D, _AMG),
    ):
        chip.write(register, bytes([value]), on_ns)
    records: list[ImuRecord] = []
    late = np.random.default_rng([world.settings.seed, 81 if on_camera else 78])
    for slot in range(n_slots):
        # A wake-up is late by some 30 us, now and then by more; a burst takes 1.3 ms, give or take.
        due = t0_ns + slot * _PERIOD_NS
        if records and due < records[-1].t_after_ns:
            continue
        before = due + round(abs(rng.normal(0, 3e4)) + (rng.random() < 0.01) * 4e5)
        before += round((late.random() < late_share) * late.uniform(0, 3.5e7))
        after = before + round(1.3e6 + abs(rng.normal(0, 2e4)))
        data = chip.read(FIRST_REGISTER, N_DATA_BYTES, (before + after) // 2)
        records.append(ImuRecord(slot, before, after, data, 0, None))
    return records
