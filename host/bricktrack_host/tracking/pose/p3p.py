"""Poses from three rays and three LEDs: at most four of each, by Grunert's quartic, compiled.

Needs rays through one point; for a camera without one, the point nearest to all rays serves, and the poses
are starts for the refinement, which asks the ray model itself.
"""

import math

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.camera_model import RayModel
from bricktrack_host.compiled import compiled, compiled_in_place

_DOUBLE_ROOT = 0.02
"""Noise makes a double root a pair with an imaginary part: up to this share of it, its real part serves."""
_SLIM = 0.05  # sine of the angle at the first point below which three points are in line


def ray_centre_mm(ray_model: RayModel) -> FloatArray:
    """Return the point nearest to the rays of a grid over the picture, shape (3,), mm, camera frame."""
    mode = ray_model.sensor_mode
    u, v = np.meshgrid(np.linspace(0.1, 0.9, 5) * mode.width, np.linspace(0.1, 0.9, 5) * mode.height)
    points, directions = rays_of(ray_model, np.stack([u.ravel(), v.ravel()], axis=1))
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    return np.asarray(
        np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, points)), dtype=np.float64
    )


def rays_of(ray_model: RayModel, uv_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the rays of pixels (..., 2): points on plane a and unit directions, shape (..., 3)."""
    a, b = ray_model.plane_a_mm, ray_model.plane_b_mm
    on_a, on_b = ray_model.points_on_plane(uv_px, a), ray_model.points_on_plane(uv_px, b)
    point = np.concatenate([on_a, np.full((*on_a.shape[:-1], 1), a)], axis=-1)
    d = np.concatenate([on_b - on_a, np.full((*on_a.shape[:-1], 1), b - a)], axis=-1)
    return point, d / np.linalg.norm(d, axis=-1, keepdims=True)


def solve_p3p(bearings: FloatArray, points_mm: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the poses that bring three points onto three rays through the origin.

    Parameters
    ----------
    bearings : ndarray, shape (n, 3, 3)
        Unit vectors, one row a ray.
    points_mm : ndarray, shape (n, 3, 3), mm, brick frame
        One row a point; points in one line give no pose.

    Returns
    -------
    R : ndarray, shape (n, 4, 3, 3)
        Brick to camera; NaN where not valid.
    t_mm : ndarray, shape (n, 4, 3), mm, from the rays' common point
    valid : ndarray of bool, shape (n, 4)

    Notes
    -----
    Haralick et al., 1994, eqs 8-11 (Grunert): quartic in v = s3 / s1, the ratio of two of the distances.
    """
    n = len(bearings)
    R, t = np.full((n, 4, 3, 3), np.nan), np.full((n, 4, 3), np.nan)
    count = np.zeros(n, dtype=np.int64)
    _solve_all(np.ascontiguousarray(bearings), np.ascontiguousarray(points_mm), R, t, count)
    return R, t, np.arange(4) < count[:, None]


@compiled
def _solve_all(
    bearings: FloatArray, points: FloatArray, R: FloatArray, t: FloatArray, count: IntArray
) -> None:
    four, distance, room = np.empty(4), np.empty((4, 3)), np.empty((3, 3, 3))
    for i in range(len(bearings)):
        f, p = bearings[i], points[i]
        found = triangle_distances(
            _gap2(p, 1, 2),
            _gap2(p, 0, 2),
            _gap2(p, 0, 1),
            _dot(f, 1, 2),
            _dot(f, 0, 2),
            _dot(f, 0, 1),
            four,
            distance,
        )
        n = 0
        for m in range(found):
            if pose_of_three(f, 0, 1, 2, p, 0, 1, 2, distance[m], R[i, n], t[i, n], room):
                n += 1
            else:
                R[i, n], t[i, n] = np.nan, np.nan
        count[i] = n


@compiled_in_place
def triangle_distances(
    a2: float, b2: float, c2: float, ca: float, cb: float, cg: float, four: FloatArray, out: FloatArray
) -> int:
    """Put the distances of a triangle's corners along three rays into ``out``, (4, 3), and return how many.

    ``a2``, ``b2``, ``c2`` are the squared sides 2-3, 1-3 and 1-2, ``ca``, ``cb``, ``cg`` the cosines between
    the rays of the same corners; ``four`` has room for four numbers.
    """
    d, e, k, a_b = (a2 - c2) / b2, (a2 + c2) / b2, c2 / b2, a2 / b2
    x4 = (d - 1) ** 2 - 4 * k * ca**2
    x3 = 4 * (d * (1 - d) * cb - (1 - e) * ca * cg + 2 * k * ca**2 * cb)
    x2 = 2 * (
        d**2 - 1 + 2 * d**2 * cb**2 + 2 * (1 - k) * ca**2 - 4 * e * ca * cb * cg + 2 * (1 - a_b) * cg**2
    )
    x1 = 4 * (-d * (1 + d) * cb + 2 * a_b * cg**2 * cb - (1 - e) * ca * cg)
    x0 = (1 + d) ** 2 - 4 * a_b * cg**2
    n = 0
    for i in range(real_quartic_roots(x4, x3, x2, x1, x0, four)):
        v = four[i]
        u = ((d - 1) * v**2 - 2 * d * cb * v + 1 + d) / (2 * (cg - v * ca))
        s1 = math.sqrt(b2 / (1 + v**2 - 2 * v * cb))
        if s1 > 0 and u > 0 and v > 0 and math.isfinite(u * s1):
            out[n, 0], out[n, 1], out[n, 2] = s1, u * s1, v * s1
            n += 1
    return n


@compiled_in_place
def pose_of_three(
    f: FloatArray,
    i: int,
    j: int,
    k: int,
    p: FloatArray,
    a: int,
    b: int,
    c: int,
    distance: FloatArray,
    R: FloatArray,
    t: FloatArray,
    room: FloatArray,
) -> bool:
    """Put the pose that brings points a, b, c onto rays i, j, k, at given distances, into ``R`` and ``t``.

    False where the points are in line; ``room`` (3, 3, 3) is to work in.
    """
    for x in range(3):
        room[0, 0, x], room[0, 1, x], room[0, 2, x] = (
            distance[0] * f[i, x],
            distance[1] * f[j, x],
            distance[2] * f[k, x],
        )
    if not (_triad(p, a, b, c, room[1]) and _triad(room[0], 0, 1, 2, room[2])):
        return False
    for r in range(3):
        total = room[0, 0, r] + room[0, 1, r] + room[0, 2, r]
        for x in range(3):
            R[r, x] = (
                room[2, 0, r] * room[1, 0, x] + room[2, 1, r] * room[1, 1, x] + room[2, 2, r] * room[1, 2, x]
            )
            total -= R[r, x] * (p[a, x] + p[b, x] + p[c, x])
        t[r] = total / 3
    return True


@compiled_in_place
def _gap2(p: FloatArray, i: int, j: int) -> float:
    return float((p[i, 0] - p[j, 0]) ** 2 + (p[i, 1] - p[j, 1]) ** 2 + (p[i, 2] - p[j, 2]) ** 2)


@compiled_in_place
def _dot(f: FloatArray, i: int, j: int) -> float:
    return float(f[i, 0] * f[j, 0] + f[i, 1] * f[j, 1] + f[i, 2] * f[j, 2])


@compiled_in_place
def _triad(p: FloatArray, i: int, j: int, k: int, out: FloatArray) -> bool:
    """Put an orthonormal frame into ``out``, one axis a row: along a side, in the plane of three points.

    False where they are in line.
    """
    x0, x1, x2 = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
    y0, y1, y2 = p[k, 0] - p[i, 0], p[k, 1] - p[i, 1], p[k, 2] - p[i, 2]
    z0, z1, z2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    x, y = math.sqrt(x0 * x0 + x1 * x1 + x2 * x2), math.sqrt(y0 * y0 + y1 * y1 + y2 * y2)
    z = math.sqrt(z0 * z0 + z1 * z1 + z2 * z2)
    if not z > _SLIM * x * y:
        return False
    out[0, 0], out[0, 1], out[0, 2] = x0 / x, x1 / x, x2 / x
    out[2, 0], out[2, 1], out[2, 2] = z0 / z, z1 / z, z2 / z
    out[1, 0] = out[2, 1] * out[0, 2] - out[2, 2] * out[0, 1]
    out[1, 1] = out[2, 2] * out[0, 0] - out[2, 0] * out[0, 2]
    out[1, 2] = out[2, 0] * out[0, 1] - out[2, 1] * out[0, 0]
    return True


@compiled_in_place
def real_quartic_roots(c4: float, c3: float, c2: float, c1: float, c0: float, out: FloatArray) -> int:
    """Put the real roots of a quartic into ``out`` and return their number; nearly double ones count as real.

    Ferrari's way: a root of the resolvent cubic splits the quartic into two quadratics; Newton's steps on the
    quartic itself then give back the digits that were lost.
    """
    largest = max(abs(c4), abs(c3), abs(c2), abs(c1), abs(c0))
    if not largest > 0:
        return 0
    c4 = c4 if abs(c4) > 1e-10 * largest else 1e-10 * largest
    a, b, c, d = c3 / c4, c2 / c4, c1 / c4, c0 / c4
    # x = y - a/4: y^4 + p y^2 + q y + r
    p = b - 0.375 * a * a
    q = c - 0.5 * a * b + 0.125 * a**3
    r = d - 0.25 * a * c + a * a * b / 16 - 3 * a**4 / 256
    # m > 0 with m^3 + p m^2 + (p^2/4 - r) m - q^2/8 = 0: its largest root.
    m = _largest_cubic_root(p, 0.25 * p * p - r, -0.125 * q * q)
    n = 0
    if m > 1e-14 * (1 + abs(p)):
        w = math.sqrt(2 * m)
        shift = q / (2 * w)
        n = _quadratic_roots(w, 0.5 * p + m - shift, a, out, n)
        n = _quadratic_roots(-w, 0.5 * p + m + shift, a, out, n)
    else:  # q = 0: a quadratic in y^2
        root = math.sqrt(max(0.25 * p * p - r, 0.0))
        for square in (-0.5 * p + root, -0.5 * p - root):
            if square >= 0:
                n = _quadratic_roots(0.0, -square, a, out, n)
    for i in range(n):
        x = out[i]
        for _ in range(2):
            value = (((x + a) * x + b) * x + c) * x + d
            slope = ((4 * x + 3 * a) * x + 2 * b) * x + c
            step = value / slope
            if not abs(step) < 0.1 * (1 + abs(x)):
                break
            x -= step
        out[i] = x
    return n


@compiled_in_place
def _quadratic_roots(w: float, k: float, a: float, out: FloatArray, n: int) -> int:
    """Append the roots of y^2 + w y + k, less a / 4, to the n in ``out``; a nearly double pair's too."""
    square = 0.25 * w * w - k
    middle = -0.5 * w - 0.25 * a
    if square < 0:
        if -square > (_DOUBLE_ROOT * middle) ** 2:
            return n
        square = 0.0
    root = math.sqrt(square)
    out[n], out[n + 1] = middle + root, middle - root
    return n + 2


@compiled_in_place
def _largest_cubic_root(a: float, b: float, c: float) -> float:
    """Return the largest real root of x^3 + a x^2 + b x + c."""
    q, r = (a * a - 3 * b) / 9, (2 * a**3 - 9 * a * b + 27 * c) / 54
    if r * r < q**3:
        size = math.sqrt(q)
        angle = math.acos(min(max(r / size**3, -1.0), 1.0))
        x = -2 * size * math.cos((angle + 2 * math.pi) / 3) - a / 3
        x = max(x, -2 * size * math.cos((angle - 2 * math.pi) / 3) - a / 3)
    else:
        u = -math.copysign((abs(r) + math.sqrt(max(r * r - q**3, 0.0))) ** (1 / 3), r)
        x = u + (q / u if u != 0 else 0.0) - a / 3
    for _ in range(2):
        slope = (3 * x + 2 * a) * x + b
        step = (((x + a) * x + b) * x + c) / slope
        if not abs(step) < 0.1 * (1 + abs(x)):
            break
        x -= step
    return x
