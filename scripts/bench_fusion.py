"""Judge the fusion on real inertial + motion-capture recordings, beside simpler methods, in one table.

Data: six windows of BROAD (Laidig, Caruso, Aparicio, Seel, Data 6(7):72, 2021, CC BY 4.0). Their README holds
the recipe followed here: poses thinned to camera rate with noise and dropouts, a hidden time offset and
skew, an unknown direction of gravity, and inertial signals made BNO055-like (simulated sensor on recorded
motion). Every random choice comes from the seed, so that other seeds are other data.

Run: ``python scripts/bench_fusion.py $BRICKTRACK_SAMPLES/fusion --seeds 3``; with ``--gtsam``, batch
optimisation by GTSAM stands beside (half a minute a case; ``pip install gtsam``).
"""

import argparse
import importlib.util
import itertools
import logging
import os
import resource
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import astuple, dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before NumPy is loaded

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.signal import butter, filtfilt, lfilter
from scipy.spatial.transform import Rotation, Slerp

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix
from bricktrack_host.fusion.believed_errors import MeanBand, draw_pose_errors, pose_errors
from bricktrack_host.fusion.clocks.time_alignment import align_times
from bricktrack_host.fusion.estimate import FusionInput, fuse_batch, fused_result, prepare_run
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.inertial.imu_signal import chain_rotations
from bricktrack_host.fusion.pose_by_pose.fused_output import common_part
from bricktrack_host.fusion.pose_by_pose.pose_level import smooth_poses
from bricktrack_host.fusion.smoothing.smoother_kernel import CHI2_6_95
from bricktrack_host.normalised_errors import normalised_squares
from bricktrack_host.quality import PoseFlag
from bricktrack_host.tracks import ImuTrack, OpticalTrack

LEVER_ARM_MM = (26.045, 53.000, 14.199)
CAMERA_EPOCH_NS = 1_000_000_000_000  # what the camera's clock says at the recording's t = 0
GYRO_LAG_S = 4.19e-3
ACC_LAG_S = 2.53e-3
N_GYRO_FITS = 3
N_DRAWS = 400  # of a run's errors, which put the ends of a band where 2 to 3 runs in 100 lie beyond


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

    # Optics.
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
    t_frame_ns = CAMERA_EPOCH_NS + np.round(t_frame * 1e9).astype(np.int64)
    optical = OpticalTrack(
        t_ns=t_frame_ns,
        R_camera_brick=R,
        t_camera_brick_mm=p_mm,
        covariance=np.broadcast_to(np.diag(sd**2), (t_frame.size, 6, 6)).copy(),
        flags=np.where(lost, int(PoseFlag.NO_POSE), 0).astype(np.int64),
        residual_px=np.full((t_frame.size, 0, 2), np.nan),
        led_t_ns=np.zeros((t_frame.size, 0), dtype=np.int64),
    )

    # Inertia: low-pass at the native rate, its constant delay taken out of the stamps, then 100 Hz.
    offset_s = rng.uniform(-recipe.max_offset_s, recipe.max_offset_s)
    skew = rng.uniform(-recipe.max_skew, recipe.max_skew)
    t_mid = 0.5 * (t_frame[0] + t_frame[-1])
    native_hz = 1 / np.median(np.diff(t))
    b, a = butter(recipe.lowpass_order, recipe.lowpass_hz, fs=native_hz)
    n = np.arange(400)
    response = lfilter(b, a, (n == 0).astype(float))
    delay_s = float((n * response).sum() / response.sum() / native_hz)
    gyro_at = make_interp_spline(t_gyro - delay_s, lfilter(b, a, gyro - gyro[0], axis=0) + gyro[0], k=3)
    acc_at = make_interp_spline(t_acc - delay_s, lfilter(b, a, acc - acc[0], axis=0) + acc[0], k=3)
    t_sample = np.arange(rng.uniform(-0.3, -0.29), 15.3, 1 / recipe.imu_rate_hz)
    acc_s = np.round(acc_at(t_sample) / recipe.acc_step_mps2) * recipe.acc_step_mps2
    limit = recipe.acc_range_g * 9.80665
    if recipe.clip_share > 0:
        limit = min(limit, float(np.quantile(np.abs(acc_s).max(axis=1), 1 - recipe.clip_share)))
    acc_s = np.clip(acc_s, -limit, limit)
    gyro_s = np.round(gyro_at(t_sample) / recipe.gyro_step_radps) * recipe.gyro_step_radps
    stamp_s = t_sample + offset_s + skew * (t_sample - t_mid)
    stamp_s = stamp_s + rng.normal(0, recipe.stamp_jitter_s, t_sample.size)
    imu = ImuTrack(
        t_ns=CAMERA_EPOCH_NS + np.round(stamp_s * 1e9).astype(np.int64),
        acc_mps2=acc_s,
        gyro_radps=gyro_s,
        flags=np.zeros(t_sample.size, dtype=np.int64),
        acc_range_mps2=limit,
    )

    t_out = t_sample[(t_sample >= t_frame[~lost][0]) & (t_sample <= t_frame[~lost][-1])]
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


