"""Poses from simulated centroids against the Cramér-Rao bound, and beside other solvers; identities; time.

A lens that the solver does not know shows dots to calibrate from, and a brick in random poses. Errors are over
the bound of each pose: 1.00 is the best that any unbiased method can do. The others get the true lens. Development
used seed 1; the figures printed are of another seed, and so of another lens.

    python scripts/bench_pose.py [--frames 100000] [--searches 2000] [--seed 2]
"""

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from identity_frames import BESIDE_PX, HEADER, N_FALSE, fitted_brick, one_beside_in, searched, tracked
from pose_peers import each, other_solvers

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix
from bricktrack_host.evaluation.bound import cramer_rao_covariance
from bricktrack_host.evaluation.paper_brick import paper_brick
from bricktrack_host.evaluation.simulated_points import points_of
from bricktrack_host.evaluation.true_camera import TrueCamera
from bricktrack_host.tracking.identity.pattern import follow_pattern
from bricktrack_host.tracking.led_model.hit_polynomials import expand_at, hit_polynomials
from bricktrack_host.tracking.optical_track import solve_poses
from bricktrack_host.tracking.pose.prsoi import START_MM, prsoi_starts
from bricktrack_host.tracking.pose.refine import LedMotion, refine_poses
from bricktrack_host.tracks import LedObservations

NOISES_PX = (0.02, 0.05, 0.1)
WRONG_MM = 2.0
CHUNK = 5000
OTHERS = 2000  # frames that the other solvers get: they take one at a time


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument(
        "--searches", type=int, default=2000, help="frames with two LEDs hidden, from nothing"
    )
    parser.add_argument("--seed", type=int, default=2)
    args = parser.parse_args()
    brick = paper_brick()
    camera = TrueCamera.of_seed(args.seed)
    clean_rays = camera.calibrated(noise_px=1e-4, rng=np.random.default_rng([args.seed, 6]))
    print(f"All figures simulated. Lens and noise of seed {args.seed}; {args.frames} random poses.\n")
    print(
        "RMSE over the bound                     rot x  rot y  rot z      x      y      z   failed   NEES/6"
    )
    solvers = other_solvers()
    for noise in NOISES_PX:
        rng = np.random.default_rng([args.seed, round(1000 * noise)])
        rays = camera.calibrated(noise_px=noise, rng=rng)
        ours, clean, raw = Tally(), Tally(), Tally()
        left = args.frames
        while left > 0:
            n = min(CHUNK, left)
            left -= n
            scene = Scene.random(n, brick, camera, noise, rng)
            R, t = prsoi_starts(scene.uv, rays, scene.points)
            raw.add(scene, R, t, None)
            fitted = refine_poses(
                scene.uv, scene.cov, R, t, rays, scene.points, collar_mm=0.0, profile_is_exact=True
            )
            ours.add(scene, fitted.R_camera_brick, fitted.t_camera_brick_mm, fitted.covariance)
            fitted = refine_poses(
                scene.uv, scene.cov, R, t, clean_rays, scene.points, collar_mm=0.0, profile_is_exact=True
            )
            clean.add(scene, fitted.R_camera_brick, fitted.t_camera_brick_mm, fitted.covariance)
        print(f"{noise:4.2f} px  PRSOI and refinement, dots   {ours}")
        print(f"         the same, dots without noise {clean}")
        print(f"         PRSOI alone, dots            {raw}")
        few = Scene.random(OTHERS, brick, camera, noise, rng)
        for name, solve in solvers.items():
            tally = Tally()
            R, t = each(few.uv, brick.led_positions_mm, camera, solve)
            tally.add(few, R, t, None)
            print(f"         {name:28s} {tally}")
    identities(args.searches, args.seed, brick, camera)
    moving(args.seed, brick, camera)
    moving_with_few(args.seed, brick, camera)
    timed(args.seed, brick, camera)
    return 0


