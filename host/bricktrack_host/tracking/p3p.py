"""Poses from three rays and three LEDs: at most four of each, by Grunert's quartic, vectorised.

Needs rays through one point; for a camera without one, the point nearest to all rays serves, and the poses
are starts for the refinement, which asks the ray model itself.
"""

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_common.camera_model import RayModel
from bricktrack_host.tracking.finite import all_finite


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
        Brick to camera.
    t_mm : ndarray, shape (n, 4, 3), mm, from the rays' common point
    valid : ndarray of bool, shape (n, 4)

    Notes
    -----
    Haralick et al., 1994, eqs 8-11 (Grunert): quartic in v = s3 / s1, the ratio of two of the distances.
    """
    f1, f2, f3 = bearings[:, 0], bearings[:, 1], bearings[:, 2]
    p1, p2, p3 = points_mm[:, 0], points_mm[:, 1], points_mm[:, 2]
    a2 = ((p2 - p3) ** 2).sum(axis=1)
    b2 = ((p1 - p3) ** 2).sum(axis=1)
    c2 = ((p1 - p2) ** 2).sum(axis=1)
    ca, cb, cg = (f2 * f3).sum(axis=1), (f1 * f3).sum(axis=1), (f1 * f2).sum(axis=1)
    d, e, k = (a2 - c2) / b2, (a2 + c2) / b2, c2 / b2
    coefficients = np.stack(
        [
            (d - 1) ** 2 - 4 * k * ca**2,
            4 * (d * (1 - d) * cb - (1 - e) * ca * cg + 2 * k * ca**2 * cb),
            2
            * (
                d**2
                - 1
                + 2 * d**2 * cb**2
                + 2 * (1 - k) * ca**2
                - 4 * e * ca * cb * cg
                + 2 * (1 - a2 / b2) * cg**2
            ),
            4 * (-d * (1 + d) * cb + 2 * a2 / b2 * cg**2 * cb - (1 - e) * ca * cg),
            (1 + d) ** 2 - 4 * a2 / b2 * cg**2,
        ],
        axis=1,
    )
    v, real = _real_quartic_roots(coefficients)
    with np.errstate(all="ignore"):
        u = ((d - 1)[:, None] * v**2 - 2 * (d * cb)[:, None] * v + (1 + d)[:, None]) / (
            2 * (cg[:, None] - v * ca[:, None])
        )
        s1 = np.sqrt(b2[:, None] / (1 + v**2 - 2 * v * cb[:, None]))
        s2, s3 = u * s1, v * s1
        valid = real & np.isfinite(s1) & (s1 > 0) & (s2 > 0) & (s3 > 0)
        q1, q2, q3 = (s[..., None] * f[:, None] for s, f in ((s1, f1), (s2, f2), (s3, f3)))
        R = _triad(q2 - q1, q3 - q1) @ np.swapaxes(_triad(p2 - p1, p3 - p1), -1, -2)[:, None]
        middle = (p1 + p2 + p3) / 3
        t = (q1 + q2 + q3) / 3 - np.einsum("nkij,nj->nki", R, middle)
    area = np.linalg.norm(np.cross(p2 - p1, p3 - p1), axis=1)
    valid &= (area > 0.05 * np.sqrt(b2 * c2))[:, None]
    valid &= all_finite(R, 2) & all_finite(t)
    return R, t, valid


def _triad(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return right-handed orthonormal frames, columns, with the first along x and the second in (x, y)."""
    e1 = x / np.linalg.norm(x, axis=-1, keepdims=True)
    e3 = np.cross(x, y)
    e3 = e3 / np.linalg.norm(e3, axis=-1, keepdims=True)
    return np.stack([e1, np.cross(e3, e1), e3], axis=-1)


def _real_quartic_roots(coefficients: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the four roots' real parts, shape (n, 4), polished, and which are real."""
    scale = np.abs(coefficients).max(axis=1, keepdims=True)
    c = coefficients / np.where(scale > 0, scale, 1.0)
    lead = np.where(np.abs(c[:, 0]) > 1e-10, c[:, 0], 1e-10)
    companion = np.zeros((len(c), 4, 4))
    companion[:, 0] = -c[:, 1:] / lead[:, None]
    companion[:, 1, 0] = companion[:, 2, 1] = companion[:, 3, 2] = 1.0
    roots = np.linalg.eigvals(companion) if len(c) else np.zeros((0, 4), dtype=complex)
    # Noise turns a double root into a pair with a small imaginary part: keep its real part as a start.
    real = np.abs(roots.imag) < 0.02 * np.abs(roots.real) + 1e-9
    return np.ascontiguousarray(roots.real), real
