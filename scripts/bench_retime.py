"""What it costs in accuracy that the motion within frames is fused by a plainer model than that of the whole run.

`process` solves its poses twice: the second time each LED is carried to its frame's instant by a first fusion. That
one takes the sensors for exact and believes the samples as far as is stated; here it stands beside one that estimates
the sensors' standing errors, and one that chooses the noise too. Simulated runs of a unit
(`tests/support/daemon_runs.py`) at 0.3 m/s, with impacts and dropouts; position errors in mm, of the poses that come
of it and of the pose-level fusion of these.

Run: ``python scripts/bench_retime.py --seeds 6``
"""

import argparse
import logging
import sys
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from daemon_runs import DaemonRun, simulate_run

from bricktrack_common.arrays import FloatArray, rows_of
from bricktrack_host.fusion.clocks.time_alignment import align_times
from bricktrack_host.fusion.estimate import fuse
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.tracking.optical_track import solve_poses, start_poses
from bricktrack_host.tracking.pose.frame_motion import led_motion

CHOICES = {
    "noise chosen": FusionSettings(),
    "noise as stated": FusionSettings(adapt_noise=False),
    "sensors exact": FusionSettings(
        adapt_noise=False, vibration_beside_camera=False, sensor_gain_sd=0.0, lever_arm_sd_mm=0.0
    ),
}


def squares_mm2(found_mm: FloatArray, true_mm: FloatArray) -> FloatArray:
    """Return squared distances, NaN where nothing was found."""
    return np.asarray(((found_mm - true_mm) ** 2).sum(axis=1))


def errors_of(run: DaemonRun) -> dict[str, tuple[float, float, float]]:
    """Return the rms error of poses and of fused motion, mm, and the first fusion's processor time, s."""
    observations, camera, brick = run.observations, run.camera, run.brick
    first = start_poses(observations, camera, brick)
    optical = solve_poses(observations, camera, brick, first=first)
    alignment, n = align_times(optical, run.imu), len(optical.t_ns)
    wanted = np.concatenate([optical.t_ns, optical.led_t_ns.ravel()])
    t_ns = np.arange(optical.t_ns[5], optical.t_ns[-5], 5_000_000)
    found = {}
    for name, settings in CHOICES.items():
        started = time.process_time()
        motion = fuse(
            optical, run.imu, lever_arm_mm=run.lever_arm_mm, output_t_ns=wanted,
            alignment=alignment, settings=settings,
        ).track  # fmt: skip
        seconds = time.process_time() - started
        within = led_motion(rows_of(motion, slice(0, n)), rows_of(motion, slice(n, None)))
        poses = solve_poses(observations, camera, brick, motion=within, first=first)
        fused = fuse(
            poses, run.imu, lever_arm_mm=run.lever_arm_mm, output_t_ns=t_ns, alignment=alignment
        ).track
        of_poses = squares_mm2(poses.t_camera_brick_mm, run.truth(poses.t_ns)[1])
        of_fused = squares_mm2(fused.t_camera_brick_mm, run.truth(t_ns)[1])
        found[name] = float(np.sqrt(np.nanmean(of_poses))), float(np.sqrt(np.nanmean(of_fused))), seconds
    return found


def main() -> None:
    """Print the rms over all runs, a row a choice."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=6, help="simulated runs")
    parser.add_argument("--first-seed", type=int, default=1)
    args = parser.parse_args()
    logging.getLogger("bricktrack_host").setLevel(logging.ERROR)
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    results = []
    for seed in track(seeds, description="simulated runs"):
        run = simulate_run(
            seed, duration_s=8.0, amplitude_mm=8.0, amplitude_deg=3.0, impact_mps=0.25,
            stamp_offset_ns=3_300_000, dropouts=((3.0, 0.5), (6.0, 0.5)),
        )  # fmt: skip
        results.append(errors_of(run))
    table = Table(title=f"{args.seeds} simulated runs of 8 s at 0.3 m/s")
    for column in ("first fusion", "poses, mm", "fused, mm", "first fusion, s"):
        table.add_column(column, justify="left" if column == "first fusion" else "right")
    for name in CHOICES:
        poses, fused, seconds = np.array([r[name] for r in results]).T
        row = np.sqrt([np.mean(poses**2), np.mean(fused**2)])
        table.add_row(name, f"{row[0]:.4f}", f"{row[1]:.4f}", f"{np.median(seconds):.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
