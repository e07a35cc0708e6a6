"""Which rising edge is t = 0: the first of a wave, and not a lone glitch before it.

Without a known period the first edge has to be believed. With one, an edge is a candidate until those after
it come in step: two of the next three periods must bring one. A wave that runs steadily at another frequency
than the configured one is believed too, because a run lost is worse than a run with a warning; `edge_report`
tells the difference.

What this cannot tell: a glitch just one period before the wave is an edge in step. The host finds such a slip
by comparing the edge trains of all units.
"""

from collections import deque
from dataclasses import dataclass
from itertools import pairwise

N_STEPS = 3
N_STEPS_NEEDED = 2
MAX_EXTRAS = 2
"""Edges out of step among those that confirm; a burst of noise has edges everywhere."""
STEP_TOLERANCE = 0.1
"""Of the period. Wider, and more glitches pass; narrower, and a first edge whose interrupt was late is taken
for one, which shifts the run by a period: 2 ms at 50 Hz is far above what a kernel's stamps scatter by."""
MIN_TOLERANCE_NS = 100_000
OTHER_WAVE_INTERVALS = 4
OTHER_WAVE_MAX_NS = 4_000_000_000
"""Longer than this the pre-roll is not held in memory beside the run."""
_MAX_SEEN = 64
_MAX_REJECTED = 100


@dataclass(frozen=True, slots=True)
class Believed:
    """The first edge, and every edge from it on that had come by then."""

    t0_ns: int
    edges_ns: list[int]


@dataclass(frozen=True, slots=True)
class _Edge:
    t_ns: int
    is_quiet: bool
    """The line was quiet before it for as long as asked."""
    may_be_first: bool
    """It belongs to no wave that ran already when the quiet gap should have been."""


class FirstEdgeFinder:
    """Takes rising edges, oldest first, until one is believed.

    Parameters
    ----------
    period_ns : float or None
        The wave's, if it is known.
    quiet_gap_ns : int
        How long the line must have been quiet before the first edge. With a known period only edges in step
        break the quiet: a lone glitch in the gap does no harm.
    """

    def __init__(self, period_ns: float | None, quiet_gap_ns: int) -> None:
        self._period_ns = period_ns
        self._tolerance_ns = max(MIN_TOLERANCE_NS, STEP_TOLERANCE * period_ns) if period_ns else 0.0
        self._quiet_gap_ns = quiet_gap_ns
        self._seen: deque[_Edge] = deque()
        self._old_wave_ns: int | None = None
        self._rejected: deque[int] = deque(maxlen=_MAX_REJECTED)
        self.n_rejected = 0

    @property
    def provisional_t0_ns(self) -> int | None:
        """The edge that will be t = 0 if those after it come in step."""
        return next((e.t_ns for e in self._seen if e.may_be_first), None)

    @property
    def rejected_ns(self) -> list[int]:
        """The edges that do not count, oldest first; the newest hundred."""
        return [*self._rejected, *(e.t_ns for e in self._seen if not e.may_be_first)][-_MAX_REJECTED:]

    def reject(self, t_ns: int) -> None:
        """Note an edge that cannot be the first, as one of a line that was never low."""
        self._rejected.append(t_ns)
        self.n_rejected += 1

    def take(self, t_ns: int, *, quiet_ns: int, since_armed_ns: int) -> Believed | None:
        """Take one rising edge; answer if the first edge is known by it.

        Parameters
        ----------
        t_ns : int
            Later than every edge before.
        quiet_ns : int
            Since the line's last change in either direction, or since arming.
        since_armed_ns : int
        """
        is_quiet = quiet_ns >= self._quiet_gap_ns
        if self._period_ns is None:
            if not is_quiet:
                self.reject(t_ns)
                return None
            return Believed(t_ns, [t_ns])
        may_be_first = self._may_be_first(t_ns, since_armed_ns, self._period_ns)
        self._seen.append(_Edge(t_ns, is_quiet, may_be_first))
        for edge in self._seen:
            if edge.may_be_first and self._is_in_step(edge.t_ns, self._period_ns):
                return self._believe(edge.t_ns)
        other = self._other_wave()
        if other is not None:
            return self._believe(other)
        if len(self._seen) > _MAX_SEEN:
            self.reject(self._seen.popleft().t_ns)
        return None

    def _may_be_first(self, t_ns: int, since_armed_ns: int, period_ns: float) -> bool:
        if not self._quiet_gap_ns:
            return True
        for edge in reversed(self._seen):
            if any(abs(t_ns - edge.t_ns - k * period_ns) <= self._tolerance_ns for k in (1, 2)):
                if not edge.may_be_first:
                    self._old_wave_ns = t_ns
                return edge.may_be_first
        silent_ns = since_armed_ns if self._old_wave_ns is None else t_ns - self._old_wave_ns
        return silent_ns >= self._quiet_gap_ns

    def _is_in_step(self, first_ns: int, period_ns: float) -> bool:
        later = [e.t_ns - first_ns for e in self._seen if e.t_ns > first_ns]
        steps = range(1, N_STEPS + 1)
        hits = [k for k in steps if any(abs(d - k * period_ns) <= self._tolerance_ns for d in later)]
        if len(hits) < N_STEPS_NEEDED:
            return False
        n_within = sum(d <= hits[-1] * period_ns + self._tolerance_ns for d in later)
        return n_within - len(hits) <= MAX_EXTRAS

    def _other_wave(self) -> int | None:
        """Return the first edge of a steady wave of another period, if the newest edges are one."""
        newest = list(self._seen)[-(OTHER_WAVE_INTERVALS + 1) :]
        if len(newest) <= OTHER_WAVE_INTERVALS or not newest[0].is_quiet:
            return None
        if newest[-1].t_ns - newest[0].t_ns > OTHER_WAVE_MAX_NS:
            return None
        intervals = sorted(b.t_ns - a.t_ns for a, b in pairwise(newest))
        middle = intervals[len(intervals) // 2]
        return newest[0].t_ns if intervals[-1] - intervals[0] <= STEP_TOLERANCE * middle else None

    def _believe(self, t0_ns: int) -> Believed:
        edges = [e.t_ns for e in self._seen if e.t_ns >= t0_ns]
        for edge in self._seen:
            if edge.t_ns < t0_ns:
                self.reject(edge.t_ns)
        self._seen.clear()
        return Believed(t0_ns, edges)
