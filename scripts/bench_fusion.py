"""Judge the fusion on real inertial + motion-capture recordings, beside simpler methods, in one table.

The recordings are those of ``broad_windows.py`` (BROAD, CC BY 4.0; simulated camera noise and sensor).

Run: ``python scripts/bench_fusion.py --seeds 3``, a second a case; with ``--gtsam``, batch
optimisation by GTSAM stands beside (half a minute a case; ``pip install gtsam``).
"""

import argparse
import importlib.util
import itertools
import logging
import os
import resource
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import astuple, dataclass, replace

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before NumPy is loaded

import numpy as np
from broad_windows import (
    CAMERA_EPOCH_NS,
    LEVER_ARM_MM,
    Case,
    Recipe,
    add_windows_argument,
    make_case,
    windows_in,
)
from rich.console import Console
from rich.table import Table
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.fusion.believed_errors import MeanBand, draw_pose_errors, pose_errors
from bricktrack_host.fusion.clocks.time_alignment import align_times
from bricktrack_host.fusion.estimate import FusionInput, fuse_batch, fused_result, prepare_run
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.pose_by_pose.fused_output import common_part
from bricktrack_host.fusion.pose_by_pose.pose_level import smooth_poses
from bricktrack_host.fusion.smoothing.smoother_kernel import CHI2_6_95
from bricktrack_host.normalised_errors import normalised_squares

N_DRAWS = 400  # of a run's errors, which put the ends of a band where 2 to 3 runs in 100 lie beyond


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
    item = replace(_input(case), alignment=alignment)
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


def _input(case: Case) -> FusionInput:
    return FusionInput(case.optical, case.imu, LEVER_ARM_MM, case.t_out_ns)


def warm_up(case: Case) -> None:
    """Fuse once, untimed: compiled code is loaded, and on a new machine made, which takes a minute."""
    print("loading compiled code, or compiling it", file=sys.stderr, flush=True)
    fuse_batch([_input(case)])


def time_batch(cases: list[Case], *, runs: int, workers: int) -> tuple[float, float, float]:
    """Return wall time and processor time of aligning and fusing so many runs, s, and a worker's peak, MB."""
    inputs = [_input(c) for c, _ in zip(itertools.cycle(cases), range(runs), strict=False)]
    warm_up(cases[0])
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
    add_windows_argument(parser)
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
    paths = windows_in(args.folder, parser)
    if not paths:
        return
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
    warm_up(make_case(paths[0], seed=args.first_seed, recipe=recipe))
    for path in paths:
        for seed in range(args.first_seed, args.first_seed + args.seeds):
            print(f"{path.stem}, seed {seed}", file=sys.stderr, flush=True)
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
