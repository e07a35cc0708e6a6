"""What the camera's own motion costs: one relative motion, with the camera at rest, shaken, and rocked too.

Simulated: the brick's motion seen from the camera, optical noise and sensor noise are the same in all rows of a
seed; only the camera's component moves differently. The error should be that at rest. A second table has sensors
as they are bought and mounted: scale and crossed axes wrong by a per cent, and places by 2 mm. NEES/6 is the
squared error over the stated covariance by its degrees of freedom, 1 when honest. With ``--known`` there is only
the first table, and scale and axes are not asked of the run.

Without ``--leds`` poses are fused (`tests/support/two_imus.py`, runs of 15 s). With it, runs of a unit of 8 s with
impacts of up to 0.25 m/s and two dropouts of 0.5 s (`tests/support/daemon_runs.py`) are fused LED by LED, beside
the fusion of their poses; in the second table of each kind of sensors two LEDs of seven remain in the dropouts.

Run: ``python scripts/bench_moving_camera.py --seeds 6``, and ``--leds --sensors exact --seeds 2``
"""

import argparse
import logging
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from brick_shakes import EPOCH_NS
from daemon_runs import simulate_run
from two_imus import simulate_two_imus

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_host.fusion.believed_errors import pose_errors
from bricktrack_host.fusion.estimate import fuse
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.pose_by_pose.moving_camera import CameraImu, without_gains
from bricktrack_host.fusion.smoothing.smoother_kernel import CHI2_6_95
from bricktrack_host.fusion.tight import fuse_tight
from bricktrack_host.normalised_errors import normalised_squares
from bricktrack_host.tracking.optical_track import solve_poses
from bricktrack_host.tracks import FusedTrack, ImuTrack

DROPOUTS = ((2.0, 2.4), (3.6, 3.9), (5.0, 5.5), (8.0, 8.4), (10.2, 10.5), (12.0, 12.5))
LED_DROPOUTS = ((3.0, 3.5), (6.0, 6.5))
LEDS, REMAINING = ("m0", "m1", "m2", "m3", "m4", "m5", "m6"), ("m1", "m5")
MOTIONS = ((0.0, 0.0), (0.3, 0.0), (0.3, 0.7), (0.3, 1.4), (0.3, 2.0))  # g and degrees, rms in each axis
SENSORS = {"exact": (0.0, 0.0), "as bought": (0.01, 2.0)}  # sd of gains and crossed axes, and of places in mm
STEP_NS = 5_000_000
COLUMNS = ("camera", "outside mm", "inside mm", "all mm", "against rest", "NEES/6", "within 95 %")
POSES, BY_LEDS = "poses", "LED by LED"


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Of a fused motion, shape (k,): squared position errors, mm^2; all, over their covariance; dropouts."""

    squares_mm2: FloatArray
    normalised: FloatArray
    inside: BoolArray

    @classmethod
    def of(cls, found: FusedTrack, truth: tuple[FloatArray, FloatArray], inside: BoolArray) -> "Errors":
        """Return them for a fused motion, given the true rotations and positions."""
        errors = pose_errors(found, *truth)
        squares = (errors[:, 3:] ** 2).sum(axis=1)
        return cls(squares, normalised_squares(errors, found.covariance), inside)

    @classmethod
    def together(cls, runs: list["Errors"]) -> "Errors":
        """Return those of several runs."""
        return cls(
            np.concatenate([run.squares_mm2 for run in runs]),
            np.concatenate([run.normalised for run in runs]),
            np.concatenate([run.inside for run in runs]),
        )

    def rms_mm(self, part: BoolArray | None = None) -> float:
        """Return the root mean square of the position's error."""
        return float(np.sqrt(np.mean(self.squares_mm2 if part is None else self.squares_mm2[part])))


@dataclass(frozen=True, slots=True)
class Work:
    """One run to be simulated and fused; ``two_remain``: of LEDs, whether two stay in view in dropouts."""

    seed: int
    motion: tuple[float, float]
    sensors: str
    settings: FusionSettings | None = None
    two_remain: bool = False


def within(since_s: FloatArray, dropouts: tuple[tuple[float, float], ...]) -> BoolArray:
    """Return which instants lie in dropouts."""
    return np.asarray(np.any([(since_s > a) & (since_s < b) for a, b in dropouts], axis=0))


def fused_poses(work: Work) -> dict[str, Errors]:
    """Return how far one simulated run is fused from the truth, pose by pose."""
    gain_sd, place_sd_mm = SENSORS[work.sensors]
    run = simulate_two_imus(
        work.seed, acc_g=work.motion[0], rocking_deg=work.motion[1], duration_s=15.0, dropouts=DROPOUTS,
        gain_sd=gain_sd, place_sd_mm=place_sd_mm,
    )  # fmt: skip
    optical = run.shake.optical
    t_ns = np.arange(optical.t_ns[3], optical.t_ns[-3], STEP_NS)
    result = fuse(
        optical, run.brick, lever_arm_mm=run.lever_arm_mm, output_t_ns=t_ns, camera="imu",
        camera_imu=CameraImu(run.camera, run.imu_to_camera_mm), settings=work.settings,
    )  # fmt: skip
    inside = within((t_ns - EPOCH_NS) * 1e-9, DROPOUTS)
    return {POSES: Errors.of(result.track, run.shake.truth(t_ns), inside)}


