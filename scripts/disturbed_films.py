"""Films for `bench_covered.py`: the simulated camera's pictures with cards and lamps before and beside the LEDs.

One render is disturbed in several ways at once; each way is encoded, decoded, identified and solved for itself, so
that errors with and without the disturbance are of the same motion and the same noise.
"""

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import track
from scipy.interpolate import PchipInterpolator

from bricktrack_common.arrays import FloatArray
from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_device.config import CameraTable
from bricktrack_device.sim.led_renderer import LedRenderer
from bricktrack_device.sim.lens import lens_of
from bricktrack_device.sim.scene import LIGHT_OF_LUMA, to_luma
from bricktrack_device.sim.settings import SimSettings
from bricktrack_device.sim.sim_camera import LINES_A_FRAME
from bricktrack_device.sim.sim_kit import write_sim_kit
from bricktrack_device.sim.video_encoder import VideoEncoder
from bricktrack_device.sim.world import SimWorld, make_epoch
from bricktrack_host.evaluation.filmed import Film, open_film

MODE = IMX219_1080P
PERIOD_NS = LINES_A_FRAME * MODE.line_time_ns
EXPOSURE_NS = 2_000_000
Luma = NDArray[np.uint8]
Disturbance = Callable[[Luma, int, FloatArray], None]
"""Changes a frame's luma in place: its number, and where the LEDs are in it, shape (n_leds, 2), px."""


def write_motion(path: Path, knots_s: FloatArray, knots: FloatArray) -> None:
    """Write a motion through knots, (n, 6), mm and degrees from rest, without overshoot, for the simulator."""
    t_s = np.arange(0.0, knots_s[-1] + 1e-9, 0.01)
    q = PchipInterpolator(knots_s, knots)(t_s)
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(("t_s", "x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg"))
        rows.writerows([f"{t:.3f}", *(f"{x:.6f}" for x in row)] for t, row in zip(t_s, q, strict=True))


def make_films(
    folder: Path,
    settings: SimSettings,
    n_frames: int,
    disturbances: dict[str, Disturbance],
) -> dict[str, Film]:
    """Film a simulated brick, once for each disturbance, and calibrate its camera from its target pictures."""
    world = SimWorld(settings, make_epoch())
    lens = lens_of(settings.seed)
    write_sim_kit(folder, settings)
    start = world.schedule(10**12)
    stamps = start + np.rint(np.arange(n_frames) * PERIOD_NS).astype(np.int64)
    middle = stamps - EXPOSURE_NS // 2 + round(float(MODE.row_delay_ns(0.5 * (MODE.height - 1))))
    R, t_mm = world.pose(middle)
    np.savez(
        folder / "film.npz",
        sensor_timestamp_ns=stamps,
        exposure_ns=np.full(n_frames, EXPOSURE_NS),
        R_camera_brick=R,
        t_camera_brick_mm=t_mm,
    )
    uv = lens.project(np.einsum("nij,lj->nli", R, world.brick.led_positions_mm) + t_mm[:, None])
    renderer = LedRenderer(settings, world, lens=lens, mode=MODE, exposure_ns=EXPOSURE_NS)
    encoders, films = {}, {}
    for name in disturbances:
        (folder / name).mkdir(exist_ok=True)
        encoders[name] = VideoEncoder(CameraTable(), MODE.width, MODE.height)
        films[name] = (folder / name / "video.h264").open("wb")
    for k, stamp in enumerate(track(stamps.tolist(), f"film {folder.name}", transient=True)):
        clean = renderer.luma(stamp)
        for name, disturb in disturbances.items():
            luma = clean.copy()
            disturb(luma, k, uv[k])
            for packet in encoders[name].encode(stamp // 1000, luma, renderer.chroma_u, renderer.chroma_v):
                films[name].write(packet.data)
    for file in films.values():
        file.close()
    film = open_film(folder)
    return {name: replace(film, folder=folder / name) for name in disturbances}


def draw_card(
    luma: Luma,
    at_px: FloatArray,
    angle_rad: float,
    edge_px: float,
    *,
    light: float,
    soft_px: float,
) -> None:
    """Put a card's end, 120 px wide and 80 px long, before the light at a place.

    It comes from the side that ``angle_rad`` points to; its edge is ``edge_px`` that way from the place, and as
    soft as what is out of focus.
    """
    _blend(luma, at_px, 150, light, lambda u, v: _card_share(u, v, angle_rad, edge_px, soft_px))


def draw_lamp(luma: Luma, at_px: FloatArray, radius_px: float, *, light: float) -> None:
    """Add a round lamp, or the image of one in a pane: it does not hide what shines behind."""
    reach = int(radius_px) + 4

    def share(u: FloatArray, v: FloatArray) -> FloatArray:
        return np.clip(0.5 + (radius_px - np.hypot(u, v)) / 3, 0, 1)

    _blend(luma, at_px, reach, light, share, brightest=True)


def _card_share(u: FloatArray, v: FloatArray, angle_rad: float, edge_px: float, soft_px: float) -> FloatArray:
    along = u * np.cos(angle_rad) + v * np.sin(angle_rad)
    across = v * np.cos(angle_rad) - u * np.sin(angle_rad)
    front = np.clip(0.5 + (along - edge_px) / soft_px, 0, 1)
    sides = np.clip(60.5 - np.abs(across), 0, 1) * np.clip(edge_px + 80.5 - along, 0, 1)
    return np.asarray(front * sides)


def _blend(
    luma: Luma,
    at_px: FloatArray,
    reach: int,
    light: float,
    share: Callable[[FloatArray, FloatArray], FloatArray],
    *,
    brightest: bool = False,
) -> None:
    u0, v0 = np.maximum(np.rint(at_px).astype(int) - reach, 0)
    u1, v1 = np.minimum(np.rint(at_px).astype(int) + reach + 1, [luma.shape[1], luma.shape[0]])
    if u1 <= u0 or v1 <= v0:
        return
    v, u = np.mgrid[v0:v1, u0:u1].astype(np.float64)
    s = share(u - at_px[0], v - at_px[1])
    window = luma[v0:v1, u0:u1]
    there = LIGHT_OF_LUMA[window]
    mixed = (1 - s) * there + s * (np.maximum(there, light) if brightest else light)
    window[...] = to_luma(mixed.astype(np.float32))
