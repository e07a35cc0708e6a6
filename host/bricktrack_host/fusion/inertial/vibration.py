"""Samples that break a steady vibration: found and filled by linear prediction from those around them.

A sensor on a vibrating mount may lose some milliseconds on its way to the reader and repeat what it had. In a
smooth signal that costs little. Within a vibration of several m/s^2 it leaves a pulse whose integral drives
the position off by a millimetre in half a second, and which no measure of roughness sees: every sample is
rough. But a vibration can be predicted, from both sides.
"""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import maximum_filter1d

from bricktrack_common.arrays import BoolArray, FloatArray, as_float_array

_ORDER = 24  # samples that a prediction looks back, and ahead: a quarter second at 100 Hz
_FEWEST = 10 * _ORDER  # samples, for a model of their own
_SIDE = 1  # a fault and the low-pass behind it touch three samples
_BREAK_CHI2 = (
    200.0  # of three samples of six channels: motion and small impacts reach 150, lost samples 200-2000
)
_MOST_OVER_VIBRATION = 2.5  # a lost sample is off by what the vibration holds, an impact by more
_ROUNDS = 4  # a great break hides those within its reach
_LEAST_NOISE = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Mended:
    """Samples with those filled that break the vibration.

    Attributes
    ----------
    gyro_radps, acc_mps2 : ndarray, shape (n, 3)
    is_filled : ndarray of bool, shape (n,)
    acc_sd_mps2 : ndarray, shape (n,)
        How unsure a filled acceleration is, the greatest of the axes; else 0.
    """

    gyro_radps: FloatArray
    acc_mps2: FloatArray
    is_filled: BoolArray
    acc_sd_mps2: FloatArray


def prediction_coefficients(values: FloatArray, whole: BoolArray, order: int) -> FloatArray:
    """Return the prediction-error filter of a signal, shape (order + 1,), its first coefficient 1.

    Least squares forwards and backwards in time (the modified covariance method: Marple, Digital Spectral
    Analysis, 1987, ch. 8), over the stretches that hold no other sample than ``whole`` ones.
    """
    x = values - values[whole].mean()
    windows = sliding_window_view(x, order + 1)[sliding_window_view(whole, order + 1).all(axis=1)]
    past = np.concatenate([windows[:, -2::-1], windows[:, 1:]])
    now = np.concatenate([windows[:, -1], windows[:, 0]])
    normal = past.T @ past
    normal += np.eye(order) * (1e-9 * np.trace(normal) / order + _LEAST_NOISE)
    return np.concatenate([[1.0], -np.linalg.solve(normal, past.T @ now)])


def interpolation_error(values: FloatArray, filter_: FloatArray) -> FloatArray:
    """Return how far each sample is off what those on both sides predict; zero near the ends."""
    order = len(filter_) - 1
    error = np.convolve(values, filter_)[: len(values)]
    error[:order] = 0.0
    both = np.convolve(error[::-1], filter_)[: len(values)][::-1] / (filter_ @ filter_)
    both[-order:] = 0.0
    return both


def fill(values: FloatArray, missing: BoolArray, filter_: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a signal with its missing samples as they are likeliest beside the others, and their sd.

    The sum of squared prediction errors becomes least (Janssen, Veldhuis and Vries, Adaptive interpolation of
    discrete-time signals that can be modeled as autoregressive processes, 1986).

    Parameters
    ----------
    values : ndarray, shape (n,)
        Mean zero.
    missing : ndarray of bool, shape (n,)
    filter_ : ndarray, shape (order + 1,)
        Of `prediction_coefficients`.
    """
    done, sd = np.where(missing, 0.0, values), np.zeros(len(values))
    order = len(filter_) - 1
    error = np.convolve(done, filter_)[order : len(done)]
    touched = np.convolve(missing, np.ones(order + 1))[order : len(done)] > 0.5
    noise = float(np.median(np.abs(error[~touched]))) / 0.6745 if (~touched).any() else 0.0
    holes = np.flatnonzero(missing)
    for hole in np.split(holes, np.flatnonzero(np.diff(holes) > order) + 1):
        at = np.arange(max(hole[0], order), min(hole[-1] + order + 1, len(done)))
        known = np.array([done[t - order : t + 1] @ filter_[::-1] for t in at])
        behind = at[:, None] - hole
        A = np.where((behind >= 0) & (behind <= order), filter_[np.clip(behind, 0, order)], 0.0)
        inverse = np.linalg.pinv(A)
        done[hole] = -inverse @ known
        sd[hole] = noise * np.linalg.norm(inverse, axis=1)
    return done, sd


def mend_vibration(gyro_radps: FloatArray, acc_mps2: FloatArray, acc_roughness_mps2: FloatArray) -> Mended:
    """Return samples in which those are filled that break a steady vibration.

    All six channels judge together, for what is lost is lost to all. Impacts, which stand out of the
    vibration, stay as they were measured.

    Parameters
    ----------
    gyro_radps, acc_mps2 : ndarray, shape (n, 3)
        At even steps, but for a few missing.
    acc_roughness_mps2 : ndarray, shape (n,)
        The steady part, see `imu_signal.roughness`.
    """
    gyro = as_float_array("gyro_radps", gyro_radps, (None, 3))
    acc = as_float_array("acc_mps2", acc_mps2, (len(gyro), 3))
    n = len(gyro)
    nothing = Mended(gyro, acc, np.zeros(n, dtype=np.bool_), np.zeros(n))
    if n < _FEWEST:
        return nothing
    mean = np.concatenate([gyro, acc], axis=1).mean(axis=0)
    samples = (np.concatenate([gyro, acc], axis=1) - mean).T
    breaks = np.zeros(n, dtype=np.bool_)
    for _ in range(_ROUNDS):
        chi2, filters = np.zeros(n), []
        for values in samples:
            filters.append(prediction_coefficients(values, ~breaks, _ORDER))
            smooth = fill(values, breaks, filters[-1])[0] if breaks.any() else values
            off = interpolation_error(smooth, filters[-1])
            usual = float(np.median(np.abs(off[_ORDER:-_ORDER]))) / 0.6745
            chi2 += (off / max(usual, _LEAST_NOISE)) ** 2
        found = _peaks(np.convolve(chi2, np.ones(2 * _SIDE + 1), mode="same"))
        if not found.any():
            break
        breaks |= found
    if not breaks.any():
        return nothing
    filled, sd = (
        np.stack(parts, axis=1)
        for parts in zip(*(fill(v, breaks, f) for v, f in zip(samples, filters, strict=True)), strict=True)
    )
    at = np.flatnonzero(breaks)
    for stretch in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1):
        off_mps2 = np.abs(filled - samples.T)[stretch, 3:].max()
        if off_mps2 > _MOST_OVER_VIBRATION * acc_roughness_mps2[stretch].max():
            breaks[stretch] = False
    done = np.where(breaks[:, None], filled, samples.T) + mean
    return Mended(done[:, :3], done[:, 3:], breaks, np.where(breaks, sd[:, 3:].max(axis=1), 0.0))


def _peaks(chi2: FloatArray) -> BoolArray:
    """Return the samples about those whose chi-square is beyond belief, and greater than all it reaches."""
    greatest = chi2 >= maximum_filter1d(chi2, 2 * _ORDER + 1, mode="nearest")
    at = np.flatnonzero(greatest & (chi2 > _BREAK_CHI2))
    found = np.zeros(len(chi2), dtype=np.bool_)
    found[np.clip(at[:, None] + np.arange(-_SIDE, _SIDE + 1), 0, len(chi2) - 1)] = True
    return found
