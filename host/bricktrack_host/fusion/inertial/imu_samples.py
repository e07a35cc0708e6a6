"""Inertial samples that can be used, as clean as they can be made, and how rough they are.

"Roughness" is what a sample differs from the polynomial through its neighbours: noise, or motion faster than
the samples can follow.
"""

from dataclasses import dataclass
from math import comb

import numpy as np
from scipy.ndimage import maximum_filter1d

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray, as_float_array
from bricktrack_common.errors import ShapeError
from bricktrack_common.imu_records import UNUSABLE, ImuFlag
from bricktrack_host.fusion.inertial.running_median import running_median
from bricktrack_host.fusion.inertial.vibration import mend_vibration
from bricktrack_host.tracks import ImuTrack

MIN_SAMPLES = 20
BRIDGE_PERIODS = 3.5
"""Up to here the cubic may bridge a gap; beyond, a fill or a straight line."""
# sd of (sample - polynomial through eight neighbours) over sd of one sample, white noise
_PREDICTION_GAIN = comb(16, 8) ** 0.5 / comb(8, 4)
_STEADY_SAMPLES = 25
_IMPACT_SIGMA = 5.0
_VIBRATION_MPS2 = 0.3  # of the median sample off its neighbours: a steady vibration, which can be predicted
_CLIP_SHARE = 0.999  # of the range
_NEARLY_CLIPPED = 0.98  # filters inside the chip round a short clipped peak off a little


def seconds_since(t_ns: IntArray, epoch_ns: int) -> FloatArray:
    """Return int64 ns as float seconds after an epoch: subtracted first, so that no digit is lost."""
    return np.asarray((t_ns - epoch_ns) * 1e-9, dtype=np.float64)


def usable_samples(imu: ImuTrack) -> BoolArray:
    """Return which samples are whole and new."""
    bad = UNUSABLE | ImuFlag.REPEAT  # a repeat is an old measurement under a new stamp
    whole = np.isfinite(imu.acc_mps2).all(axis=1) & np.isfinite(imu.gyro_radps).all(axis=1)
    return np.asarray(whole & ((imu.flags & int(bad)) == 0))


