"""Errors of poses squared over what is believed of them: 6 on the mean where the covariance is honest."""

import numpy as np

from bricktrack_common.arrays import FloatArray

_LEAST_SHARE = 1e-9
"""Of a coordinate's variance, given those before it: below, a covariance is singular but for rounding."""


def normalised_squares(errors: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return squared errors over their covariance, ``e^T C^-1 e``.

    Parameters
    ----------
    errors : ndarray, shape (k, d) or (k, d, n_draws)
        In the units of the covariance, as ``[dtheta rad, dt mm]``.
    covariance : ndarray, shape (k, d, d)

    Returns
    -------
    squares : ndarray, shape (k,) or (k, n_draws)
        Of d degrees of freedom. NaN where an error or its covariance is not known, or the covariance is
        singular.
    """
    e = errors if errors.ndim == 3 else errors[..., None]
    squares = np.full((len(e), e.shape[2]), np.nan)
    sd = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    known = np.flatnonzero((sd > 0).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2)))
    # mm and rad differ by orders of magnitude; correlations do not.
    unit = np.moveaxis(covariance[known] / (sd[known, :, None] * sd[known, None, :]), 0, -1).copy()
    along = np.moveaxis(e[known] / sd[known, :, None], 0, -1).copy()
    regular = np.ones(len(known), dtype=np.bool_)
    total = np.zeros(along.shape[1:])
    # Cholesky's elimination of one coordinate after the other, of all rows at once.
    for j in range(len(unit)):
        regular &= unit[j, j] > _LEAST_SHARE
        root = np.sqrt(np.where(regular, unit[j, j], 1.0))
        column, own = unit[j + 1 :, j] / root, along[j] / root
        total += own**2
        along[j + 1 :] -= column[:, None] * own
        unit[j + 1 :, j + 1 :] -= column[:, None] * column
    squares[known[regular]] = total.T[regular]
    return squares if errors.ndim == 3 else squares[:, 0]
