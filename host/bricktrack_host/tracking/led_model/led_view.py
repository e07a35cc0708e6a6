"""Compiled: where one LED is seen, and how that moves with it, from the rays near a pixel.

The neighbourhood of a pixel is its hits on two planes with their derivatives (`hit_polynomials`); the lit
body's outline is from the tables of `led_outline`. What is costly and hardly moves while a pose is refined
(the outline's moments, the lens's curvature across the LED) is had once, as the LED's *shape*.
"""

import math

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_host.compiled import compiled_inline
from bricktrack_host.tracking.led_model.led_outline import LARGEST_SIZE, LARGEST_TANGENT, outline_near

(
    TANGENT,
    SHIFT,
    SHIFT_1,
    HALF_LENGTH,
    AREA,
    LENS_U,
    LENS_V,
    AT_X,
    AT_Y,
    AT_Z,
    SLOPE_X,
    SLOPE_Y,
) = range(12)
N_SHAPE = 12
"""An LED's shape: tangent of half the view angle, about which the next two expand the shift of the centroid
along the projected axis over the angle's sine, mm (of a bare hemisphere it is linear in it); half length of
the outline, mm; its area, mm^2; what the lens's curvature adds to the centroid, px; the centre that it is of,
mm, and the slopes of the line of sight to there."""


@compiled_inline
def pixel_near(
    x: float, y: float, b: float, hits: FloatArray, k: int
) -> tuple[float, float, float, float, float, float, float, float]:
    """Return where a point falls, from the rays near a pixel.

    Parameters
    ----------
    x, y : float, mm
    b : float
        Depth of the point: 0 on plane a, 1 on plane b.
    hits : ndarray, shape (n_leds, 6, 4)
        Of which those of LED ``k`` are taken.

    Returns
    -------
    du, dv : float, px, from the pixel
    i00, i01, i10, i11 : float, px/mm
        Derivative of the pixel by x and y.
    kx, ky : float, mm
        Slopes of its ray, over the distance of the planes.
    """
    a = 1 - b
    ex, ey = x - a * hits[k, 0, 0] - b * hits[k, 0, 2], y - a * hits[k, 0, 1] - b * hits[k, 0, 3]
    m00, m01 = a * hits[k, 1, 0] + b * hits[k, 1, 2], a * hits[k, 2, 0] + b * hits[k, 2, 2]
    m10, m11 = a * hits[k, 1, 1] + b * hits[k, 1, 3], a * hits[k, 2, 1] + b * hits[k, 2, 3]
    det = m00 * m11 - m01 * m10
    i00, i01, i10, i11 = m11 / det, -m01 / det, -m10 / det, m00 / det
    xuu, xuv, xvv = (
        a * hits[k, 3, 0] + b * hits[k, 3, 2],
        a * hits[k, 4, 0] + b * hits[k, 4, 2],
        a * hits[k, 5, 0] + b * hits[k, 5, 2],
    )
    yuu, yuv, yvv = (
        a * hits[k, 3, 1] + b * hits[k, 3, 3],
        a * hits[k, 4, 1] + b * hits[k, 4, 3],
        a * hits[k, 5, 1] + b * hits[k, 5, 3],
    )
    du, dv = i00 * ex + i01 * ey, i10 * ex + i11 * ey
    for _ in range(2):  # the quadratic part: 1e-4 px at 1 px from the pixel, 0.1 px at 30
        qx = ex - 0.5 * xuu * du * du - xuv * du * dv - 0.5 * xvv * dv * dv
        qy = ey - 0.5 * yuu * du * du - yuv * du * dv - 0.5 * yvv * dv * dv
        du, dv = i00 * qx + i01 * qy, i10 * qx + i11 * qy
    m00, m01 = m00 + xuu * du + xuv * dv, m01 + xuv * du + xvv * dv
    m10, m11 = m10 + yuu * du + yuv * dv, m11 + yuv * du + yvv * dv
    det = m00 * m11 - m01 * m10
    kx = (
        hits[k, 0, 2]
        - hits[k, 0, 0]
        + (hits[k, 1, 2] - hits[k, 1, 0]) * du
        + (hits[k, 2, 2] - hits[k, 2, 0]) * dv
    )
    ky = (
        hits[k, 0, 3]
        - hits[k, 0, 1]
        + (hits[k, 1, 3] - hits[k, 1, 1]) * du
        + (hits[k, 2, 3] - hits[k, 2, 1]) * dv
    )
    return du, dv, m11 / det, -m01 / det, -m10 / det, m00 / det, kx, ky