@dataclass(frozen=True, slots=True)
class Score:
    """RMS errors of one method on one case; mm (length of the vector) and deg."""

    outside_mm: float
    inside_mm: float
    outside_deg: float
    inside_deg: float


def score(case: Case, R: FloatArray, t_mm: FloatArray) -> Score:
    """Return the errors at every inertial sample that has a pose, outside and inside the dropouts."""
    shift = np.linalg.norm(t_mm - case.t_true_mm, axis=1)
    turn = np.degrees(np.linalg.norm(rvec_from_matrix(np.swapaxes(case.R_true, 1, 2) @ R), axis=1))

    given = np.isfinite(shift)

    def rms(values: FloatArray, where: BoolArray) -> float:
        where = where & given
        return float(np.sqrt(np.mean(values[where] ** 2))) if where.any() else float("nan")

    inside = case.in_dropout
    return Score(rms(shift, ~inside), rms(shift, inside), rms(turn, ~inside), rms(turn, inside))


def interpolate_frames(case: Case) -> tuple[FloatArray, FloatArray]:
    """Return poses between frames: a cubic for the position, constant rate for the rotation."""
    seen = np.isfinite(case.optical.t_camera_brick_mm).all(axis=1)
    t_s = (case.optical.t_ns[seen] - CAMERA_EPOCH_NS) * 1e-9
    at_s = (case.t_out_ns - CAMERA_EPOCH_NS) * 1e-9
    p = CubicSpline(t_s, case.optical.t_camera_brick_mm[seen])(at_s)
    R = Slerp(t_s, Rotation.from_matrix(case.optical.R_camera_brick[seen]))(at_s).as_matrix()
    return R, np.asarray(p)


def run_case(case: Case, *, with_gtsam: bool = False) -> tuple[dict[str, Score], dict[str, float]]:
    """Return the scores of each method on one case, and what ours says of itself."""
    started = time.perf_counter()
    alignment = align_times(case.optical, case.imu, max_offset_s=0.25)
    settings = FusionSettings()
    item = FusionInput(case.optical, case.imu, LEVER_ARM_MM, case.t_out_ns, alignment)
    smoothed = smooth_poses([prepare_run(item, settings)], settings)[0]
    result = fused_result(item, smoothed, settings, with_forward=True)
    seconds = time.perf_counter() - started
    if result.forward is None:
        raise RuntimeError("the forward filter was asked for and is missing")
    scores = {
        "interpolation": score(case, *interpolate_frames(case)),
        "forward EKF": score(case, result.forward.R_camera_brick, result.forward.t_camera_brick_mm),
        "ours": score(case, result.track.R_camera_brick, result.track.t_camera_brick_mm),
    }
    if with_gtsam:
        from oracle_gtsam import gtsam_poses  # an optional package, and slow to import

        poses = gtsam_poses(
            case.optical,
            case.imu,
            lever_arm_mm=np.array(LEVER_ARM_MM),
            output_t_ns=case.t_out_ns,
            alignment=alignment,
        )
        scores["GTSAM"] = score(case, *poses)
    errors = pose_errors(result.track, case.R_clean, case.t_clean_mm)
    from_raw = pose_errors(result.track, case.R_true, case.t_true_mm)
    chi2 = normalised_squares(errors, result.track.covariance)
    turn = normalised_squares(errors[:, :3], result.track.covariance[:, :3, :3])
    drawn = draw_pose_errors(
        smoothed, case.t_out_ns, n_draws=N_DRAWS, rng=np.random.default_rng(0),
        common=common_part(smoothed.run, smoothed.scale, settings.optical_common_share),
    )  # fmt: skip
    band = MeanBand.of(normalised_squares(*drawn))
    facts = {
        "alignment error, ms": alignment.offset_ns * 1e-6 - case.offset_s * 1e3,
        "offset error, ms": result.offset_ns * 1e-6 - case.offset_s * 1e3,
        "lag error, ms": result.acc_lag_ns * 1e-6 - case.lag_s * 1e3,
        "NEES outside": float(chi2[~case.in_dropout].mean()),
        "NEES inside": float(chi2[case.in_dropout].mean()),
        "of it rotation": float(turn.mean()),
        "reference error, deg": float(np.degrees(_rms((errors - from_raw)[:, :3].ravel()))),
        "reference error, mm": _rms((errors - from_raw)[:, 3:].ravel()),
        "NEES by it as it is": float(normalised_squares(from_raw, result.track.covariance).mean()),
        "share within 95 %": float((chi2 < CHI2_6_95).mean()),
        "runs in their band": float(band.holds(chi2)),
        "independent errors": band.n_independent,
        "worse than frames": float(scores["ours"].outside_mm > scores["interpolation"].outside_mm),
        "offset error / its sd": (result.offset_ns - case.offset_s * 1e9) / result.offset_sd_ns,
        "share without pose": float(np.isnan(result.track.t_camera_brick_mm[:, 0]).mean()),
        "forward without pose": float(np.isnan(result.forward.t_camera_brick_mm[:, 0]).mean()),
        "seconds": seconds,
    }
    return scores, facts


