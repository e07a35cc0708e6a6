"""What a sweep amounts to: errors after zeroing at its first step, beside the bound and the paper's."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.evaluation.sweeps import Sweep
from bricktrack_host.normalised_errors import normalised_squares
from bricktrack_host.tracking.pose.finite import all_finite

PAPER_RMS_MM = (0.2296, 0.3943, 0.0703)
"""Of x, y and z over all the paper's sweeps (its section 6.2)."""
PAPER_WORST_ANGLE_DEG = 2.88
"""The angle that drifted most, in pure translation."""


@dataclass(frozen=True, slots=True, eq=False)
class SweepScore:
    """Errors along a sweep.

    Attributes
    ----------
    sweep : Sweep
    error_mm : ndarray, shape (n, 3), mm, camera frame
        Measured less true displacement since the first step with a pose; NaN where there is no pose.
    error_deg : ndarray, shape (n, 3), degrees, brick axes
        The same of the rotation since the first step.
    bound_mm, bound_deg : ndarray, shape (n, 3)
        Standard deviations that no unbiased method can fall below; NaN where the noise is not known.
    nees : ndarray, shape (n,)
        Squared error of each pose, nothing zeroed, over its covariance: 6 on average where that is honest.
        NaN where there is none.
    """

    sweep: Sweep
    error_mm: FloatArray
    error_deg: FloatArray
    bound_mm: FloatArray
    bound_deg: FloatArray
    nees: FloatArray

    @property
    def n_posed(self) -> int:
        """Steps with a pose."""
        return int(all_finite(self.error_mm).sum())

    @property
    def rms_mm(self) -> FloatArray:
        """Root mean square of x, y and z, shape (3,), mm."""
        return rms(self.error_mm)

    @property
    def rms_deg(self) -> float:
        """Root mean square of the angle of rotation, degrees."""
        return float(np.sqrt(np.sum(rms(self.error_deg) ** 2)))


def score_sweep(
    sweep: Sweep,
    R_camera_brick: FloatArray,
    t_camera_brick_mm: FloatArray,
    bound: FloatArray | None = None,
    covariance: FloatArray | None = None,
) -> SweepScore:
    """Return the errors of poses, shapes (n, 3, 3) and (n, 3), NaN where there are none, along a sweep.

    ``bound``, shape (n, 6, 6), is that of single poses; both ends of a displacement count. ``covariance``,
    shape (n, 6, 6), is what the poses say of themselves.
    """
    n = len(sweep)
    error_mm, error_deg = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
    bound_mm, bound_deg = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
    nees = np.full(n, np.nan)
    posed = np.flatnonzero(all_finite(R_camera_brick, 2) & all_finite(t_camera_brick_mm))
    if posed.size:
        zero = posed[0]
        true_mm = sweep.t_camera_brick_mm - sweep.t_camera_brick_mm[zero]
        error_mm[posed] = (t_camera_brick_mm - t_camera_brick_mm[zero] - true_mm)[posed]
        measured = R_camera_brick[zero].T @ R_camera_brick[posed]
        true = sweep.R_camera_brick[zero].T @ sweep.R_camera_brick[posed]
        error_deg[posed] = np.degrees(rvec_from_matrix(np.swapaxes(true, -1, -2) @ measured))
        if bound is not None:
            variance = np.einsum("nii->ni", bound)
            sd = np.sqrt(variance + np.where(np.arange(n) == zero, 0.0, 1.0)[:, None] * variance[zero])
            sd[zero] = 0.0
            bound_deg[posed], bound_mm[posed] = np.degrees(sd[posed, :3]), sd[posed, 3:]
        if covariance is not None:
            turn = rvec_from_matrix(np.swapaxes(R_camera_brick[posed], -1, -2) @ sweep.R_camera_brick[posed])
            e = np.hstack([turn, sweep.t_camera_brick_mm[posed] - t_camera_brick_mm[posed]])
            nees[posed] = normalised_squares(e, covariance[posed])
    return SweepScore(sweep, error_mm, error_deg, bound_mm, bound_deg, nees)


def joined(scores: Sequence[SweepScore]) -> SweepScore:
    """Return the same sweep seen by several cameras as one: its steps one after the other."""
    first = scores[0].sweep
    sweep = Sweep(
        first.name,
        np.concatenate([s.sweep.step for s in scores]),
        first.unit,
        np.concatenate([s.sweep.R_camera_brick for s in scores]),
        np.concatenate([s.sweep.t_camera_brick_mm for s in scores]),
    )
    names = ("error_mm", "error_deg", "bound_mm", "bound_deg", "nees")
    return SweepScore(sweep, **{name: np.concatenate([getattr(s, name) for s in scores]) for name in names})


def rms(values: FloatArray) -> FloatArray:
    """Return the root mean square along the first axis of the rows that are numbers; NaN if none are."""
    good = values[all_finite(values)]
    return np.sqrt(np.mean(good**2, axis=0)) if len(good) else np.full(values.shape[1], np.nan)
