"""Windows of real inertial and motion-capture recordings, made into what a camera and a BNO055 would give.

Data: six windows of BROAD (Laidig, Caruso, Aparicio, Seel, Data 6(7):72, 2021, CC BY 4.0). Their README holds
the recipe followed here: poses thinned to camera rate with noise and dropouts, a hidden time offset and
skew, an unknown direction of gravity, and inertial signals made BNO055-like (simulated sensor on recorded
motion). Every random choice comes from the seed, so that other seeds are other data.
"""

import argparse
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.signal import butter, filtfilt, lfilter
from scipy.spatial.transform import Rotation, Slerp

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.rotations import matrix_from_rvec
from bricktrack_host.fusion.inertial.imu_signal import chain_rotations
from bricktrack_host.quality import PoseFlag
from bricktrack_host.tracks import ImuTrack, OpticalTrack

LEVER_ARM_MM = (26.045, 53.000, 14.199)
CAMERA_EPOCH_NS = 1_000_000_000_000  # what the camera's clock says at the recording's t = 0
GYRO_LAG_S = 4.19e-3
ACC_LAG_S = 2.53e-3
N_GYRO_FITS = 3


@dataclass(frozen=True, slots=True)
class Recipe:
    """What is done to a window; the defaults are the README's.

    ``clip_share``: the accelerometer's range is so small that this share of the samples lies beyond it on some
    axis; none of the windows reaches 4 g.
    """

    frame_rate_hz: float = 30.0058
    position_sd_mm: float = 0.1
    rotation_sd_deg: float = 0.1
    n_dropouts: int = 4
    imu_rate_hz: float = 100.0
    lowpass_hz: float = 40.0
    lowpass_order: int = 2
    acc_step_mps2: float = 0.01
    gyro_step_radps: float = np.deg2rad(1 / 16)
    acc_range_g: float = 16.0
    clip_share: float = 0.0
    keep_native_lags: bool = False
    max_offset_s: float = 0.15
    max_skew: float = 50e-6
    stamp_jitter_s: float = 40e-6
    outlier_share: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One window after the recipe: what the fusion gets, and the truth that it does not get.

    R_clean, t_clean_mm : the same without most of the reference's own errors, see `cleaned_reference`.
    """

    name: str
    optical: OpticalTrack
    imu: ImuTrack
    offset_s: float
    lag_s: float
    t_out_ns: IntArray
    R_true: FloatArray
    t_true_mm: FloatArray
    in_dropout: BoolArray
    R_clean: FloatArray
    t_clean_mm: FloatArray


def add_windows_argument(parser: argparse.ArgumentParser) -> None:
    """Let a benchmark be given the folder of the windows."""
    parser.add_argument(
        "folder", type=Path, nargs="?", help="of the windows (*.npz); default: $BRICKTRACK_SAMPLES/fusion"
    )


def windows_in(folder: Path | None, parser: argparse.ArgumentParser) -> list[Path]:
    """Return the windows' files; none, and a word, where no folder is given and none known."""
    if folder is None:
        if not (root := os.environ.get("BRICKTRACK_SAMPLES")):
            print("BRICKTRACK_SAMPLES is not set: no recorded windows")
            return []
        folder = Path(root) / "fusion"
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        parser.error(f"no *.npz in {folder}")
    return paths


def _dropouts(rng: np.random.Generator, n: int, t_end_s: float) -> list[tuple[float, float]]:
    """Return ``n`` stretches of 0.15-0.5 s, each in its own part of the run."""
    edges = np.linspace(0.8, t_end_s - 0.8, n + 1)
    lengths = rng.uniform(0.15, 0.5, n)
    return [
        (a, a + d)
        for a, d in (
            (rng.uniform(lo, hi - d), d) for lo, hi, d in zip(edges, edges[1:], lengths, strict=False)
        )
    ]


