"""Pictures of dot targets, drawn by casting rays: independent of whatever finds the dots.

Every pixel is sampled on a fine raster; each sample's ray is met with the board's plane, and what is printed
there is looked up in the target's drawing. Light, reflections, blur and noise come after that.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from pinhole import PinholeCamera
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from bricktrack_host.calibration.target.printed_target import DotTarget

DARK, LIGHT, DESK = 0.08, 0.72, 0.2  # of full scale
_KNOT_PX = 8


@dataclass(frozen=True)
class BoardPose:
    """Where the target is: its middle, mm, camera frame; turns about z, then its tilts about x and y."""

    at_mm: tuple[float, float, float]
    turn_deg: float = 0.0
    tilt_x_deg: float = 0.0
    tilt_y_deg: float = 0.0

    @property
    def rotation(self):
        return Rotation.from_euler(
            "ZYX", [self.turn_deg, self.tilt_y_deg, self.tilt_x_deg], degrees=True
        ).as_matrix()

    def points(self, xy_mm):
        xyz = np.concatenate([xy_mm, np.zeros((*xy_mm.shape[:-1], 1))], axis=-1)
        return xyz @ self.rotation.T + np.array(self.at_mm)


@dataclass(frozen=True)
class Faults:
    """What is wrong with a picture; ``light`` maps (u, v) from 0 to 1 to a factor."""

    hidden_share: float = 0.0
    light: object = None
    blur_px: float = 0.8
    noise: float = 0.006
    n_reflections: int = 0
    glare: float = 0.0
    seed: int = 1


@dataclass(frozen=True)
class BoardPicture:
    """A picture with its truth.

    Attributes
    ----------
    grey : ndarray of uint8
    column_row : ndarray of int, shape (n, 2)
        Of every dot that is not hidden, whether in view or not.
    centre_px, centroid_px : ndarray, shape (n, 2), px
        Images of the dots' centres; centroids of the dots' images.
    whole : ndarray of bool, shape (n,)
        The outline lies in the picture.
    """

    grey: np.ndarray
    column_row: np.ndarray
    xy_mm: np.ndarray
    centre_px: np.ndarray
    centroid_px: np.ndarray
    whole: np.ndarray
    reflections: list = field(default_factory=list)


def camera_of(width=960, height=540, *, f_px=None, k1=-0.12, k2=0.04, p1=3e-4, p2=-2e-4):
    """Return a camera of 59 degrees across, its axis a little off the middle."""
    f = f_px if f_px is not None else 0.885 * width
    return PinholeCamera(
        f_px=f, u0_px=(width - 1) / 2 + 0.006 * width, v0_px=(height - 1) / 2 - 0.005 * width,
        k1=k1, k2=k2, p1=p1, p2=p2,
    )  # fmt: skip


def picture_of_board(
    target: DotTarget, camera, pose: BoardPose, *, size=(960, 540), faults=None, samples=3, bits=8
) -> BoardPicture:
    """Draw a target through a camera."""
    faults = faults or Faults()
    rng = np.random.default_rng(faults.seed)
    width, height = size
    shown = rng.uniform(size=(target.rows, target.columns)) >= faults.hidden_share
    diameters = np.where(shown, target.diameters_mm(), 0.0)

    cover = np.zeros((height, width))
    desk = np.zeros((height, width))
    slopes = _slope_splines(camera, width, height)
    for du in (np.arange(samples) + 0.5) / samples - 0.5:
        for dv in (np.arange(samples) + 0.5) / samples - 0.5:
            u, v = np.arange(width) + du, np.arange(height) + dv
            lit, off = _printed_at(target, diameters, pose, *(s(v, u) for s in slopes))
            cover += lit / samples**2
            desk += off / samples**2
    if target.polarity == "black-on-white":
        cover = 1 - cover
    picture = (DARK + (LIGHT - DARK) * cover) * (1 - desk) + DESK * desk

    v, u = np.mgrid[0:height, 0:width]
    if faults.light is not None:
        picture = picture * faults.light(u / width, v / height)
    spots = []
    for _ in range(faults.n_reflections):
        at = rng.uniform([0.05 * width, 0.05 * height], [0.95 * width, 0.95 * height])
        reach = rng.uniform(0.006, 0.03, 2) * width
        turn = rng.uniform(0, np.pi)
        along = (u - at[0]) * np.cos(turn) + (v - at[1]) * np.sin(turn)
        across = (v - at[1]) * np.cos(turn) - (u - at[0]) * np.sin(turn)
        picture = picture + 1.2 * np.exp(-(((along / reach[0]) ** 2 + (across / reach[1]) ** 2) ** 2))
        spots.append((*at, *reach))
    if faults.glare:
        at = rng.uniform([0, 0], [width, height])
        far = np.hypot(u - at[0], v - at[1]) / (0.25 * width)
        picture = picture + faults.glare * np.exp(-(far**2))
    picture = np.minimum(picture, 1.3)  # light is light up to the lens; the sensor saturates at 1
    if faults.blur_px:
        picture = cv2.GaussianBlur(picture, (0, 0), faults.blur_px)
    picture = picture + rng.normal(0, faults.noise, picture.shape)
    full = (1 << bits) - 1
    grey = np.clip(np.round(picture * full), 0, full).astype(np.uint8 if bits == 8 else np.uint16)

    xy = target.centres_mm()[shown]
    ring = np.linspace(0, 2 * np.pi, 96, endpoint=False)
    circle = np.stack([np.cos(ring), np.sin(ring)], axis=-1)
    outline = _seen(camera, pose, xy[:, None] + diameters[shown][:, None, None] / 2 * circle)
    a, b = outline, np.roll(outline, -1, axis=1)
    cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    centroid = ((a + b) * cross[..., None]).sum(axis=1) / (3 * cross.sum(axis=1))[:, None]
    inside = np.all((outline > -0.5) & (outline < np.array(size) - 0.5), axis=(1, 2))
    rows, columns = np.nonzero(shown)
    return BoardPicture(
        grey, np.stack([columns, rows], axis=1), xy, _seen(camera, pose, xy), centroid, inside, spots
    )


def wrong_and_right(dots, picture, *, within_px):
    """Return how many dots found have a wrong place, and how many the right one.

    A dot found where none is has no right place: it counts as wrong.
    """
    distance = np.hypot(*np.moveaxis(dots.uv_px[:, None] - picture.centroid_px[None], -1, 0))
    nearest = distance.argmin(axis=1)
    on_dot = distance.min(axis=1) < within_px
    right = on_dot & np.all(picture.column_row[nearest] == dots.column_row, axis=1)
    return int(np.count_nonzero(~right)), int(np.count_nonzero(right))


def _seen(camera, pose, xy_mm):
    return camera.project(pose.points(xy_mm)).uv_px


def _slope_splines(camera, width, height):
    """Return the rays' slopes as functions of (v, u): cubic between knots, good to 1e-4 px."""
    u = np.arange(-_KNOT_PX, width + 2 * _KNOT_PX, _KNOT_PX, dtype=float)
    v = np.arange(-_KNOT_PX, height + 2 * _KNOT_PX, _KNOT_PX, dtype=float)
    knots = camera.points_on_plane(np.stack(np.meshgrid(u, v), axis=-1), 1.0)
    return [RectBivariateSpline(v, u, knots[..., i]) for i in (0, 1)]


def _printed_at(target, diameters, pose, x, y):
    """Return, for rays of slopes x, y, whether they meet a dot, and whether they miss the sheet."""
    R, t = pose.rotation, np.array(pose.at_mm)
    normal = R[:, 2]
    depth = (normal @ t) / (normal[0] * x + normal[1] * y + normal[2])
    dx, dy, dz = depth * x - t[0], depth * y - t[1], depth - t[2]
    column = (dx * R[0, 0] + dy * R[1, 0] + dz * R[2, 0]) / target.pitch_mm + (target.columns - 1) / 2
    row = (dx * R[0, 1] + dy * R[1, 1] + dz * R[2, 1]) / target.pitch_mm + (target.rows - 1) / 2
    i, j = np.rint(column).astype(int), np.rint(row).astype(int)
    on = (i >= 0) & (i < target.columns) & (j >= 0) & (j < target.rows)
    radius = diameters[np.where(on, j, 0), np.where(on, i, 0)] / 2 / target.pitch_mm
    lit = on & ((column - i) ** 2 + (row - j) ** 2 < radius**2)
    off = (column < -1) | (column > target.columns) | (row < -1) | (row > target.rows)
    return lit, off
