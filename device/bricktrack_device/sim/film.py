"""A simulated recording, made as fast as the machine can: for evaluation, not for the daemon.

    python -m bricktrack_device.sim.film FOLDER --seed 3 --motion impacts --seconds 6

writes what a unit's user would have (`sim_kit`), ``video.h264`` from the renderer and encoder of the
simulated camera, and ``film.npz``: stamps, exposures, and the true pose at mid-exposure of each picture's
centre row.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_device.config import CameraTable
from bricktrack_device.sim.led_renderer import LedRenderer
from bricktrack_device.sim.lens import lens_of
from bricktrack_device.sim.settings import SimSettings
from bricktrack_device.sim.sim_camera import LINES_A_FRAME
from bricktrack_device.sim.sim_kit import write_sim_kit
from bricktrack_device.sim.video_encoder import VideoEncoder
from bricktrack_device.sim.world import SimWorld, make_epoch

_ARMED_NS = 1_000_000_000_000


def film(folder: Path, settings: SimSettings, camera: CameraTable, *, seconds: float) -> int:
    """Write a recording from the start of the motion on, and say how far it is on standard output.

    Returns
    -------
    int
        Number of frames.
    """
    mode = IMX219_1080P
    world = SimWorld(settings, make_epoch())
    write_sim_kit(folder, settings)
    first_edge = world.schedule(_ARMED_NS)
    start = first_edge + round(settings.quiet_s * 1e9)
    period_ns = LINES_A_FRAME * mode.line_time_ns
    exposure_ns = 1000 * round(round(camera.exposure_us * 1e3 / mode.line_time_ns) * mode.line_time_ns / 1e3)
    renderer = LedRenderer(settings, world, lens=lens_of(settings.seed), mode=mode, exposure_ns=exposure_ns)
    encoder = VideoEncoder(camera, mode.width, mode.height)
    n = round(seconds * 1e9 / period_ns)
    stamps = start + np.rint(np.arange(n) * period_ns).astype(np.int64)
    with (folder / "video.h264").open("wb") as video:
        for k, stamp in enumerate(stamps.tolist()):
            luma = renderer.luma(stamp)
            for packet in encoder.encode(stamp // 1000, luma, renderer.chroma_u, renderer.chroma_v):
                video.write(packet.data)
            print(f"{k + 1}/{n}", flush=True)  # whoever started this shows it
    middle = stamps - exposure_ns // 2 + round(float(mode.row_delay_ns(0.5 * (mode.height - 1))))
    R, t_mm = world.pose(middle)
    np.savez(
        folder / "film.npz",
        sensor_timestamp_ns=stamps,
        exposure_ns=np.full(n, exposure_ns, dtype=np.int64),
        R_camera_brick=R,
        t_camera_brick_mm=t_mm,
    )
    return n


def main() -> int:
    """Read the command line and film."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--motion", choices=("sines", "sweep", "impacts", "csv"), default="impacts")
    parser.add_argument("--motion-csv", default="")
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--exposure-us", type=int, default=2000)
    parser.add_argument("--clutter", type=float, default=1.0)
    parser.add_argument("--noise", type=float, default=1.0)
    args = parser.parse_args()
    settings = SimSettings(
        seed=args.seed,
        motion=args.motion,
        motion_csv=args.motion_csv,
        shake_s=args.seconds,
        clutter=args.clutter,
        noise=args.noise,
        quiet_s=0.0,
    )
    film(args.folder, settings, CameraTable(exposure_us=args.exposure_us), seconds=args.seconds)
    return 0


if __name__ == "__main__":
    sys.exit(main())