def cleaned_reference(
    t_s: FloatArray,
    body: Rotation,
    sensor_m: FloatArray,
    *,
    t_gyro: FloatArray,
    gyro: FloatArray,
    t_acc: FloatArray,
    acc: FloatArray,
) -> tuple[Rotation, FloatArray]:
    """Return the reference's attitudes and positions of the sensor, m, without most of its own errors.

    Cameras see markers to some hundredths of a millimetre and of a degree, and worse while they move fast: as
    much as the fusion errs. The inertial unit at its native rate knows fast motion far better (above 0.5 Hz
    its gyro integrates to 0.002 deg, above 5 Hz its accelerometer to some micrometres), slow motion not at all.
    So the reference's error is what it differs by, faster than that, from the signals integrated. Scale,
    crossed axes, bias and delay of the gyro would differ too, and are fitted first.
    """
    native_hz = 1 / np.median(np.diff(t_s))

    def above(values: FloatArray, hz: float) -> FloatArray:
        b, a = butter(3, hz, btype="high", fs=native_hz)
        return np.asarray(filtfilt(b, a, values, axis=0, method="gust"))

    dt, start = np.diff(t_s)[:, None, None], body[0]
    for _ in range(N_GYRO_FITS):
        rate = CubicSpline(t_gyro, gyro)
        steps = matrix_from_rvec(np.diff(rate.antiderivative()(t_s), axis=0))
        by_gyro = start * Rotation.from_matrix(np.concatenate([np.eye(3)[None], chain_rotations(steps)]))
        off = (body * by_gyro.inv()).as_rotvec()  # in the scene's axes
        # What bias (3), gains (9), delay (1) and the start (3) turn it by, to first order.
        R, omega = by_gyro.as_matrix(), rate(t_s)
        turns = np.concatenate([R, (R[..., None] * omega[:, None, None, :]).reshape(-1, 3, 9)], axis=2)
        grown = np.cumsum(0.5 * (turns[1:] + turns[:-1]) * dt, axis=0)
        grown = np.concatenate([np.zeros((1, 3, 12)), grown])
        from_start = np.broadcast_to(np.eye(3), R.shape)
        causes = np.concatenate([grown, R @ omega[..., None], from_start], axis=2).reshape(-1, 16)
        fit = np.linalg.lstsq(causes, off.ravel(), rcond=None)[0]
        gyro = gyro + fit[:3] + gyro @ fit[3:12].reshape(3, 3).T + fit[12] * rate(t_gyro, 1)
        start = Rotation.from_rotvec(fit[13:]) * start
    clean = Rotation.from_rotvec(-above(off - (causes @ fit).reshape(-1, 3), 0.5)) * body

    force = clean.apply(CubicSpline(t_acc, acc)(t_s))
    acceleration = CubicSpline(t_s, force - force.mean(axis=0))
    felt_m = acceleration.antiderivative(2)(t_s)
    # Drifts of the integrals are parabolas and slow waves; a parabola less, nothing of them is above 5 Hz.
    off_m = sensor_m - felt_m
    powers = np.vander(np.linspace(-1, 1, len(t_s)), 4)
    off_m = off_m - powers @ np.linalg.lstsq(powers, off_m, rcond=None)[0]
    return clean, sensor_m - above(off_m, 5.0)


def make_case(path: Path, *, seed: int, recipe: Recipe | None = None) -> Case:
    """Return one window treated by the recipe; the same seed gives the same case."""
    recipe = recipe or Recipe()
    rng = np.random.default_rng([seed, *path.stem.encode()])
    with np.load(path) as d:
        t, p_m, q_xyzw = d["t_mocap"], d["p"], d["q_xyzw"]
        t_gyro, gyro = d["t_gyro"], d["gyro"].astype(np.float64)
        t_acc, acc = d["t_acc"], d["acc"].astype(np.float64)
        sensor_m = d["imu_in_opt_m"]
    scene = Rotation.random(rng=rng)
    body = scene * Rotation.from_quat(q_xyzw)
    lever_m = np.array(LEVER_ARM_MM) / 1000
    origin_mm = 1000 * (scene.apply(p_m) + body.apply(sensor_m - lever_m))
    position, attitude = CubicSpline(t, origin_mm), Slerp(t, body)
    clean, clean_sensor_m = cleaned_reference(
        t, body, scene.apply(p_m) + body.apply(sensor_m), t_gyro=t_gyro, gyro=gyro, t_acc=t_acc, acc=acc
    )
    clean_position = CubicSpline(t, 1000 * (clean_sensor_m - clean.apply(lever_m)))

    if recipe.keep_native_lags:
        t_gyro, t_acc = t_gyro + GYRO_LAG_S, t_acc + ACC_LAG_S

    optical, t_frame, dropouts = _film(rng, recipe, attitude, position)
    imu, t_sample, offset_s = _feel(
        rng,
        recipe,
        (t_gyro, gyro),
        (t_acc, acc),
        native_hz=1 / np.median(np.diff(t)),
        t_mid=0.5 * (t_frame[0] + t_frame[-1]),
    )

    seen = t_frame[np.isfinite(optical.t_camera_brick_mm[:, 0])]
    t_out = t_sample[(t_sample >= seen[0]) & (t_sample <= seen[-1])]
    inside = np.zeros(t_out.size, dtype=bool)
    for a_s, b_s in dropouts:
        inside |= (t_out > a_s) & (t_out < b_s)
    return Case(
        name=path.stem.removeprefix("dev_"),
        optical=optical,
        imu=imu,
        offset_s=offset_s + (GYRO_LAG_S if recipe.keep_native_lags else 0.0),
        lag_s=(ACC_LAG_S - GYRO_LAG_S) if recipe.keep_native_lags else 0.0,
        t_out_ns=CAMERA_EPOCH_NS + np.round(t_out * 1e9).astype(np.int64),
        R_true=attitude(t_out).as_matrix(),
        t_true_mm=position(t_out),
        in_dropout=inside,
        R_clean=Slerp(t, clean)(t_out).as_matrix(),
        t_clean_mm=clean_position(t_out),
    )


