"""Bricks with LEDs, poses and pictures of them, made without the product's projection or segmentation."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from pinhole import PinholeCamera
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from bricktrack_common.brick_model import (
    BrickModel,
    LayoutFile,
    LedEntry,
    ProfileEntry,
    brick_model_from_file,
)
from bricktrack_host.tracking.pictures.segment import Picture

FloatArray = NDArray[np.float64]

_S, _C = np.sin(np.radians(50.0)), np.cos(np.radians(50.0))
COLUMN = {0: (0.0, 0.0, 0.0), 3: (0.0, 15.0, 0.0), 4: (0.0, 26.0, 0.0), 5: (0.0, 46.0, 0.0)}


def seven_leds(collar_mm: float | None = None) -> BrickModel:
    """A layout of the paper's kind: a column of four, one LED out of the plane, two on the other side."""
    places = {**COLUMN, 1: (24.0, 4.0, 12.0), 2: (51.0, 12.0, 0.0), 6: (54.0, 48.0, 0.0)}
    axes = dict.fromkeys(COLUMN, (_S, 0.0, -_C)) | {
        1: (0.0, 0.0, -1.0),
        2: (-_S, 0.0, -_C),
        6: (-_S, 0.0, -_C),
    }
    leds = [LedEntry(name=f"m{i}", position_mm=places[i], axis=axes[i], radius_mm=3.0) for i in range(7)]
    profile = None if collar_mm is None else ProfileEntry(collar_mm=collar_mm, source="test")
    return brick_model_from_file(LayoutFile(name="test", led=leds, led_profile=profile), where="test")


def random_poses(n: int, *, seed: int, tilt_deg: float = 20.0) -> tuple[FloatArray, FloatArray]:
    """Poses near facing the camera, all LEDs in its picture."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(n, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    R = Rotation.from_rotvec(axis * np.radians(rng.uniform(0, tilt_deg, n))[:, None]).as_matrix()
    centre = np.column_stack([rng.uniform(-6, 6, n), rng.uniform(-4, 4, n), rng.uniform(125, 150, n)])
    return R, centre - R @ np.array([26.0, 24.0, 3.0])


def leds_in_camera(R: FloatArray, t: FloatArray, brick: BrickModel) -> FloatArray:
    """Centres of the LEDs, shape (n, n_leds, 3)."""
    return np.asarray(np.einsum("nij,lj->nli", R, brick.led_positions_mm) + t[:, None])


def lit_outline(
    centre: FloatArray, axis: FloatArray, *, radius: float, collar: float, camera: PinholeCamera, n: int = 240
) -> FloatArray:
    """Outline of a dome on a collar in the picture: the hull of its projected surface, shape (m, 2), px.

    A collar below zero is half an ellipsoid that is so much higher than half a sphere.
    """
    side = np.cross(axis, [0.3, 0.9, 0.1])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    around = np.linspace(0, 2 * np.pi, n, endpoint=False)
    ring = np.cos(around)[:, None] * side + np.sin(around)[:, None] * other
    parts = [
        centre + radius * np.sin(polar) * ring + (radius + max(-collar, 0.0)) * np.cos(polar) * axis
        for polar in np.linspace(0, np.pi / 2, n // 4)
    ]
    parts.append(centre - max(collar, 0.0) * axis + radius * ring)
    uv = camera.project(np.concatenate(parts)).uv_px
    return np.asarray(uv[ConvexHull(uv).vertices])


def polygon_centroid(corners: FloatArray) -> tuple[FloatArray, float]:
    """Centroid and area of a polygon, by its corners in order."""
    origin = corners.mean(axis=0)
    x, y = (corners - origin).T
    x1, y1 = np.roll(x, -1), np.roll(y, -1)
    cross = x * y1 - x1 * y
    area = cross.sum() / 2
    moment = np.array([((x + x1) * cross).sum(), ((y + y1) * cross).sum()]) / (6 * area)
    return moment + origin, float(abs(area))


def luma_of_light(light: FloatArray) -> NDArray[np.uint8]:
    """Limited-range codes of linear light 0..1, by Rec. 709's curve."""
    signal = np.where(light < 0.018, 4.5 * light, 1.099 * np.maximum(light, 1e-9) ** 0.45 - 0.099)
    return np.asarray(np.clip(np.rint(16 + 219 * signal), 0, 255), dtype=np.uint8)


