"""Two calibrations of one unit compared: what a move of the camera explains, and what the lens changed."""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.calibration_file import Calibration, require_match
from bricktrack_host.calibration.rays.pixel_polynomials import picture_grid
from bricktrack_host.calibration.rays.ray_uncertainty import CHI_95


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationComparison:
    """How rays moved from an earlier calibration to this one.

    Attributes
    ----------
    uv_px : ndarray, shape (n, 2), px
        Pixels that both calibrations covered.
    z_mm : float, mm
        Depth, midway between the planes, at which the rays are compared.
    moved_mm : ndarray, shape (n, 2), mm
        This calibration's points less the earlier one's.
    shift_mm, turn_rad : ndarray, shape (3,)
        The motion of the camera in the rig that explains most of it.
    left_mm : ndarray, shape (n, 2), mm
        What that motion does not explain: the lens.
    explained_share : float
        Of the pixels, those where what is left lies within both calibrations' 95 %.
    """

    uv_px: FloatArray
    z_mm: float
    moved_mm: FloatArray
    shift_mm: FloatArray
    turn_rad: FloatArray
    left_mm: FloatArray
    explained_share: float


def compare_calibrations(now: Calibration, earlier: Calibration) -> CalibrationComparison:
    """Compare two calibrations of the same unit and sensor mode.

    Raises
    ------
    CalibrationError
        If they belong to different units or modes, or cover no pixel in common.
    """
    try:
        require_match(earlier, unit=now.unit, sensor_mode=now.sensor_mode)
    except CalibrationError as e:
        raise CalibrationError(f"the earlier calibration is not comparable: {e}") from e
    new, old = now.ray_model, earlier.ray_model
    uv = picture_grid(now.sensor_mode, 49, 28)
    uv = uv[new.is_covered(uv) & old.is_covered(uv)]
    if len(uv) < 10:
        raise CalibrationError("the two calibrations cover no part of the picture in common")
    a, b = new.plane_a_mm, new.plane_b_mm
    points = {z: old.points_on_plane(uv, z) for z in (a, b)}
    slopes = (points[b] - points[a]) / (b - a)
    # Moving the earlier camera by (t, w) moves its rays' points on z by t + w x p, less the part along z.
    rows, wanted = [], []
    for z, xy in points.items():
        p = np.column_stack([xy, np.full(len(xy), z)])
        motion = np.zeros((len(p), 3, 6))
        motion[:, :, :3] = np.eye(3)
        for k in range(3):
            motion[:, :, 3 + k] = np.cross(np.eye(3)[k], p)
        rows.append(motion[:, :2] - slopes[:, :, None] * motion[:, 2:3])
        wanted.append(new.points_on_plane(uv, z) - xy)
    A = np.concatenate(rows).reshape(-1, 6)
    scale = np.linalg.norm(A, axis=0)
    solution = np.linalg.lstsq(A / scale, np.concatenate(wanted).reshape(-1), rcond=None)[0] / scale
    middle = (a + b) / 2
    moved = new.points_on_plane(uv, middle) - old.points_on_plane(uv, middle)
    left = moved - ((rows[0] + rows[1]) / 2) @ solution
    covariance = new.point_covariance_mm2(uv, middle) + old.point_covariance_mm2(uv, middle)
    squares = np.einsum("ni,nij,nj->n", left, np.linalg.inv(covariance), left)
    return CalibrationComparison(
        uv_px=uv,
        z_mm=middle,
        moved_mm=moved,
        shift_mm=solution[:3],
        turn_rad=solution[3:],
        left_mm=left,
        explained_share=float(np.mean(squares < CHI_95**2)),
    )
