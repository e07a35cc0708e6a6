"""What fusing LED by LED gains over fusing pose by pose, at 0.3 m/s, and what bounds both.

Simulated runs of a unit (`tests/support/daemon_runs.py`): chip registers, centroids at row times, impacts of up to
0.25 m/s, two dropouts of 0.5 s, and clocks that are 3.3 ms apart. Rows:

- poses, one instant: each frame solved as if all its rows were exposed at once;
- poses, row times: each LED at its row's time, the motion within a frame by splines; what the fusion begins with;
- poses, true motion: the same with the true motion within each frame, the limit of whatever takes poses;
- LED by LED: the tightly coupled smoother.

In the second table the dropouts leave two LEDs of seven: too few for a pose.

The third table says whether the motion is as sure as it claims: squared errors over the covariance, by their
degrees of freedom (NEES/6, 1 when honest), and in how many runs the mean lies in its 95 % band, which is as wide
as the smoother's own model has it for so few independent errors (`fusion.believed_errors`). These runs hold errors
that stand still too, drawn as widely as is stated of them: LED profile, picture size, single LEDs.

Run: ``python scripts/bench_tight.py --seeds 6``, and ``--honest 20`` for the third table alone
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

from daemon_runs import DaemonRun, simulate_run

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.fusion.believed_errors import MeanBand, draw_pose_errors, pose_errors
from bricktrack_host.fusion.estimate import FusionInput, fuse, fused_result, smooth_one
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.led_by_led.led_measurements import SeenLeds
from bricktrack_host.fusion.led_by_led.led_smoothing import LedSmoother
from bricktrack_host.fusion.pose_by_pose.fused_output import common_part
from bricktrack_host.fusion.smoothing.smoother_kernel import CHI2_6_95
from bricktrack_host.fusion.tight import fuse_tight, tight_result
from bricktrack_host.normalised_errors import normalised_squares
from bricktrack_host.quality import PoseFlag
from bricktrack_host.tracking.optical_track import solve_poses
from bricktrack_host.tracking.pose.frame_motion import led_motion
from bricktrack_host.tracks import FusedTrack, OpticalTrack

DROPOUTS = ((3.0, 0.5), (6.0, 0.5))
SEEN = ("m1", "m5")
LEDS = ("m0", "m1", "m2", "m3", "m4", "m5", "m6")
STEP_NS = 5_000_000
STANDING_PX = 0.01
N_DRAWS = 400  # of a run's errors, for the ends of its band
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


@dataclass(frozen=True, slots=True, eq=False)
class Honesty:
    """Normalised errors, squared (6 degrees of freedom), of one run and method; shape (k,).

    ``band``: where their mean may lie when they are as believed.
    """

    squares: FloatArray
    band: MeanBand
    is_impact: BoolArray
    is_dropout: BoolArray


def honesty_of(seed: int) -> dict[str, Honesty]:
    """Return how honest both fusions are on one run of the bench with errors that stand still."""
    run = simulate_run(
        seed, duration_s=8.0, amplitude_mm=8.0, amplitude_deg=3.0, impact_mps=0.25, stamp_offset_ns=3_300_000,
        dropouts=DROPOUTS, standing_px=STANDING_PX,
    )  # fmt: skip
    optical, settings = solve_poses(run.observations, run.camera, run.brick), FusionSettings()
    t_ns = np.arange(optical.t_ns[5], optical.t_ns[-5], STEP_NS)
    item = FusionInput(optical, run.imu, run.lever_arm_mm, t_ns)
    first, leds = smooth_one(item, settings), SeenLeds.of(run.observations, run.camera)
    arm_m = run.lever_arm_mm * 1e-3
    done = LedSmoother(leds, first, run.camera, run.brick, lever_arm_m=arm_m, settings=settings).smooth()
    tight = tight_result(run.observations, item, fused_result(item, first, settings), done, settings)
    since = run.world.since_first_edge_s(t_ns)
    is_dropout = np.any([(since > a) & (since < a + d) for a, d in DROPOUTS], axis=0)
    is_impact = (tight.fused.track.flags & int(PoseFlag.IMPACT)) != 0
    common = common_part(first.run, first.scale, settings.optical_common_share)
    out = {}
    for name, found, states, shared in (
        ("poses", tight.pose_level.track, first, common),
        ("LED by LED", tight.fused.track, done.states, np.zeros((6, 6))),
    ):
        drawn = draw_pose_errors(
            states, t_ns, common=shared, n_draws=N_DRAWS, rng=np.random.default_rng(seed)
        )
        squares = normalised_squares(pose_errors(found, *run.truth(t_ns)), found.covariance)
        out[name] = Honesty(squares, MeanBand.of(normalised_squares(*drawn)), is_impact, is_dropout)
    return out


def print_honesty(console: Console, runs: list[dict[str, Honesty]]) -> None:
    """Print a row for each method: NEES/6 by kind of instant, and how many instants and runs are in their bands."""
    table = Table(title=f"Are {len(runs)} runs as sure as they claim? NEES/6 (simulated)")
    table.add_column("method")
    for column in (
        "quiet",
        "at impacts",
        "in dropouts",
        "all",
        "instants in 95 %",
        "runs in their band",
        "independent",
    ):
        table.add_column(column, justify="right")
    for name in runs[0]:
        of = [run[name] for run in runs]
        squares, impact, dropout = (
            np.concatenate([getattr(h, field) for h in of])
            for field in ("squares", "is_impact", "is_dropout")
        )
        parts = (~impact & ~dropout, impact & ~dropout, dropout, np.ones(len(squares), dtype=np.bool_))
        table.add_row(
            name, *(f"{squares[part].mean() / 6:.2f}" for part in parts),
            f"{100 * (squares < CHI2_6_95).mean():.0f} %",
            f"{sum(h.band.holds(h.squares) for h in of)} of {len(of)}",
            f"{np.median([h.band.n_independent for h in of]):.0f}",
        )  # fmt: skip
    console.print(table)


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
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=6, help="runs of each table")
    parser.add_argument("--first-seed", type=int, default=13)
    parser.add_argument("--honest", type=int, default=0, help="only the third table, of so many runs")
    args = parser.parse_args()
    logging.getLogger("bricktrack_host").setLevel(logging.ERROR)
    console = Console(width=120)
    seeds = range(args.first_seed, args.first_seed + (args.honest or args.seeds))
    if args.honest:
        print_honesty(console, [honesty_of(seed) for seed in track(seeds, "simulating", transient=True)])
        return
    for two_remain, words in (
        (False, "all LEDs hidden in the dropouts"),
        (True, "two LEDs of seven remain in them"),
    ):
        runs = track(seeds, words, transient=True)
        found = [errors_of(make_run(seed, two_remain=two_remain)) for seed in runs]
        print_table(console, f"{args.seeds} runs of 8 s, 0.3 m/s (simulated): {words}", found)
    print_honesty(console, [honesty_of(seed) for seed in track(seeds, "honesty", transient=True)])


if __name__ == "__main__":
    main()