def picture_of_light(light: FloatArray) -> Picture:
    """A grey picture."""
    half = np.full((light.shape[0] // 2, light.shape[1] // 2), 128, dtype=np.uint8)
    return Picture(luma_of_light(light), half, half.copy())


def draw_disc(
    light: FloatArray,
    centre: Sequence[float],
    radii: tuple[float, float],
    *,
    level: float,
    smear: tuple[float, float] = (0.0, 0.0),
    oversampling: int = 8,
) -> None:
    """Add an ellipse of light to a linear picture, supersampled, smeared along a straight line."""
    reach = np.ceil(np.array(radii) + np.abs(smear) / 2 + 3).astype(int)
    u0, v0 = (round(c) for c in centre)
    fine = (np.arange(oversampling) + 0.5) / oversampling - 0.5
    u = (np.arange(u0 - reach[0], u0 + reach[0] + 1)[:, None] + fine).ravel()
    v = (np.arange(v0 - reach[1], v0 + reach[1] + 1)[:, None] + fine).ravel()
    steps = np.linspace(-0.5, 0.5, 17) if any(smear) else np.zeros(1)
    share = np.zeros((v.size, u.size))
    for s in steps:
        x = (u - centre[0] - s * smear[0]) / radii[0]
        y = (v - centre[1] - s * smear[1]) / radii[1]
        share += (x[None] ** 2 + y[:, None] ** 2 <= 1) / steps.size
    share = share.reshape(v.size // oversampling, oversampling, u.size // oversampling, oversampling)
    window = light[v0 - reach[1] : v0 + reach[1] + 1, u0 - reach[0] : u0 + reach[0] + 1]
    mean = share.mean(axis=(1, 3))
    window[...] = window * (1 - mean) + level * mean


def draw_polygon(light: FloatArray, corners: FloatArray, *, level: float, oversampling: int = 8) -> None:
    """Add a lit polygon to a linear picture, supersampled; parts outside the picture are cut off."""
    rows, columns = light.shape
    low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 3, [columns, rows])
    if (high <= low).any():
        return
    width, height = high - low
    fine = np.zeros((height * oversampling, width * oversampling), dtype=np.uint8)
    # Sample k of a pixel lies at (k + 0.5) / n - 0.5; cv2 counts in 1/16 of a sample.
    points = ((corners - low + 0.5) * oversampling - 0.5) * 16
    cv2.fillPoly(fine, [np.rint(points).astype(np.int32)], 1, shift=4)
    share = fine.reshape(height, oversampling, width, oversampling).mean(axis=(1, 3))
    window = light[low[1] : high[1], low[0] : high[0]]
    window[...] = window * (1 - share) + level * share


def picture_of_brick(
    R: FloatArray,
    t: FloatArray,
    brick: BrickModel,
    *,
    collar: float,
    camera: PinholeCamera,
    hidden: Sequence[int] = (),
    covered_right_of: dict[int, float] | None = None,
    lamps: Sequence[tuple[float, float]] = (),
) -> Picture:
    """Picture of a brick at rest: domes on a dark wall, some hidden or half covered, round lamps elsewhere."""
    light = np.full((camera.sensor_mode.height, camera.sensor_mode.width), 0.02)
    for lamp in lamps:
        draw_disc(light, lamp, (30.0, 30.0), level=0.9)
    centres, axes = leds_in_camera(R[None], t[None], brick)[0], brick.led_axes @ R.T
    for k, (centre, axis) in enumerate(zip(centres, axes, strict=True)):
        if k in hidden:
            continue
        outline = lit_outline(centre, axis, radius=3.0, collar=collar, camera=camera, n=120)
        draw_polygon(light, outline, level=0.8)
        cover = (covered_right_of or {}).get(k)
        if cover is not None:
            middle = outline.mean(axis=0)
            edge = outline[:, 0].min() + cover * np.ptp(outline[:, 0])
            box = np.array([[edge, middle[1] - 60], [edge + 90, middle[1] - 60]])
            draw_polygon(light, np.vstack([box, box[::-1] + np.array([0.0, 120.0])]), level=0.02)
    return picture_of_light(light)
