"""The phase of a steady vibration in inertial samples, and the instants at which it jumps.

A sensor on a vibrating mount measures by a clock of its own inside, and is read by another. A vibration
faster than half the rate of either is folded down; what is left between the clocks shows as jumps of its
phase, as regular as the beat of the two. Sampling adds nothing but copies of a vibration at fixed distances
in frequency, and pulses where its phase jumps: both are known up to a factor once the phase is.
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import FloatArray
from bricktrack_host.compiled import compiled
from bricktrack_host.fusion.inertial.vibration import interpolation_error, prediction_coefficients

ComplexArray = NDArray[np.complex128]
_Number = TypeVar("_Number", np.float64, np.complex128)

_LEAST_HZ = 15.0  # below, bricks move
_HALF_WIDTH_HZ = 1.2  # by which a motor's speed wanders and mounts sway, and no neighbouring copy comes in
_HALF_TAPS = 50  # of a low-pass: half a second at 100 Hz
_ORDER = 24
_FEWEST = 4 * _HALF_TAPS
_SHORTEST_BEAT = 12.0  # samples: below, what is between two jumps is no steady vibration
_FEWEST_JUMPS = 4
_BEAT_CAP = 4.0  # what one sample can say, over what the upper quarter of samples say: impacts are no beat
_BEAT_SIGMA = 8.0  # chance stays below 6 over all beats tried


@dataclass(frozen=True, slots=True, eq=False)
class VibrationPhase:
    """The phase of a vibration that all axes share.

    Attributes
    ----------
    frequency_hz : float
        As it appears in the samples, below half their rate.
    t_s : ndarray, shape (n,)
    slow : ndarray of complex, shape (n,)
        ``exp(i phase)`` at the samples, less the phase of a tone at ``frequency_hz``.
    """

    frequency_hz: float
    t_s: FloatArray
    slow: ComplexArray

    def at(self, t_s: FloatArray, *, distance_hz: float = 0.0) -> ComplexArray:
        """Return ``exp(i phase)`` of the vibration, or of a copy at a distance in frequency."""
        slow = np.interp(t_s, self.t_s, self.slow.real) + 1j * np.interp(t_s, self.t_s, self.slow.imag)
        return np.asarray(slow * np.exp(2j * np.pi * (self.frequency_hz + distance_hz) * t_s))


def vibration_phase(t_s: FloatArray, acc_mps2: FloatArray) -> VibrationPhase | None:
    """Return the phase of the strongest vibration above 15 Hz, or None where samples are too few.

    Parameters
    ----------
    t_s : ndarray, shape (n,)
        At even steps, but for a few missing.
    acc_mps2 : ndarray, shape (n, 3)
    """
    n = len(t_s)
    rate_hz = 1 / float(np.median(np.diff(t_s)))
    if n < _FEWEST or rate_hz < 3 * _LEAST_HZ:
        return None
    acc = acc_mps2 - acc_mps2.mean(axis=0)
    power = (np.abs(np.fft.rfft(acc * np.hanning(n)[:, None], axis=0)) ** 2).sum(axis=1)
    hz = np.fft.rfftfreq(n, 1 / rate_hz)
    frequency_hz = float(hz[np.argmax(np.where(hz > _LEAST_HZ, power, 0.0))])
    turned = np.asarray(acc * np.exp(-2j * np.pi * frequency_hz * t_s)[:, None])
    slow = low_pass(turned, _HALF_WIDTH_HZ, rate_hz=rate_hz)
    shared = np.linalg.svd(slow, full_matrices=False)[0][:, 0]
    return VibrationPhase(frequency_hz, t_s, shared / np.maximum(np.abs(shared), 1e-12))


def low_pass(values: NDArray[_Number], cut_hz: float, *, rate_hz: float) -> NDArray[_Number]:
    """Return what of samples, shape (n, d), is slower than a frequency; none of it comes late.

    By a windowed sinc of half a second at 100 Hz; at both ends the samples are mirrored. n is above 50.
    """
    # Written out: of SciPy, the signals take longest to load.
    taps = np.sinc(2 * cut_hz / rate_hz * np.arange(-_HALF_TAPS, _HALF_TAPS + 1))
    taps *= np.hamming(len(taps))
    padded = np.pad(values, ((_HALF_TAPS, _HALF_TAPS), (0, 0)), mode="reflect")
    return np.stack([np.convolve(axis, taps / taps.sum(), "valid") for axis in padded.T], axis=1)


def phase_jumps(acc_mps2: FloatArray) -> tuple[float, float] | None:
    """Return the regular beat at which a vibration jumps: samples from jump to jump, and the place of one.

    A sample at a jump is off what those on both sides predict. One alone hardly stands out; at the places of
    a beat they do together. None where there is no beat beyond chance.

    Parameters
    ----------
    acc_mps2 : ndarray, shape (n, 3)
        At even steps, but for a few missing.
    """
    n = len(acc_mps2)
    if n < _FEWEST:
        return None
    chi2 = np.zeros(n)
    for values in (acc_mps2 - acc_mps2.mean(axis=0)).T:
        filter_ = prediction_coefficients(values, np.ones(n, dtype=np.bool_), _ORDER)
        off = interpolation_error(values, filter_)
        chi2 += (off / max(float(np.median(np.abs(off[_ORDER:-_ORDER]))), 1e-12)) ** 2
    off = np.sqrt(np.convolve(chi2, np.ones(3), "same"))
    off -= np.median(off)
    off = np.minimum(off, _BEAT_CAP * float(np.percentile(np.abs(off), 75)))
    off -= off.mean()
    off /= max(float(off.std()), 1e-12)
    # The last jump moves by a sample from each beat to the next: of the nearest it is half a sample off.
    steps = np.log(n / _FEWEST_JUMPS / _SHORTEST_BEAT) / np.log1p(1 / n)
    beats = _SHORTEST_BEAT * np.exp(np.arange(int(steps)) * np.log1p(1 / n))
    sigma, beat, place = _likeliest_beat(off, beats)
    if sigma < _BEAT_SIGMA:
        return None
    finer = beat * (1 + np.linspace(-1, 1, 21) / n)
    places = place + np.linspace(-1.5, 1.5, 31)

    def strength(beat: float, place: float) -> float:
        at = np.arange(place % beat, n - 1, beat)
        return float(np.interp(at, np.arange(n), off).sum() / np.sqrt(len(at)))

    _, beat, place = max((strength(b, p), b, p) for b in finer for p in places)
    return float(beat), float(place % beat)


@compiled
def _likeliest_beat(off: FloatArray, beats: FloatArray) -> tuple[float, float, float]:
    """Return the beat whose places hold the greatest sum: that in sd, samples a beat, and the first place."""
    n = len(off)
    best, best_beat, best_place = 0.0, beats[0], 0.0
    sums, counts = np.zeros(n), np.zeros(n)
    for beat in beats:
        n_places = int(np.ceil(beat))
        sums[:n_places], counts[:n_places] = 0.0, 0.0
        since = 0.0
        for i in range(n):
            sums[int(since)] += off[i]
            counts[int(since)] += 1.0
            since += 1.0
            if since >= beat:
                since -= beat
        for place in range(n_places):
            sigma = sums[place] / np.sqrt(max(counts[place], 1.0))
            if sigma > best:
                best, best_beat, best_place = sigma, beat, place + 0.5
    return best, best_beat, best_place
