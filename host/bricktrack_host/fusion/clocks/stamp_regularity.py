"""How regular the frames' stamps are: steady rate, dropped frames, steps, strays and scatter.

The sensor of a free-running camera keeps its period to parts in a million, and the kernel stamps it to some
tens of microseconds. What is irregular by more came in elsewhere.
"""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from bricktrack_common.arrays import FloatArray, IntArray

MIN_FRAMES = 12
JITTER_NS = 100e3  # at 0.25 m/s 0.025 mm, what a good pose is unsure of anyway
_STEP_NS = 2 * JITTER_NS
_STEP_SIGMA = 6.0
_BESIDE = 5  # intervals on either side that say what is usual there
_MANY_STEPS = 0.05  # of the intervals: then the camera has no steady rate
_WANDER = 2.5  # residual from a straight line in units of the local scatter; 1 where the rate is steady


@dataclass(frozen=True, slots=True)
class StampStep:
    """A place where the interval between two stamps is not a whole number of periods, and stays so.

    Attributes
    ----------
    frame : int
        The first frame after it, from 0.
    interval_ns : float
        Between the stamps of that frame and the one before.
    size_ns : float
        What the interval has more than the nearest whole number of periods.
    """

    frame: int
    interval_ns: float
    size_ns: float


@dataclass(frozen=True, slots=True, eq=False)
class StampRegularity:
    """How regular the stamps of a run are.

    Attributes
    ----------
    is_steady : bool
        Whether there is a steady rate to compare with; without it nothing below is found.
    period_ns : float
        Steady: the fitted period; else the median interval. NaN for fewer than two frames.
    shortest_ns, longest_ns : float
        Interval, dropped frames taken out; NaN as above.
    jitter_ns : float
        Standard deviation of single stamps about the steady rate, steps and strays left out.
    steps : tuple of StampStep
    stray_ns : ndarray, shape (n_frames,)
        How far single stamps lie off where their neighbours lie on; zero for all others.
    """

    is_steady: bool
    period_ns: float
    shortest_ns: float
    longest_ns: float
    jitter_ns: float
    steps: tuple[StampStep, ...]
    stray_ns: FloatArray


def stamp_regularity(stamps_ns: IntArray) -> StampRegularity:
    """Return how regular the frames' stamps are. Dropped frames, whole periods, do not count against them.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (n_frames,), ns, rising
    """
    n = len(stamps_ns)
    intervals = np.diff(stamps_ns).astype(np.float64)
    none = np.zeros(n)
    if n < MIN_FRAMES:
        shortest, median, longest = (
            (intervals.min(), np.median(intervals), intervals.max()) if n > 1 else (np.nan,) * 3
        )
        return StampRegularity(False, float(median), float(shortest), float(longest), 0.0, (), none)
    period = float(np.median(intervals))
    number = np.concatenate([[0.0], np.cumsum(np.maximum(np.rint(intervals / period), 1.0))])
    # Over several periods: stamps rounded to milliseconds have no typical interval of their own.
    far = min(10, n // 8) or 1
    since = (stamps_ns - stamps_ns[0]).astype(np.float64)
    period = float(np.median((since[far:] - since[:-far]) / (number[far:] - number[:-far])))
    excess = intervals - np.diff(number) * period
    steps, stray = _steps_and_strays(excess)
    sizes = dict(steps)
    steady = since.copy()
    for k, size in steps:
        steady[k + 1 :] -= size
    keep = stray == 0
    line = np.polyfit(number[keep], steady[keep], 1)
    residual = (steady - np.polyval(line, number))[keep]
    inside = keep[:-2] & keep[1:-1] & keep[2:]
    bend = (np.diff(steady, 2) - np.diff(number, 2) * line[0])[inside]
    local = 1.4826 * float(np.median(np.abs(bend))) / np.sqrt(6) if len(bend) else 0.0
    wander = float(np.sqrt(np.mean(residual**2)))
    one = intervals / np.diff(number)
    is_steady = wander <= _WANDER * max(local, JITTER_NS) and len(steps) <= max(2, _MANY_STEPS * n)
    return StampRegularity(
        is_steady=bool(is_steady),
        period_ns=float(line[0]) if is_steady else float(np.median(intervals)),
        shortest_ns=float(one.min()),
        longest_ns=float(one.max()),
        jitter_ns=wander if is_steady else 0.0,
        steps=tuple(StampStep(k + 1, float(intervals[k]), size) for k, size in sizes.items())
        if is_steady
        else (),
        stray_ns=stray if is_steady else none,
    )


def _steps_and_strays(excess_ns: FloatArray) -> tuple[list[tuple[int, float]], FloatArray]:
    """Return the intervals that stand out of those beside them for good, with sizes, and stamps off alone."""
    n = len(excess_ns)
    limit = max(_STEP_SIGMA * 1.4826 * float(np.median(np.abs(excess_ns))), _STEP_NS)
    usual = np.stack([_before(excess_ns), _before(excess_ns[::-1])[::-1]], axis=1)
    # Where the rate itself changes, an interval is like those after it: that is no step.
    above = excess_ns[:, None] - usual
    out = (np.abs(above) > limit).all(axis=1) & (above[:, 0] * above[:, 1] > 0)
    # At either end there is nothing beyond: the one side decides.
    out[0], out[-1] = abs(above[0, 1]) > limit, abs(above[-1, 0]) > limit
    jump = np.where(out, above[np.arange(n), np.abs(above).argmin(axis=1)], 0.0)
    jump[0], jump[-1] = above[0, 1] * out[0], above[-1, 0] * out[-1]
    steps: list[tuple[int, float]] = []
    stray = np.zeros(n + 1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], out.astype(np.int8), [0]])))
    for first, end in edges.reshape(-1, 2).tolist():
        total = float(jump[first:end].sum())
        if end - first == 1 and first in (0, n - 1):
            # The first or the last stamp alone: a step there would be no more than that.
            stray[0 if first == 0 else n] = -total if first == 0 else total
        elif abs(total) > limit:
            steps.append((end - 1, total))
            stray[first + 1 : end] = np.cumsum(jump[first : end - 1])
        else:
            stray[first + 1 : end] = np.cumsum(jump[first : end - 1])
    return steps, stray


def _before(values: FloatArray) -> FloatArray:
    """Return the median of up to `_BESIDE` values before each one; of the first, itself."""
    first = [np.median(values[:k]) if k else values[0] for k in range(min(_BESIDE, len(values)))]
    if len(values) <= _BESIDE:
        return np.array(first)
    return np.concatenate([first, np.median(sliding_window_view(values, _BESIDE)[:-1], axis=1)])
