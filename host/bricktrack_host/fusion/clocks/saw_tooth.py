"""The saw-tooth in the age of samples that a free-running sensor gives to reads on a grid of another clock.

It has two numbers: by how much the sensor's clock is slow, and the age of the sample that a punctual read in
the middle of the run finds. Three kinds of evidence are weighed, as chi-square: optical rotations, which see
the age directly; reads that found the sample before once more, or did not; and kinks in the signal where a
sample was left out and nothing else says so.
"""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.imu_records import ImuFlag
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.fusion.clocks.posed_frames import PosedFrames
from bricktrack_host.fusion.clocks.saw_tooth_kernel import (
    least_optics_costs,
    likeliest_path,
    optics_cost,
    slip_costs,
)
from bricktrack_host.fusion.inertial.imu_samples import seconds_since, usable_samples
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.fusion.inertial.running_median import running_median
from bricktrack_host.tracks import ImuTrack

MIN_PAIRS = 60  # of frames side by side, for a search
STEP_S = 0.0005  # of ages and offsets
_GRID_STEPS = 2  # of the first search
_FINER = 4  # steps of offsets in one of these, near the end
_BEYOND = 12  # steps that a search near the end may go beyond the table
_MAX_RATE_ERROR = 0.012  # of the sensor's oscillator
_SIDE_S = 0.008  # how far beside the coarse offset, which is half a saw-tooth wrong
_BIN_S = 0.1  # of frame-to-frame rotations summed before the search
_CAP = 9.0  # what one rotation can say: an outlier does not choose the clock
_READ_JITTER_S = 1.5e-4  # of a stamp against the instant at which the sensor answered
_MISSED_REPEAT = 30.0  # a sample that must have been read twice and was not
_REPEAT_CAP = 20.0
_MOST_REACH = 150  # samples
_MANY_REPEATS = 0.1
_KINK_WINDOW = 51
_KINK_CAP = 60.0  # what one sample can say
_KINK_TELLS = 150.0  # impacts are kinks too: how large one is says no more
_KINK_IS = 20.0
_UNSEEN_SKIP = 10.0
_FORBIDDEN = 400.0
_PHASE_STEP_S = 5e-5
_APART_S = 2.5e-4
_CONSIDERED = 60.0  # by the frame-to-frame rotations, which tell less than the attitudes
_MAX_WAYS = 5

_PLAIN = (-2, -1, 1, 2)
# Two samples before a hole and two behind it: place after the last before it, and their neighbours' numbers.
_AROUND_A_HOLE = ((-1, (-2, -1, 1, 3)), (0, (-2, -1, 2, 3)), (1, (-3, -2, 1, 2)), (2, (-3, -1, 1, 2)))


@dataclass(frozen=True, slots=True)
class SawTooth:
    """One way in which the reads can have beaten with the sensor.

    Attributes
    ----------
    rate : float
        By how much the sensor's period is longer than ours, as a share.
    phase_s : float
        Age of the sample that a punctual read in the middle of the run finds.
    lag_s : float
        Offset from camera time to the instants of the samples, less the coarse offset.
    cost : float
        Chi-square by all evidence.
    read_cost : float
        The part by reads and kinks.
    """

    rate: float
    phase_s: float
    lag_s: float
    cost: float
    read_cost: float


@dataclass(frozen=True, slots=True, eq=False)
class AsRead:
    """A run by the stamps of its reads, in which a sensor's own clock is sought.

    Attributes
    ----------
    frames : PosedFrames
        Camera time, after the signal's epoch.
    signal : ImuSignal
        Of ``imu``.
    imu : ImuTrack
    offset_s : float
        Stamps less camera time, coarsely.
    """

    frames: PosedFrames
    signal: ImuSignal
    imu: ImuTrack
    offset_s: float


