"""What the camera's own motion costs: one relative motion, with the camera at rest, shaken, and rocked too.

Simulated (`tests/support/two_imus.py`): the brick's motion seen from the camera, optical noise and sensor noise
are the same in all rows of a seed; only the camera's component moves differently. The error should be that at
rest.

Run: ``python scripts/bench_moving_camera.py --seeds 6``
"""

import argparse
import logging
import sys
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from brick_shakes import EPOCH_NS, LEVER_ARM_MM
from two_imus import IMU_TO_CAMERA_MM, simulate_two_imus

from bricktrack_common.arrays import FloatArray
from bricktrack_host.fusion.estimate import fuse
from bricktrack_host.fusion.pose_by_pose.moving_camera import CameraImu

DROPOUTS = ((2.0, 2.4), (3.6, 3.9), (5.0, 5.5))
MOTIONS = ((0.0, 0.0), (0.3, 0.0), (0.3, 0.7), (0.3, 1.4), (0.3, 2.0))  # g and degrees, rms in each axis
STEP_NS = 5_000_000


def squared_errors_mm2(seed: int, acc_g: float, rocking_deg: float) -> tuple[FloatArray, FloatArray, float]:
    """Return squared position errors outside and inside the dropouts, and the offset's error, ms."""
    run = simulate_two_imus(seed, acc_g=acc_g, rocking_deg=rocking_deg, duration_s=8.0, dropouts=DROPOUTS)
    optical = run.shake.optical
    t_ns = np.arange(optical.t_ns[3], optical.t_ns[-3], STEP_NS)
    result = fuse(
        optical, run.brick, lever_arm_mm=LEVER_ARM_MM, output_t_ns=t_ns, camera="imu",
        camera_imu=CameraImu(run.camera, IMU_TO_CAMERA_MM),
    )  # fmt: skip
    _, t_mm = run.shake.truth(t_ns)
    squares = ((result.track.t_camera_brick_mm - t_mm) ** 2).sum(axis=1)
    since_s = (t_ns - EPOCH_NS) * 1e-9
    inside = np.any([(since_s > a) & (since_s < b) for a, b in DROPOUTS], axis=0)
    return squares[~inside], squares[inside], result.offset_ns * 1e-6 - 4.0


def rms(parts: list[FloatArray]) -> float:
    """Return the root mean square over runs."""
    return float(np.sqrt(np.mean(np.concatenate(parts))))


def main() -> None:
    """Print one table: a row for each motion of the camera."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=6, help="runs of each row")
    parser.add_argument("--first-seed", type=int, default=1)
    args = parser.parse_args()
    logging.getLogger("bricktrack_host").setLevel(logging.ERROR)
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    works = [(seed, *motion) for motion in MOTIONS for seed in seeds]
    found = [squared_errors_mm2(*work) for work in track(works, "simulating and fusing", transient=True)]
    table = Table(title=f"Camera's own motion, {args.seeds} runs of 8 s a row (simulated)")
    for column in ("camera", "outside mm", "inside mm", "all mm", "against rest", "offset error ms, rms"):
        table.add_column(column, justify="left" if column == "camera" else "right")
    at_rest = float("nan")
    for i, (acc_g, rocking_deg) in enumerate(MOTIONS):
        rows = found[i * args.seeds : (i + 1) * args.seeds]
        outside, inside = [row[0] for row in rows], [row[1] for row in rows]
        error = rms(outside + inside)
        at_rest = error if i == 0 else at_rest
        name = "at rest" if i == 0 else f"{acc_g:g} g, rocking {rocking_deg:g} deg rms"
        offset = float(np.sqrt(np.mean(np.square([row[2] for row in rows]))))
        table.add_row(
            name, f"{rms(outside):.4f}", f"{rms(inside):.4f}", f"{error:.4f}",
            f"{100 * (error / at_rest - 1):+.1f} %", f"{offset:.3f}",
        )  # fmt: skip
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
