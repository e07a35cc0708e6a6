"""Where a board stands before a camera that is not calibrated yet: tilt and turn, from one picture.

A pinhole with two coefficients of radial distortion and the board's pose are fitted to the dots. It is a
check of the rig, not a calibration: the depth is given, and the lens's axis is held near the middle.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from bricktrack_common.arrays import FloatArray
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dots.dot_observations import DotObservations, board_turn_deg

AXIS_SD = 0.01
"""Standard deviation of the lens axis's place, share of the picture's width: some 20 px of 1920."""
MODEL_SD_DEG = 0.05
"""What a lens that is not quite this model adds: the tilt found on path-traced (simulated) pictures of boards
that stand square."""
_SCALES = np.array([1e-2, 0.1, 0.1, 1e-2, 1e-2, 1e-2, 1.0, 1.0, 1e-2, 1e-2])


@dataclass(frozen=True, slots=True)
class BoardPose:
    """How a board lies to the optical axis.

    Attributes
    ----------
    tilt_deg : float
        Angle between the board's normal and the optical axis.
    tilt_sd_deg : float
        Its standard deviation.
    recedes_deg : float
        Direction in the picture in which the board recedes, from +u towards +v.
    turn_deg : float
        Of the board's x axis from +u towards +v.
    f_px : float, px
        Focal length.
    rms_px : float, px
        What the fit leaves, each coordinate.
    """

    tilt_deg: float
    tilt_sd_deg: float
    recedes_deg: float
    turn_deg: float
    f_px: float
    rms_px: float


def board_pose(dots: DotObservations, *, z_mm: float, size_px: tuple[int, int]) -> BoardPose:
    """Return how a board stands.

    Parameters
    ----------
    dots : DotObservations
    z_mm : float, mm
        Depth at which the optical axis meets the board.
    size_px : (int, int), px
        Width and height of the picture.

    Raises
    ------
    CalibrationError
        If the dots lie in one line or no pose fits.
    """
    width, height = size_px
    middle = np.array([width - 1, height - 1]) / 2
    turn = np.deg2rad(board_turn_deg(dots))
    # Affine start: scale, and the board's point in the picture's middle.
    xy_mean, uv_mean = dots.xy_mm.mean(axis=0), dots.uv_px.mean(axis=0)
    A = np.linalg.lstsq(dots.xy_mm - xy_mean, dots.uv_px - uv_mean, rcond=None)[0].T
    f0 = z_mm * float(np.sqrt(abs(np.linalg.det(A))))
    axis0 = xy_mean + np.linalg.solve(A, middle - uv_mean)
    scales = _SCALES * np.array([f0, 1, 1, 1, 1, 1, 1, 1, width, width])

    def project(p: FloatArray) -> FloatArray:
        f, k1, k2 = f0 + p[0], p[1], p[2]
        R = Rotation.from_euler("z", turn).as_matrix() @ Rotation.from_rotvec(p[3:6]).as_matrix()
        d = dots.xy_mm - axis0 - p[6:8]
        xyz = d @ R[:, :2].T + np.array([0.0, 0.0, z_mm])
        s = xyz[:, :2] / xyz[:, 2:]
        r2 = np.sum(s * s, axis=1, keepdims=True)
        return np.asarray(f * s * (1 + r2 * (k1 + r2 * k2)) + middle + p[8:10])

    def residuals(p: FloatArray) -> FloatArray:
        off = (project(p) - dots.uv_px).ravel()
        # Tenths of a pixel for each dot: a printed board, a lens that is not quite this.
        return np.asarray(np.concatenate([off / 0.1, p[8:10] / (AXIS_SD * width)]))

    fit = least_squares(residuals, np.zeros(10), x_scale=scales, loss="soft_l1", max_nfev=200)
    if not fit.success:
        raise CalibrationError("no pose of the board fits the dots; is the grid read rightly?")
    p = np.asarray(fit.x, dtype=np.float64)
    rms = float(np.sqrt(np.mean(np.square(project(p) - dots.uv_px))))
    R = Rotation.from_euler("z", turn).as_matrix() @ Rotation.from_rotvec(p[3:6]).as_matrix()
    normal = R[:, 2]
    # The prior on the axis is in units of itself already; that of the dots in tenths of a pixel.
    jacobian = np.asarray(fit.jac, dtype=np.float64)
    cov = np.linalg.pinv(jacobian.T @ jacobian) * max(rms / 0.1, 0.2) ** 2
    tilt_sd_deg = float(np.rad2deg(np.sqrt((cov[3, 3] + cov[4, 4]) / 2)))
    return BoardPose(
        tilt_deg=float(np.rad2deg(np.arccos(np.clip(normal[2], -1, 1)))),
        tilt_sd_deg=float(np.hypot(tilt_sd_deg, MODEL_SD_DEG)),
        # Going along (a, b) on the board changes the depth by -(normal_x a + normal_y b) / normal_z.
        recedes_deg=float(np.rad2deg(np.arctan2(-normal[1], -normal[0]))),
        turn_deg=float(np.rad2deg(np.arctan2(R[1, 0], R[0, 0]))),
        f_px=float(f0 + p[0]),
        rms_px=rms,
    )
