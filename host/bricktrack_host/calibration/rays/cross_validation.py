"""How well a ray model predicts dots not fitted to: blocks of them are left out, and predicted."""

from typing import Literal

import msgspec
import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dots.neighbours import median_spacing
from bricktrack_host.calibration.rays.dot_data import Planes
from bricktrack_host.calibration.rays.ray_fit import RayFit
from bricktrack_host.calibration.rays.ray_uncertainty import UncertainRays

ModelKind = Literal["central", "walking-pupil", "two-plane"]

N_FOLDS = 8
BLOCK_STEPS = 2.0
"""Side of the blocks left out, in dot spacings: what lies between the last whole dots and the border."""


class CrossValidatedError(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How well a model predicts dots that it was not fitted to.

    Attributes
    ----------
    model : "central", "walking-pupil" or "two-plane"
    order : int
        Highest degree of the polynomials.
    held : bool
        High degrees are held as the data say, not free.
    rms_um : float, um
        Over the left-out dots of all planes, each as seen by the fit without its block.
    max_um : float, um
    picture_noise_um : float, um
        What the covariance says of the rays over the whole picture, on all planes, root mean square. It grows
        where there are no dots.
    """

    model: ModelKind
    order: int
    held: bool = False
    rms_um: float
    max_um: float
    picture_noise_um: float

    @property
    def expected_um(self) -> float:
        """Error to expect over the whole picture, among dots and beyond; models are chosen by it."""
        return float(np.hypot(self.rms_um, self.picture_noise_um))

    @property
    def name(self) -> str:
        """Model and order in words."""
        return f"{self.model}, {'degrees held to' if self.held else 'order'} {self.order}"


def cross_validate(
    fit: RayFit, model: UncertainRays, planes: Planes, *, kind: ModelKind, held: bool, picture: FloatArray
) -> CrossValidatedError:
    """Return how well a model predicts blocks of dots left out of its fit.

    The blocks are squares of the picture, common to all planes: what one plane loses is not handed over by
    another.

    Parameters
    ----------
    fit : RayFit
    model : UncertainRays
        Of that fit.
    planes : sequence of (float, DotObservations)
        Those fitted, nearest first.
    kind : str
    held : bool
    picture : ndarray, shape (n, 2), px
        Pixels over which the expected error is taken.
    """
    errors = left_out_errors_mm(fit, block_folds(planes))
    distance_um = 1e3 * np.hypot(*errors.T)
    variance = [
        np.mean(np.trace(model.point_covariance_mm2(picture, z), axis1=1, axis2=2)) for z, _ in planes
    ]
    return CrossValidatedError(
        model=kind,
        order=fit.order,
        held=held,
        rms_um=float(np.sqrt(np.mean(distance_um**2))),
        max_um=float(distance_um.max()),
        picture_noise_um=float(1e3 * np.sqrt(np.mean(variance))),
    )


def left_out_errors_mm(fit: RayFit, fold: IntArray) -> FloatArray:
    """Return the errors, shape (n, 2), mm, at dots left out of the fit fold by fold.

    Without fitting again: with H the matrix from whitened data to whitened fit and S a fold, the errors are
    ``(I - H_SS)^-1`` times the residuals. Exact but for what all dots share, which stays that of the fit to
    all: the held variances, the noise, and the curvature by the projection centre.

    Parameters
    ----------
    fit : RayFit
    fold : ndarray of int64, shape (n,)
        Of all planes' dots, nearest plane first.
    """
    A, S = fit.whitened_rows, fit.fitted_covariance
    of_row = np.repeat(fold, 2)
    errors = np.empty(len(A))
    for k in np.unique(fold):
        own = of_row == k
        rest = np.eye(int(np.count_nonzero(own))) - A[own] @ S @ A[own].T
        try:
            errors[own] = np.linalg.solve(rest, fit.whitened_residual[own])
        except np.linalg.LinAlgError as e:
            raise CalibrationError(
                f"{fit.family.name}: too few dots to leave some out; take a lower order or more dots"
            ) from e
    return np.asarray(np.linalg.solve(fit.whitening, errors.reshape(-1, 2, 1))[:, :, 0])


def block_folds(planes: Planes) -> IntArray:
    """Return the fold of each dot, shape (n,): blocks of the picture, neighbours in different folds."""
    spacing_px = median_spacing(planes[0][1].uv_px)
    uv = np.concatenate([dots.uv_px for _, dots in planes])
    block = np.floor(uv / (BLOCK_STEPS * spacing_px)).astype(np.int64)
    return np.asarray((block[:, 0] + 3 * block[:, 1]) % N_FOLDS, dtype=np.int64)
