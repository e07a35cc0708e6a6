"""When a free-running sensor truly took its samples, found from reads that beat with it.

A BNO055 samples on its own clock, which differs from ours by parts in a thousand, and keeps the latest sample
for whoever asks. Reads on a grid of our own clock find a sample of some age: it grows or shrinks by the
difference of the clocks until, a whole period old or none, one is left out or read twice. Taken for the time
of measurement, the stamps are wrong by a saw-tooth of one period: 10 ms, 3 mm at 0.3 m/s.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.errors import ShapeError
from bricktrack_common.imu_records import UNUSABLE, ImuFlag
from bricktrack_host.fusion.clocks.posed_frames import PosedFrames
from bricktrack_host.fusion.clocks.rotation_fit import Fit, RotationFit
from bricktrack_host.fusion.clocks.saw_tooth import MIN_PAIRS, STEP_S, AsRead, SawTooth, SawToothSearch
from bricktrack_host.fusion.clocks.skip_places import NEAR_S, skips_by_attitudes
from bricktrack_host.fusion.inertial.imu_samples import seconds_since
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.tracks import ImuTrack

logger = logging.getLogger(__name__)

_EARN = 45.0  # chi-square that a saw-tooth must earn; the best of 50 000 by chance earns some 22
RATE_SD = 2e-4  # of a clock that was found, before the attitudes have told its skew
_RATE_STEP = 2e-5
_ANY_RATE_SD = 0.01  # of stamps whose own clock is wrong


@dataclass(frozen=True, slots=True, eq=False)
class SampleClock:
    """The sensor's own clock: sample k was taken at ``first_ns + k * period_ns``.

    Attributes
    ----------
    first_ns : int, on the clock of the stamps
    period_ns : float, ns
    sample : ndarray of int64, shape (n,)
        Which sample each read found.
    n_skipped : int
        Samples that no read found, though there was one in every slot.
    sample_sd : ndarray, shape (n,), or None
        How unsure ``sample`` is, where others are nearly as likely; in samples.
    """

    first_ns: int
    period_ns: float
    sample: IntArray
    n_skipped: int
    sample_sd: FloatArray | None = None

    def restamp(self, imu: ImuTrack) -> ImuTrack:
        """Return the track with the instants of measurement for stamps; samples read twice are flagged.

        Raises
        ------
        ShapeError
            If the track is not the one the clock was found for.
        """
        if len(imu.t_ns) != len(self.sample):
            raise ShapeError(
                f"the sample clock is of {len(self.sample)} reads and the track has {len(imu.t_ns)}; "
                "align the times of this very track"
            )
        flags = imu.flags.copy()
        flags[1:][np.diff(self.sample) == 0] |= int(ImuFlag.REPEAT)
        t_ns = self.first_ns + np.round(self.sample * self.period_ns).astype(np.int64)
        t_sd_s = None if self.sample_sd is None else self.sample_sd * (self.period_ns * 1e-9)
        return replace(imu, t_ns=t_ns, flags=flags, t_sd_s=t_sd_s)

    def is_between_samples(self, imu: ImuTrack) -> BoolArray:
        """Return which reads came so near to the sensor's taking a sample that they may hold another."""
        age_ns = imu.t_ns - self.first_ns - self.sample * self.period_ns
        return np.asarray((age_ns < 1e9 * NEAR_S) | (age_ns > self.period_ns - 1e9 * NEAR_S))


def find_sample_clock(
    frames: PosedFrames, signal: ImuSignal, imu: ImuTrack, *, as_read: Fit
) -> SampleClock | None:
    """Return the sensor's own clock, or None where the stamps serve as well.

    Parameters
    ----------
    frames : PosedFrames
        Camera time, after the signal's epoch.
    signal : ImuSignal
        Of ``imu`` with its stamps as read.
    imu : ImuTrack
    as_read : Fit
        Of the attitudes to the gyro by those stamps.
    """
    if len(frames.t_s) <= MIN_PAIRS:
        return None
    run = AsRead(frames, signal, imu, as_read.offset_s)
    search = SawToothSearch(run)
    if search.n_pairs < MIN_PAIRS:
        return None
    way = search.coarse()
    earned = search.null_cost() - way.cost
    logger.debug("a saw-tooth of %.0f ppm earns %.0f", way.rate * 1e6, earned)
    # A sample found twice proves a clock of its own, however little the motion shows of it.
    if earned < (-_EARN if search.has_repeats else _EARN):
        return None

    judge = _Judge(run, search)
    judge.hear(search.ways(way, rate_sd=STEP_S / search.span_s))
    if not judge.heard:
        return None
    # The attitudes know the rate better than the rotations between frames: once more with theirs.
    best = judge.best
    judge.hear(search.ways(replace(best.way, rate=best.rate), rate_sd=_RATE_STEP))
    best = judge.best
    clock, fit = judge.clock(replace(best.way, rate=best.rate), judge.samples()), best.fit
    clock = replace(clock, sample_sd=judge.sample_sd())
    if not search.has_repeats:
        # Stamps at a wrong rate are a straight line and no saw-tooth, and so is one that never wraps.
        read = np.flatnonzero((imu.flags & int(UNUSABLE)) == 0)
        line = RotationFit(frames, signal, skew_prior_sd=_ANY_RATE_SD).solve(run.offset_s) or as_read
        left = min(as_read.misfit, line.misfit) - fit.misfit
        if left < _EARN * fit.residual_sd**2 or (np.diff(clock.sample[read]) == np.diff(read)).all():
            return None
    logger.info(
        "the inertial sensor samples by its own clock, %.0f ppm slow; %d samples were not read",
        best.rate * 1e6,
        clock.n_skipped,
    )
    return clock


