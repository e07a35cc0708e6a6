"""The loops of `saw_tooth`, compiled: what optics and reads say of many saw-tooths."""

from math import floor

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.compiled import compiled, compiled_inline


@compiled
def optics_cost(
    table: FloatArray,
    since_mid_s: FloatArray,
    first_lag_s: float,
    lag_step_s: float,
    period_s: float,
    rate: float,
    phases_s: FloatArray,
    lags_s: FloatArray,
) -> FloatArray:
    """Return the cost of saw-tooths of one rate by the optical rotations, shape (n_phases, n_lags).

    Parameters
    ----------
    table : ndarray, shape (n_bins, n_table_lags)
        Cost of each stretch of time over offsets of camera time to stamps, from ``first_lag_s`` on.
    since_mid_s : ndarray, shape (n_bins,)
        The stretches' middles.
    period_s : float
        The sensor's.
    phases_s : ndarray, shape (n_phases,)
    lags_s : ndarray, shape (n_phases, n_lags)
        Offsets to be added to the samples' ages.
    """
    n_bins, n_table = table.shape
    out = np.zeros(lags_s.shape)
    columns_per_s = 1.0 / lag_step_s
    for i in range(lags_s.shape[0]):
        least, most = lags_s[i].min(), lags_s[i].max()
        for m in range(n_bins):
            age = _age(phases_s[i] - since_mid_s[m] * rate, period_s) - first_lag_s
            if age + least >= 0.0 and (age + most) * columns_per_s < n_table - 1:
                for j in range(lags_s.shape[1]):
                    column = (age + lags_s[i, j]) * columns_per_s
                    at = int(column)
                    before = table[m, at]
                    out[i, j] += before + (column - at) * (table[m, at + 1] - before)
            else:  # beyond the table its ends hold
                for j in range(lags_s.shape[1]):
                    column = min(max((age + lags_s[i, j]) * columns_per_s, 0.0), n_table - 1.0)
                    at = min(int(column), n_table - 2)
                    before = table[m, at]
                    out[i, j] += before + (column - at) * (table[m, at + 1] - before)
    return out


@compiled
def grid_cost(
    table: FloatArray,
    since_mid_s: FloatArray,
    first_lag_s: float,
    lag_step_s: float,
    period_s: float,
    rate: float,
    phases_s: FloatArray,
    least_lag_s: float,
    stride: int,
    n_lags: int,
) -> FloatArray:
    """Return what `optics_cost` does, for lags ``stride`` columns of the table apart, none beyond it."""
    n_bins, n_table = table.shape
    last = n_table - 2 - stride * (n_lags - 1)
    out = np.zeros((len(phases_s), n_lags))
    for m in range(n_bins):
        for i in range(len(phases_s)):
            age = _age(phases_s[i] - since_mid_s[m] * rate, period_s)
            column = (age + least_lag_s - first_lag_s) / lag_step_s
            at = min(max(int(column), 0), last)
            later = min(max(column - at, 0.0), 1.0)
            earlier = 1.0 - later
            for j in range(n_lags):
                k = at + stride * j
                out[i, j] += earlier * table[m, k] + later * table[m, k + 1]
    return out


@compiled_inline
def _age(since_s: float, period_s: float) -> float:
    """Return how old a sample of a clock is, 0 to a period; quicker than a remainder."""
    return since_s - floor(since_s / period_s) * period_s


@compiled
def slip_cost(
    price: FloatArray,
    at_s: FloatArray,
    first_slips_s: FloatArray,
    every_s: float,
    numbers: IntArray,
    sd_samples: float,
    reach: int,
    kink_is: float,
) -> tuple[FloatArray, IntArray]:
    """Return what the slips of saw-tooths cost, and one number for the kinks that each makes use of.

    Parameters
    ----------
    price : ndarray, shape (n,)
        Of a slip at each sample; away from it the price rises with the square of the distance over
        ``sd_samples``, up to ``reach`` samples.
    at_s : ndarray, shape (n,)
        When the samples were read, rising.
    first_slips_s : ndarray, shape (n_phases,)
        Slip number 0 of each saw-tooth.
    every_s : float
        From one slip to the next; may be negative.
    numbers : ndarray of int64, shape (n_slips,)
    kink_is : float
        Below minus this a price is that of a kink.
    """
    n = len(at_s)
    cost, kinks = np.zeros(len(first_slips_s)), np.zeros(len(first_slips_s), dtype=np.int64)
    for p in range(len(first_slips_s)):
        weight = 1
        for i in range(len(numbers)):
            slip = first_slips_s[p] + numbers[i] * every_s
            if at_s[0] < slip < at_s[n - 1]:
                centre = np.searchsorted(at_s, slip)
                least, best = np.inf, 0
                for k in range(max(centre - reach, 0), min(centre + reach + 1, n)):
                    here = price[k] + ((k - centre) / sd_samples) ** 2
                    if here < least:
                        least, best = here, k
                cost[p] += least
                if least < -kink_is:
                    kinks[p] += (best + 1) * weight
            weight = weight * 7919 if i % 4 != 3 else 1
    return cost, kinks


@compiled
def likeliest_path(
    number: IntArray,
    price: FloatArray,
    is_repeat: BoolArray,
    is_next_slot: BoolArray,
    unseen: FloatArray,
    forbidden: float,
) -> IntArray:
    """Return which of the candidates of each read makes the cheapest sequence (Viterbi), shape (n,).

    Parameters
    ----------
    number : ndarray of int64, shape (n, c)
        Samples that each read may have found.
    price : ndarray, shape (n, c)
    is_repeat : ndarray of bool, shape (n,)
        The read found the sample before once more; others find a later one. Else ``forbidden`` is paid.
    is_next_slot : ndarray of bool, shape (n - 1,)
        Whether the next read was made one slot later.
    unseen : ndarray, shape (n,)
        Price of a sample left out after each read, where that is so.
    """
    n, n_choices = number.shape
    total, there = price[0].copy(), np.empty(n_choices)
    came = np.zeros((n, n_choices), dtype=np.int64)
    for j in range(1, n):
        for to in range(n_choices):
            least = np.inf
            for start in range(n_choices):
                step = number[j, to] - number[j - 1, start]
                cost = total[start]
                if (step != 0) if is_repeat[j] else (step < 1):
                    cost += forbidden
                if step > 1 and is_next_slot[j - 1]:
                    cost += unseen[j - 1]
                if cost < least:
                    least, came[j, to] = cost, start
            there[to] = least + price[j, to]
        total[:] = there
    path = np.empty(n, dtype=np.int64)
    path[n - 1] = np.argmin(total)
    for j in range(n - 1, 0, -1):
        path[j - 1] = came[j, path[j]]
    return path
