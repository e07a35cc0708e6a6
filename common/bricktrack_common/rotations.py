"""Rotations: rotation vectors, matrices, unit quaternions and angles, all batched.

Matrices named ``R_a_b`` take coordinates in frame b to frame a. Quaternions are w, x, y, z; q and -q are the
same rotation, and `continuous_quaternions` picks the sign that does not jump. Angles are intrinsic XYZ:
``R = Rx(a) @ Ry(b) @ Rz(c)``.
"""

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import FloatArray, as_float_array

_SMALL_RAD = 1e-4  # below this, series to fourth order are exact to double precision


def skew(v: ArrayLike) -> FloatArray:
    """Return the matrix of the cross product, ``skew(v) @ w == cross(v, w)``, shape (..., 3, 3)."""
    v = as_float_array("v", v, (..., 3))
    m = np.zeros((*v.shape[:-1], 3, 3))
    m[..., 0, 1], m[..., 0, 2], m[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    m[..., 1, 0], m[..., 2, 0], m[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return m


def matrix_from_rvec(rvec_rad: ArrayLike) -> FloatArray:
    """Return the rotation matrices of rotation vectors (Rodrigues' formula).

    Parameters
    ----------
    rvec_rad : array_like, shape (..., 3), rad

    Returns
    -------
    R : ndarray, shape (..., 3, 3)

    Examples
    --------
    >>> matrix_from_rvec([0, 0, np.pi / 2]).round(12) + 0.0
    array([[ 0., -1.,  0.],
           [ 1.,  0.,  0.],
           [ 0.,  0.,  1.]])
    """
    r = as_float_array("rvec_rad", rvec_rad, (..., 3))
    angle2 = np.sum(r * r, axis=-1)[..., None, None]
    angle = np.sqrt(angle2)
    small = angle < _SMALL_RAD
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1 - angle2 / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle2 / 24, (1 - np.cos(safe)) / safe**2)
    k = skew(r)
    return np.asarray(np.eye(3) + a * k + b * (k @ k))


def quaternion_from_matrix(R: ArrayLike) -> FloatArray:
    """Return unit quaternions w, x, y, z with w >= 0 (Bar-Itzhack's largest-pivot form).

    Parameters
    ----------
    R : array_like, shape (..., 3, 3)

    Returns
    -------
    q_wxyz : ndarray, shape (..., 4)
    """
    R = as_float_array("R", R, (..., 3, 3))
    m00, m11, m22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    # Four times the outer product of the quaternion with itself; take the best-conditioned row.
    K = np.empty((*R.shape[:-2], 4, 4))
    K[..., 0, 0] = 1 + m00 + m11 + m22
    K[..., 1, 1] = 1 + m00 - m11 - m22
    K[..., 2, 2] = 1 - m00 + m11 - m22
    K[..., 3, 3] = 1 - m00 - m11 + m22
    K[..., 0, 1] = K[..., 1, 0] = R[..., 2, 1] - R[..., 1, 2]
    K[..., 0, 2] = K[..., 2, 0] = R[..., 0, 2] - R[..., 2, 0]
    K[..., 0, 3] = K[..., 3, 0] = R[..., 1, 0] - R[..., 0, 1]
    K[..., 1, 2] = K[..., 2, 1] = R[..., 0, 1] + R[..., 1, 0]
    K[..., 1, 3] = K[..., 3, 1] = R[..., 0, 2] + R[..., 2, 0]
    K[..., 2, 3] = K[..., 3, 2] = R[..., 1, 2] + R[..., 2, 1]
    best = np.argmax(np.diagonal(K, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(K, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., :1] < 0, -q, q))


def matrix_from_quaternion(q_wxyz: ArrayLike) -> FloatArray:
    """Return rotation matrices of quaternions w, x, y, z; the norm is divided out.

    Examples
    --------
    >>> matrix_from_quaternion([1, 0, 0, 0]).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    q = as_float_array("q_wxyz", q_wxyz, (..., 4))
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, v = q[..., 0, None, None], q[..., 1:]
    k = skew(v)
    return np.asarray(np.eye(3) + 2 * w * k + 2 * (k @ k))


def rvec_from_matrix(R: ArrayLike) -> FloatArray:
    """Return the rotation vectors of rotation matrices, angle within [0, pi].

    Parameters
    ----------
    R : array_like, shape (..., 3, 3)

    Returns
    -------
    rvec_rad : ndarray, shape (..., 3), rad
    """
    q = quaternion_from_matrix(R)
    v = q[..., 1:]
    norm = np.linalg.norm(v, axis=-1, keepdims=True)
    angle = 2 * np.arctan2(norm, q[..., :1])
    return np.asarray(v * np.where(norm < 1e-12, 2.0, angle / np.where(norm < 1e-12, 1.0, norm)))


def continuous_quaternions(q_wxyz: ArrayLike) -> FloatArray:
    """Return a sequence of quaternions with signs chosen so that it does not jump.

    Parameters
    ----------
    q_wxyz : array_like, shape (n, 4)
        In time order. Rows with NaN (no pose) are kept and passed over.
    """
    q = as_float_array("q_wxyz", q_wxyz, (None, 4)).copy()
    valid = np.flatnonzero(np.isfinite(q).all(axis=1))
    if valid.size > 1:
        dots = np.einsum("ij,ij->i", q[valid[1:]], q[valid[:-1]])
        q[valid[1:]] *= np.cumprod(np.where(dots < 0, -1.0, 1.0))[:, None]
    return q


def angles_xyz_from_matrix(R: ArrayLike) -> FloatArray:
    """Return intrinsic XYZ angles a, b, c with ``R = Rx(a) @ Ry(b) @ Rz(c)``, shape (..., 3), rad.

    At ``b = +-pi/2`` only a +- c is defined; c is then returned as it falls out of `arctan2`.
    """
    R = as_float_array("R", R, (..., 3, 3))
    a = np.arctan2(-R[..., 1, 2], R[..., 2, 2])
    b = np.arctan2(R[..., 0, 2], np.hypot(R[..., 0, 0], R[..., 0, 1]))
    c = np.arctan2(-R[..., 0, 1], R[..., 0, 0])
    return np.stack([a, b, c], axis=-1)


def matrix_from_angles_xyz(angles_rad: ArrayLike) -> FloatArray:
    """Return ``Rx(a) @ Ry(b) @ Rz(c)`` for intrinsic XYZ angles, shape (..., 3, 3)."""
    angles = as_float_array("angles_rad", angles_rad, (..., 3))
    x, y, z = (matrix_from_rvec(angles[..., i, None] * np.eye(3)[i]) for i in range(3))
    return np.asarray(x @ y @ z)


def nearest_rotation(M: ArrayLike) -> FloatArray:
    """Return the proper rotation nearest to each matrix in the Frobenius norm (by SVD)."""
    M = as_float_array("M", M, (..., 3, 3))
    U, _, Vt = np.linalg.svd(M)
    det = np.linalg.det(U @ Vt)
    U = U.copy()
    U[..., :, 2] *= np.where(det < 0, -1.0, 1.0)[..., None]
    return np.asarray(U @ Vt)


def right_jacobian(rvec_rad: ArrayLike) -> FloatArray:
    """Return Jr with ``Exp(r + d) ~= Exp(r) @ Exp(Jr @ d)``, shape (..., 3, 3)."""
    r = as_float_array("rvec_rad", rvec_rad, (..., 3))
    angle2 = np.sum(r * r, axis=-1)[..., None, None]
    angle = np.sqrt(angle2)
    small = angle < _SMALL_RAD
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 0.5 - angle2 / 24, (1 - np.cos(safe)) / safe**2)
    b = np.where(small, 1 / 6 - angle2 / 120, (safe - np.sin(safe)) / safe**3)
    k = skew(r)
    return np.asarray(np.eye(3) - a * k + b * (k @ k))
