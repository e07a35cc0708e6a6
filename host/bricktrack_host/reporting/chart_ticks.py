"""Where the numbers of an axis stand, and how they are written."""

from dataclasses import dataclass
from math import ceil, floor, log10

import numpy as np

from bricktrack_common.arrays import FloatArray

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_MINUS = "−"
_STEPS = ((1.0, 0), (2.0, 0), (2.5, 1), (5.0, 0), (10.0, -1), (20.0, -1), (25.0, 0))
"""Lengths of a step, and how many digits more than the power of ten its multiples need."""


@dataclass(frozen=True, slots=True, eq=False)
class Ticks:
    """Values of an axis that are marked, and their words."""

    values: FloatArray
    words: list[str]


def linear_ticks(low: float, high: float, *, at_most: int) -> Ticks:
    """Return round values between two limits: steps of 1, 2, 2.5 or 5 times a power of ten.

    Examples
    --------
    >>> linear_ticks(-0.1, 1.04, at_most=5).words
    ['0.00', '0.25', '0.50', '0.75', '1.00']
    >>> linear_ticks(0, 3000, at_most=4).words
    ['0', '1000', '2000', '3000']
    """
    rough = (high - low) / max(at_most - 1, 1)
    power = 10.0 ** floor(log10(rough))
    steps = [(factor * power, n_digits) for factor, n_digits in _STEPS]
    chosen = (s for s in steps if floor(high / s[0] + 1e-9) - ceil(low / s[0] - 1e-9) < at_most)
    step, n_digits = next(chosen, steps[-1])
    digits = max(n_digits - round(log10(power)), 0)
    values = np.array([i * step for i in range(ceil(low / step - 1e-9), floor(high / step + 1e-9) + 1)])
    return Ticks(values, [_number(v, digits) for v in values.tolist()])


def log_ticks(low: float, high: float, *, at_most: int) -> Ticks:
    """Return powers of ten between two positive limits, every so many; with 2 and 5 where they are few.

    Examples
    --------
    >>> log_ticks(2e-3, 30, at_most=5).words
    ['10⁻²', '10⁻¹', '10⁰', '10¹']
    >>> log_ticks(0.3, 4.0, at_most=5).words
    ['0.5', '1', '2']
    """
    first, last = ceil(log10(low) - 1e-9), floor(log10(high) + 1e-9)
    if last - first < 1:
        values = np.array(
            [m * 10.0**p for p in range(first - 1, last + 1) for m in (1, 2, 5) if low <= m * 10.0**p <= high]
        )
        return Ticks(values, [f"{v:.6g}" for v in values.tolist()])
    every = ceil((last - first + 1) / at_most)
    powers = range(first, last + 1, every)
    return Ticks(
        np.array([10.0**p for p in powers]), ["10" + str(p).translate(_SUPERSCRIPTS) for p in powers]
    )


def _number(value: float, digits: int) -> str:
    words = f"{value:.{digits}f}"
    return words.replace("-", _MINUS) if float(words) else words.removeprefix("-")
