"""What the user of a simulated unit would have on the host: layout, rig file and pictures of the target."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.frame import VideoFrame

from bricktrack_common.arrays import FloatArray
from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_device.sim.lens import Lens, lens_of
from bricktrack_device.sim.settings import SimSettings
from bricktrack_device.sim.world import load_layout

PLANES_MM = {"A": 101.117, "B": 161.111}
PITCH_MM = 4.0
DOT_DIAMETER_MM = 2.0
COLUMNS, ROWS = 54, 32
_SUB = 4
_WHITE, _BLACK = 0.72, 0.03
_PSF_SIGMA_PX = 1.1

_RIG = """\
# The calibration rig of a simulated unit. Camera frame: x right (u), y down (v), z forward, mm.
simulated = true

[calibration]
plane_a_mm = {a}
plane_b_mm = {b}
pitch_mm = {pitch}
dot_diameter_mm = {diameter}
# The origin is midway between the four dots nearest to this pixel: the target's centre, on the optical axis.
origin_near_px = [{u:.0f}, {v:.0f}]

[[calibration.target]]
name = "{columns}x{rows}"
columns = {columns}
rows = {rows}
images = ["calib_A.png", "calib_B.png"]

[sensor]
width = {width}
height = {height}
line_time_us = {line_time_us}
"""
_HALF_TARGET_MM = np.array([COLUMNS, ROWS]) / 2 * PITCH_MM


def write_sim_kit(folder: Path, settings: SimSettings) -> list[Path]:
    """Write ``layout.toml``, ``rig.toml``, ``calib_A.png`` and ``calib_B.png``; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    lens = lens_of(settings.seed)
    layout = folder / "layout.toml"
    layout.write_text(_layout_text(settings), encoding="utf-8")
    rig = folder / "rig.toml"
    rig.write_text(
        _RIG.format(
            a=PLANES_MM["A"], b=PLANES_MM["B"], pitch=PITCH_MM, diameter=DOT_DIAMETER_MM, u=lens.cx_px,
            v=lens.cy_px, columns=COLUMNS, rows=ROWS, width=lens.width, height=lens.height,
            line_time_us=IMX219_1080P.line_time_ns / 1000,
        ),
        encoding="utf-8",
    )  # fmt: skip
    written = [layout, rig]
    for i, (name, z_mm) in enumerate(PLANES_MM.items()):
        path = folder / f"calib_{name}.png"
        rng = np.random.default_rng([settings.seed, 7, i])
        _write_png(path, target_picture(lens, z_mm, rng, noise=settings.noise))
        written.append(path)
    return written


def target_picture(lens: Lens, z_mm: float, rng: np.random.Generator, *, noise: float) -> FloatArray:
    """Return grey levels 0..255 of the dot target square before the camera at depth ``z_mm``."""
    v, u = np.mgrid[0 : lens.height, 0 : lens.width].astype(np.float64)
    base = lens.pixel_slopes * z_mm
    du, dv = np.gradient(base, axis=1), np.gradient(base, axis=0)
    light = _target_light(base)
    # Only where an edge crosses a pixel do its parts differ.
    reach_mm = float((np.abs(du) + np.abs(dv)).sum(axis=-1).max())
    is_cut = (np.abs(_from_dot_mm(base) - DOT_DIAMETER_MM / 2) < reach_mm) | (
        np.abs(np.abs(base) - _HALF_TARGET_MM) < reach_mm
    ).any(axis=-1)
    base, du, dv = base[is_cut], du[is_cut], dv[is_cut]
    offsets = (np.arange(_SUB) + 0.5) / _SUB - 0.5
    parts = [_target_light(base + off_u * du + off_v * dv) for off_v in offsets for off_u in offsets]
    light[is_cut] = np.mean(parts, axis=0)
    light *= 1 - 0.12 * ((u / lens.width - 0.4) ** 2 + (v / lens.height - 0.6) ** 2)  # uneven lamps
    x = np.arange(-4, 5)
    kernel = np.exp(-0.5 * (x / _PSF_SIGMA_PX) ** 2)
    kernel /= kernel.sum()
    for axis in (0, 1):
        padded = np.pad(light, [(4, 4) if a == axis else (0, 0) for a in (0, 1)], mode="edge")
        n = light.shape[axis]
        light = sum(
            (w * (padded[k : k + n] if axis == 0 else padded[:, k : k + n]) for k, w in enumerate(kernel)),
            np.zeros_like(light),
        )
    light += noise * 0.006 * rng.standard_normal(light.shape)
    return np.asarray(255 * np.clip(light, 0, 1))


def _from_dot_mm(xy: FloatArray) -> FloatArray:
    """Return how far points of the target's plane are from the middle of the nearest dot, mm."""
    cell = xy / PITCH_MM - 0.5  # an even count: the dots nearest to the origin are half a pitch away
    to_dot = (cell - np.rint(cell)) * PITCH_MM
    return np.asarray(np.hypot(to_dot[..., 0], to_dot[..., 1]))


def _target_light(xy: FloatArray) -> FloatArray:
    """Return how bright points of the target's plane are."""
    is_dot = (_from_dot_mm(xy) < DOT_DIAMETER_MM / 2) & (np.abs(xy) < _HALF_TARGET_MM).all(axis=-1)
    return np.where(is_dot, _WHITE, _BLACK)


def _write_png(path: Path, grey: FloatArray) -> None:
    """Write an 8-bit grey PNG with FFmpeg's own encoder."""
    encoder = av.CodecContext.create("png", "w")
    encoder.width, encoder.height, encoder.pix_fmt = grey.shape[1], grey.shape[0], "gray"
    encoder.framerate = Fraction(1)
    frame = VideoFrame.from_ndarray(np.rint(grey).astype(np.uint8), format="gray")
    frame.pts = 0
    packets = [*encoder.encode(frame), *encoder.encode(None)]
    path.write_bytes(b"".join(bytes(p) for p in packets))


def _layout_text(settings: SimSettings) -> str:
    if settings.layout:
        return Path(settings.layout).read_text(encoding="utf-8")
    brick = load_layout(settings)
    lines = [
        "# The brick of a simulated unit: the paper's seven LEDs.",
        "# Brick frame, mm: origin m0, x right, y down.",
        f'name = "{brick.name}"',
        "",
        "[led_profile]",
        f"collar_mm = {settings.collar_mm}",
        "shift_sd_per_radius = 0.0015",
        'source = "known: the simulated LEDs are drawn with it"',
    ]
    for name, position, axis, radius in zip(
        brick.led_names, brick.led_positions_mm, brick.led_axes, brick.led_radii_mm, strict=True
    ):
        lines += [
            "",
            "[[led]]",
            f'name = "{name}"',
            f"position_mm = {[float(x) for x in position]}",
            f"axis = {[float(x) for x in axis]}",
            f"radius_mm = {float(radius)}",
        ]
    if brick.imu_lever_arm_mm is not None and brick.R_brick_imu is not None:
        lines += [
            "",
            "[imu]",
            f"lever_arm_mm = {brick.imu_lever_arm_mm.tolist()}",
            f"rotation = {brick.R_brick_imu.tolist()}",
        ]
    return "\n".join(lines) + "\n"
