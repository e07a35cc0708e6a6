"""Optical poses on the shared path-traced sample (simulated): errors against its truth, and time by stage.

Prints frames with a pose and RMS errors in x, y, z and angle: ours against the paper's filter, with the LED
profile unknown, fitted on the static sweep, and that of the sample's description; with and without row times.
Then the time each stage takes beside the decode of the same pictures, in the same run, as processor time. The
folder of samples comes from ``BRICKTRACK_SAMPLES``; the calibration is fitted from the sample's PNGs.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import av
import numpy as np

from bricktrack_common.brick_model import BrickModel, ProfileEntry, load_brick_model
from bricktrack_common.camera_model import RayModel
from bricktrack_common.rotations import matrix_from_quaternion, rvec_from_matrix
from bricktrack_host.calibration.calibration_file import load_calibration
from bricktrack_host.tracking.centroid_noise import with_measured_noise
from bricktrack_host.tracking.frame_errors import frame_errors
from bricktrack_host.tracking.led_fit import fit_collar
from bricktrack_host.tracking.optical_track import observe_leds, solve_poses, start_poses
from bricktrack_host.tracking.pictures.segment import Picture, find_blobs, paper_filter
from bricktrack_host.tracks import LedObservations, OpticalTrack

FIRST_STAMP_NS = {"static": 4823310455208, "motion": 5118442907613}  # rig.toml
EXPOSURE_NS = 4_000_000
IMPACT_US = 1_837_525
TRUE_COLLAR_MM = 0.7


def main() -> int:
    root = os.environ.get("BRICKTRACK_SAMPLES")
    if root is None:
        print("BRICKTRACK_SAMPLES is not set: no benchmark of the optical chain")
        return 0
    folder = Path(root) / "path-traced"
    rays = calibrated(folder)
    brick = load_brick_model(folder / "layout.toml")
    print("Simulated (path-traced) recording; calibration fitted from calib_*_32x18.png\n")
    static, motion = Recording(folder, "static"), Recording(folder, "motion")
    seen = {
        (r.name, method): r.observe(rays, brick, method)
        for r in (static, motion)
        for method in ("default", "paper")
    }
    fit = fit_collar(seen["static", "default"], rays, brick)
    print(
        f"collar fitted on static.h264: {fit.collar_mm:.3f} +- {fit.sd_mm:.3f} mm; residuals {fit.rms_px:.3f} px, "
        f"left-out frames {fit.cross_validated_rms_px:.3f} px, without profile {fit.rms_without_px:.3f} px\n"
    )
    profiles = {
        "unknown": brick,
        "fitted": with_collar(brick, fit.collar_mm),
        f"{TRUE_COLLAR_MM:g} mm": with_collar(brick, TRUE_COLLAR_MM),
    }
    print(
        "recording  method   profile  rows  poses      x      y      z mm    deg   median NEES (6 expected)"
    )
    for r in (static, motion):
        for method in ("default", "paper"):
            for name, model in profiles.items():
                for rows in (False, True) if r.name == "motion" else (False,):
                    first = start_poses(seen[r.name, method], rays, model)
                    errors = frame_errors(seen[r.name, method], first, rays, model, rolling_shutter=rows)
                    told = with_measured_noise(seen[r.name, method], errors)
                    track = solve_poses(told, rays, model, rolling_shutter=rows, first=first)
                    label = f"{r.name:9s}  {method:7s}  {name:7s}  {'yes' if rows else 'no ':3s}"
                    print(f"{label}   {r.judged(track)}")
                    if rows:
                        print(f"{'  50 ms about the impact left out':40s}{r.judged(track, away=True)}")
                        print(f"{'  m0 hidden (35-42)':40s}{r.judged(track, frames=range(35, 43))}")
    printed = solve_poses(seen["static", "default"], rays, brick, form="printed", refined=False)
    safe = solve_poses(seen["static", "default"], rays, brick, refined=False)
    print(f"static, PRSOI alone, safe form          {static.judged(safe)}")
    print(f"static, PRSOI alone, printed form       {static.judged(printed)}\n")
    timed(motion, rays, profiles["fitted"])
    return 0


class Recording:
    """A video of the sample with its times and truth."""

    def __init__(self, folder: Path, name: str) -> None:
        self.name, self._video = name, folder / f"{name}.h264"
        pts_us = np.loadtxt(folder / f"{name}_pts_us.txt")
        self.stamps_ns = FIRST_STAMP_NS[name] + np.rint(1000 * pts_us).astype(np.int64)
        truth = np.genfromtxt(folder / "truth" / f"{name}_poses.csv", delimiter=",", names=True, dtype=None)
        self.R = matrix_from_quaternion(np.stack([truth[c] for c in ("qw", "qx", "qy", "qz")], axis=1))
        self.t_mm = np.stack([truth[c] for c in ("x_mm", "y_mm", "z_mm")], axis=1)
        self.mid_us = truth["t_mid_us"] if name == "motion" else np.zeros(len(self.R))

    def pictures(self) -> Iterator[tuple[int, Picture]]:
        """Decode the video."""
        with av.open(str(self._video)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            for i, frame in enumerate(container.decode(stream)):
                planes = [
                    np.frombuffer(p, np.uint8).reshape(p.height, p.line_size)[:, : p.width]
                    for p in frame.planes
                ]
                yield i, Picture(*planes)

    def observe(self, rays: RayModel, brick: BrickModel, method: str) -> LedObservations:
        """Find the LEDs in all its pictures."""
        exposure_ns = np.full(len(self.stamps_ns), EXPOSURE_NS)
        return observe_leds(
            self.pictures(),
            rays,
            brick,
            sensor_timestamp_ns=self.stamps_ns,
            exposure_ns=exposure_ns,
            method="paper" if method == "paper" else "default",
        )

    def judged(self, track: OpticalTrack, *, away: bool = False, frames: range | None = None) -> str:
        """Return a line of errors against the truth."""
        which = np.isfinite(track.t_camera_brick_mm).all(axis=1)
        if away:
            which &= np.abs(self.mid_us - IMPACT_US) > 50_000
        if frames is not None:
            which &= np.isin(np.arange(len(which)), list(frames))
        if not which.any():
            return "    0"
        R, t = track.R_camera_brick[which], track.t_camera_brick_mm[which]
        turn = rvec_from_matrix(np.swapaxes(R, -1, -2) @ self.R[which])
        shift = self.t_mm[which] - t
        x, y, z = np.sqrt(np.mean(shift**2, axis=0))
        deg = np.degrees(np.sqrt(np.mean(np.sum(turn**2, axis=1))))
        line = f"{which.sum():5d}  {x:5.3f}  {y:5.3f}  {z:5.3f}     {deg:5.3f}"
        error = np.concatenate([turn, shift], axis=1)
        covariance = track.covariance[which]
        if np.isfinite(covariance).all():
            nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
            line += f"   {np.median(nees):6.1f}"
        return line


def calibrated(folder: Path) -> RayModel:
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "calibration.json"
        command = "from bricktrack_host.cli import main; main()"
        arguments = [
            "calibrate",
            "fit",
            "--rig",
            folder / "rig.toml",
            "--target",
            "32x18",
            "--unit",
            "sample",
        ]
        subprocess.run(
            [sys.executable, "-c", command, *map(str, arguments), "--focus-note", "sample", "-o", str(out)],
            check=True,
            capture_output=True,
        )
        return load_calibration(out).ray_model


def with_collar(brick: BrickModel, collar_mm: float) -> BrickModel:
    return replace(brick, led_profile=ProfileEntry(collar_mm=collar_mm, source="scripts/bench_optical.py"))


def timed(recording: Recording, rays: RayModel, brick: BrickModel) -> None:
    """Print processor time per frame, beside that of the decode of the same pictures."""
    n = len(recording.stamps_ns)

    def per_frame_ms(start: float) -> float:
        return (time.process_time() - start) / n * 1e3

    start = time.process_time()
    pictures = list(recording.pictures())
    decode = per_frame_ms(start)
    print(f"processor time a frame over {n} frames; decode of the same pictures {decode:.2f} ms")
    start = time.process_time()
    for _, picture in pictures:
        find_blobs(picture, radius_px=36.0)
    blobs = per_frame_ms(start)
    start = time.process_time()
    for _, picture in pictures:
        paper_filter(picture)
    paper = per_frame_ms(start)
    exposure_ns = np.full(n, EXPOSURE_NS)
    start = time.process_time()
    seen = observe_leds(
        pictures, rays, brick, sensor_timestamp_ns=recording.stamps_ns, exposure_ns=exposure_ns
    )
    observe = per_frame_ms(start)
    start = time.process_time()
    solve_poses(seen, rays, brick)
    solve = per_frame_ms(start)
    print("stage                              ms    of the decode")
    for name, ms in (
        ("find and measure lights", blobs),
        ("  the paper's filter instead", paper),
        ("identify, from nothing once", observe - blobs),
        ("solve poses with row times", solve),
        ("all of ours", observe + solve),
    ):
        print(f"{name:32s} {ms:6.2f}   {100 * ms / decode:5.1f} %")


if __name__ == "__main__":
    sys.exit(main())
