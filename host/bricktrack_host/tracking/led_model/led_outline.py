"""Compiled: the outline of a dome LED, and tables of it.

In units of the LED's radius an outline depends on the collar, on the angle of view, and on the radius over
the distance, its *size*. For each collar there is a table over the other two, had once: it gives within
1e-4 px what takes ten times as long to work out, and a pose fit asks for it seven times a frame.

Up to the angle whose sine is the size a collar hides behind its dome; from there the centroid moves by the
power 3/2 of the tangent of half the angle. The table's steps are equal in the root of that tangent's excess.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.compiled import compiled_in_place, compiled_inline

_ROOT_STEP, _N_ROOTS = 0.003, 430
LARGEST_TANGENT = 1.6  # of half the view angle: 116 degrees, where nothing is seen
_SIZE_STEP, _N_SIZES = 0.001, 120
LARGEST_SIZE = _SIZE_STEP * _N_SIZES  # eight radii before the pupil: inside the lens


class Outlines(NamedTuple):
    """Tables of LEDs' outlines.

    Attributes
    ----------
    tables : ndarray, shape (n_kinds, n_sizes, n_roots, 3), in radii
        Over sizes, in the middles of their steps, and roots, from 0: shift of the centroid along the
        projected axis over the angle's sine, half length, area.
    kind : ndarray of int, shape (n_leds,)
        The table that an LED's outline is in.
    """

    tables: FloatArray
    kind: IntArray


def outlines_of(radii_mm: ArrayLike, collar_mm: float | None) -> Outlines:
    """Return the outlines of LEDs of such radii, shape (n_leds,); without a fitted collar the spheres'.

    A collar below zero is a dome that is so much taller than half a sphere.
    """
    radii = np.asarray(radii_mm, dtype=np.float64)
    if collar_mm is None:
        return Outlines(_table_of(None)[None], np.zeros(radii.shape, dtype=np.int64))
    ratios, kind = np.unique(collar_mm / radii, return_inverse=True)
    tables = [_table_of(float(ratio)) for ratio in ratios]
    return Outlines(tables[0][None] if len(tables) == 1 else np.stack(tables), kind)


@lru_cache(maxsize=16)
def _table_of(collar_radii: float | None) -> FloatArray:
    table = np.empty((_N_SIZES, _N_ROOTS, 3))
    if collar_radii is None:
        size = (np.arange(_N_SIZES) + 0.5) * _SIZE_STEP
        sphere = 1 / np.sqrt(1 - size**2)
        table[..., 0], table[..., 1], table[..., 2] = 0.0, sphere[:, None], np.pi * sphere[:, None] ** 2
    else:
        _fill(collar_radii, table)
    return table


@compiled_in_place
def outline(c: float, r: float, h: float, distance: float) -> tuple[float, float, float]:
    """Return area, centroid and half length of an outline; see `led_profile.outline_moments`."""
    if h < 0:
        return _tall_outline(c, r, 1 - h / r, distance)
    s = math.sqrt(max(1 - c * c, 0.0))
    rho = r / math.sqrt(1 - (r / distance) ** 2)
    far = (-h * s + r * c) / (distance + h * c + r * s)
    near = (-h * s - r * c) / (distance + h * c - r * s)
    x_e, p = 0.5 * distance * (far + near), 0.5 * distance * abs(far - near)
    k = r * s / (distance + h * c)
    q = r * distance / ((distance + h * c) * math.sqrt(1 - k * k))
    # Common tangent: (rho - x_e x)^2 = q^2 + (p^2 - q^2) x^2 with x the cosine of its normal's angle.
    root = math.sqrt(max(rho**2 * x_e**2 - (x_e**2 + q**2 - p**2) * (rho**2 - q**2), 0.0))
    x = min(max((rho**2 - q**2) / min(rho * x_e - root, -1e-12), -1.0), 1.0)
    phi = math.acos(x)
    sin_phi = math.sqrt(max(1 - x * x, 0.0))
    theta = math.atan2(q * sin_phi, p * x)
    size = math.hypot(q * sin_phi, p * x)
    sin_t, cos_t = (q * sin_phi / size, p * x / size) if size > 0 else (0.0, 1.0)
    cos2 = 0.5 * (math.pi - theta) - 0.5 * sin_t * cos_t  # integral of cos^2 from theta to pi
    cos3 = -(sin_t - sin_t**3 / 3)
    x1, y1 = rho * x, rho * sin_phi
    x2, y2 = x_e + p * cos_t, q * sin_t
    half_area = (
        0.5 * rho**2 * (phi + sin_phi * x) + 0.5 * (x1 + x2) * (y2 - y1) + q * (-x_e * sin_t + p * cos2)
    )
    half_moment = (
        0.5 * rho**3 * (sin_phi - sin_phi**3 / 3)
        + (x1 * x1 + x1 * x2 + x2 * x2) * (y2 - y1) / 6
        + 0.5 * q * (-(x_e**2) * sin_t + 2 * x_e * p * cos2 + p**2 * cos3)
    )
    rear = min(x_e - p, -rho if x <= -1 + 1e-12 else 0.0)
    return 2 * half_area, half_moment / half_area, 0.5 * (rho - rear)


@compiled_in_place
def _tall_outline(c: float, r: float, tall: float, distance: float) -> tuple[float, float, float]:
    """Return the same of half an ellipsoid, ``tall`` times as high as a half sphere.

    In front it is the ellipsoid's tangent cone, cut across the line of sight, and at the rear the rim's
    ellipse; the two touch where the rim's own normal is across the ray.
    """
    s, tall2 = math.sqrt(max(1 - c * c, 0.0)), tall * tall
    cone = distance**2 - r * r * (s * s + tall2 * c * c)
    x_f = r * r * distance * s * c * (tall2 - 1) / cone
    length = math.sqrt(x_f * x_f + (r * distance) ** 2 * (c * c + tall2 * s * s) / cone)
    beyond = (distance / r) ** 2 * (s * s + c * c / tall2) - 1
    across = (x_f * distance * s * c * (1 - 1 / tall2) / r**2 + 1) ** 2 / beyond
    width = r * math.sqrt(across + 1 - (x_f / r) ** 2 * (c * c + s * s / tall2))
    if distance * s <= r:  # the rim is behind the dome
        return math.pi * length * width, x_f, length
    cos_rim = r / (distance * s)
    x_rim = -c * r * cos_rim / (1 - s * r * cos_rim / distance)
    far, near = r * c / (distance + r * s), -r * c / (distance - r * s)
    x_e, p = 0.5 * distance * (far + near), 0.5 * distance * abs(far - near)
    q = r / math.sqrt(1 - (r * s / distance) ** 2)
    front = math.acos(min(max((x_rim - x_f) / length, -1.0), 1.0))
    rear = math.pi - math.acos(min(max((x_rim - x_e) / p, -1.0), 1.0)) if p > 0 else 0.0
    half_area, half_moment = _cap(length, width, front)
    half_moment += x_f * half_area
    rear_area, rear_moment = _cap(p, q, rear)
    half_area, half_moment = half_area + rear_area, half_moment + x_e * rear_area - rear_moment
    return 2 * half_area, half_moment / half_area, 0.5 * (x_f + length - x_e + p)


@compiled_inline
def _cap(length: float, width: float, angle: float) -> tuple[float, float]:
    """Return half the area of an ellipse's end, up to an angle from its tip, and its moment about the middle.

    ``length`` and ``width`` are half axes; the tip is at the end of the first.
    """
    sine = math.sin(angle)
    return 0.5 * length * width * (angle - sine * math.cos(angle)), length**2 * width * sine**3 / 3


@compiled_inline
def _first_tangent(size: float) -> float:
    """Return the tangent of half the angle whose sine is ``size``."""
    return size / (1 + math.sqrt(1 - size * size))


@compiled_in_place
def _fill(collar_radii: float, table: FloatArray) -> None:
    for j in range(table.shape[0]):
        size = (j + 0.5) * _SIZE_STEP
        for i in range(table.shape[1]):
            tangent = _first_tangent(size) + max((i * _ROOT_STEP) ** 2, 1e-12)
            per = 1 / (1 + tangent * tangent)
            area, shift, half = outline((1 - tangent * tangent) * per, 1.0, collar_radii, 1 / size)
            table[j, i, 0], table[j, i, 1], table[j, i, 2] = shift / (2 * tangent * per), half, area


@compiled_inline
def outline_near(
    tables: FloatArray, kind: int, tangent: float, size: float
) -> tuple[float, float, float, float]:
    """Return shift over sine, its slope by the tangent, half length and area, in radii, from a table.

    ``tangent`` is at most `LARGEST_TANGENT`, ``size`` at most `LARGEST_SIZE`; neither is negative or NaN.
    """
    excess = max(tangent - _first_tangent(size), 0.0)
    y = size / _SIZE_STEP - 0.5
    i = min(int(math.sqrt(excess) / _ROOT_STEP), _N_ROOTS - 2)
    j = min(max(int(y), 0), _N_SIZES - 2)
    from_ = (i * _ROOT_STEP) ** 2
    width = ((i + 1) * _ROOT_STEP) ** 2 - from_
    x, y = (excess - from_) / width, y - j
    low = tables[kind, j, i, 0] + y * (tables[kind, j + 1, i, 0] - tables[kind, j, i, 0])
    high = tables[kind, j, i + 1, 0] + y * (tables[kind, j + 1, i + 1, 0] - tables[kind, j, i + 1, 0])
    w00, w01, w10, w11 = (1 - y) * (1 - x), (1 - y) * x, y * (1 - x), y * x
    half = w00 * tables[kind, j, i, 1] + w01 * tables[kind, j, i + 1, 1]
    half += w10 * tables[kind, j + 1, i, 1] + w11 * tables[kind, j + 1, i + 1, 1]
    area = w00 * tables[kind, j, i, 2] + w01 * tables[kind, j, i + 1, 2]
    area += w10 * tables[kind, j + 1, i, 2] + w11 * tables[kind, j + 1, i + 1, 2]
    return low + x * (high - low), (high - low) / width, half, area
