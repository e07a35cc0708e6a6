"""Compiled: where one LED is seen, and how that moves with it, from the rays near a pixel.

The neighbourhood of a pixel is its hits on two planes with their derivatives (`hit_polynomials`); the lit
body's outline is that of `led_profile`. What is costly and hardly moves while a pose is refined (the
outline's moments, the lens's curvature across the LED) is had once, as the LED's *shape*.
"""

import math

from bricktrack_common.arrays import FloatArray
from bricktrack_host.compiled import compiled

FACING, PER_SINE, SLOPE, HALF_LENGTH, AREA, LENS_U, LENS_V = range(7)
N_SHAPE = 7
"""An LED's shape: facing where it was had; shift of the centroid along the projected axis over the sine of
the view angle, mm, and its derivative by the facing; half length of the outline, mm; its area, mm^2; what the
lens's curvature adds to the centroid, px."""


@compiled
def outline(c: float, r: float, h: float, distance: float) -> tuple[float, float, float]:
    """Return area, centroid and half length of an outline; see `led_profile.outline_moments`."""
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


@compiled
def pixel_near(
    x: float, y: float, b: float, hits: FloatArray
) -> tuple[float, float, float, float, float, float, float, float]:
    """Return where a point falls, from the rays near a pixel.

    Parameters
    ----------
    x, y : float, mm
    b : float
        Depth of the point: 0 on plane a, 1 on plane b.
    hits : ndarray, shape (6, 4)

    Returns
    -------
    du, dv : float, px, from the pixel
    i00, i01, i10, i11 : float, px/mm
        Derivative of the pixel by x and y.
    kx, ky : float, mm
        Slopes of its ray, over the distance of the planes.
    """
    a = 1 - b
    ex, ey = x - a * hits[0, 0] - b * hits[0, 2], y - a * hits[0, 1] - b * hits[0, 3]
    m00, m01 = a * hits[1, 0] + b * hits[1, 2], a * hits[2, 0] + b * hits[2, 2]
    m10, m11 = a * hits[1, 1] + b * hits[1, 3], a * hits[2, 1] + b * hits[2, 3]
    det = m00 * m11 - m01 * m10
    i00, i01, i10, i11 = m11 / det, -m01 / det, -m10 / det, m00 / det
    xuu, xuv, xvv = (
        a * hits[3, 0] + b * hits[3, 2],
        a * hits[4, 0] + b * hits[4, 2],
        a * hits[5, 0] + b * hits[5, 2],
    )
    yuu, yuv, yvv = (
        a * hits[3, 1] + b * hits[3, 3],
        a * hits[4, 1] + b * hits[4, 3],
        a * hits[5, 1] + b * hits[5, 3],
    )
    du, dv = i00 * ex + i01 * ey, i10 * ex + i11 * ey
    for _ in range(2):  # the quadratic part: 1e-4 px at 1 px from the pixel, 0.1 px at 30
        qx = ex - 0.5 * xuu * du * du - xuv * du * dv - 0.5 * xvv * dv * dv
        qy = ey - 0.5 * yuu * du * du - yuv * du * dv - 0.5 * yvv * dv * dv
        du, dv = i00 * qx + i01 * qy, i10 * qx + i11 * qy
    m00, m01 = m00 + xuu * du + xuv * dv, m01 + xuv * du + xvv * dv
    m10, m11 = m10 + yuu * du + yuv * dv, m11 + yuv * du + yvv * dv
    det = m00 * m11 - m01 * m10
    kx = hits[0, 2] - hits[0, 0] + (hits[1, 2] - hits[1, 0]) * du + (hits[2, 2] - hits[2, 0]) * dv
    ky = hits[0, 3] - hits[0, 1] + (hits[1, 3] - hits[1, 1]) * du + (hits[2, 3] - hits[2, 1]) * dv
    return du, dv, m11 / det, -m01 / det, -m10 / det, m00 / det, kx, ky