def fused_leds(work: Work) -> dict[str, Errors]:
    """Return how far one simulated run of a unit is fused from the truth, LED by LED and pose by pose."""
    spans = [(a, b - a) for a, b in LED_DROPOUTS]
    hidden = tuple((name, *span) for span in spans for name in LEDS if name not in REMAINING)
    run = simulate_run(
        work.seed, duration_s=8.0, amplitude_mm=8.0, amplitude_deg=3.0, impact_mps=0.25, stamp_offset_ns=3_300_000,
        camera_acc_g=work.motion[0], camera_rocking_deg=work.motion[1], has_camera_imu=True,
        **({"hidden_leds": hidden} if work.two_remain else {"dropouts": tuple(spans)}),
    )  # fmt: skip
    if run.camera_imu is None:
        raise ValueError("the simulated camera has no sensor")
    gain_sd, place_sd_mm = SENSORS[work.sensors]
    wrong = np.random.default_rng([work.seed, 13])

    def bought(imu: ImuTrack) -> ImuTrack:
        gains = np.eye(3) + gain_sd * wrong.normal(size=(2, 3, 3))
        return without_gains(imu, gyro_gain=gains[0], acc_gain=gains[1])

    brick, camera = bought(run.imu), bought(run.camera_imu.imu)
    arms_mm = [
        arm + place_sd_mm * wrong.normal(size=3)
        for arm in (run.lever_arm_mm, run.camera_imu.imu_to_camera_mm)
    ]
    optical = solve_poses(run.observations, run.camera, run.brick)
    t_ns = np.arange(optical.t_ns[5], optical.t_ns[-5], STEP_NS)
    result = fuse_tight(
        run.observations, optical, brick, run.camera, run.brick, lever_arm_mm=arms_mm[0], output_t_ns=t_ns,
        camera="imu", camera_imu=replace(run.camera_imu, imu=camera, imu_to_camera_mm=arms_mm[1]),
        settings=work.settings,
    )  # fmt: skip
    inside = within(run.world.since_first_edge_s(t_ns), LED_DROPOUTS)
    tracks = {POSES: result.pose_level.track, BY_LEDS: result.fused.track}
    return {name: Errors.of(found, run.truth(t_ns), inside) for name, found in tracks.items()}


def table_of(title: str, method: str, found: list[list[dict[str, Errors]]]) -> Table:
    """Return the table of one kind of runs and method: a row for each motion of the camera."""
    table = Table(title=f"{title}, {method}: {len(found[0])} runs a row (simulated)")
    for column in COLUMNS:
        table.add_column(column, justify="left" if column == "camera" else "right")
    at_rest = float("nan")
    for (acc_g, rocking_deg), runs in zip(MOTIONS, found, strict=True):
        errors = Errors.together([run[method] for run in runs])
        error = errors.rms_mm()
        at_rest = error if np.isnan(at_rest) else at_rest
        name = "at rest" if acc_g == 0 else f"{acc_g:g} g, rocking {rocking_deg:g} deg rms"
        table.add_row(
            name, f"{errors.rms_mm(~errors.inside):.4f}", f"{errors.rms_mm(errors.inside):.4f}", f"{error:.4f}",
            f"{100 * (error / at_rest - 1):+.1f} %", f"{errors.normalised.mean() / 6:.2f}",
            f"{100 * (errors.normalised < CHI2_6_95).mean():.1f} %",
        )  # fmt: skip
    return table


def tables(args: argparse.Namespace) -> Iterator[Table]:
    """Yield the tables asked for."""
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    settings = FusionSettings(sensor_gain_sd=0.0) if args.known else None
    for sensors in ["exact"] if args.known else args.sensors:
        for two_remain in (False, True) if args.leds else (False,):
            works = [
                [Work(seed, motion, sensors, settings, two_remain) for seed in seeds] for motion in MOTIONS
            ]
            fused = fused_leds if args.leds else fused_poses
            rows = track(works, f"sensors {sensors}", transient=True)
            found = [[fused(work) for work in row] for row in rows]
            title = f"Sensors {sensors}" + ", two LEDs remain in dropouts" * two_remain
            for method in found[0][0]:
                yield table_of(title, method, found)


def main() -> None:
    """Print one table for exact sensors and one for sensors as they are bought."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=6, help="runs of each row")
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--known", action="store_true", help="scale and axes are known to be exact")
    parser.add_argument("--sensors", nargs="+", choices=[*SENSORS], default=[*SENSORS])
    parser.add_argument("--leds", action="store_true", help="fuse LED by LED")
    args = parser.parse_args()
    logging.getLogger("bricktrack_host").setLevel(logging.ERROR)
    for table in tables(args):
        Console(width=110).print(table)


if __name__ == "__main__":
    main()
