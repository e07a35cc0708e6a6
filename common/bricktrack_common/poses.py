"""Rigid poses: where one frame stands in another.

A ``pose_camera_brick`` takes brick coordinates to camera coordinates. Poses compose where neighbouring
names meet: ``pose_table_brick = pose_table_camera @ pose_camera_brick``.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import FloatArray, as_float_array
from bricktrack_common.errors import ShapeError


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """One pose, or a batch of them along leading dimensions.

    Attributes
    ----------
    R : ndarray, shape (..., 3, 3)
        Rotation from the inner frame to the outer.
    t_mm : ndarray, shape (..., 3), mm
        Origin of the inner frame seen from the outer.

    Examples
    --------
    >>> p = Pose(np.eye(3), [1.0, 2.0, 3.0])
    >>> p.apply([0.5, 0.0, 0.0]).tolist()
    [1.5, 2.0, 3.0]
    >>> (p @ p.inverse()).t_mm.tolist()
    [0.0, 0.0, 0.0]
    """

    R: FloatArray
    t_mm: FloatArray

    def __post_init__(self) -> None:
        R = as_float_array("R", self.R, (..., 3, 3))
        t_mm = as_float_array("t_mm", self.t_mm, (..., 3))
        if R.shape[:-2] != t_mm.shape[:-1]:
            raise ShapeError(f"pose has {R.shape[:-2]} rotations but {t_mm.shape[:-1]} positions")
        whole = R[np.isfinite(R).all(axis=(-2, -1))].reshape(-1, 3, 3)  # NaN means "no pose": let it pass
        if whole.size:
            error = np.abs(whole @ np.swapaxes(whole, -1, -2) - np.eye(3)).max()
            if error > 1e-6:
                raise ShapeError(f"rotation is not orthonormal: off by {error:.2g}")
            if np.linalg.det(whole).min() < 0:
                raise ShapeError("rotation mirrors: its determinant is -1")
        object.__setattr__(self, "R", R)
        object.__setattr__(self, "t_mm", t_mm)

    def apply(self, points_mm: ArrayLike) -> FloatArray:
        """Return points, shape (..., 3), mm, in the outer frame; one pose broadcasts over points."""
        p = as_float_array("points_mm", points_mm, (..., 3))
        return np.asarray(np.einsum("...ij,...j->...i", self.R, p) + self.t_mm)

    def inverse(self) -> "Pose":
        """Return the pose of the outer frame in the inner."""
        Rt = np.swapaxes(self.R, -1, -2)
        return Pose(Rt, -np.einsum("...ij,...j->...i", Rt, self.t_mm))

    def __matmul__(self, other: "Pose") -> "Pose":
        return Pose(self.R @ other.R, self.apply(other.t_mm))