class Scene:
    """Random poses of a brick whose LEDs are points, and what the camera shows of them."""

    def __init__(
        self, R: FloatArray, t: FloatArray, brick: BrickModel, camera: TrueCamera, noise_px: float
    ) -> None:
        self.R, self.t, self.brick, self.noise_px = R, t, brick, noise_px
        self.points = points_of(brick)
        self.camera = camera
        self.uv_true = camera.project(np.einsum("nij,lj->nli", R, brick.led_positions_mm) + t[:, None])
        self.cov = np.tile(noise_px**2 * np.eye(2), (len(R), brick.n_leds, 1, 1))
        self.uv = self.uv_true

    @classmethod
    def random(
        cls, n: int, brick: BrickModel, camera: TrueCamera, noise_px: float, rng: np.random.Generator
    ) -> "Scene":
        """Draw poses within 25 degrees of facing the camera, all LEDs in the picture."""
        middle = 0.5 * (brick.led_positions_mm.min(axis=0) + brick.led_positions_mm.max(axis=0))
        R, t = np.empty((0, 3, 3)), np.empty((0, 3))
        while len(R) < n:
            axis = rng.normal(size=(n, 3))
            axis *= np.radians(rng.uniform(0, 25, (n, 1))) / np.linalg.norm(axis, axis=1, keepdims=True)
            turn = matrix_from_rvec(axis)
            place = np.column_stack(
                [rng.uniform(-18, 18, n), rng.uniform(-8, 8, n), rng.uniform(112, 155, n)]
            )
            shift = place - turn @ middle
            drawn = cls(turn, shift, brick, camera, noise_px)
            whole = camera.sees(drawn.uv_true).all(axis=1)
            R, t = np.concatenate([R, turn[whole]]), np.concatenate([t, shift[whole]])
        scene = cls(R[:n], t[:n], brick, camera, noise_px)
        scene.uv = scene.uv_true + rng.normal(0, noise_px, scene.uv_true.shape)
        return scene

    def bound(self, seen: BoolArray | None = None) -> FloatArray:
        """Return the Cramér-Rao bound, (n, 6, 6)."""
        seen = np.ones(self.uv.shape[:2], dtype=bool) if seen is None else seen
        return cramer_rao_covariance(
            self.camera.project, self.R, self.t, self.brick.led_positions_mm, seen, noise_px=self.noise_px
        )


class Tally:
    """Sums of squared errors over the bound, failures, and normalised squared errors."""

    def __init__(self) -> None:
        self.squares, self.n, self.failed, self.nees = np.zeros(6), 0, 0, 0.0
        self.has_covariance = False

    def add(self, scene: Scene, R: FloatArray, t: FloatArray, covariance: FloatArray | None) -> None:
        """Count poses; one that is missing or wrong by millimetres is a failure and no error."""
        distance = np.linalg.norm(t - scene.t, axis=1)
        good = np.isfinite(distance) & (distance < WRONG_MM + 200 * scene.noise_px)
        self.failed += int((~good).sum())
        turn = rvec_from_matrix(np.swapaxes(R[good], -1, -2) @ scene.R[good])
        error = np.concatenate([turn, (scene.t - t)[good]], axis=1)
        variance = np.einsum("nii->ni", scene.bound()[good])
        self.squares += np.sum(error**2 / variance, axis=0)
        self.n += int(good.sum())
        if covariance is not None:
            self.has_covariance = True
            self.nees += float(np.einsum("ni,nij,nj->", error, np.linalg.inv(covariance[good]), error))

    def __str__(self) -> str:
        ratio = np.sqrt(self.squares / max(self.n, 1))
        nees = f"{self.nees / self.n / 6:8.3f}" if self.has_covariance else "       -"
        return "  ".join(f"{r:5.3f}" for r in ratio) + f"  {self.failed:7d} {nees}"


