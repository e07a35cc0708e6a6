"""Whole-period slips of frame stamps, located by the turns that camera and gyro both saw.

A picture that was lost, or is there twice, where stamps and pictures were joined by counting puts every later
stamp whole periods off, and no interval tells it from a dropped frame. The gyro does: before such a slip the
attitudes agree with it at one offset of the clocks, behind it at another, which is whole periods away.

A slip is believed only where the turns on either side, each for itself, rule out the offset of the other side
and all others; and where the clocks, aligned anew with the stamps mended, leave no step behind.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.fusion.clocks.offset_change import offset_change, signal_of
from bricktrack_host.fusion.clocks.posed_frames import MIN_POSES
from bricktrack_host.fusion.clocks.rate_correlation import correlate
from bricktrack_host.fusion.clocks.rotation_fit_kernel import integrate_attitudes
from bricktrack_host.fusion.clocks.slip_search_kernel import (
    likeliest_shifts,
    path_costs,
    surprises,
    turns_from_gyro,
)
from bricktrack_host.fusion.clocks.stamp_regularity import stamp_regularity
from bricktrack_host.fusion.clocks.stamp_slips import StampSlip, StampSlips, may_slip_at, mend
from bricktrack_host.fusion.clocks.time_alignment import MIN_ROTATION_SD_RAD, TimeAlignment, has_pose
from bricktrack_host.fusion.inertial.imu_samples import BRIDGE_PERIODS, seconds_since
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.tracks import ImuTrack, OpticalTrack

logger = logging.getLogger(__name__)

_MOST_PERIODS = 5
_CAP = 25.0  # what one frame can say, chi-square
_CHANGE_PRICE = 60.0
_EARN = 120.0  # chi-square on either side of a slip against the offset of the other: five frames at least
_RIVAL = 40.0  # and against every other number of periods
_COARSE = 0.3  # of both, while the clocks are those that were found with the slips in the stamps
_DOUBT = 16.0  # by which a place may be less likely than the best: four sigmas
_MEMORY_S = 0.5  # over which the gyro holds an attitude: its noise, bias and scale drift by more
_UNKNOWN_RAD = 0.5  # what a brick turns while no sample tells
_LEAST_SCALE = 0.3  # of attitudes that are better than their covariance says
_MEDIAN_CHI2_3 = 2.366
_SIGMA = 4.0
_SURE_PERIODS = 0.15  # to which the step that is left must be known


@dataclass(frozen=True, slots=True, eq=False)
class _Turns:
    """What each posed frame is turned against the gyro, for each shift of its stamp.

    ``frame`` (n,) are the frames, ``error`` (n, n_shifts, 3) rad, ``variance`` and ``drift`` (n,) rad^2,
    ``interval`` (n,) periods since the frame before, and ``offset_ns`` that of the clocks beyond the
    alignment's.
    """

    frame: IntArray
    error: FloatArray
    variance: FloatArray
    drift: FloatArray
    interval: FloatArray
    offset_ns: float

    def likeliest(self) -> tuple[IntArray, float, "_Turns"]:
        """Return each frame's likeliest shift, what they cost, and the turns with a variance that fits."""
        path, cost = self._path()
        square = surprises(self.error, self.variance, self.drift, path, _CAP)
        scale = max(float(np.median(square)) / _MEDIAN_CHI2_3, _LEAST_SCALE)
        scaled = replace(self, variance=self.variance * scale, drift=self.drift * scale)
        return scaled._path()[0], cost, scaled

    def _path(self) -> tuple[IntArray, float]:
        return likeliest_shifts(self.error, self.variance, self.drift, self.interval, _CHANGE_PRICE, _CAP)

    def costs(self, part: slice, paths: IntArray) -> FloatArray:
        """Return the costs of sequences of shifts in a part of the frames."""
        return path_costs(self.error[part], self.variance[part], self.drift[part], paths, _CAP)

    def by_shift(self, part: slice) -> FloatArray:
        """Return what each shift, the same for all frames of a part, costs; shape (n_shifts,)."""
        n, n_shifts = self.error[part].shape[:2]
        return self.costs(part, np.tile(np.arange(n_shifts)[:, None], n))