class SawToothSearch:
    """The evidence of one run, and what it says of saw-tooths."""

    def __init__(self, run: AsRead) -> None:
        signal, imu = run.signal, run.imu
        self._read_s = seconds_since(imu.t_ns, signal.epoch_ns)
        self._is_repeat = (imu.flags & int(ImuFlag.REPEAT)) != 0
        self._fresh = usable_samples(imu)
        # What a repeat found was there in the slots before it that were not read.
        found = self._fresh | self._is_repeat
        next_found = np.flatnonzero(np.append(found, True))[np.cumsum(found) - found]
        self._is_held = np.append(self._is_repeat, False)[next_found]
        # The slot of each read, and when a read in the middle one would be, were it as late as most.
        half = len(self._read_s) // 2
        slot = np.arange(len(self._read_s))
        by_row_s = float(np.median(self._read_s[half : 2 * half] - self._read_s[:half])) / half
        if abs(by_row_s / signal.period_s - 1) > _MAX_RATE_ERROR:  # not every slot has a row
            step = np.round(np.diff(self._read_s) / signal.period_s)
            slot = np.concatenate([[0], np.cumsum(step)]).astype(np.int64)
        far = slot[half:] - slot[: len(slot) - half]
        self.period_s = float(np.median((self._read_s[half:] - self._read_s[: len(slot) - half]) / far))
        late_s = float(np.median(self._read_s - slot * self.period_s))
        self._slot = slot - slot[half]
        self._mid_s = late_s + float(slot[half]) * self.period_s
        self._tabulate(run.frames, signal, run.offset_s)
        self._weigh_kinks(imu)

    def _tabulate(self, frames: PosedFrames, signal: ImuSignal, offset_s: float) -> None:
        """Tabulate the misfit of frame-to-frame rotations over offsets of camera time to stamps."""
        t_s, R, sd_rad = frames.t_s, frames.R, frames.sd_rad
        dt = np.diff(t_s)
        pair = np.flatnonzero(dt < 1.5 * np.median(dt))
        n_side = int(np.ceil((self.period_s + _SIDE_S) / STEP_S))
        self._lags_s = np.arange(-n_side, n_side + 1) * STEP_S
        begin = t_s[pair][:, None] + self._lags_s + offset_s
        end = begin + dt[pair][:, None]
        whole = ~(signal.in_gap(begin) | signal.in_gap(end)).any(axis=1)
        pair, begin, end = pair[whole], begin[whole], end[whole]
        self.n_pairs = len(pair)
        if self.n_pairs < MIN_PAIRS:
            return
        turn = signal.angle_at(end) - signal.angle_at(begin)
        span = dt[pair][:, None, None]
        off = (rvec_from_matrix(np.swapaxes(R[pair], 1, 2) @ R[pair + 1])[:, None] - turn) / span
        off = (off - np.median(off[:, n_side], axis=0)) * span  # less the bias
        chi2 = (off**2).sum(axis=2) / (sd_rad[pair] ** 2 + sd_rad[pair + 1] ** 2)[:, None]
        # Three components less the one that the choice takes: median of chi-square 1.39.
        scale = max(float(np.median(chi2.min(axis=1))) / 1.39, 0.1)
        chi2 = np.minimum(chi2 / scale, chi2.min(axis=1, keepdims=True) / scale + _CAP)
        middle = t_s[pair] + 0.5 * dt[pair]
        index, where = np.unique(np.floor((middle - middle[0]) / _BIN_S), return_inverse=True)
        self._cost = np.zeros((len(index), len(self._lags_s)))
        np.add.at(self._cost, where, chi2)
        self._bin_s = np.bincount(where, middle) / np.bincount(where) + offset_s
        self.span_s = max(float(self._bin_s[-1] - self._bin_s[0]), 1.0)

    def _weigh_kinks(self, imu: ImuTrack) -> None:
        """Take down what a sample left out after each new one gains, as chi-square (negative: likely).

        A sample is compared with the cubic through two on each side, numbered as if none, or one, was left
        out. What is ordinary for each numbering is measured where nothing is left out, nearby: a fast motion
        departs from its cubic too.
        """
        fresh = np.flatnonzero(self._fresh)
        values = np.concatenate([imu.gyro_radps[fresh], imu.acc_mps2[fresh]], axis=1)
        n = len(fresh)
        slot = self._slot[fresh]
        self._slip_at_s = self._mid_s + (slot + 0.5) * self.period_s
        self._has_next = np.diff(slot, append=slot[-1]) == 1
        self._repeat_price = np.where(np.append(self._is_held, False)[fresh + 1], 0.0, _MISSED_REPEAT)
        self._kink_gain = np.zeros(n)
        after = np.arange(4, n - 5)
        if len(after) < _KINK_WINDOW:
            return
        spreads = {
            numbers: _spread(np.abs(_departure(values, np.arange(3, n - 3), numbers, numbers)))
            for numbers in (_PLAIN, *(holed for _, holed in _AROUND_A_HOLE))
        }
        for place, holed in _AROUND_A_HOLE:
            rows = after + place
            chi2 = []
            for numbers in (_PLAIN, holed):
                off = _departure(values, rows, _PLAIN, numbers) / (spreads[numbers][rows - 3] + 1e-9)
                chi2.append(np.minimum((off**2).sum(axis=1), _KINK_CAP))
            self._kink_gain[after] += chi2[1] - chi2[0]
        self._kink_gain = np.clip(self._kink_gain, -_KINK_TELLS, _KINK_TELLS)

    @property
    def has_repeats(self) -> bool:
        """Whether reads found the sample before once more: now and then, not as a rule at rest."""
        n = int(np.count_nonzero(self._is_repeat))
        return 0 < n < _MANY_REPEATS * len(self._is_repeat)

    def null_cost(self) -> float:
        """Return the least cost by optics of stamps that are right, but for an offset and a small skew."""
        # A rate without a period to wrap at is a skew.
        lags = np.arange(-_SIDE_S, _SIDE_S, STEP_S)
        far_s = 2 * _SIDE_S
        return min(
            float(self._optics(rate, np.array([far_s]), lags - far_s, period_s=1e3).min())
            for rate in np.arange(-3, 4) * 5e-5
        )

    def _optics(
        self, rate: float, phases_s: FloatArray, lags_s: FloatArray, *, period_s: float | None = None
    ) -> FloatArray:
        """Return the cost by optics of saw-tooths of one rate, shape (n_phases, n_lags).

        ``lags_s``: offsets less the coarse one, beside the samples' ages; of all phases, or of each.
        """
        lags = np.broadcast_to(lags_s, (len(phases_s), lags_s.shape[-1])).copy()
        period = self.period_s * (1 + rate) if period_s is None else period_s
        since_mid = self._bin_s - self._mid_s
        return optics_cost(self._cost, since_mid, self._lags_s[0], STEP_S, period, rate, phases_s, lags)

    def coarse(self) -> SawTooth:
        """Return the best saw-tooth on a grid, by optics and by repeats that never came."""
        step = 3 * STEP_S / self.span_s
        n = int(_MAX_RATE_ERROR / step)
        phases = np.arange(0.0, self.period_s, _GRID_STEPS * STEP_S)
        lags = np.arange(-_SIDE_S, _SIDE_S + 1e-9, _GRID_STEPS * STEP_S) - 0.5 * self.period_s
        rates = step * np.arange(-n, n + 1, dtype=np.float64)
        cost, lag = least_optics_costs(
            self._cost, self._bin_s - self._mid_s, self._lags_s[0], STEP_S, self.period_s, rates, phases,
            np.full(len(phases), lags[0]), _GRID_STEPS, len(lags),
        )  # fmt: skip
        cost += self._slip_costs(rates, phases, STEP_S, entices=0.0)[0]
        r, i = np.unravel_index(int(np.argmin(cost)), cost.shape)
        values = rates[r], phases[i], lags[lag[r, i]], cost[r, i], 0.0
        return self._refined(SawTooth(*map(float, values)))

    def _refined(self, way: SawTooth) -> SawTooth:
        """Return what the optics like best near the best of a grid; the cost stays the grid's."""
        best = (np.inf, way.rate, way.phase_s, way.lag_s)
        width = np.array([3 * STEP_S / self.span_s, _GRID_STEPS * STEP_S, _GRID_STEPS * STEP_S])
        for _ in range(4):
            _, rate, phase, lag = best
            phases, lags = phase + width[1] * np.linspace(-1, 1, 5), lag + width[2] * np.linspace(-1, 1, 5)
            for r in rate + width[0] * np.linspace(-1, 1, 5):
                cost = self._optics(r, phases, lags)
                i, j = np.unravel_index(int(np.argmin(cost)), cost.shape)
                best = min(best, (float(cost[i, j]), float(r), float(phases[i]), float(lags[j])))
            width *= 0.6
        return SawTooth(best[1], best[2], best[3], way.cost, 0.0)

    def ways(self, near: SawTooth, *, rate_sd: float) -> list[SawTooth]:
        """Return the saw-tooths near one that all evidence allows, the likeliest first.

        Age and offset trade against each other but for where the slips lie, and near a slip there may be no
        frame: so there can be several.
        """
        phases = np.arange(0.0, self.period_s * (1 + near.rate), _PHASE_STEP_S)
        # What a later phase takes away the offset gives back.
        back = near.lag_s + near.phase_s - phases
        back -= self.period_s * np.round((back - near.lag_s) / self.period_s)
        rates = near.rate + rate_sd * np.linspace(-2, 2, 9)
        # The table is linear between its columns, so a finer one says the same. Beyond it its ends hold.
        n_columns = self._cost.shape[1]
        columns = np.arange(-_BEYOND * _FINER, (n_columns - 1 + _BEYOND) * _FINER + 1) / _FINER
        before = np.clip(columns.astype(np.int64), 0, n_columns - 2)
        share = np.clip(columns - before, 0.0, 1.0)
        finer = (1 - share) * self._cost[:, before] + share * self._cost[:, before + 1]
        step_s, least = STEP_S / _FINER, back - STEP_S
        cost, lag = least_optics_costs(
            finer, self._bin_s - self._mid_s, self._lags_s[0] - _BEYOND * STEP_S, step_s, self.period_s,
            rates, phases, least, 1, 2 * _FINER + 1,
        )  # fmt: skip
        lag_at = least + lag * step_s
        read_costs, kinks = self._slip_costs(rates, phases, _READ_JITTER_S, entices=_KINK_TELLS)
        read_costs += [self._repeat_cost(rate, phases) for rate in rates]
        cost += read_costs
        out: list[SawTooth] = []
        seen: list[tuple[int, float]] = []
        for flat in np.argsort(cost, axis=None):
            i, j = np.unravel_index(int(flat), cost.shape)
            if len(out) == _MAX_WAYS or cost[i, j] > cost.min() + _CONSIDERED:
                break
            # Another way is one whose slips lie at other kinks, or one that is apart.
            at = int(kinks[i, j]), float(phases[j])
            if any(at[0] == k and abs(at[1] - p) < _APART_S for k, p in seen):
                continue
            seen.append(at)
            values = rates[i], phases[j], lag_at[i, j], cost[i, j], read_costs[i, j]
            out.append(SawTooth(*map(float, values)))
        return out

    def _slip_costs(
        self, rates: FloatArray, phases_s: FloatArray, age_sd_s: float, *, entices: float
    ) -> tuple[FloatArray, IntArray]:
        """Return what the slips of saw-tooths cost: a sample read twice, or left out, near to each of them.

        Shape (n_rates, n_phases), and so the kinks made use of, as one number. ``age_sd_s`` is how unsure the
        ages are. A kink where one is needed earns no more than ``entices``: from afar nothing, or a clock
        with more slips would earn by more impacts.
        """
        # A read that was late is spaced wrongly for reasons of its own.
        skip_price = np.where(self._has_next, np.maximum(self._kink_gain, -entices), 0.0)
        return slip_costs(
            self._repeat_price, skip_price, self._slip_at_s, self._read_s[[0, -1]] - self._mid_s, self._mid_s,
            self.period_s, rates, phases_s, age_sd_s, _MOST_REACH, _KINK_IS,
        )  # fmt: skip

    def _repeat_cost(self, rate: float, phases_s: FloatArray) -> FloatArray:
        """Return what reads that found, or did not find, the sample before say of phases.

        A read finds a new sample if one was taken since the read before it. Soon after a late read that may
        not be so; the more unpunctual the reads, the more they tell.
        """
        period = self.period_s * (1 + rate)
        read = np.flatnonzero(self._fresh | self._is_repeat)
        since = np.diff(self._read_s[read])
        short = np.flatnonzero(since < self.period_s - 2 * _READ_JITTER_S)
        j, since = read[short + 1], since[short]
        age = np.mod(self._read_s[j] - (self._mid_s - phases_s[:, None]), period)
        again, anew = np.minimum(since - age, age), np.minimum(age - since, period - age)
        wrong = np.maximum(np.where(self._is_repeat[j], again, anew), 0.0)
        return np.asarray(np.minimum((wrong / _READ_JITTER_S) ** 2, _REPEAT_CAP).sum(axis=1))

    def first_sample_s(self, way: SawTooth) -> float:
        """Return when sample 0 of `samples` was taken, on the clock of the stamps."""
        return self._mid_s - way.phase_s

    def samples(self, way: SawTooth) -> IntArray:
        """Return which sample each read found.

        The likeliest sequence (Viterbi): near to what the clock says, a repeat with its forerunner's number
        and nothing else so, a sample left out where there is a kink rather than beside it.
        """
        period = self.period_s * (1 + way.rate)
        since_s = self._read_s - self.first_sample_s(way)
        number = np.floor(since_s / period).astype(np.int64)[:, None] + np.array([-1, 0, 1])
        age = since_s[:, None] - number * period
        price = (np.maximum(np.maximum(-age, age - period), 0.0) / _READ_JITTER_S) ** 2
        unseen = np.full(len(number), _UNSEEN_SKIP)
        unseen[self._fresh] += self._kink_gain
        # Slots that were not read found nothing: a repeat is of the last one that was.
        read = np.flatnonzero(self._fresh | self._is_repeat)
        path = likeliest_path(
            number[read], price[read], self._is_repeat[read], np.diff(self._slot[read]) == 1, unseen[read],
            _FORBIDDEN,
        )  # fmt: skip
        sample, taken = number[:, 1].copy(), np.maximum.accumulate(number[read, path])
        n_before = np.searchsorted(read, np.arange(len(sample)))
        later = n_before < len(read)
        sample[later] = np.minimum(sample[later], taken[n_before[later]])
        sample[read] = taken
        return np.asarray(np.maximum.accumulate(sample))


def _spread(values: FloatArray) -> FloatArray:
    """Return the sd nearby, by the running median; the ends mirrored."""
    half = _KINK_WINDOW // 2
    mirrored = np.pad(values, ((half, half), (0, 0)), mode="reflect")
    return running_median(mirrored, _KINK_WINDOW)[half:-half] / 0.6745


def _departure(
    values: FloatArray, rows: IntArray, taken: tuple[int, ...], numbers: tuple[int, ...]
) -> FloatArray:
    """Return how far samples are from the cubic through others of them.

    Parameters
    ----------
    taken : tuple of int
        Which rows beside each are taken.
    numbers : tuple of int
        When those were measured, in periods after the sample.
    """
    off = values[rows].copy()
    for row, number in zip(taken, numbers, strict=True):
        weight = np.prod([other / (other - number) for other in numbers if other != number])
        off -= weight * values[rows + row]
    return np.asarray(off)
