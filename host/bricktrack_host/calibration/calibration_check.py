"""Does a calibration still hold? New pictures of a board, wherever it stands, against what the rays say.

The board's pose is fitted with six degrees of freedom, because nobody puts a board back to some micrometres.
What is left must be as small as the dots', the rays' and the board's stated uncertainties together; the depth
found must be the rig's, where that is known.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dots.disc_bias import disc_bias_px
from bricktrack_host.calibration.dots.dot_observations import DotObservations

MIN_DOTS = 20
OUTLIER_SIGMAS = 6.0
MAX_RATIO = 1.5
"""Residuals by what is stated, beyond which a calibration does not hold. Chance alone gives 1.0 within 5 %
for a few hundred dots; the rest is for boards and dots a little worse than stated."""
MAX_ROUNDS = 30
CONVERGED = 1e-9


class CheckableRays(RayModel, Protocol):
    """A ray model that states its uncertainty."""

    def point_covariance_mm2(self, uv_px: ArrayLike, z_mm: ArrayLike) -> FloatArray:
        """Return the covariance, shape (..., 2, 2), mm^2, of the points that pixels see on the plane z."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class BoardCheck:
    """What a picture says of a calibration.

    Attributes
    ----------
    uv_px : ndarray, shape (n, 2), px
        Centres of the dots judged.
    residual_um : ndarray, shape (n, 2), um
        Where the rays meet the board less where the dots are, along the board's x and y.
    n_outliers : int
        Dots left out: smeared or dirty.
    ratio : float
        Root mean square of the residuals, in units of what is stated.
    mean_um, rms_um, max_um : float, um
        Of the residuals' length.
    stated_um : float, um
        Root mean square of the length that dots, rays and board together are stated to have.
    depth_mm, depth_sd_mm : float, mm
        Of the board on the camera's axis.
    tilt_deg : float
        Of the board to the camera's axis.
    covered : float
        Share of the dots that the calibration covers.
    """

    uv_px: FloatArray
    residual_um: FloatArray
    n_outliers: int
    ratio: float
    mean_um: float
    rms_um: float
    max_um: float
    stated_um: float
    depth_mm: float
    depth_sd_mm: float
    tilt_deg: float
    covered: float


def check_board(
    model: CheckableRays,
    dots: DotObservations,
    *,
    dot_diameter_mm: float,
    added_px: float = 0.0,
    board_um: float = 0.0,
) -> BoardCheck:
    """Compare a picture of a board with a calibration.

    Parameters
    ----------
    model : CheckableRays
    dots : DotObservations
        As measured.
    dot_diameter_mm : float, mm
        Of the (small) dots.
    added_px : float, optional, px
        Standard deviation of each of a dot's coordinates beyond the noise seen in the picture: what the
        camera's pixels and the lens add, as the calibration found it (`ray_fit.PlaneNoise`).
    board_um : float, optional, um
        Standard deviation of each of a dot's coordinates on the board: print and flatness.

    Raises
    ------
    CalibrationError
        If there are too few dots, or no pose of the board fits.
    """
    if len(dots) < MIN_DOTS:
        raise CalibrationError(f"{len(dots)} dots; a check needs at least {MIN_DOTS}")
    board = np.column_stack([dots.xy_mm, np.zeros(len(dots))])
    R, t = _start(model, dots)
    dots_px2 = dots.cov_px2 + added_px**2 * np.eye(2)
    uv = dots.uv_px
    keep = np.ones(len(dots), dtype=np.bool_)
    for _ in range(3):  # the discs' correction needs the pose, the pose the corrected dots
        p = board @ R.T + t
        uv = dots.uv_px - disc_bias_px(
            model,
            p[:, :2],
            z_mm=p[:, 2],
            diameter_mm=dot_diameter_mm * np.asarray(dots.size),
            axes=R[:, :2],
        )
        W = np.asarray(np.linalg.inv(_stated_px2(model, dots_px2, uv, p, R, board_um)), dtype=np.float64)
        # From the first guess of a pose some dots may lie where the rays do not reach.
        reached = keep & np.isfinite(W).all(axis=(1, 2))
        R, t, normal = _fitted_pose(model, board, uv, W, reached, R, t)
        off = model.project(board @ R.T + t).uv_px - uv
        distance = np.sqrt(np.einsum("ni,nij,nj->n", off, W, off))
        scale = max(float(np.nanmedian(distance[reached])) / 1.1774, 1.0)
        keep = np.isfinite(distance) & (distance < OUTLIER_SIGMAS * scale)
        if np.count_nonzero(keep) < max(MIN_DOTS, 0.8 * len(dots)):
            raise CalibrationError(
                f"{np.count_nonzero(~keep)} of {len(dots)} dots contradict the others; is the target's file "
                "the right one?"
            )
    p = board @ R.T + t
    J = model.project(p).J_px_per_mm[keep] @ R[:, :2]
    inverse = np.linalg.inv(J)
    residual_um = -1e3 * np.einsum("nij,nj->ni", inverse, off[keep])
    stated = np.linalg.inv(W[keep])
    stated_um = 1e3 * np.sqrt(
        np.mean(np.trace(inverse @ stated @ np.swapaxes(inverse, 1, 2), axis1=1, axis2=2))
    )
    length = np.hypot(residual_um[:, 0], residual_um[:, 1])
    freedom = 2 * np.count_nonzero(keep) - 6
    depth, depth_sd = _depth(R, t, np.asarray(np.linalg.inv(normal), dtype=np.float64))
    return BoardCheck(
        uv_px=uv[keep],
        residual_um=residual_um,
        n_outliers=int(np.count_nonzero(~keep)),
        ratio=float(np.sqrt(np.sum(distance[keep] ** 2) / freedom)),
        mean_um=float(length.mean()),
        rms_um=float(np.sqrt(np.mean(length**2))),
        max_um=float(length.max()),
        stated_um=float(stated_um),
        depth_mm=depth,
        depth_sd_mm=depth_sd,
        tilt_deg=float(np.rad2deg(np.arccos(np.clip(R[2, 2], -1, 1)))),
        covered=float(np.mean(model.is_covered(uv[keep]))),
    )