@compiled
def led_shape(
    centre: FloatArray,
    axis: FloatArray,
    radius: float,
    collar: float,
    hits: FloatArray,
    plane_a: float,
    apart: float,
    shape: FloatArray,
) -> None:
    """Fill in an LED's shape, see `N_SHAPE`; ``collar`` is NaN where no profile was fitted."""
    _, _, i00, i01, i10, i11, kx, ky = pixel_near(centre[0], centre[1], (centre[2] - plane_a) / apart, hits)
    kx, ky = kx / apart, ky / apart
    norm = math.sqrt(kx * kx + ky * ky + 1)
    dx, dy, dz = kx / norm, ky / norm, 1 / norm
    along = axis[0] * dx + axis[1] * dy + axis[2] * dz
    distance = centre[2] / dz
    shape[FACING] = -along
    if math.isnan(collar):  # the sphere's own outline
        half = radius / math.sqrt(1 - (radius / distance) ** 2)
        shape[PER_SINE], shape[SLOPE], shape[HALF_LENGTH], shape[AREA] = 0.0, 0.0, half, math.pi * half**2
    else:
        step = 1e-4
        c = min(max(-along, -1 + 2 * step), 1 - 2 * step)
        area, low, half = outline(c - step, radius, collar, distance)
        area_2, high, half_2 = outline(c + step, radius, collar, distance)
        low, high = low / math.sqrt(1 - (c - step) ** 2), high / math.sqrt(1 - (c + step) ** 2)
        shape[PER_SINE], shape[SLOPE] = 0.5 * (low + high), (high - low) / (2 * step)
        shape[HALF_LENGTH], shape[AREA] = 0.5 * (half + half_2), 0.5 * (area + area_2)
    # Unit vectors across the line of sight, the first along the projected axis.
    ax, ay, az = axis[0] - along * dx, axis[1] - along * dy, axis[2] - along * dz
    s = math.sqrt(ax * ax + ay * ay + az * az)
    if s > 1e-6:
        e1x, e1y, e1z = ax / s, ay / s, az / s
    else:
        n = math.sqrt(dy * dy + dz * dz)
        e1x, e1y, e1z = 0.0, dz / n, -dy / n
    e2x, e2y, e2z = dy * e1z - dz * e1y, dz * e1x - dx * e1z, dx * e1y - dy * e1x
    # How they show in the picture, to first and second order.
    a0, a1 = i00 * (e1x - kx * e1z) + i01 * (e1y - ky * e1z), i10 * (e1x - kx * e1z) + i11 * (e1y - ky * e1z)
    b0, b1 = i00 * (e2x - kx * e2z) + i01 * (e2y - ky * e2z), i10 * (e2x - kx * e2z) + i11 * (e2y - ky * e2z)
    share = (centre[2] - plane_a) / apart
    aa0, aa1 = _bend(a0, a1, e1z, a0, a1, e1z, share, apart, hits, i00, i01, i10, i11)
    ab0, ab1 = _bend(a0, a1, e1z, b0, b1, e2z, share, apart, hits, i00, i01, i10, i11)
    bb0, bb1 = _bend(b0, b1, e2z, b0, b1, e2z, share, apart, hits, i00, i01, i10, i11)
    det = a0 * b1 - a1 * b0
    # Growth of the picture's area per area along e1 and e2.
    grow_1 = (b1 * aa0 - b0 * aa1 - a1 * ab0 + a0 * ab1) / det
    grow_2 = (b1 * ab0 - b0 * ab1 - a1 * bb0 + a0 * bb1) / det
    var_1, var_2 = 0.25 * shape[HALF_LENGTH] ** 2, 0.25 * radius**2
    shape[LENS_U] = var_1 * (0.5 * aa0 + grow_1 * a0) + var_2 * (0.5 * bb0 + grow_2 * b0)
    shape[LENS_V] = var_1 * (0.5 * aa1 + grow_1 * a1) + var_2 * (0.5 * bb1 + grow_2 * b1)