def _film(
    rng: np.random.Generator, recipe: Recipe, attitude: Slerp, position: CubicSpline
) -> tuple[OpticalTrack, FloatArray, list[tuple[float, float]]]:
    """Return the noisy poses of the frames, when they were, s, and the dropouts among them, s."""
    t_frame = np.arange(rng.uniform(0, 1 / recipe.frame_rate_hz), 15.0, 1 / recipe.frame_rate_hz)
    noise_rad = rng.normal(0, np.deg2rad(recipe.rotation_sd_deg), (t_frame.size, 3))
    R = (attitude(t_frame) * Rotation.from_rotvec(noise_rad)).as_matrix()
    p_mm = position(t_frame) + rng.normal(0, recipe.position_sd_mm, (t_frame.size, 3))
    outlier = rng.random(t_frame.size) < recipe.outlier_share
    p_mm[outlier] += rng.normal(0, 8.0, (outlier.sum(), 3))
    dropouts = _dropouts(rng, recipe.n_dropouts, 15.0)
    lost = np.zeros(t_frame.size, dtype=bool)
    for a, b in dropouts:
        lost |= (t_frame > a) & (t_frame < b)
    R[lost], p_mm[lost] = np.nan, np.nan
    sd = np.r_[np.full(3, np.deg2rad(recipe.rotation_sd_deg)), np.full(3, recipe.position_sd_mm)]
    t_ns = CAMERA_EPOCH_NS + np.round(t_frame * 1e9).astype(np.int64)
    track = OpticalTrack(
        t_ns=t_ns,
        R_camera_brick=R,
        t_camera_brick_mm=p_mm,
        covariance=np.broadcast_to(np.diag(sd**2), (t_frame.size, 6, 6)).copy(),
        flags=np.where(lost, int(PoseFlag.NO_POSE), 0).astype(np.int64),
        residual_px=np.full((t_frame.size, 0, 2), np.nan),
        led_t_ns=np.zeros((t_frame.size, 0), dtype=np.int64),
    )
    return track, t_frame, dropouts


def _feel(
    rng: np.random.Generator,
    recipe: Recipe,
    gyro: tuple[FloatArray, FloatArray],
    acc: tuple[FloatArray, FloatArray],
    *,
    native_hz: float,
    t_mid: float,
) -> tuple[ImuTrack, FloatArray, float]:
    """Return the samples of a sensor like a BNO055, when each was taken, s, and the hidden offset, s.

    The low-pass is at the native rate, and its constant delay is taken out of the stamps. ``gyro`` and ``acc``
    are times, s, and what was recorded then.
    """
    (t_gyro, gyro_radps), (t_acc, acc_mps2) = gyro, acc
    offset_s = rng.uniform(-recipe.max_offset_s, recipe.max_offset_s)
    skew = rng.uniform(-recipe.max_skew, recipe.max_skew)
    b, a = butter(recipe.lowpass_order, recipe.lowpass_hz, fs=native_hz)
    n = np.arange(400)
    response = lfilter(b, a, (n == 0).astype(float))
    delay_s = float((n * response).sum() / response.sum() / native_hz)
    gyro_at = make_interp_spline(t_gyro - delay_s, _passed(b, a, gyro_radps), k=3)
    acc_at = make_interp_spline(t_acc - delay_s, _passed(b, a, acc_mps2), k=3)
    t_sample = np.arange(rng.uniform(-0.3, -0.29), 15.3, 1 / recipe.imu_rate_hz)
    acc_s = np.round(acc_at(t_sample) / recipe.acc_step_mps2) * recipe.acc_step_mps2
    limit = recipe.acc_range_g * 9.80665
    if recipe.clip_share > 0:
        limit = min(limit, float(np.quantile(np.abs(acc_s).max(axis=1), 1 - recipe.clip_share)))
    acc_s = np.clip(acc_s, -limit, limit)
    gyro_s = np.round(gyro_at(t_sample) / recipe.gyro_step_radps) * recipe.gyro_step_radps
    stamp_s = t_sample + offset_s + skew * (t_sample - t_mid)
    stamp_s = stamp_s + rng.normal(0, recipe.stamp_jitter_s, t_sample.size)
    track = ImuTrack(
        t_ns=CAMERA_EPOCH_NS + np.round(stamp_s * 1e9).astype(np.int64),
        acc_mps2=acc_s,
        gyro_radps=gyro_s,
        flags=np.zeros(t_sample.size, dtype=np.int64),
        acc_range_mps2=limit,
    )
    return track, t_sample, offset_s


def _passed(b: FloatArray, a: FloatArray, values: FloatArray) -> FloatArray:
    """Return what a low-pass makes of values that were steady before the first."""
    return np.asarray(lfilter(b, a, values - values[0], axis=0) + values[0])
