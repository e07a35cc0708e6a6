"""What fusing LED by LED gains over fusing pose by pose, at 0.3 m/s, and what bounds both.

Simulated runs of a unit (`tests/support/daemon_runs.py`): chip registers, centroids at row times, impacts of up to
0.25 m/s, two dropouts of 0.5 s, and clocks that are 3.3 ms apart. Rows:

- poses, one instant: each frame solved as if all its rows were exposed at once;
- poses, row times: each LED at its row's time, the motion within a frame by splines; what the fusion begins with;
- poses, true motion: the same with the true motion within each frame, the limit of whatever takes poses;
- LED by LED: the tightly coupled smoother.

In the second table the dropouts leave two LEDs of seven: too few for a pose.

Run: ``python scripts/bench_tight.py --seeds 6``
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

from daemon_runs import DaemonRun, simulate_run

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.fusion.estimate import fuse
from bricktrack_host.fusion.tight import fuse_tight
from bricktrack_host.quality import PoseFlag
from bricktrack_host.tracking.frame_motion import led_motion
from bricktrack_host.tracking.optical_track import solve_poses
from bricktrack_host.tracks import FusedTrack, OpticalTrack

DROPOUTS = ((3.0, 0.5), (6.0, 0.5))
SEEN = ("m1", "m5")
LEDS = ("m0", "m1", "m2", "m3", "m4", "m5", "m6")
STEP_NS = 5_000_000
Errors = dict[str, tuple[FloatArray, FloatArray]]


def make_run(seed: int, *, two_remain: bool) -> DaemonRun:
    """Return one run of 8 s; in its dropouts either all LEDs are hidden, or all but two."""
    hidden = tuple((name, *d) for d in DROPOUTS for name in LEDS if name not in SEEN)
    return simulate_run(
        seed, duration_s=8.0, amplitude_mm=8.0, amplitude_deg=3.0, impact_mps=0.25, stamp_offset_ns=3_300_000,
        **({"hidden_leds": hidden} if two_remain else {"dropouts": DROPOUTS}),
    )  # fmt: skip


def true_track(run: DaemonRun, t_ns: IntArray) -> FusedTrack:
    """Return the true motion at instants, as if it had been fused."""
    R, t_mm = run.truth(t_ns)
    omega, v = run.world.twist(t_ns)
    n = len(t_ns)
    return FusedTrack(t_ns, R, t_mm, omega, v, np.tile(np.eye(6) * 1e-12, (n, 1, 1)), np.zeros(n, np.int64))


def errors_of(run: DaemonRun) -> tuple[Errors, BoolArray, BoolArray]:
    """Return squared errors and variances, mm^2, by method; and which instants lie in dropouts, and by impacts."""
    observations, camera, brick = run.observations, run.camera, run.brick
    optical = solve_poses(observations, camera, brick)
    t_ns = np.arange(optical.t_ns[5], optical.t_ns[-5], STEP_NS)
    _, t_mm = run.truth(t_ns)
    tight = fuse_tight(
        observations, optical, run.imu, camera, brick, lever_arm_mm=run.lever_arm_mm, output_t_ns=t_ns
    )

    def by_poses(poses: OpticalTrack) -> FusedTrack:
        return fuse(poses, run.imu, lever_arm_mm=run.lever_arm_mm, output_t_ns=t_ns).track

    motion = led_motion(true_track(run, optical.t_ns), true_track(run, optical.led_t_ns.ravel()))
    tracks = {
        "poses, one instant": by_poses(solve_poses(observations, camera, brick, rolling_shutter=False)),
        "poses, row times": tight.pose_level.track,
        "poses, true motion": by_poses(solve_poses(observations, camera, brick, motion=motion)),
        "LED by LED": tight.fused.track,
    }
    errors = {
        name: (
            ((found.t_camera_brick_mm - t_mm) ** 2).sum(axis=1),
            np.trace(found.covariance[:, 3:, 3:], axis1=1, axis2=2),
        )
        for name, found in tracks.items()
    }
    since = run.world.since_first_edge_s(t_ns)
    inside = np.any([(since > a) & (since < a + d) for a, d in DROPOUTS], axis=0)
    return errors, inside, (tight.fused.track.flags & int(PoseFlag.IMPACT)) != 0


def rms(values: list[FloatArray]) -> float:
    """Return the root mean square of squares from several runs; NaN where nothing was given out."""
    squares = np.concatenate(values)
    return float(np.sqrt(np.mean(squares))) if np.isfinite(squares).all() else float("nan")


def print_table(console: Console, title: str, found: list[tuple[Errors, BoolArray, BoolArray]]) -> None:
    """Print a row for each method: errors away from impacts and dropouts, at impacts, in dropouts, and in all."""
    table = Table(title=title)
    columns = ("quiet mm", "at impacts mm", "in dropouts mm", "all mm", "against poses", "its own sd, all mm")
    table.add_column("method")
    for column in columns:
        table.add_column(column, justify="right")
    reference = rms([errors["poses, row times"][0] for errors, _, _ in found])
    for name in found[0][0]:
        parts = {
            "quiet": [e[name][0][~inside & ~impact] for e, inside, impact in found],
            "impact": [e[name][0][~inside & impact] for e, inside, impact in found],
            "inside": [e[name][0][inside] for e, inside, _ in found],
            "all": [e[name][0] for e, _, _ in found],
            "sd": [e[name][1] for e, _, _ in found],
        }
        figures = {key: rms(part) for key, part in parts.items()}
        table.add_row(
            name, *(f"{figures[key]:.4f}" for key in ("quiet", "impact", "inside", "all")),
            f"{figures['all'] / reference:.2f}", f"{figures['sd']:.3f}",
        )  # fmt: skip
    console.print(table)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=6, help="runs of each table")
    parser.add_argument("--first-seed", type=int, default=13)
    args = parser.parse_args()
    logging.getLogger("bricktrack_host").setLevel(logging.ERROR)
    console = Console(width=120)
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    for two_remain, words in (
        (False, "all LEDs hidden in the dropouts"),
        (True, "two LEDs of seven remain in them"),
    ):
        runs = track(seeds, words, transient=True)
        found = [errors_of(make_run(seed, two_remain=two_remain)) for seed in runs]
        print_table(console, f"{args.seeds} runs of 8 s, 0.3 m/s (simulated): {words}", found)


if __name__ == "__main__":
    main()