@compiled
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
    i00: float,
    i01: float,
    i10: float,
    i11: float,
) -> tuple[float, float]:
    """Return the second derivative of the pixel along two directions of space.

    The directions are given by their pixels' first derivatives, (a0, a1) and (b0, b1), and their depths. From
    the implicit ``X(pixel, z) = (x, y)``: ``d2u = -M^-1 [X_uu(a, b) + X_uz(a) bz + X_uz(b) az]``.
    """
    x, y = 0.0, 0.0
    for k in range(2):
        w = 1 - share if k == 0 else share
        c = 2 * k
        cross = a0 * b1 + a1 * b0
        x += w * (hits[3, c] * a0 * b0 + hits[4, c] * cross + hits[5, c] * a1 * b1)
        y += w * (hits[3, c + 1] * a0 * b0 + hits[4, c + 1] * cross + hits[5, c + 1] * a1 * b1)
    g0, g1 = (a0 * bz + b0 * az) / apart, (a1 * bz + b1 * az) / apart
    x += (hits[1, 2] - hits[1, 0]) * g0 + (hits[2, 2] - hits[2, 0]) * g1
    y += (hits[1, 3] - hits[1, 1]) * g0 + (hits[2, 3] - hits[2, 1]) * g1
    return -(i00 * x + i01 * y), -(i10 * x + i11 * y)


@compiled
def led_view(
    centre: FloatArray,
    axis: FloatArray,
    hits: FloatArray,
    plane_a: float,
    apart: float,
    shape: FloatArray,
    J_centre: FloatArray,
    J_axis: FloatArray,
    across_px: FloatArray,
) -> tuple[float, float, float, float]:
    """Return where an LED is seen, and fill in its derivatives.

    Parameters
    ----------
    centre, axis : ndarray, shape (3,), mm, camera frame
    hits : ndarray, shape (6, 4)
    plane_a, apart : float, mm
        Depth of plane a, and from it to plane b.
    shape : ndarray, shape (N_SHAPE,)
    J_centre : ndarray, shape (2, 3), px/mm, out
    J_axis : ndarray, shape (2, 3), px, out
    across_px : ndarray, shape (2,), px/mm, out
        What one millimetre along the projected axis is in the picture, times the sine of the view angle.

    Returns
    -------
    du, dv : float, px
        Centroid less the pixel that the hits are of.
    facing : float
    magnification : float, px^2/mm^2
        Of the plane across the line of sight.
    """
    _, _, _, _, _, _, kx, ky = pixel_near(centre[0], centre[1], (centre[2] - plane_a) / apart, hits)
    kx, ky = kx / apart, ky / apart
    norm = math.sqrt(kx * kx + ky * ky + 1)
    dx, dy, dz = kx / norm, ky / norm, 1 / norm
    along = axis[0] * dx + axis[1] * dy + axis[2] * dz
    ax, ay, az = axis[0] - along * dx, axis[1] - along * dy, axis[2] - along * dz
    slope = shape[SLOPE]
    per_sine = shape[PER_SINE] + slope * (-along - shape[FACING])
    per_distance = dz / centre[2]
    p, q = -along * per_sine * per_distance, slope * per_distance
    x, y, z = centre[0] + per_sine * ax, centre[1] + per_sine * ay, centre[2] + per_sine * az
    du, dv, i00, i01, i10, i11, kx, ky = pixel_near(x, y, (z - plane_a) / apart, hits)
    kx, ky = kx / apart, ky / apart
    for k in range(2):
        j0, j1 = (i00, i01) if k == 0 else (i10, i11)
        j2 = -(j0 * kx + j1 * ky)
        shown = j0 * ax + j1 * ay + j2 * az
        across_px[k] = shown
        # Moving the LED turns its line of sight, and with it what is seen of the shift:
        # J (1 + p (1 - d d') - q across across'), and by the axis J (per_sine (1 - d d') - slope across d').
        J_centre[k, 0] = j0 * (1 + p) - q * shown * ax
        J_centre[k, 1] = j1 * (1 + p) - q * shown * ay
        # What the lens adds falls with the square of the distance.
        J_centre[k, 2] = j2 * (1 + p) - q * shown * az - 2 * shape[LENS_U + k] / centre[2]
        J_axis[k, 0] = per_sine * j0 - slope * shown * dx
        J_axis[k, 1] = per_sine * j1 - slope * shown * dy
        J_axis[k, 2] = per_sine * j2 - slope * shown * dz
    # Area of the picture per area across the line of sight: that per area of (x, y), over dz.
    return du + shape[LENS_U], dv + shape[LENS_V], -along, abs(i00 * i11 - i01 * i10) / dz
