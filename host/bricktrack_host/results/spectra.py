"""Amplitude spectra of motion: how much of it at which frequency."""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.errors import BricktrackError

MIN_SAMPLES = 64
SEGMENT = 512


class SpectrumError(BricktrackError, ValueError):
    """A signal that has no spectrum."""


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """Amplitude spectral densities.

    Attributes
    ----------
    f_hz : ndarray, shape (m,), Hz
        Without 0, where the mean was taken away.
    density : ndarray, shape (m, columns), unit of the signal / sqrt(Hz)
        Its square, summed over the frequencies times their spacing, is the variance of the signal.
    """

    f_hz: FloatArray
    density: FloatArray


def amplitude_spectrum(t_s: FloatArray, values: FloatArray) -> Spectrum:
    """Return the amplitude spectral density of each column (Welch's method, Hann windows, half overlapping).

    Samples that come unevenly are interpolated to their median step.

    Parameters
    ----------
    t_s : ndarray, shape (n,), s, rising
    values : ndarray, shape (n, columns)
        Rows with NaN are bridged by straight lines.

    Raises
    ------
    SpectrumError
        If fewer than 64 rows are known.

    Examples
    --------
    >>> t_s = np.arange(1024) / 100
    >>> spectrum = amplitude_spectrum(t_s, np.sin(2 * np.pi * 6.25 * t_s)[:, None])
    >>> round(float(spectrum.f_hz[np.argmax(spectrum.density)]), 6)
    6.25
    """
    known = np.isfinite(t_s) & np.isfinite(values).all(axis=1)
    n = int(np.count_nonzero(known))
    if n < MIN_SAMPLES:
        raise SpectrumError(f"{n} known samples; a spectrum needs at least {MIN_SAMPLES}")
    t_s, values = t_s[known] - t_s[known][0], values[known]
    step_s = float(np.median(np.diff(t_s)))
    if not step_s > 0:
        raise SpectrumError("the times of a spectrum must rise from sample to sample")
    even_s = np.arange(0, t_s[-1], step_s)
    even = np.stack([np.interp(even_s, t_s, column) for column in values.T], axis=1)
    f_hz, power = power_density(even, step_s, n_segment=min(len(even), SEGMENT))
    return Spectrum(f_hz[1:], np.sqrt(power[1:]))


def power_density(values: FloatArray, step_s: float, *, n_segment: int) -> tuple[FloatArray, FloatArray]:
    """Return frequencies, Hz, and the one-sided power density of each column, its unit squared a Hz.

    Mean over segments that overlap by half, each less its mean, under a Hann window (Welch, 1967). SciPy's
    `signal.welch` gives the same, and takes half a second to load.
    """
    hop = n_segment - n_segment // 2
    segments = np.lib.stride_tricks.sliding_window_view(values, n_segment, axis=0)[::hop]
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(n_segment) / n_segment)
    spectra = np.fft.rfft((segments - segments.mean(axis=-1, keepdims=True)) * window)
    density: FloatArray = np.mean(np.abs(spectra) ** 2, axis=0).T * step_s / np.sum(window**2)
    density[1 : (n_segment + 1) // 2] *= 2  # the negative frequencies; zero and Nyquist's have none
    return np.asarray(np.fft.rfftfreq(n_segment, step_s), dtype=np.float64), density