def identities(n: int, seed: int, brick: BrickModel, camera: TrueCamera) -> None:
    """Print how identities come out with LEDs hidden and five false lights: from nothing, and along runs."""
    rng = np.random.default_rng([seed, 7])
    rays = camera.calibrated(noise_px=0.05, rng=rng)
    domes = fitted_brick(brick)
    unfitted = replace(brick, led_profile=None)

    def poses(m: int) -> tuple[FloatArray, FloatArray]:
        scene = Scene.random(m, brick, camera, 0.05, rng)
        return scene.R, scene.t

    print(
        f"\nIdentities with {N_FALSE} false lights, 0.05 px; each frame from nothing, or runs of 450 frames"
    )
    print(HEADER)
    for n_hidden, share in ((0, 0.1), (1, 0.3), (2, 1.0)):
        found = searched(max(int(n * share), 1), n_hidden, poses, domes, camera, rays, rng)
        print(f"from nothing, {n_hidden} hidden          {found}", flush=True)
    few = max(n // 10, 1)
    found = searched(few, 2, poses, domes, camera, rays, rng, mirrors=True)
    print(f"  the false ones mirror images   {found}", flush=True)
    found = searched(few, 2, poses, unfitted, camera, rays, rng, fitted=False)
    print(f"  2 hidden, profile not fitted   {found}", flush=True)
    for name, mm_s in (("0.03 m/s", 30.0), ("0.3 m/s", 300.0)):
        found = searched(few, 2, poses, domes, camera, rays, rng, speed_mm_s=mm_s)
        print(f"  2 hidden, {name:10s}           {found}", flush=True)
    for name, speed in (("at rest", 0.0), ("0.03 m/s", 0.1), ("0.09 m/s", 0.3), ("0.3 m/s", 1.0)):
        print(f"run, 1 or 2 hidden, {name:10s}   {tracked(few, domes, camera, rays, rng, speed_share=speed)}")
    found, often = searched(n, 2, poses, domes, camera, rays, rng, beside=True), one_beside_in(2)
    print(f"from nothing, 2 hidden, a false light within {BESIDE_PX:.0f} px of one of them: 1 in {often:.0f}")
    print(f"{'':33s}{found}")
    print(f"{'':33s}by such lights, of all frames wrong: {found.wrong / n / often:.1e}", flush=True)


def observed(uv: FloatArray, scene: Scene, step_ns: int = 33_327_000) -> LedObservations:
    n, n_leds = uv.shape[:2]
    missing = ~np.isfinite(uv[..., 0])
    return LedObservations(
        sensor_timestamp_ns=np.arange(n, dtype=np.int64) * step_ns + 10**12,
        exposure_ns=np.full(n, 2_000_000, dtype=np.int64),
        uv_px=uv,
        cov_px2=np.tile(scene.noise_px**2 * np.eye(2), (n, n_leds, 1, 1)),
        area_px2=np.full((n, n_leds), np.nan),
        led_flags=missing.astype(np.int64),
        frame_flags=np.zeros(n, dtype=np.int64),
    )


class Swing:
    """A brick swinging at up to 0.3 m/s and some 2 degrees, whose LEDs are seen as their rows are read out."""

    def __init__(self, brick: BrickModel, camera: TrueCamera, n: int) -> None:
        self.brick, self.camera = brick, camera
        self.frame_s = np.arange(n) * 33.327e-3

    def pose(self, t_s: FloatArray, share: float) -> tuple[FloatArray, FloatArray]:
        """Return the pose at instants; 4 Hz, 12 mm: 0.3 m/s along x and half of it along y and z."""
        places_mm = self.brick.led_positions_mm
        middle = 0.5 * (places_mm.min(axis=0) + places_mm.max(axis=0))
        angle = 2 * np.pi * 4.0 * t_s
        wave = np.stack([np.sin(angle), 0.5 * np.sin(angle + 1), 0.5 * np.sin(angle + 2)], axis=-1)
        R = matrix_from_rvec(np.radians(2.0) * share * wave[..., [1, 2, 0]])
        return R, np.array([0.0, 0.0, 134.0]) + 12.0 * share * wave - R @ middle

    def pixels(self, share: float) -> FloatArray:
        """Return where the LEDs are seen: a fixed point of row and instant, which a few rounds settle."""
        mode = self.camera.mode
        led_s = np.repeat(self.frame_s[:, None], self.brick.n_leds, axis=1)
        for _ in range(20):
            R, t = self.pose(led_s, share)
            uv = self.camera.project(np.einsum("nlij,lj->nli", R, self.brick.led_positions_mm) + t)
            led_s = self.frame_s[:, None] + (uv[..., 1] - 0.5 * (mode.height - 1)) * mode.line_time_ns * 1e-9
        return uv


def moving(seed: int, brick: BrickModel, camera: TrueCamera) -> None:
    """Print errors of a brick swinging at 0.3 m/s, read out in 20 ms: row times taken, and not."""
    rng = np.random.default_rng([seed, 9])
    noise, n = 0.05, 900
    rays = camera.calibrated(noise_px=noise, rng=rng)
    swing = Swing(brick, camera, n)
    print("\nMoving at up to 0.3 m/s, 4 Hz, 20 ms read-out, 0.05 px: root mean square errors")
    print("                       x      y      z mm    deg")
    for name, share, rows in (("at rest", 0.0, True), ("row times", 1.0, True), ("one instant", 1.0, False)):
        scene = Scene(*swing.pose(swing.frame_s, share), brick, camera, noise)
        uv = swing.pixels(share)
        uv = uv + rng.normal(0, noise, uv.shape)
        track = solve_poses(observed(uv, scene), rays, scene.points, rolling_shutter=rows)
        inner = slice(5, -5)  # the ends know one neighbour only
        posed = np.arange(n)[inner][np.isfinite(track.t_camera_brick_mm[inner]).all(axis=1)]
        error = (track.t_camera_brick_mm - scene.t)[posed]
        turn = rvec_from_matrix(np.swapaxes(track.R_camera_brick[posed], -1, -2) @ scene.R[posed])
        rms = np.sqrt(np.mean(error**2, axis=0))
        deg = np.degrees(np.sqrt(np.mean(np.sum(turn**2, axis=1))))
        whole = np.concatenate([turn, -error], axis=1)
        nees = np.einsum("ni,nij,nj->n", whole, np.linalg.inv(track.covariance[posed]), whole).mean() / 6
        refused = n - 10 - len(posed)
        print(
            f"{name:20s} "
            + "  ".join(f"{x:5.3f}" for x in rms)
            + f"     {deg:5.3f}   NEES/6 {nees:5.2f}"
            + (f"   {refused} of {n - 10} refused" if refused else "")
        )


def moving_with_few(seed: int, brick: BrickModel, camera: TrueCamera) -> None:
    """Print how often poses of a swinging brick with few LEDs are wrong and sure, or refused."""
    rng = np.random.default_rng([seed, 10])
    noise, n = 0.05, 60
    rays = camera.calibrated(noise_px=noise, rng=rng)
    swing = Swing(brick, camera, n)
    print("\nThe same, each choice of LEDs in its turn the only ones seen, of 60 frames")
    print("                    frames   off by a degree and 4 sd   refused")
    for n_leds in (6, 5, 4):
        n_frames = n_wrong = n_refused = 0
        for leds in combinations(range(brick.n_leds), n_leds):
            places_mm = brick.led_positions_mm[list(leds)]
            if np.linalg.matrix_rank(places_mm - places_mm[0], tol=0.1) < 2:
                continue  # a column has no pose
            scene = Scene(*swing.pose(swing.frame_s, 1.0), brick, camera, noise)
            uv = swing.pixels(1.0) + rng.normal(0, noise, (n, brick.n_leds, 2))
            uv[:, [k for k in range(brick.n_leds) if k not in leds]] = np.nan
            track = solve_poses(observed(uv, scene), rays, scene.points)
            posed = np.isfinite(track.t_camera_brick_mm).all(axis=1)
            R, sd = track.R_camera_brick[posed], track.covariance[posed, :3, :3]
            turn = np.linalg.norm(rvec_from_matrix(np.swapaxes(R, -1, -2) @ scene.R[posed]), axis=1)
            sure = 4 * np.sqrt(np.einsum("nii->n", sd))
            n_frames, n_refused = n_frames + n, n_refused + int((~posed).sum())
            n_wrong += int((turn > np.maximum(sure, np.radians(1.0))).sum())
        print(f"{n_leds} LEDs           {n_frames:10d} {n_wrong:26d} {n_refused:9d}", flush=True)


def timed(seed: int, brick: BrickModel, camera: TrueCamera) -> None:
    """Print processor time a frame of the batch's parts."""
    rng = np.random.default_rng([seed, 8])
    rays = camera.calibrated(noise_px=0.05, rng=rng)
    scene = Scene.random(20_000, brick, camera, 0.05, rng)
    R, t = prsoi_starts(scene.uv, rays, scene.points)
    n = len(scene.uv)
    lights = (scene.uv[:1] + rng.normal(0, 10, (n, 1, 2)) + rng.normal(0, 1, (n, 7, 2))).reshape(-1, 2)
    first, stamps = np.arange(n + 1) * 7, np.arange(n) * 33_327_000
    nothing_known = np.zeros(n, dtype=bool)
    still = LedMotion(np.zeros((20_000, 7, 3)), np.zeros((20_000, 7, 3)), np.zeros((20_000, 7)))
    parts: dict[str, Callable[[], object]] = {
        "rays of the pixels": lambda: expand_at(hit_polynomials(rays), scene.uv),
        "rays and PRSOI": lambda: prsoi_starts(scene.uv, rays, scene.points),
        "  as a start": lambda: prsoi_starts(scene.uv, rays, scene.points, tolerance_mm=START_MM),
        "identity, followed": lambda: follow_pattern(
            lights, first, stamps, nothing_known, 0, scene.uv[0], radius_px=35.0, max_coast_ns=10**9
        ),
        "refinement, with rays": lambda: refine_poses(
            scene.uv, scene.cov, R, t, rays, scene.points, collar_mm=0.0, profile_is_exact=True
        ),
        "  with LED motion": lambda: refine_poses(
            scene.uv, scene.cov, R, t, rays, scene.points, collar_mm=0.0, profile_is_exact=True, motion=still
        ),
    }
    print("\nProcessor time, batch of 20,000 frames, best of three")
    took_us = {}
    for name, run in parts.items():
        best = np.inf
        for _ in range(3):
            start = time.process_time()
            run()
            best = min(best, time.process_time() - start)
        took_us[name] = best / n * 1e6
        print(f"{name:24s} {took_us[name]:7.2f} us a frame")
    whole_us = sum(took_us[name] for name in ("identity, followed", "  as a start", "refinement, with rays"))
    print(f"identity, start, fit     {whole_us:7.2f} us a frame")
    print("\nRefinement with rays, shared by threads: wall time, best of three")
    for n_threads in (1, 2):
        best = np.inf
        for _ in range(3):
            start = time.perf_counter()
            refine_poses(
                scene.uv,
                scene.cov,
                R,
                t,
                rays,
                scene.points,
                collar_mm=0.0,
                profile_is_exact=True,
                n_threads=n_threads,
            )
            best = min(best, time.perf_counter() - start)
        print(
            f"{n_threads} thread{'s' if n_threads > 1 else ' '}                {best / len(scene.R) * 1e6:7.2f} us a frame"
        )


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent))
    sys.exit(main())
