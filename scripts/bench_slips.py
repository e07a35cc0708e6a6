"""Frame stamps that slip by whole periods: how often they are found, and what mending them is worth.

First table: simulated shakes (`tests/support/brick_shakes.py`) of 8 s with impacts and two dropouts, turns of 0.3 to
3 degrees rms; each as it is, and with one slip of one or two periods, early or late, at any frame of the motion.
Stamps that are right must never be mended.

Second table: runs of a unit (`tests/support/daemon_runs.py`) at 0.3 m/s with impacts and a dropout, fused LED by LED
with stamps that slip in the middle, soon after the start, twice, and where no LED is seen: position error when they
are fused as they are, and when they are mended before.

Run: ``python scripts/bench_slips.py --shakes 200 --runs 3``
"""

import argparse
import logging
import sys
from collections import Counter
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from brick_shakes import simulate_shake
from daemon_runs import DaemonRun, simulate_run
from slipped_stamps import double, slip

from bricktrack_host.fusion.clocks.slip_search import find_slips
from bricktrack_host.fusion.clocks.stamp_slips import StampSlips
from bricktrack_host.fusion.clocks.time_alignment import TimeAlignment, align_times
from bricktrack_host.fusion.tight import fuse_tight
from bricktrack_host.stages.clocks import with_stamps_mended
from bricktrack_host.tracking.optical_track import solve_poses
from bricktrack_host.tracks import ImuTrack, LedObservations, OpticalTrack

DROPOUT = (3.0, 0.5)


def found_in(optical: OpticalTrack, imu: ImuTrack) -> tuple[TimeAlignment, StampSlips | None]:
    """Return the alignment of the stamps as they are, and the slips found in them."""

    def aligned(poses: OpticalTrack) -> TimeAlignment:
        return align_times(poses, imu)

    as_they_are = aligned(optical)
    return as_they_are, find_slips(optical, imu, as_they_are, aligned)


def verdicts(seed: int) -> tuple[bool, str]:
    """Return whether right stamps of one shake were mended, and what became of a slip put into them."""
    rng = np.random.default_rng([seed, 5])
    gaps = tuple((a, a + rng.uniform(0.15, 0.5)) for a in (rng.uniform(1.5, 3.5), rng.uniform(4.5, 6.0)))
    shake = simulate_shake(
        seed, rotation_deg=float(np.exp(rng.uniform(np.log(0.3), np.log(3.0)))), impacts=6, dropouts=gaps,
        offset_s=rng.uniform(0.0, 0.012), skew=rng.uniform(-5e-5, 5e-5),
    )  # fmt: skip
    false_alarm = found_in(shake.optical, shake.imu)[1] is not None
    frame, late = int(rng.integers(45, 195)), int(rng.choice([-2, -1, 1, 2]))
    found = found_in(slip(shake.optical, frame, late), shake.imu)[1]
    if found is None:
        return false_alarm, "not found"
    if [s.late_periods for s in found.slips] != [late]:
        return false_alarm, "wrong number of periods"
    (one,) = found.slips
    if not one.first <= frame <= one.last:
        return false_alarm, "wrong place"
    return false_alarm, "to the frame" if one.first == one.last else "to a few frames"


def error_mm(run: DaemonRun, observations: LedObservations, *, is_mended: bool) -> float:
    """Return the rms position error, mm, of a run fused LED by LED."""
    optical = solve_poses(observations, run.camera, run.brick)
    alignment, slips = found_in(optical, run.imu)
    if is_mended and slips is not None:
        observations = with_stamps_mended(observations, slips, optical.t_ns)
        optical, alignment = solve_poses(observations, run.camera, run.brick), slips.alignment
    stamps_ns = run.observations.sensor_timestamp_ns
    t_ns = np.arange(stamps_ns[10], stamps_ns[-10], 5_000_000)
    track_ = fuse_tight(
        observations, optical, run.imu, run.camera, run.brick,
        lever_arm_mm=run.lever_arm_mm, output_t_ns=t_ns, alignment=alignment,
    ).fused.track  # fmt: skip
    error = track_.t_camera_brick_mm - run.truth(t_ns)[1]
    return float(np.sqrt(np.mean((error**2).sum(axis=1))))


def print_search(console: Console, n_shakes: int) -> None:
    """Print how many slips were found, and how many that were not there."""
    told = [verdicts(seed) for seed in track(range(n_shakes), "searching", transient=True)]
    table = Table(title=f"{n_shakes} shakes with impacts and dropouts (simulated)")
    table.add_column("stamps")
    table.add_column("runs", justify="right")
    table.add_row("right, and mended", str(sum(is_false for is_false, _ in told)))
    for words, n in Counter(words for _, words in told).most_common():
        table.add_row(f"one slip: {words}", str(n))
    console.print(table)


def print_errors(console: Console, n_runs: int) -> None:
    """Print what mending is worth."""
    cases = {
        "right": lambda seen: seen,
        "late from the middle": lambda seen: slip(seen, 120, 1),
        "early from the middle": lambda seen: slip(seen, 120, -1),
        "late from the start": lambda seen: slip(seen, 42, 1),
        "early from the start": lambda seen: slip(seen, 42, -1),
        "a picture twice": lambda seen: double(seen, 130),
        "late, early again": lambda seen: slip(slip(seen, 80, 1), 160, -1),
        "late, later still": lambda seen: slip(slip(seen, 80, 1), 160, 1),
        "late from a dropout": lambda seen: slip(seen, 97, 1),
    }
    runs = [
        simulate_run(
            seed, duration_s=8.0, amplitude_mm=8.0, amplitude_deg=2.0, impact_mps=0.25,
            stamp_offset_ns=3_300_000, dropouts=(DROPOUT,),
        )
        for seed in range(31, 31 + n_runs)
    ]  # fmt: skip
    table = Table(title=f"{n_runs} runs of 8 s at 0.3 m/s, LED by LED: rms error, mm (simulated)")
    for column in ("stamps", "as they are", "mended"):
        table.add_column(column, justify="left" if column == "stamps" else "right")
    for words, change in track(cases.items(), "fusing", transient=True):
        both = [
            np.sqrt(np.mean([error_mm(run, change(run.observations), is_mended=m) ** 2 for run in runs]))
            for m in (False, True)
        ]
        table.add_row(words, *(f"{error:.3f}" for error in both))
    console.print(table)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shakes", type=int, default=200, help="of the first table")
    parser.add_argument("--runs", type=int, default=3, help="of the second table")
    args = parser.parse_args()
    logging.getLogger("bricktrack_host").setLevel(logging.ERROR)
    console = Console(width=120)
    if args.shakes:
        print_search(console, args.shakes)
    if args.runs:
        print_errors(console, args.runs)


if __name__ == "__main__":
    main()