def find_slips(
    optical: OpticalTrack,
    imu: ImuTrack,
    alignment: TimeAlignment,
    align: Callable[[OpticalTrack], TimeAlignment],
    *,
    prior_offset_ns: float = 0.0,
    prior_sd_ns: float = 5e6,
    max_offset_s: float = 0.25,
) -> StampSlips | None:
    """Return the whole-period slips of the frames' stamps, or None where none is certain.

    Parameters
    ----------
    optical : OpticalTrack
        Of a camera at rest, with instants as stamped.
    imu : ImuTrack
        In brick axes.
    alignment : TimeAlignment
        Of the two as they are.
    align : callable
        Aligns other poses with the same IMU.
    prior_offset_ns, prior_sd_ns, max_offset_s
        As `align_times` has them: they tell which side of a slip is right.

    Notes
    -----
    The attitudes against the integrated gyro have a likelihood for each shift of each frame by whole periods.
    Its best sequence (Viterbi) says how many slips there are, and all places of one slip are then compared.
    Twice: clocks aligned with the first answer's stamps are sharper.
    """
    regularity = stamp_regularity(optical.t_ns)
    if not regularity.is_steady or regularity.steps:
        return None
    at: TimeAlignment | None = alignment
    if alignment.source != "data":
        at = _by_correlation(optical, imu, alignment, prior_offset_ns * 1e-9, max_offset_s)
    else:
        # A skew, and a clock of the sensor's own, may be how the slip was taken; without, 5 ms are wrong.
        at = replace(alignment, skew=0.0, sample_clock=None)
    slips: StampSlips | None = None
    for strictness in (_COARSE, 1.0):
        levels = None if at is None else _levels(_turns(optical, imu, at, regularity.period_ns), strictness)
        if at is None or levels is None:
            return None
        slips = _slips(optical, levels, regularity.period_ns, at, prior_offset_ns, prior_sd_ns)
        at = align(slips.mended(optical))
        if at.source != "data":
            return None
        slips = replace(slips, alignment=at)
    if slips is None or not _is_without_step(slips, optical, imu):
        return None
    logger.warning("frame stamps slip by whole periods at frames %s", [s.frame for s in slips.slips])
    return slips


def _by_correlation(
    optical: OpticalTrack, imu: ImuTrack, alignment: TimeAlignment, prior_s: float, max_offset_s: float
) -> TimeAlignment | None:
    """Return an alignment with the offset at which the angular rates correlate best, if they do at all."""
    seen = has_pose(optical)
    signal = ImuSignal.from_track(imu)
    t_s = seconds_since(optical.t_ns[seen], signal.epoch_ns)
    if len(t_s) < MIN_POSES:
        return None
    found = correlate(t_s, optical.R_camera_brick[seen], signal, centre_s=prior_s, max_offset_s=max_offset_s)
    if not np.isfinite(found.vector).any():
        return None
    offset_s = float(found.lags_s[np.nanargmax(found.vector)])
    return replace(alignment, offset_ns=offset_s * 1e9, skew=0.0, sample_clock=None)