def _rms(values: Sequence[float] | FloatArray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def time_batch(cases: list[Case], *, runs: int, workers: int) -> tuple[float, float, float]:
    """Return wall time and processor time of aligning and fusing so many runs, s, and a worker's peak, MB."""
    inputs = [
        FusionInput(c.optical, c.imu, LEVER_ARM_MM, c.t_out_ns)
        for c, _ in zip(itertools.cycle(cases), range(runs), strict=False)
    ]
    fuse_batch(inputs[:1])  # compiled code is loaded, and made on a new machine
    started = time.perf_counter()
    with ProcessPoolExecutor(workers) as pool:
        results = fuse_batch(inputs, executor=pool)
    seconds = time.perf_counter() - started
    if len(results) != runs:
        raise RuntimeError(f"{len(results)} results for {runs} runs")
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return seconds, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def main() -> None:
    """Print one table: a row a window and method, and the rms over all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="the folder of the windows (*.npz)")
    parser.add_argument("--seeds", type=int, default=1, help="cases made of each window")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--lags", action="store_true", help="keep the sensor's native lags")
    parser.add_argument("--clip-g", type=float, default=16.0, help="accelerometer range")
    parser.add_argument(
        "--clip-share", type=float, default=0.0, help="share of samples beyond the range, which is set by it"
    )
    parser.add_argument("--frame-rate", type=float, default=30.0058, help="Hz")
    parser.add_argument("--outliers", type=float, default=0.0, help="share of frames 8 mm off")
    parser.add_argument("--gtsam", action="store_true", help="beside GTSAM, which must be installed")
    parser.add_argument("--batch", type=int, default=0, help="time so many runs instead of judging")
    parser.add_argument("--workers", type=int, default=2, help="processes that share the batch")
    args = parser.parse_args()
    logging.getLogger("bricktrack_host").setLevel(logging.ERROR)  # the hidden offset is known to be there
    recipe = Recipe(
        keep_native_lags=args.lags,
        acc_range_g=args.clip_g,
        clip_share=args.clip_share,
        frame_rate_hz=args.frame_rate,
        outlier_share=args.outliers,
    )
    if args.gtsam and importlib.util.find_spec("gtsam") is None:
        parser.error("--gtsam needs the package gtsam, which is not installed: pip install gtsam")
    paths = sorted(args.folder.glob("*.npz"))
    if not paths:
        parser.error(f"no *.npz in {args.folder}")
    if args.batch:
        cases = [make_case(p, seed=s, recipe=recipe) for p in paths for s in range(4)]
        seconds, busy_s, megabytes = time_batch(cases, runs=args.batch, workers=args.workers)
        print(
            f"{args.batch} runs of 15 s aligned and fused by {args.workers} processes: {seconds:.1f} s "
            f"({busy_s:.0f} s of processor time), {megabytes:.0f} MB at most in each"
        )
        return
    table = Table(title=f"{recipe}\nreal inertial and motion-capture recordings (BROAD, CC BY 4.0)")
    for column in ("window", "seed", "method", "out mm", "in mm", "out deg", "in deg"):
        table.add_column(column, justify="left" if column in ("window", "method") else "right")
    all_scores: dict[str, list[Score]] = {}
    all_facts: dict[str, list[float]] = {}
    for path in paths:
        for seed in range(args.first_seed, args.first_seed + args.seeds):
            scores, facts = run_case(make_case(path, seed=seed, recipe=recipe), with_gtsam=args.gtsam)
            for method, s in scores.items():
                all_scores.setdefault(method, []).append(s)
                table.add_row(path.stem, str(seed), method, *(f"{v:.3f}" for v in astuple(s)))
            for name, value in facts.items():
                all_facts.setdefault(name, []).append(value)
    table.add_section()
    for method, rows in all_scores.items():
        table.add_row(
            "all, rms", "", method, *(f"{_rms(c):.3f}" for c in zip(*map(astuple, rows), strict=True))
        )
    console = Console(width=130)
    console.print(table)
    for name, values in all_facts.items():
        how = "rms" if "error" in name else "mean"
        value = _rms(values) if how == "rms" else float(np.mean(values))
        console.print(f"{name:22s} {how:4s} {value:8.3f}   worst {max(values, key=abs):8.3f}")


if __name__ == "__main__":
    main()
