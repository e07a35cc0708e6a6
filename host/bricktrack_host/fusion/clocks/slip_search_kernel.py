"""The loops of `slip_search`, compiled: which shift of its stamp each frame likeliest has.

What a frame is turned against the gyro stays the same but for a slow drift, if its stamp is right. The drift
is followed by a filter: its mean and variance are those of the frames before. What one frame can say is
capped, and one beyond the cap moves the mean nowhere but makes it half as sure: the attitude may have jumped,
in an impact that the gyro did not follow.
"""

from typing import Any

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.compiled import compiled, compiled_in_place
from bricktrack_host.fusion.inertial.rotation_kernel import write_rotation_vector

_LEAST_PERIODS = -0.25  # between two frames: pictures do not run backwards, but one may be there twice


@compiled_in_place
def _square(error: Any, mean: Any) -> float:
    """Return the squared distance of an error from what was expected."""
    return float((error[0] - mean[0]) ** 2 + (error[1] - mean[1]) ** 2 + (error[2] - mean[2]) ** 2)


@compiled_in_place
def _follow(error: Any, mean: Any, before: float, variance: float, cap: float) -> float:
    """Move the mean towards an error, and return its variance; ``before`` is that of the mean it had."""
    if _square(error, mean) >= cap * (before + variance):
        return float(2.0 * before + variance)
    gain = before / (before + variance)
    for a in range(3):
        mean[a] += gain * (error[a] - mean[a])
    return float((1.0 - gain) * before)


@compiled
def turns_from_gyro(seen: FloatArray, by_gyro: FloatArray) -> FloatArray:
    """Return what frames are turned against the gyro at each of some instants, shape (n, n_shifts, 3), rad.

    Parameters
    ----------
    seen : ndarray, shape (n, 3, 3)
        Attitudes by the camera, in the axes that the gyro starts in.
    by_gyro : ndarray, shape (n, n_shifts, 3, 3)
    """
    out = np.empty(by_gyro.shape[:3])
    for i in range(by_gyro.shape[0]):
        for s in range(by_gyro.shape[1]):
            write_rotation_vector(seen[i].T, by_gyro[i, s].T, out[i, s])
    return out


@compiled
def likeliest_shifts(
    error: FloatArray,
    variance: FloatArray,
    drift: FloatArray,
    interval_periods: FloatArray,
    change_price: float,
    cap: float,
) -> tuple[IntArray, float]:
    """Return the likeliest sequence of shifts (Viterbi, each survivor with a drift of its own), and its cost.

    Parameters
    ----------
    error : ndarray, shape (n, n_shifts, 3), rad
        What each frame is turned against the gyro at its stamp shifted by so many periods.
    variance : ndarray, shape (n,), rad^2
        Of each component, of the frame's own attitude.
    drift : ndarray, shape (n,), rad^2
        By which the drift's variance grows since the frame before.
    interval_periods : ndarray, shape (n,)
        From the stamp before to this one.
    change_price : float
        Of a change of shift, as -2 log likelihood.
    cap : float
        What one frame can say, likewise.
    """
    n, n_shifts = error.shape[0], error.shape[1]
    came_from = np.zeros((n, n_shifts), dtype=np.int64)
    cost, before = np.zeros(n_shifts), np.zeros(n_shifts)
    mean, mean_before = error[0].copy(), np.empty((n_shifts, 3))
    spread, total, floor = np.full(n_shifts, variance[0]), np.empty(n_shifts), np.empty(n_shifts)
    for i in range(1, n):
        mean_before[:] = mean
        for b in range(n_shifts):
            total[b] = spread[b] + drift[i] + variance[i]
            floor[b] = 3.0 * np.log(total[b])
            before[b] = cost[b]
        for s in range(n_shifts):
            best, origin = before[s] + floor[s] + min(_square(error[i, s], mean_before[s]) / total[s], cap), s
            for b in range(n_shifts):
                c = before[b] + floor[b] + change_price
                if b == s or c >= best or interval_periods[i] + s - b < _LEAST_PERIODS:
                    continue
                c += min(_square(error[i, s], mean_before[b]) / total[b], cap)
                if c < best:
                    best, origin = c, b
            cost[s], came_from[i, s] = best, origin
            mean[s] = mean_before[origin]
            spread[s] = _follow(error[i, s], mean[s], total[origin] - variance[i], variance[i], cap)
    path = np.empty(n, dtype=np.int64)
    path[n - 1] = np.argmin(cost)
    for i in range(n - 1, 0, -1):
        path[i - 1] = came_from[i, path[i]]
    return path, cost.min()


@compiled
def path_costs(
    error: FloatArray, variance: FloatArray, drift: FloatArray, paths: IntArray, cap: float
) -> FloatArray:
    """Return what sequences of shifts cost, shape (n_paths,), -2 log likelihood; see `likeliest_shifts`.

    ``paths`` has shape (n_paths, n).
    """
    out = np.zeros(paths.shape[0])
    mean = np.empty(3)
    for p in range(paths.shape[0]):
        mean[:] = error[0, paths[p, 0]]
        spread = variance[0]
        for i in range(1, paths.shape[1]):
            here = error[i, paths[p, i]]
            total = spread + drift[i] + variance[i]
            out[p] += min(_square(here, mean) / total, cap) + 3.0 * np.log(total)
            spread = _follow(here, mean, spread + drift[i], variance[i], cap)
    return out


@compiled
def surprises(
    error: FloatArray, variance: FloatArray, drift: FloatArray, path: IntArray, cap: float
) -> FloatArray:
    """Return the squares of the errors along a sequence of shifts over what was expected, shape (n - 1,)."""
    out = np.empty(len(path) - 1)
    mean = error[0, path[0]].copy()
    spread = variance[0]
    for i in range(1, len(path)):
        here = error[i, path[i]]
        before = spread + drift[i]
        out[i - 1] = _square(here, mean) / (before + variance[i])
        spread = _follow(here, mean, before, variance[i], cap)
    return out