@compiled_inline
def led_shape(
    centre: FloatArray,
    axis: FloatArray,
    radius: float,
    tables: FloatArray,
    kind: int,
    hits: FloatArray,
    k: int,
    plane_a: float,
    apart: float,
    shape: FloatArray,
) -> None:
    """Fill in the shape of LED ``k``, whose outline is in ``tables[kind]``; see `N_SHAPE`."""
    share = (centre[2] - plane_a) / apart
    _, _, i00, i01, i10, i11, kx, ky = pixel_near(centre[0], centre[1], share, hits, k)
    kx, ky = kx / apart, ky / apart
    norm = math.sqrt(kx * kx + ky * ky + 1)
    dx, dy, dz = kx / norm, ky / norm, 1 / norm
    along = axis[0] * dx + axis[1] * dy + axis[2] * dz
    distance = centre[2] / dz
    ax, ay, az = axis[0] - along * dx, axis[1] - along * dy, axis[2] - along * dz
    s = math.sqrt(ax * ax + ay * ay + az * az)
    size = radius / distance
    at = min(s / max(1 - along, 1e-3), LARGEST_TANGENT)
    if 0 <= size <= LARGEST_SIZE and 0 <= at <= LARGEST_TANGENT:
        shift, slope, half, area = outline_near(tables, kind, at, size)
        shape[k, TANGENT], shape[k, SHIFT], shape[k, SHIFT_1] = at, shift * radius, slope * radius
        shape[k, HALF_LENGTH], shape[k, AREA] = half * radius, area * radius * radius
    else:  # behind the camera or inside its lens
        shape[k, TANGENT], shape[k, SHIFT], shape[k, SHIFT_1] = np.nan, np.nan, np.nan
        shape[k, HALF_LENGTH], shape[k, AREA] = np.nan, np.nan
    shape[k, AT_X], shape[k, AT_Y], shape[k, AT_Z] = centre[0], centre[1], centre[2]
    shape[k, SLOPE_X], shape[k, SLOPE_Y] = kx, ky
    # Unit vectors across the line of sight, the first along the projected axis.
    if s > 1e-6:
        e1x, e1y, e1z = ax / s, ay / s, az / s
    else:
        n = math.sqrt(dy * dy + dz * dz)
        e1x, e1y, e1z = 0.0, dz / n, -dy / n
    e2x, e2y, e2z = dy * e1z - dz * e1y, dz * e1x - dx * e1z, dx * e1y - dy * e1x
    # How they show in the picture, to first and second order.
    a0, a1 = i00 * (e1x - kx * e1z) + i01 * (e1y - ky * e1z), i10 * (e1x - kx * e1z) + i11 * (e1y - ky * e1z)
    b0, b1 = i00 * (e2x - kx * e2z) + i01 * (e2y - ky * e2z), i10 * (e2x - kx * e2z) + i11 * (e2y - ky * e2z)
    aa0, aa1 = _bend(a0, a1, e1z, a0, a1, e1z, share, apart, hits, k, i00, i01, i10, i11)
    ab0, ab1 = _bend(a0, a1, e1z, b0, b1, e2z, share, apart, hits, k, i00, i01, i10, i11)
    bb0, bb1 = _bend(b0, b1, e2z, b0, b1, e2z, share, apart, hits, k, i00, i01, i10, i11)
    det = a0 * b1 - a1 * b0
    # Growth of the picture's area per area along e1 and e2.
    grow_1 = (b1 * aa0 - b0 * aa1 - a1 * ab0 + a0 * ab1) / det
    grow_2 = (b1 * ab0 - b0 * ab1 - a1 * bb0 + a0 * bb1) / det
    var_1, var_2 = 0.25 * shape[k, HALF_LENGTH] ** 2, 0.25 * radius**2
    shape[k, LENS_U] = var_1 * (0.5 * aa0 + grow_1 * a0) + var_2 * (0.5 * bb0 + grow_2 * b0)
    shape[k, LENS_V] = var_1 * (0.5 * aa1 + grow_1 * a1) + var_2 * (0.5 * bb1 + grow_2 * b1)


@compiled_inline
def _bend(
    a0: float,
    a1: float,
    az: float,
    b0: float,
    b1: float,
    bz: float,
    share: float,
    apart: float,
    hits: FloatArray,
    k: int,
    i00: float,
    i01: float,
    i10: float,
    i11: float,
) -> tuple[float, float]:
    """Return the second derivative of the pixel along two directions of space.

    The directions are given by their pixels' first derivatives, (a0, a1) and (b0, b1), and their depths. From
    the implicit ``X(pixel, z) = (x, y)``: ``d2u = -M^-1 [X_uu(a, b) + X_uz(a) bz + X_uz(b) az]``.
    """
    aa, cross, bb = a0 * b0, a0 * b1 + a1 * b0, a1 * b1
    g0, g1 = (a0 * bz + b0 * az) / apart, (a1 * bz + b1 * az) / apart
    x = (1 - share) * (hits[k, 3, 0] * aa + hits[k, 4, 0] * cross + hits[k, 5, 0] * bb)
    x += share * (hits[k, 3, 2] * aa + hits[k, 4, 2] * cross + hits[k, 5, 2] * bb)
    x += (hits[k, 1, 2] - hits[k, 1, 0]) * g0 + (hits[k, 2, 2] - hits[k, 2, 0]) * g1
    y = (1 - share) * (hits[k, 3, 1] * aa + hits[k, 4, 1] * cross + hits[k, 5, 1] * bb)
    y += share * (hits[k, 3, 3] * aa + hits[k, 4, 3] * cross + hits[k, 5, 3] * bb)
    y += (hits[k, 1, 3] - hits[k, 1, 1]) * g0 + (hits[k, 2, 3] - hits[k, 2, 1]) * g1
    return -(i00 * x + i01 * y), -(i10 * x + i11 * y)


