"""Motion of one component seen from another, with its covariance: turned into brick axes, chained, inverted.

A `Motion` moves points of a component from where they stood at rest to where they are, both in brick axes of
the component that it is seen from. So a chain is a product, ``base <- Q = (base <- P) @ (P <- Q)``, and the
other point of view is the inverse. Errors are ``[dtheta rad, dt mm]`` with ``R_true = R Exp(dtheta)`` and
``t_true = t + dt``; to first order they pass through

    (R1, t1)(R2, t2):   dtheta = R2' dtheta1 + dtheta2,    dt = dt1 + R1 dt2 - R1 [t2]x dtheta1
    (R, t)^-1:          dtheta' = -R dtheta,               dt' = -R' dt - [R' t]x dtheta
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import FloatArray, IntArray, as_float_array
from bricktrack_common.errors import ShapeError
from bricktrack_common.poses import Pose
from bricktrack_common.rotations import rvec_from_matrix, skew
from bricktrack_host.normalised_errors import normalised_squares


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Displacement from rest of a component, seen from another, at a row of instants.

    Attributes
    ----------
    R : ndarray, shape (n, 3, 3)
        NaN where it is not known.
    t_mm : ndarray, shape (n, 3), mm
        Displacement of the point at the brick's origin.
    covariance : ndarray, shape (n, 6, 6), of ``[dtheta rad, dt mm]``
    flags : ndarray of int64, shape (n,), `PoseFlag`
        Of all views that the motion is made of.
    """

    R: FloatArray
    t_mm: FloatArray
    covariance: FloatArray
    flags: IntArray

    def __post_init__(self) -> None:
        n = len(self.R)
        shapes = self.R.shape, self.t_mm.shape, self.covariance.shape, self.flags.shape
        if shapes != ((n, 3, 3), (n, 3), (n, 6, 6), (n,)):
            raise ShapeError(f"motion of shapes {shapes}; expected (n, 3, 3), (n, 3), (n, 6, 6), (n,)")

    def __matmul__(self, other: "Motion") -> "Motion":
        first = np.zeros((len(self.R), 6, 6))
        first[:, :3, :3] = np.swapaxes(other.R, 1, 2)
        first[:, 3:, :3] = -self.R @ skew(other.t_mm)
        first[:, 3:, 3:] = np.eye(3)
        second = np.zeros_like(first)
        second[:, :3, :3] = np.eye(3)
        second[:, 3:, 3:] = self.R
        product = Pose(self.R, self.t_mm) @ Pose(other.R, other.t_mm)
        return Motion(
            R=product.R,
            t_mm=product.t_mm,
            covariance=_through(first, self.covariance) + _through(second, other.covariance),
            flags=self.flags | other.flags,
        )

    def inverse(self) -> "Motion":
        """Return how the other component moved, seen from this one."""
        inverse = Pose(self.R, self.t_mm).inverse()
        jacobian = np.zeros((len(self.R), 6, 6))
        jacobian[:, :3, :3] = -self.R
        jacobian[:, 3:, :3] = skew(inverse.t_mm)  # -[R' t]x, as inverse.t is -R' t
        jacobian[:, 3:, 3:] = -np.swapaxes(self.R, 1, 2)
        return Motion(inverse.R, inverse.t_mm, _through(jacobian, self.covariance), self.flags)

    def in_axes(self, pose_brick_layout: Pose) -> "Motion":
        """Return the same motion in brick axes, given in the axes of an LED layout.

        Parameters
        ----------
        pose_brick_layout : Pose
            Where the layout's frame stands in the whole brick, from the drawing.
        """
        S, s_mm = pose_brick_layout.R, pose_brick_layout.t_mm
        moved = pose_brick_layout @ Pose(self.R, self.t_mm) @ pose_brick_layout.inverse()
        jacobian = np.zeros((len(self.R), 6, 6))
        jacobian[:, :3, :3] = S
        jacobian[:, 3:, :3] = moved.R @ skew(s_mm) @ S
        jacobian[:, 3:, 3:] = S
        return Motion(moved.R, moved.t_mm, _through(jacobian, self.covariance), self.flags)

    def about(self, point_mm: ArrayLike) -> "Motion":
        """Return the same motion with another point as origin: `t_mm` is then the displacement of that point.

        Parameters
        ----------
        point_mm : array_like, shape (3,), mm, brick axes, at rest
        """
        return self.in_axes(Pose(np.eye(3), -as_float_array("point_mm", point_mm, (3,))))


def disagreement(one: Motion, other: Motion) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return how far two accounts of the same motion lie apart.

    Returns
    -------
    position_mm : ndarray, shape (n, 3), mm
        Of the point at the brick's origin, first less second.
    rotation_rad : ndarray, shape (n, 3), rad
        Rotation vector from the second to the first.
    normalised : ndarray, shape (n,)
        Squared difference over the sum of both covariances; 6 on average if both are independent and honest.
        NaN where either is not known.
    """
    position_mm = one.t_mm - other.t_mm
    rotation_rad = rvec_from_matrix(np.swapaxes(other.R, 1, 2) @ one.R)
    difference = np.concatenate([rotation_rad, position_mm], axis=1)
    total = one.covariance + other.covariance
    return position_mm, rotation_rad, normalised_squares(difference, total)


def _through(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    return np.asarray(jacobian @ covariance @ np.swapaxes(jacobian, 1, 2))
