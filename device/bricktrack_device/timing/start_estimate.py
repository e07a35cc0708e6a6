"""How long a camera takes to start, estimated from counts of frames: the source paper's eqs 28 to 30.

A recording is stopped ``window`` after the command that started it and holds n frames of period T. What is
missing, ``window - n T``, is the initialisation time, but for the fraction of a period between the last
frame and the stop. That fraction is anything between 0 and T: on average T/2, which is taken off here, with
a variance of T^2 / 12, which Sheppard's correction takes off the variance over the runs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bricktrack_common.errors import ShapeError


@dataclass(frozen=True, slots=True)
class StartEstimate:
    """Mean and spread of an initialisation time over runs, ms.

    Attributes
    ----------
    n_runs : int
    mean_ms : float
    sd_ms : float
        As counted, the counting's own scatter included.
    sd_corrected_ms : float
        Without it: ``sqrt(sd^2 - T^2 / 12)``; 0 where the scatter is less than that of counting.
    mean_standard_error_ms : float
    """

    n_runs: int
    mean_ms: float
    sd_ms: float
    sd_corrected_ms: float
    mean_standard_error_ms: float


def initialisation_ms(window_ms: float, n_frames: int, period_ms: float) -> float:
    """Return one run's initialisation time from its count of frames, ms.

    Examples
    --------
    >>> round(initialisation_ms(1000.0, 22, 1000 / 30), 9)
    283.333333333
    """
    return window_ms - (n_frames - 0.5) * period_ms


def estimate_start(initialisations_ms: Sequence[float], period_ms: float) -> StartEstimate:
    """Return mean and spread of some runs' initialisation times.

    Parameters
    ----------
    initialisations_ms : sequence of float
        As from `initialisation_ms`, two or more.
    period_ms : float
        What the counts are quantised by; 0 for times that were measured directly.

    Raises
    ------
    ShapeError
        If there are fewer than two, or a value is not finite.
    """
    values = np.asarray(initialisations_ms, dtype=np.float64)
    if values.ndim != 1 or values.size < 2 or not np.isfinite(values).all():
        raise ShapeError(f"initialisation times {values.tolist()}; expected two or more finite values, ms")
    variance = float(np.var(values, ddof=1))
    return StartEstimate(
        n_runs=values.size,
        mean_ms=float(values.mean()),
        sd_ms=variance**0.5,
        sd_corrected_ms=max(0.0, variance - period_ms**2 / 12) ** 0.5,
        mean_standard_error_ms=(variance / values.size) ** 0.5,
    )