def _start(model: RayModel, dots: DotObservations) -> tuple[FloatArray, FloatArray]:
    """Return the pose of a board square to the axis, at the depth where its size is right."""
    a, b = model.plane_a_mm, model.plane_b_mm
    own = dots.xy_mm - dots.xy_mm.mean(axis=0)

    def spread(z_mm: float) -> float:
        xy = model.points_on_plane(dots.uv_px, z_mm)
        return float(np.sqrt(np.nanmean(np.sum((xy - np.nanmean(xy, axis=0)) ** 2, axis=1))))

    wanted, at_a, at_b = float(np.sqrt(np.mean(np.sum(own**2, axis=1)))), spread(a), spread(b)
    z = a + (b - a) * (wanted - at_a) / (at_b - at_a)
    if not 0.1 * a < z < 10 * b:
        raise CalibrationError(
            f"the dots would lie at a depth of {z:.0f} mm; is the pitch of the target's file the true one?"
        )
    xy = model.points_on_plane(dots.uv_px, z)
    seen = xy - xy.mean(axis=0)
    angle = np.arctan2(np.sum(own[:, 0] * seen[:, 1] - own[:, 1] * seen[:, 0]), np.sum(own * seen))
    R = Rotation.from_euler("z", float(angle)).as_matrix()
    t = np.append(xy.mean(axis=0) - R[:2, :2] @ dots.xy_mm.mean(axis=0), z)
    return R, t


def _stated_px2(
    model: CheckableRays, dots_px2: FloatArray, uv: FloatArray, p: FloatArray, R: FloatArray, board_um: float
) -> FloatArray:
    """Return the covariance of the pixel residuals: of dots, rays and board, shape (n, 2, 2)."""
    J = model.project(p).J_px_per_mm
    across = J[..., :2]
    rays = across @ model.point_covariance_mm2(uv, p[:, 2]) @ np.swapaxes(across, 1, 2)
    along_board = J @ R[:, :2]
    board = (board_um * 1e-3) ** 2 * along_board @ np.swapaxes(along_board, 1, 2)
    return np.asarray(dots_px2 + rays + board)


def _fitted_pose(
    model: RayModel,
    board: FloatArray,
    uv: FloatArray,
    W: FloatArray,
    keep: BoolArray,
    R: FloatArray,
    t: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return turn and shift by Gauss-Newton, and the normal matrix of (turn in the camera's axes, shift)."""
    for _ in range(MAX_ROUNDS):
        q = board[keep] @ R.T
        seen = model.project(q + t)
        off = seen.uv_px - uv[keep]
        # A turn w after R moves R X by w x (R X).
        d_turn = np.zeros((len(q), 3, 3))
        d_turn[:, 0, 1], d_turn[:, 0, 2] = q[:, 2], -q[:, 1]
        d_turn[:, 1, 0], d_turn[:, 1, 2] = -q[:, 2], q[:, 0]
        d_turn[:, 2, 0], d_turn[:, 2, 1] = q[:, 1], -q[:, 0]
        J = np.concatenate([seen.J_px_per_mm @ d_turn, seen.J_px_per_mm], axis=2)
        # On the way there dots may lie where the rays do not reach.
        reached = np.isfinite(J).all(axis=(1, 2)) & np.isfinite(off).all(axis=1)
        if np.count_nonzero(reached) < 0.5 * len(reached):
            break
        J, off = J[reached], off[reached]
        JW = np.einsum("nki,nkl->nil", J, W[keep][reached])
        normal = np.einsum("nil,nlj->ij", JW, J)
        step = -np.linalg.solve(normal, np.einsum("nil,nl->i", JW, off))
        R = Rotation.from_rotvec(step[:3]).as_matrix() @ R
        t = t + step[3:]
        if np.abs(step).max() < CONVERGED * abs(t[2]):
            return R, t, normal
    raise CalibrationError("no pose of the board fits the rays; does the picture belong to this calibration?")


def _depth(R: FloatArray, t: FloatArray, cov: FloatArray) -> tuple[float, float]:
    """Return where the camera's axis meets the board, z, mm, and its standard deviation."""

    def depth(turn: FloatArray, shift: FloatArray) -> float:
        normal = (Rotation.from_rotvec(turn).as_matrix() @ R)[:, 2]
        return float(normal @ (t + shift) / normal[2])

    zero, h = np.zeros(3), 1e-6
    here = depth(zero, zero)
    slope = [
        (depth(h * e[:3], h * e[3:]) - here) / h  # for a turn and for a shift along each axis
        for e in np.eye(6)
    ]
    return here, float(np.sqrt(np.array(slope) @ cov @ np.array(slope)))
