"""From the centroid of a dot's image to the image of the dot's centre, by a calibrated ray model.

Distortion and perspective do not take centroids to centroids. The centroid of the image of a disc is the
mean of the projection over the disc, weighted with the local area scale:
``uv_area = sum f(x_k) |det Df(x_k)| / sum |det Df(x_k)|`` over points x_k of the disc. To second order in
the radius the shift is ``r^2/8 laplace(f) + r^2/4 Df grad(log det Df)``.
"""

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.camera_model import RayModel

_RING = np.linspace(0, 2 * np.pi, 8, endpoint=False)
# Two rings of Gauss-Legendre nodes in r^2: exact for polynomials of degree 7 over the unit disc.
_RADII = np.sqrt(0.5 + 0.5 * np.array([-1.0, 1.0]) / np.sqrt(3.0))
_UNIT_DISC = np.concatenate([r * np.stack([np.cos(_RING), np.sin(_RING)], axis=1) for r in _RADII])


def disc_bias_px(
    model: RayModel,
    xy_mm: FloatArray,
    *,
    z_mm: float | FloatArray,
    diameter_mm: float | FloatArray,
    axes: FloatArray | None = None,
) -> FloatArray:
    """Return how far a disc's image centroid lies from the image of its centre.

    Parameters
    ----------
    model : RayModel
    xy_mm : ndarray, shape (n, 2), mm, camera frame
        Centres of the discs.
    z_mm : float or ndarray, shape (n,), mm
        Their depths.
    diameter_mm : float or ndarray, shape (n,), mm
        Of all discs, or of each.
    axes : ndarray, shape (3, 2), optional
        Unit vectors along the discs' x and y, camera frame; square to the optical axis where not given.

    Returns
    -------
    shift_px : ndarray, shape (n, 2), px
        To be subtracted from measured centroids; 0 where the model cannot see the whole disc.
    """
    axes = np.eye(3)[:, :2] if axes is None else axes
    points = np.empty((len(xy_mm), len(_UNIT_DISC) + 1, 3))
    points[..., :2], points[..., 2] = xy_mm[:, None], np.asarray(z_mm, dtype=np.float64).reshape(-1, 1)
    radius_mm = np.broadcast_to(np.asarray(diameter_mm, dtype=np.float64) / 2, len(xy_mm))
    points[:, 1:] += radius_mm[:, None, None] * (_UNIT_DISC @ axes.T)
    seen = model.project(points)
    J = seen.J_px_per_mm[:, 1:] @ axes
    scale = np.abs(J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0])[..., None]
    mean = (seen.uv_px[:, 1:] * scale).sum(axis=1) / scale.sum(axis=1)
    return np.asarray(np.nan_to_num(mean - seen.uv_px[:, 0]))


def disc_diameter_mm(
    model: RayModel,
    uv_px: FloatArray,
    area_px2: FloatArray,
    *,
    z_mm: float,
    size: float | FloatArray = 1.0,
) -> float:
    """Return the diameter of the dots, median over those given, from their areas in the picture.

    Parameters
    ----------
    model : RayModel
    uv_px : ndarray, shape (n, 2), px
    area_px2 : ndarray, shape (n,), px^2
    z_mm : float, mm
        Depth of the plane that they lie in.
    size : float or ndarray, shape (n,), optional
        Diameters in units of the one wanted, as `DotObservations` holds them.
    """
    xy = model.points_on_plane(uv_px, z_mm)
    J = model.project(np.concatenate([xy, np.full((len(xy), 1), float(z_mm))], axis=1)).J_px_per_mm[..., :2]
    area_mm2 = area_px2 / np.abs(np.linalg.det(J)) / np.square(size)
    return float(np.sqrt(4 / np.pi * np.nanmedian(area_mm2)))
