"""Where samples were left out, by the attitudes: reads and kinks alone may put it some samples beside.

A read that comes as the sensor takes a sample may find it, or the one before. So for some reads around a slip
of the two clocks nobody knows from them alone which samples they found, and all between a wrong place and the
right one are a period off. In a fast motion that is a degree, which the frames beside it see.
"""

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.fusion.clocks.posed_frames import FramesBesideGyro, PosedFrames
from bricktrack_host.fusion.clocks.rotation_fit import Fit
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal

NEAR_S = 4.5e-4
"""Of the taking of a sample, where a read may find it or the one before: three times how unsure reads are."""
_FARTHEST = 40  # reads
_BESIDE = 4  # frames on either side of what moves
_EARN = 20.0  # chi-square that another place must earn; there are some tens of places to choose from
_CAP = 100.0  # what one frame can say: one wrong pose does not choose the place


def skips_by_attitudes(
    sample: IntArray,
    age_s: FloatArray,
    frames: PosedFrames,
    signal: ImuSignal,
    sample_s: FloatArray,
    fit: Fit,
) -> IntArray:
    """Return which sample each read found, samples left out where the attitudes fit best.

    Parameters
    ----------
    sample : ndarray of int64, shape (n,)
        By reads and kinks.
    age_s : ndarray, shape (n,), s
        How long before the read that sample was taken.
    frames : PosedFrames
        Camera time, after the signal's epoch.
    signal : ImuSignal
        At the instants of ``sample``.
    sample_s : ndarray, shape (n,), s
        Those of each read, after the epoch.
    fit : Fit
        Of the attitudes to it.
    """
    may_be_next, may_be_last = age_s > signal.period_s - NEAR_S, age_s < NEAR_S
    skips = np.flatnonzero(np.diff(sample) == 2) + 1
    skips = skips[may_be_next[skips - 1] | may_be_last[skips]]
    if not skips.size:
        return sample
    places = _Places(frames, signal, fit)
    out = sample.copy()
    for skip in skips.tolist():
        moves = _moves(out, may_be_next, may_be_last, skip)
        if moves and (best := places.best(moves, sample_s)) is not None:
            begin, end, by = best
            out[begin:end] += by
    return out


def _moves(
    sample: IntArray, may_be_next: BoolArray, may_be_last: BoolArray, skip: int
) -> list[tuple[int, int, int]]:
    """Return how a skip can be put elsewhere: reads ``begin`` to ``end`` found a sample ``by`` later.

    None that splits a repeat, of which both reads found one sample.
    """
    out = []
    for begin in range(skip - 1, max(skip - _FARTHEST, 1) - 1, -1):
        if not may_be_next[begin]:
            break
        if sample[begin] - sample[begin - 1] == 1:
            out.append((begin, skip, 1))
    for end in range(skip + 1, min(skip + _FARTHEST, len(sample) - 1) + 1):
        if not may_be_last[end - 1]:
            break
        if sample[end] - sample[end - 1] == 1:
            out.append((skip, end, -1))
    return out


class _Places:
    """How the attitudes agree with the gyro, and what another place of a skip does to that."""

    def __init__(self, frames: PosedFrames, signal: ImuSignal, fit: Fit) -> None:
        self._signal = signal
        beside = FramesBesideGyro(frames, signal)
        inside, self._segment = beside.covered(fit.offset_s)
        t_s = frames.t_s
        since_mid = t_s - 0.5 * (t_s[0] + t_s[-1])
        self._t_s = (t_s + fit.offset_s + fit.skew * since_mid)[inside]
        self._attitude, self._error, _ = beside.compared(
            inside, self._t_s, since_mid[inside], beside.integrated(fit.bias_radps), fit.bias_radps
        )
        self._segment = self._segment[inside]
        self._sd_rad = frames.sd_rad[inside] * fit.residual_sd

    def best(self, moves: list[tuple[int, int, int]], sample_s: FloatArray) -> tuple[int, int, int] | None:
        """Return the move that the attitudes earn enough by, if there is one."""
        first_s = sample_s[min(begin for begin, _, _ in moves) - 1]
        last_s = sample_s[max(end for _, end, _ in moves)]
        near = slice(
            max(int(np.searchsorted(self._t_s, first_s)) - _BESIDE, 0),
            int(np.searchsorted(self._t_s, last_s)) + _BESIDE,
        )
        t_s, error, variance = self._t_s[near], self._error[near], self._sd_rad[near] ** 2
        if len(t_s) < _BESIDE or len(np.unique(self._segment[near])) > 1:
            return None
        between = variance[1:] + variance[:-1]

        def cost(turned: FloatArray) -> float:
            step = np.diff(error - np.einsum("nij,nj->ni", self._attitude[near], turned), axis=0)
            return float(np.minimum((step**2).sum(axis=1) / between, _CAP).sum())

        costs = [cost(self._turned(t_s, sample_s, *move)) for move in moves]
        least = int(np.argmin(costs))
        return moves[least] if costs[least] < cost(np.zeros_like(error)) - _EARN else None

    def _turned(self, t_s: FloatArray, sample_s: FloatArray, begin: int, end: int, by: int) -> FloatArray:
        """Return how much farther the gyro turns up to instants, if samples were taken later, rad."""
        edges_s = np.array([sample_s[begin - 1], sample_s[begin], sample_s[end - 1], sample_s[end]])
        rate = self._signal.gyro_at(edges_s)
        before, behind = 0.5 * (rate[0] + rate[1]), 0.5 * (rate[2] + rate[3])
        later_s = by * self._signal.period_s
        at = np.clip(t_s, edges_s[1] + max(later_s, 0.0), edges_s[2] + min(later_s, 0.0))
        within = before - self._signal.gyro_at(at - 0.5 * later_s)
        turned = np.where((t_s > 0.5 * (edges_s[2] + edges_s[3]))[:, None], before - behind, within)
        return np.asarray(later_s * np.where((t_s < 0.5 * (edges_s[0] + edges_s[1]))[:, None], 0.0, turned))
