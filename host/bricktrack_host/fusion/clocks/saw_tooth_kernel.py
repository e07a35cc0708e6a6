"""The loops of `saw_tooth`, compiled: what optics and reads say of many saw-tooths."""

from math import ceil, floor

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.compiled import compiled, compiled_inline

_NO_RATE = 1e-6  # slips of such a clock are farther apart than any run is long


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
def least_optics_costs(
    table: FloatArray,
    since_mid_s: FloatArray,
    first_lag_s: float,
    lag_step_s: float,
    period_s: float,
    rates: FloatArray,
    phases_s: FloatArray,
    least_lags_s: FloatArray,
    stride: int,
    n_lags: int,
) -> tuple[FloatArray, IntArray]:
    """Return the least of `optics_cost` over lags, and at which lag, of rates and phases.

    Each of shape (n_rates, n_phases). ``period_s`` is that of a sensor of rate 0; the lags begin at
    ``least_lags_s``, shape (n_phases,), and are ``stride`` columns of the table apart, none beyond it.
    """
    n_bins, n_table = table.shape
    n_phases = len(phases_s)
    last = n_table - 2 - stride * (n_lags - 1)
    # Columns that lags take together stand side by side: sums over the lags take half the time.
    place = np.empty(n_table, dtype=np.int64)
    n_placed = 0
    for begin in range(stride):
        for k in range(begin, n_table, stride):
            place[k] = n_placed
            n_placed += 1
    ordered = np.empty_like(table)
    for k in range(n_table):
        ordered[:, place[k]] = table[:, k]
    least, lag = np.empty((len(rates), n_phases)), np.empty((len(rates), n_phases), dtype=np.int64)
    cost = np.empty((n_phases, n_lags))
    for r in range(len(rates)):
        cost[:] = 0.0
        for m in range(n_bins):
            row = ordered[m]
            for i in range(n_phases):
                age = _age(phases_s[i] - since_mid_s[m] * rates[r], period_s * (1 + rates[r]))
                column = (age + least_lags_s[i] - first_lag_s) / lag_step_s
                at = min(max(int(column), 0), last)
                later = min(max(column - at, 0.0), 1.0)
                earlier = 1.0 - later
                before = row[place[at] : place[at] + n_lags]
                behind = row[place[at + 1] : place[at + 1] + n_lags]
                total = cost[i]
                for j in range(n_lags):
                    total[j] += earlier * before[j] + later * behind[j]
        for i in range(n_phases):
            lag[r, i] = np.argmin(cost[i])
            least[r, i] = cost[i, lag[r, i]]
    return least, lag


@compiled_inline
def _age(since_s: float, period_s: float) -> float:
    """Return how old a sample of a clock is, 0 to a period; quicker than a remainder."""
    return since_s - floor(since_s / period_s) * period_s


@compiled
def slip_costs(
    repeat_price: FloatArray,
    skip_price: FloatArray,
    at_s: FloatArray,
    ends_s: FloatArray,
    mid_s: float,
    period_s: float,
    rates: FloatArray,
    phases_s: FloatArray,
    age_sd_s: float,
    most_reach: int,
    kink_is: float,
) -> tuple[FloatArray, IntArray]:
    """Return what the slips of saw-tooths cost, and one number for the kinks that each makes use of.

    Each of shape (n_rates, n_phases); a clock without a rate has no slips.

    Parameters
    ----------
    repeat_price, skip_price : ndarray, shape (n,)
        Of a slip at each sample, where the sensor is slow and where it is fast. Away from the sample the
        price rises with the square of the distance over its sd, up to three of it and ``most_reach`` samples.
    at_s : ndarray, shape (n,)
        When the samples were read, rising.
    ends_s : ndarray, shape (2,)
        The first and the last read, after ``mid_s``.
    mid_s : float
        The read that has a saw-tooth's phase for its sample's age.
    period_s : float
        Of a sensor of rate 0.
    age_sd_s : float
        How unsure ages are.
    kink_is : float
        Below minus this a price is that of a kink.
    """
    n = len(at_s)
    shape = len(rates), len(phases_s)
    cost, kinks = np.zeros(shape), np.zeros(shape, dtype=np.int64)
    for r in range(len(rates)):
        rate = rates[r]
        if abs(rate) < _NO_RATE:
            continue
        price = repeat_price if rate > 0 else skip_price
        every_s = period_s * (1 + rate) / rate  # negative for a fast sensor
        one_end, other_end = ends_s[0] / every_s, ends_s[1] / every_s
        first = floor(min(one_end, other_end)) - 1
        last = ceil(max(one_end, other_end)) + 1
        sd = age_sd_s / abs(rate) / period_s + 1.0
        reach = int(min(3 * sd, most_reach))
        for p in range(len(phases_s)):
            weight = 1
            for i in range(last - first + 1):
                slip = mid_s + phases_s[p] / rate + (first + i) * every_s
                if at_s[0] < slip < at_s[n - 1]:
                    centre = np.searchsorted(at_s, slip)
                    least, best = np.inf, 0
                    for k in range(max(centre - reach, 0), min(centre + reach + 1, n)):
                        here = price[k] + ((k - centre) / sd) ** 2
                        if here < least:
                            least, best = here, k
                    cost[r, p] += least
                    if least < -kink_is:
                        kinks[r, p] += (best + 1) * weight
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