def _turns(optical: OpticalTrack, imu: ImuTrack, alignment: TimeAlignment, period_ns: float) -> list[_Turns]:
    """Return what posed frames with inertial samples beside them are turned against the gyro.

    At the alignment's offset, and a third of a period to either side: the one offset that was found for
    stamps that slip may lie half-way between those that they have. Empty where too few frames compare.
    """
    signal = signal_of(imu, alignment)
    frame = np.flatnonzero(has_pose(optical))
    period_s = period_ns * 1e-9
    shifts_s = np.arange(-3 * _MOST_PERIODS - 1, 3 * _MOST_PERIODS + 2) * period_s / 3
    t_s = seconds_since(alignment.imu_time_ns(optical.t_ns[frame]), signal.epoch_ns)[:, None] + shifts_s
    whole = ~signal.in_gap(t_s, least_periods=BRIDGE_PERIODS).any(axis=1)
    frame, t_s = frame[whole], t_s[whole]
    if len(frame) < MIN_POSES:
        return []
    instants, which = np.unique(t_s, return_inverse=True)
    A = np.empty((len(instants), 3, 3))
    integrate_attitudes(signal.gyro_pieces(), instants, alignment.gyro_bias_radps, A)
    A = A[which.reshape(t_s.shape)]
    R = optical.R_camera_brick[frame]
    start = R[0] @ A[0, A.shape[1] // 2].T
    error = turns_from_gyro(start.T @ R, A)
    variance = np.trace(optical.covariance[frame][:, :3, :3], axis1=1, axis2=2) / 3
    variance = np.maximum(variance, MIN_ROTATION_SD_RAD**2)
    interval_s = np.diff(t_s[:, 0], prepend=t_s[0, 0])
    # A mean whose variance grows so remembers about this long.
    drift = np.median(variance) * period_s * interval_s / _MEMORY_S**2
    # Across a gap the gyro holds no attitude at all.
    at_s = t_s[:, t_s.shape[1] // 2]
    long_s = signal.gaps_s[np.diff(signal.gaps_s, axis=1)[:, 0] > BRIDGE_PERIODS * signal.period_s, 0]
    drift[1:][np.diff(np.searchsorted(long_s, at_s)) > 0] = _UNKNOWN_RAD**2
    return [
        _Turns(frame, np.ascontiguousarray(error[:, third::3]), variance, drift, interval_s / period_s, ms)
        for third, ms in ((1, 0.0), (0, -period_ns / 3), (2, period_ns / 3))
    ]


def _levels(at_offsets: list[_Turns], strictness: float) -> tuple[_Turns, list[int], list[int]] | None:
    """Return where the shift changes, as numbers of posed frames with both ends, and the shift of each part.

    None where it never does, or the turns do not tell to which shift, ``strictness`` times as clearly as a
    slip must be in the end.
    """
    if not at_offsets:
        return None
    path, _, turns = min((turns.likeliest() for turns in at_offsets), key=lambda found: found[1])
    ends = [0, *(np.flatnonzero(np.diff(path)) + 1).tolist(), len(path)]
    shifts = [int(path[begin]) for begin in ends[:-1]]
    while len(shifts) > 1:
        costs = [turns.by_shift(slice(*part)) for part in pairwise(ends)]
        beside = [shifts[max(i - 1, 0) : i] + shifts[i + 1 : i + 2] for i in range(len(shifts))]
        earned = [
            min(cost[others]) - cost[own] for cost, own, others in zip(costs, shifts, beside, strict=True)
        ]
        i = int(np.argmin(earned))
        if earned[i] >= strictness * _EARN:
            break
        # What a part does not rule out of the part beside it, it shares.
        shifts[i] = min(beside[i], key=lambda s: float(costs[i][s]))
        keep = [k for k in range(1, len(shifts)) if shifts[k] != shifts[k - 1]]
        ends = [0, *(ends[k] for k in keep), ends[-1]]
        shifts = [shifts[0], *(shifts[k] for k in keep)]
    if len(shifts) == 1:
        return None
    for part, own in zip(pairwise(ends), shifts, strict=True):
        cost = turns.by_shift(slice(*part))
        if np.delete(cost, own).min() - cost[own] < strictness * _RIVAL:
            return None  # the motion repeats
    return turns, ends, shifts


def _places(turns: _Turns, ends: list[int], shifts: list[int], i: int) -> IntArray:
    """Return the posed frames that may be the first behind change ``i`` of the shift, the likeliest first."""
    begin, end = ends[i - 1], ends[i + 1]
    behind = np.arange(begin + 1, end)
    paths = np.where(np.arange(begin, end) < behind[:, None], shifts[i - 1], shifts[i])
    cost = turns.costs(slice(begin, end), paths)
    return behind[np.argsort(cost, kind="stable")][: int(np.count_nonzero(cost < cost.min() + _DOUBT))]


def _slips(
    optical: OpticalTrack,
    levels: tuple[_Turns, list[int], list[int]],
    period_ns: float,
    alignment: TimeAlignment,
    prior_offset_ns: float,
    prior_sd_ns: float,
) -> StampSlips:
    """Return the slips, each at its likeliest place, and the stamps mended by them."""
    turns, ends, shifts = levels
    n = len(optical.t_ns)
    offset_ns = alignment.offset_ns + turns.offset_ns - prior_offset_ns
    base, is_side_told = _right_side(shifts, period_ns, offset_ns, prior_sd_ns)
    late = np.full(n, base - shifts[0])
    slips: list[StampSlip] = []
    for i in range(1, len(shifts)):
        step = shifts[i - 1] - shifts[i]
        between = [np.arange(turns.frame[k - 1], turns.frame[k]) + 1 for k in _places(turns, ends, shifts, i)]
        may_slip = [frames[may_slip_at(optical, frames, step, period_ns)] for frames in between]
        likeliest, *others = [frames for frames in may_slip if frames.size] or between
        # Where several frames lie between two that have turns: behind the longest interval of the stamps.
        frame = int(likeliest[np.argmax(optical.t_ns[likeliest] - optical.t_ns[likeliest - 1])])
        late[frame:] = base - shifts[i]
        candidates = np.concatenate([likeliest, *others])
        slips.append(StampSlip(frame, int(candidates.min()), int(candidates.max()), step))
    return mend(optical, slips, late, period_ns=period_ns, is_side_told=is_side_told, alignment=alignment)


def _right_side(
    shifts: list[int], period_ns: float, offset_ns: float, prior_sd_ns: float
) -> tuple[int, bool]:
    """Return the shift at which the stamps are right, and whether the clocks told it.

    ``offset_ns`` is of the clocks, beyond what was promised, at no shift.
    """
    each = sorted(set(shifts), key=lambda s: abs(offset_ns + (s - _MOST_PERIODS) * period_ns))
    near, far = (((offset_ns + (s - _MOST_PERIODS) * period_ns) / prior_sd_ns) ** 2 for s in each[:2])
    if near < _SIGMA**2 <= far - near:
        return each[0], True
    return shifts[0], False


def _is_without_step(slips: StampSlips, optical: OpticalTrack, imu: ImuTrack) -> bool:
    """Return whether the clocks run on at every slip, once the stamps are mended."""
    mended = slips.mended(optical)
    ends = [0, *(slip.frame for slip in slips.slips), len(mended.t_ns)]
    for i, slip in enumerate(slips.slips, start=1):
        change = offset_change(
            mended, imu, slips.alignment, split_ns=int(mended.t_ns[slip.frame]),
            from_ns=int(mended.t_ns[ends[i - 1]]), to_ns=int(mended.t_ns[ends[i + 1] - 1]),
        )  # fmt: skip
        if change is None or abs(change.change_s) > _SIGMA * change.sd_s:
            return False
        if change.sd_s * 1e9 > _SURE_PERIODS * slips.period_ns:
            return False
    return True
