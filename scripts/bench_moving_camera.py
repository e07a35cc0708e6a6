"""What the camera's own motion costs: one relative motion, with the camera at rest, shaken, and rocked too.

Simulated (`tests/support/two_imus.py`): the brick's motion seen from the camera, optical noise and sensor noise
are the same in all rows of a seed; only the camera's component moves differently. The error should be that at
rest. A second table has sensors as they are bought and mounted: scale and crossed axes wrong by a per cent, and
places by 2 mm. With ``--known`` there is only the first, and scale and axes are not asked of the run.

Run: ``python scripts/bench_moving_camera.py --seeds 6``
"""

import argparse
import logging
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from brick_shakes import EPOCH_NS
from two_imus import simulate_two_imus

from bricktrack_common.arrays import FloatArray
from bricktrack_host.fusion.believed_errors import pose_errors
from bricktrack_host.fusion.estimate import fuse
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.pose_by_pose.moving_camera import CameraImu
from bricktrack_host.fusion.smoothing.smoother_kernel import CHI2_6_95
from bricktrack_host.normalised_errors import normalised_squares

DURATION_S = 15.0
DROPOUTS = ((2.0, 2.4), (3.6, 3.9), (5.0, 5.5), (8.0, 8.4), (10.2, 10.5), (12.0, 12.5))
MOTIONS = ((0.0, 0.0), (0.3, 0.0), (0.3, 0.7), (0.3, 1.4), (0.3, 2.0))  # g and degrees, rms in each axis
SENSORS = {"exact": (0.0, 0.0), "as bought": (0.01, 2.0)}  # sd of gains and crossed axes, and of places in mm
STEP_NS = 5_000_000
COLUMNS = ("camera", "outside mm", "inside mm", "all mm", "against rest", "offset ms, rms", "within 95 %")


@dataclass(frozen=True, slots=True)
class Errors:
    """Of one run: squared position errors, mm^2, of the offset, ms, and the share within its 95 % region."""

    outside_mm2: FloatArray
    inside_mm2: FloatArray
    offset_ms: float
    share_within: float


def fused_errors(
    seed: int, motion: tuple[float, float], sensors: str, settings: FusionSettings | None
) -> Errors:
    """Return how far one simulated run is fused from the truth."""
    gain_sd, place_sd_mm = SENSORS[sensors]
    run = simulate_two_imus(
        seed, acc_g=motion[0], rocking_deg=motion[1], duration_s=DURATION_S, dropouts=DROPOUTS,
        gain_sd=gain_sd, place_sd_mm=place_sd_mm,
    )  # fmt: skip
    optical = run.shake.optical
    t_ns = np.arange(optical.t_ns[3], optical.t_ns[-3], STEP_NS)
    result = fuse(
        optical, run.brick, lever_arm_mm=run.lever_arm_mm, output_t_ns=t_ns, camera="imu",
        camera_imu=CameraImu(run.camera, run.imu_to_camera_mm), settings=settings,
    )  # fmt: skip
    R, t_mm = run.shake.truth(t_ns)
    errors = pose_errors(result.track, R, t_mm)
    squares = (errors[:, 3:] ** 2).sum(axis=1)
    since_s = (t_ns - EPOCH_NS) * 1e-9
    inside = np.any([(since_s > a) & (since_s < b) for a, b in DROPOUTS], axis=0)
    within = normalised_squares(errors, result.track.covariance) < CHI2_6_95
    return Errors(squares[~inside], squares[inside], result.offset_ns * 1e-6 - 4.0, float(within.mean()))


def rms(parts: list[FloatArray]) -> float:
    """Return the root mean square over runs."""
    return float(np.sqrt(np.mean(np.concatenate(parts))))


def table_of(sensors: str, found: list[list[Errors]]) -> Table:
    """Return the table of one kind of sensors: a row for each motion of the camera."""
    n = len(found[0])
    table = Table(title=f"Sensors {sensors}: {n} runs of {DURATION_S:g} s a row (simulated)")
    for column in COLUMNS:
        table.add_column(column, justify="left" if column == "camera" else "right")
    at_rest = float("nan")
    for (acc_g, rocking_deg), runs in zip(MOTIONS, found, strict=True):
        outside, inside = [run.outside_mm2 for run in runs], [run.inside_mm2 for run in runs]
        error = rms(outside + inside)
        at_rest = error if np.isnan(at_rest) else at_rest
        name = "at rest" if acc_g == 0 else f"{acc_g:g} g, rocking {rocking_deg:g} deg rms"
        offset_ms = float(np.sqrt(np.mean([run.offset_ms**2 for run in runs])))
        within = np.mean([run.share_within for run in runs])
        table.add_row(
            name, f"{rms(outside):.4f}", f"{rms(inside):.4f}", f"{error:.4f}",
            f"{100 * (error / at_rest - 1):+.1f} %", f"{offset_ms:.3f}", f"{100 * within:.1f} %",
        )  # fmt: skip
    return table


def main() -> None:
    """Print one table for exact sensors and one for sensors as they are bought."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=6, help="runs of each row")
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--known", action="store_true", help="scale and axes are known to be exact")
    args = parser.parse_args()
    kinds = ["exact"] if args.known else list(SENSORS)
    settings = FusionSettings(sensor_gain_sd=0.0) if args.known else None
    logging.getLogger("bricktrack_host").setLevel(logging.ERROR)
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    works = [(seed, motion, sensors, settings) for sensors in kinds for motion in MOTIONS for seed in seeds]
    done = iter([fused_errors(*work) for work in track(works, "simulating and fusing", transient=True)])
    for sensors in kinds:
        found = [[next(done) for _ in seeds] for _ in MOTIONS]
        Console(width=110).print(table_of(sensors, found))


if __name__ == "__main__":
    main()
