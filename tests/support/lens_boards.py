"""Cameras whose rays are known exactly, and the dots of a board as they see them.

Written apart from the product's models, none of which is a special case of these: their mappings from points to
pixels have no polynomial inverse. Everything simulated; a generator makes the noise.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from bricktrack_host.calibration.dots.dot_observations import DotObservations

A_MM, B_MM = 101.117, 161.111
WIDTH, HEIGHT = 1920, 1080

Lens = Callable[[np.ndarray], np.ndarray]
"""Points, shape (..., 3), mm, camera frame, to pixels, shape (..., 2)."""


def brown(xyz, *, walk_mm=0.0):
    """Barrel distortion of 14 % at the corners, with decentring (Brown 1966), 60 degrees across.

    With ``walk_mm`` the pupil of a ray of slope r lies ``walk_mm r^2`` along the axis.
    """
    xyz = np.asarray(xyz, dtype=float)
    pupil = np.zeros(xyz.shape[:-1])
    for _ in range(40 if walk_mm else 1):
        x, y = xyz[..., 0] / (xyz[..., 2] - pupil), xyz[..., 1] / (xyz[..., 2] - pupil)
        r2 = x * x + y * y
        pupil = walk_mm * r2
    radial = 1 - 0.28 * r2 + 0.10 * r2**2 - 0.02 * r2**3
    p1, p2 = 3e-4, -2e-4
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return 1650.0 * np.stack([u, v], axis=-1) + (963.2, 534.8)


def fisheye(xyz):
    """Image height by the angle, not its tangent (Kannala and Brandt 2006), 67 degrees across."""
    xyz = np.asarray(xyz, dtype=float)
    x, y = xyz[..., 0] / xyz[..., 2], xyz[..., 1] / xyz[..., 2]
    r = np.hypot(x, y) + 1e-12
    angle = np.arctan(r)
    height = angle * (1 - 0.05 * angle**2 + 0.02 * angle**4)
    return 1500.0 * np.stack([x, y], axis=-1) * (height / r)[..., None] + (955.0, 545.0)


def tilted(xyz):
    """One-parameter division distortion (Fitzgibbon 2001) on a sensor tilted by half a degree."""
    xyz = np.asarray(xyz, dtype=float)
    x, y = xyz[..., 0] / xyz[..., 2] + 0.011, xyz[..., 1] / xyz[..., 2] - 0.007
    r = np.hypot(x, y) + 1e-12
    # r = d / (1 - 0.22 d^2), solved for the distorted d.
    d = (np.sqrt(1 + 4 * 0.22 * r * r) - 1) / (2 * 0.22 * r)
    x, y = x * d / r, y * d / r
    scale = 1 / (1 + 0.008 * x - 0.005 * y)
    return 1640.0 * np.stack([x * scale, y * scale], axis=-1) + (950.0, 550.0)


LENSES: dict[str, Lens] = {"brown": brown, "fisheye": fisheye, "tilted": tilted}


@dataclass(frozen=True)
class Board:
    """The paper's: 32 x 18 dots, 4 mm apart. With faults: off its place, bent, badly printed.

    ``bend_mm`` is the height of a paraboloid along x at x = 62 mm; ``misprint_mm`` the standard deviation of
    every dot's own place, in x and in y, the same each time the board is seen.
    """

    columns: int = 32
    rows: int = 18
    pitch_mm: float = 4.0
    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    bend_mm: float = 0.0
    misprint_mm: float = 0.0

    def nominal(self):
        i, j = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        middle = [(self.columns - 1) / 2, (self.rows - 1) / 2]
        return self.pitch_mm * (np.stack([i, j], axis=-1).reshape(-1, 2) - middle)

    def places(self, z_mm):
        xy = self.nominal()
        xy = xy + np.random.default_rng(77).normal(0, self.misprint_mm, xy.shape)
        xyz = np.column_stack([xy, self.bend_mm * (xy[:, 0] / 62.0) ** 2])
        turned = xyz @ Rotation.from_rotvec(np.deg2rad(self.turn_deg)).as_matrix().T
        return turned + self.shift_mm + [0, 0, z_mm]


def see(lens: Lens, z_mm, rng, *, board=Board(), noise_px=0.02, margin_px=16.0):
    """Dots as the picture shows them, those next to its border left out, each with the noise's covariance.

    ``noise_px`` may be one standard deviation or one for each of the board's dots.
    """
    uv = lens(board.places(z_mm))
    noise = np.broadcast_to(np.asarray(noise_px, dtype=float), len(uv))
    keep = np.all((uv > margin_px) & (uv < [WIDTH - 1 - margin_px, HEIGHT - 1 - margin_px]), axis=1)
    uv = uv + rng.normal(size=uv.shape) * noise[:, None]
    cov = np.maximum(noise, 1e-3)[:, None, None] ** 2 * np.eye(2)
    i, j = np.meshgrid(np.arange(board.columns), np.arange(board.rows))
    index = np.stack([i.ravel(), j.ravel()], axis=1)
    n = int(keep.sum())
    return DotObservations(uv[keep], board.nominal()[keep], cov[keep], np.full(n, 800.0), index[keep])


def two_planes(lens: Lens, seed, **options):
    rng = np.random.default_rng(seed)
    return [(z, see(lens, z, rng, **options)) for z in (A_MM, B_MM)]


LEDS_MM = np.array(
    [
        [0.0, 0.0, 0.0],
        [24.607, 3.5, 12.584],
        [51.62, 12.5, 0.0],
        [0.0, 14.5, 0.0],
        [0.0, 25.0, 0.0],
        [0.0, 46.5, 0.0],
        [54.514, 49.0, 0.0],
    ]
)
"""The paper's layout, from the first LED."""


def sweep_points():
    """The paper's sweeps: the brick from 106 to 158 mm along z, and over 84 mm along x. LEDs, shape (n, 3)."""
    along_z = [[-28.35, -23.55, z] for z in np.linspace(106.2, 157.5, 10)]
    along_x = [[x, -23.55, 129.33] for x in np.linspace(-70.05, 13.95, 10)]
    return (np.array(along_z + along_x)[:, None] + LEDS_MM).reshape(-1, 3)


def in_picture(uv):
    return np.all((uv >= 0) & (uv <= [WIDTH - 1, HEIGHT - 1]), axis=-1)


def picture_points(lens: Lens, z_mm, columns=49, rows=29):
    """Points of the plane z spread over the picture, shape (n, 2), and their pixels."""
    i, j = np.meshgrid(np.linspace(-0.75, 0.75, columns), np.linspace(-0.42, 0.42, rows))
    xy = z_mm * np.stack([i.ravel(), j.ravel()], axis=1)
    uv = lens(np.column_stack([xy, np.full(len(xy), z_mm)]))
    keep = in_picture(uv)
    return xy[keep], uv[keep]