def roughness(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return what of a signal is faster than its samples: the steady part, and single impacts.

    Parameters
    ----------
    values : ndarray, shape (n, 3), n >= 9

    Returns
    -------
    steady : ndarray, shape (n,), unit of ``values``
        As the sd of one sample of white noise: from how far samples are off the polynomial through their
        eight neighbours, by the median over a quarter second at 100 Hz, so that an impact does not count; the
        greatest of the axes. A motion of a fifth of the sample rate gives 3 % of its amplitude, about what
        the spline loses of it.
    impact : ndarray, shape (n,), unit of ``values``
        Height of a pulse over the same polynomial, where it stands out of what is usual there, at its sample
        and the two beside it; else 0.
    """
    v = as_float_array("values", values, (None, 3))
    off = _off_neighbours(v, 4)
    usual = _usual(off)
    # A pulse pulls its neighbours' polynomials as well: only the peak counts.
    peak = off >= 0.9 * maximum_filter1d(off, 9, axis=0, mode="nearest")
    impact = np.where(peak & (off > _IMPACT_SIGMA * usual), off, 0.0).max(axis=1)
    return _steady(usual), np.asarray(maximum_filter1d(impact, 3, mode="nearest"))


def is_vibrating(acc_mps2: FloatArray) -> bool:
    """Return whether specific force, shape (n, 3), holds a steady vibration: most of it is rough."""
    return bool(np.median(_steady(_usual(_off_neighbours(acc_mps2, 4)))) > _VIBRATION_MPS2)


def _off_neighbours(values: FloatArray, n_side: int) -> FloatArray:
    """Return the distance of samples from the polynomial through ``n_side`` neighbours on each side."""
    off = np.abs(np.diff(values, 2 * n_side, axis=0)) / comb(2 * n_side, n_side)
    return np.pad(off, ((n_side, n_side), (0, 0)), mode="edge")


def _usual(off: FloatArray) -> FloatArray:
    """Return the sd by the running median of absolute values."""
    return running_median(off, _STEADY_SAMPLES) / 0.6745


def _steady(usual: FloatArray) -> FloatArray:
    """Return the steady roughness, shape (n,), of what samples usually are off their eight neighbours."""
    return np.asarray(usual.max(axis=1) / _PREDICTION_GAIN)


def _bridge_clipped(t_s: FloatArray, acc: FloatArray, limit: float) -> tuple[FloatArray, FloatArray]:
    """Return samples with clipped peaks completed by the cubic of the others, and how unsure they are.

    A sample a little below the limit was clipped only if those around it lead beyond the limit; else it is a
    measurement like any other.
    """
    done, sd = acc.copy(), np.zeros(len(acc))
    for axis in range(3):
        size = np.abs(acc[:, axis])
        near = np.flatnonzero(size >= _NEARLY_CLIPPED * limit)
        if not near.size:
            continue
        others = np.delete(np.arange(len(acc)), near)
        if len(others) < 4:
            sd[near] = limit
            continue
        sign = np.sign(acc[near, axis])
        from scipy.interpolate import CubicSpline  # which takes long to load, and few runs are clipped

        bridge = sign * CubicSpline(t_s[others], acc[others, axis])(t_s[near])
        is_clipped = (size[near] >= _CLIP_SHARE * limit) | (bridge > limit)
        clipped, sign, bridge = near[is_clipped], sign[is_clipped], bridge[is_clipped]
        # The truth lies beyond the limit; a cubic over a long clipped stretch can fly off, so it is bounded.
        excess = np.clip(bridge - limit, 0.0, limit)
        done[clipped, axis] = sign * (limit + excess)
        sd[clipped] = np.maximum(sd[clipped], 0.1 * limit + 0.5 * excess)
    return done, np.asarray(maximum_filter1d(sd, 3, mode="nearest"))


def bridge_error(values: FloatArray) -> FloatArray:
    """Return the usual error of the cubic where one sample is missing, shape (n,), unit of ``values``."""
    return np.asarray(_usual(_off_neighbours(values, 2)).max(axis=1))


def fill_instants(before_s: float, after_s: float, period_s: float) -> FloatArray:
    """Return the even instants, a sample period or less apart, between the samples beside a gap."""
    n_steps = int(np.ceil((after_s - before_s) / period_s))
    return np.asarray(before_s + np.arange(1, n_steps) / n_steps * (after_s - before_s))


@dataclass(frozen=True, slots=True, eq=False)
class Fill:
    """What stands for the samples in long gaps, see `gap_fill`.

    Attributes
    ----------
    t_s : ndarray, shape (m,)
        Rising, all within the gaps.
    gyro_radps, acc_mps2 : ndarray, shape (m, 3)
    spans_s : ndarray, shape (n_gaps, 2)
        From the last sample before to the first after each gap that is filled.
    gyro_density, acc_density : float, rad^2/s and m^2/s^3
        Of their error as white noise.
    """

    t_s: FloatArray
    gyro_radps: FloatArray
    acc_mps2: FloatArray
    spans_s: FloatArray
    gyro_density: float
    acc_density: float

    def covers(self, t_s: FloatArray) -> BoolArray:
        """Return which instants lie in a gap that is filled."""
        i = np.searchsorted(self.spans_s[:, 0], t_s, side="left") - 1
        return np.asarray((i >= 0) & (t_s < self.spans_s[np.maximum(i, 0), 1]))


@dataclass(frozen=True, slots=True, eq=False)
class CleanSamples:
    """The samples of a run that can be used, with clipped peaks and broken vibrations mended.

    Attributes
    ----------
    epoch_ns : int
        Zero of the seconds below, on the samples' clock.
    t_s : ndarray, shape (n,)
    gyro_radps, acc_mps2 : ndarray, shape (n, 3)
        Clipped accelerations are completed by the cubic of their neighbours.
    clip_sd_mps2 : ndarray, shape (n,)
        Above zero where a sample was clipped or stands beside one.
    filled_sd_mps2 : ndarray, shape (n,)
        Above zero where samples that broke a vibration were filled.
    fill : Fill or None
        What stands for those missing in long gaps.
    t_sd_s : ndarray, shape (n,), or None
        How unsure each stamp is by itself.
    """

    epoch_ns: int
    t_s: FloatArray
    gyro_radps: FloatArray
    acc_mps2: FloatArray
    clip_sd_mps2: FloatArray
    filled_sd_mps2: FloatArray
    fill: Fill | None = None
    t_sd_s: FloatArray | None = None


def clean_samples(imu: ImuTrack, *, mend: bool = True) -> CleanSamples:
    """Return what of a track can be used; without samples that are NaN, gaps or repeats.

    ``mend``: whether samples that break a steady vibration are filled.

    Raises
    ------
    ShapeError
        If fewer than `MIN_SAMPLES` samples can be used, or their stamps do not increase.
    """
    as_float_array("acc_mps2", imu.acc_mps2, (len(imu.t_ns), 3))
    as_float_array("gyro_radps", imu.gyro_radps, (len(imu.t_ns), 3))
    use = usable_samples(imu)
    if use.sum() < MIN_SAMPLES:
        raise ShapeError(
            f"only {use.sum()} of {use.size} inertial samples are whole; at least {MIN_SAMPLES} are "
            "needed. Process the run with the camera alone."
        )
    t_ns = imu.t_ns[use]
    if (np.diff(t_ns) <= 0).any():
        i = int(np.argmax(np.diff(t_ns) <= 0))
        raise ShapeError(
            f"inertial stamps do not increase: {t_ns[i]} ns is followed by {t_ns[i + 1]} ns; sort the samples"
        )
    epoch_ns = int(t_ns[0])
    t_s = seconds_since(t_ns, epoch_ns)
    clip_limit = imu.acc_range_mps2 if imu.acc_range_mps2 > 0 else np.inf
    acc, clip_sd = _bridge_clipped(t_s, imu.acc_mps2[use], clip_limit)
    gyro, filled_sd = imu.gyro_radps[use], np.zeros(len(t_s))
    if mend and is_vibrating(acc):
        mended = mend_vibration(gyro, acc, roughness(acc)[0])
        gyro, acc, filled_sd = mended.gyro_radps, mended.acc_mps2, mended.acc_sd_mps2
    t_sd_s = None if imu.t_sd_s is None else imu.t_sd_s[use]
    return CleanSamples(epoch_ns, t_s, gyro, acc, clip_sd, filled_sd, t_sd_s=t_sd_s)