@dataclass(frozen=True, slots=True, eq=False)
class _Heard:
    """One sequence of samples found by the reads, and what speaks for it.

    ``way`` is the likeliest saw-tooth that leads to it, ``rate`` the one that the attitudes find under it,
    and ``read_cost`` the chi-square of the reads and of that between the two rates.
    """

    way: SawTooth
    sample: IntArray
    fit: Fit
    rate: float
    read_cost: float

    def led_to_by(self, way: SawTooth) -> "_Heard":
        """Return the same with this saw-tooth, if that is likelier."""
        off = (way.rate - self.rate) ** 2 / (_RATE_STEP**2 + float(self.fit.covariance[1, 1]))
        cost = way.read_cost + off
        return replace(self, way=way, read_cost=cost) if cost < self.read_cost else self


class _Judge:
    """Tells which sequence of samples is the likeliest, by how the attitudes agree with the gyro under each.

    Saw-tooths differ in more than the sequence; but their rates and phases the fit sets right by itself.
    """

    def __init__(self, run: AsRead, search: SawToothSearch) -> None:
        self._run, self._search = run, search
        self.heard: list[_Heard] = []

    def clock(self, way: SawTooth, sample: IntArray) -> SampleClock:
        """Return the clock of a sequence."""
        period_ns = self._search.period_s * (1 + way.rate) * 1e9
        first_s = self._search.first_sample_s(way)
        first_ns = self._run.signal.epoch_ns + round(first_s * 1e9 + float(sample[0]) * period_ns)
        read = np.flatnonzero((self._run.imu.flags & int(UNUSABLE)) == 0)
        skipped = np.maximum(np.diff(sample[read]) - np.diff(read), 0)
        return SampleClock(first_ns, period_ns, sample - sample[0], int(skipped.sum()))

    def hear(self, ways: list[SawTooth]) -> None:
        """Fit the attitudes to every sequence of samples that was not heard before."""
        for way in ways:
            sample = self._search.samples(way)
            step = np.diff(sample)
            for i, known in enumerate(self.heard):
                if (np.diff(known.sample) == step).all():
                    self.heard[i] = known.led_to_by(way)
                    break
            else:
                fit = self._fit(way, sample)
                if fit is not None:
                    new = _Heard(way, sample, fit, way.rate - fit.skew, np.inf)
                    self.heard.append(new.led_to_by(way))

    def _fit(self, way: SawTooth, sample: IntArray) -> Fit | None:
        run, restamped = self._run, ImuSignal.from_track(self.clock(way, sample).restamp(self._run.imu))
        frames = run.frames.later_by((run.signal.epoch_ns - restamped.epoch_ns) * 1e-9)
        return RotationFit(frames, restamped, skew_prior_sd=RATE_SD).solve(run.offset_s + way.lag_s)

    def samples(self) -> IntArray:
        """Return the likeliest sequence, samples left out where the attitudes fit best."""
        run, best = self._run, self.best
        restamped = self.clock(best.way, best.sample).restamp(run.imu)
        signal = ImuSignal.from_track(restamped)
        frames = run.frames.later_by((run.signal.epoch_ns - signal.epoch_ns) * 1e-9)
        sample_s = seconds_since(restamped.t_ns, signal.epoch_ns)
        age_s = seconds_since(run.imu.t_ns, signal.epoch_ns) - sample_s
        return skips_by_attitudes(best.sample, age_s, frames, signal, sample_s, best.fit)

    def costs(self) -> FloatArray:
        """Return the chi-square of all that was heard, by the attitudes and by the reads."""
        sd = min(one.fit.residual_sd for one in self.heard)
        return np.array([one.fit.misfit / sd**2 + one.read_cost for one in self.heard])

    @property
    def best(self) -> _Heard:
        """Return the likeliest."""
        return self.heard[int(np.argmin(self.costs()))]

    def sample_sd(self) -> FloatArray:
        """Return how unsure each read's sample is, in samples, shape (n,): all that was heard by its odds."""
        costs, likeliest = self.costs(), self.best.sample
        off = np.array([one.sample - likeliest for one in self.heard], dtype=np.float64)
        off -= np.median(off, axis=1, keepdims=True)  # what all samples share is the offset's
        odds = np.exp(-0.5 * (costs - costs.min()))
        return np.asarray(np.sqrt(odds @ off**2 / odds.sum()))