@compiled_inline
def led_view(
    centre: FloatArray,
    axis: FloatArray,
    hits: FloatArray,
    k: int,
    plane_a: float,
    apart: float,
    shape: FloatArray,
    J_centre: FloatArray,
    J_axis: FloatArray,
) -> tuple[float, float, float, float, float, float]:
    """Return where LED ``k`` is seen, and fill in its derivatives.

    Parameters
    ----------
    centre, axis : ndarray, shape (3,), mm, camera frame
    hits : ndarray, shape (n_leds, 6, 4)
    plane_a, apart : float, mm
        Depth of plane a, and from it to plane b.
    shape : ndarray, shape (n_leds, N_SHAPE)
    J_centre : ndarray, shape (2, 3), px/mm, out
    J_axis : ndarray, shape (2, 3), px, out

    Returns
    -------
    du, dv : float, px
        Centroid less the pixel that the hits are of.
    facing : float
    magnification : float, px^2/mm^2
        Of the plane across the line of sight.
    shown_u, shown_v : float, px/mm
        What one millimetre along the projected axis is in the picture, times the sine of the view angle.
    """
    # The line of sight turns as the centre moves, about a pupil near the camera's origin.
    kx, ky, per_z = shape[k, SLOPE_X], shape[k, SLOPE_Y], 1 / centre[2]
    moved = centre[2] - shape[k, AT_Z]
    kx += (centre[0] - shape[k, AT_X] - kx * moved) * per_z
    ky += (centre[1] - shape[k, AT_Y] - ky * moved) * per_z
    norm = math.sqrt(kx * kx + ky * ky + 1)
    dx, dy, dz = kx / norm, ky / norm, 1 / norm
    along = axis[0] * dx + axis[1] * dy + axis[2] * dz
    ax, ay, az = axis[0] - along * dx, axis[1] - along * dy, axis[2] - along * dz
    s = max(math.sqrt(ax * ax + ay * ay + az * az), 1e-9)
    per_height = 1 / max(1 - along, 1e-3)
    per_sine = shape[k, SHIFT] + (s * per_height - shape[k, TANGENT]) * shape[k, SHIFT_1]
    slope = -shape[k, SHIFT_1] * per_height / s  # by the facing, -along
    x, y, z = centre[0] + per_sine * ax, centre[1] + per_sine * ay, centre[2] + per_sine * az
    du, dv, i00, i01, i10, i11, kx, ky = pixel_near(x, y, (z - plane_a) / apart, hits, k)
    kx, ky = kx / apart, ky / apart
    # Moving the LED turns its line of sight, and with it what is seen of the shift:
    # J (1 + p (1 - d d') - q across across'), and by the axis J (per_sine (1 - d d') - slope across d').
    per_distance = dz / centre[2]
    p, q = -along * per_sine * per_distance, slope * per_distance
    u2, v2 = -(i00 * kx + i01 * ky), -(i10 * kx + i11 * ky)
    shown_u, shown_v = i00 * ax + i01 * ay + u2 * az, i10 * ax + i11 * ay + v2 * az
    # What the lens adds falls with the square of the distance.
    lens_u, lens_v = shape[k, LENS_U], shape[k, LENS_V]
    J_centre[0, 0] = i00 * (1 + p) - q * shown_u * ax
    J_centre[0, 1] = i01 * (1 + p) - q * shown_u * ay
    J_centre[0, 2] = u2 * (1 + p) - q * shown_u * az - 2 * lens_u / centre[2]
    J_centre[1, 0] = i10 * (1 + p) - q * shown_v * ax
    J_centre[1, 1] = i11 * (1 + p) - q * shown_v * ay
    J_centre[1, 2] = v2 * (1 + p) - q * shown_v * az - 2 * lens_v / centre[2]
    J_axis[0, 0] = per_sine * i00 - slope * shown_u * dx
    J_axis[0, 1] = per_sine * i01 - slope * shown_u * dy
    J_axis[0, 2] = per_sine * u2 - slope * shown_u * dz
    J_axis[1, 0] = per_sine * i10 - slope * shown_v * dx
    J_axis[1, 1] = per_sine * i11 - slope * shown_v * dy
    J_axis[1, 2] = per_sine * v2 - slope * shown_v * dz
    # Area of the picture per area across the line of sight: that per area of (x, y), over dz.
    return du + lens_u, dv + lens_v, -along, abs(i00 * i11 - i01 * i10) / dz, shown_u, shown_v
