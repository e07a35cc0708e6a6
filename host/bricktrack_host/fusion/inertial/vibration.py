"""Samples that break a steady vibration: found and filled by linear prediction from those around them.

A sensor on a vibrating mount may lose some milliseconds on its way to the reader and repeat what it had. In a
smooth signal that costs little. Within a vibration of several m/s^2 it leaves a pulse whose integral drives
the position off by a millimetre in half a second, and which no measure of roughness sees: every sample is
rough. But a vibration can be predicted, from both sides.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import toeplitz
from scipy.ndimage import maximum_filter1d

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray, as_float_array

_ORDER = 24  # samples that a prediction looks back, and ahead: a quarter second at 100 Hz
_FEWEST = 10 * _ORDER  # samples, for a model of their own
_SIDE = 1  # a fault and the low-pass behind it touch three samples, more or less:
_REACH = 3  # within so many samples of its middle
_WIDTHS = (1, 2, 3, 4, 5)
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
    products = windows.T @ windows
    back, ahead = slice(order - 1, None, -1), slice(1, None)  # a window's past, and its future
    normal = products[back, back] + products[ahead, ahead]
    normal += np.eye(order) * (1e-9 * np.trace(normal) / order + _LEAST_NOISE)
    wanted = products[back, order] + products[ahead, 0]
    return np.concatenate([[1.0], -np.linalg.solve(normal, wanted)])


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
        known = np.convolve(done[at[0] - order : at[-1] + 1], filter_, "valid")
        behind = at[:, None] - hole
        A = np.where((behind >= 0) & (behind <= order), filter_[np.clip(behind, 0, order)], 0.0)
        curve = np.linalg.inv(A.T @ A)
        done[hole] = -curve @ (A.T @ known)
        sd[hole] = noise * np.sqrt(np.diag(curve))
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
        The steady part, see `imu_samples.roughness`.
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
    middles: list[int] = []
    filters, noise = np.zeros((len(samples), _ORDER + 1)), np.zeros(len(samples))
    for _ in range(_ROUNDS):
        chi2 = np.zeros(n)
        for c, values in enumerate(samples):
            filters[c] = prediction_coefficients(values, ~breaks, _ORDER)
            smooth = fill(values, breaks, filters[c])[0] if breaks.any() else values
            off = interpolation_error(smooth, filters[c])
            usual = max(float(np.median(np.abs(off[_ORDER:-_ORDER]))) / 0.6745, _LEAST_NOISE)
            noise[c] = usual * float(np.linalg.norm(filters[c]))
            chi2 += (off / usual) ** 2
        found = _peaks(np.convolve(chi2, np.ones(2 * _SIDE + 1), mode="same"))
        if not found.size:
            break
        middles += found.tolist()
        breaks |= _within(found, _SIDE, n)
    if not middles:
        return nothing
    breaks = _placed(samples, breaks, middles, filters, noise)
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


def _peaks(chi2: FloatArray) -> IntArray:
    """Return the samples whose chi-square is beyond belief, and greater than all that it reaches."""
    greatest = chi2 >= maximum_filter1d(chi2, 2 * _ORDER + 1, mode="nearest")
    return np.flatnonzero(greatest & (chi2 > _BREAK_CHI2))


def _within(middles: IntArray, n_side: int, n: int) -> BoolArray:
    """Return which of n samples lie within so many of one of those in the middle."""
    found = np.zeros(n, dtype=np.bool_)
    found[np.clip(middles[:, None] + np.arange(-n_side, n_side + 1), 0, n - 1)] = True
    return found


def _placed(
    samples: FloatArray, breaks: BoolArray, middles: list[int], filters: FloatArray, noise: FloatArray
) -> BoolArray:
    """Return which samples are lost: about each middle those that it is likeliest were, beside all others.

    Each hole is the likeliest by the samples around it, of all channels together.

    ``samples``: shape (channels, n), mean zero; ``breaks``: three about each middle; ``filters``, ``noise``:
    of `prediction_coefficients`, shape (channels, order + 1), and the sd of what they leave.
    """
    n = samples.shape[1]
    filled = np.stack([fill(v, breaks, f)[0] for v, f in zip(samples, filters, strict=True)])
    kinds = [_holes(width, filters, noise, samples.std(axis=1)) for width in _WIDTHS]
    placed = np.zeros(n, dtype=np.bool_)
    for middle in middles:
        first, last = middle - _REACH - _ORDER, middle + _REACH + _ORDER
        if first < 0 or last >= n:
            placed |= _within(np.array([middle]), _SIDE, n)
            continue
        own = np.arange(middle - _SIDE, middle + _SIDE + 1)
        near = filled[:, first : last + 1].copy()
        near[:, own - first] = samples[:, own]
        # Half the derivative of the squared prediction errors by each sample that may be lost.
        slopes = [
            np.correlate(np.convolve(v, f, "valid"), f, "valid") for v, f in zip(near, filters, strict=True)
        ]
        start, width = max(kind.likeliest(np.stack(slopes)) for kind in kinds)[1:]
        at = middle - _REACH + start
        placed[at : at + width] = True
    return placed


class _Holes(NamedTuple):
    """What a hole of some width does to the likelihood of all samples but those in it.

    Of the samples in it no more is said than their sd: so a wider hole has to earn what any number more would
    explain.
    """

    width: int
    curve: FloatArray
    """Of the squared errors: half the second derivative, inverted, over their variance; by channel."""
    price: float

    def likeliest(self, slopes: FloatArray) -> tuple[float, int, int]:
        """Return what the likeliest place earns, that place and the width."""
        holes = sliding_window_view(slopes, self.width, axis=1)
        earned = ((holes @ self.curve) * holes).sum(axis=(0, 2))
        start = int(np.argmax(earned))
        return float(earned[start]) - self.price, start, self.width


def _holes(width: int, filters: FloatArray, noise: FloatArray, size: FloatArray) -> _Holes:
    curves = np.stack([toeplitz(np.correlate(f, f, "full")[_ORDER : _ORDER + width]) for f in filters])
    price = np.linalg.slogdet(np.eye(width) + ((size / noise) ** 2)[:, None, None] * curves)[1].sum()
    return _Holes(width, np.linalg.inv(curves) / (noise**2)[:, None, None], float(price))
