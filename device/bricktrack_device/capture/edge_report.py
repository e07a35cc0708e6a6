"""What a run's edges say of the square wave: its frequency, and what is missing, extra, late or wrong.

The stream keeps every edge as it was stamped; this only counts and puts into words. A host judges the edges
anew, with a line through all of them.
"""

from collections.abc import Sequence
from itertools import pairwise
from statistics import median

from bricktrack_common.run_manifest import WaveSection

IN_STEP = 0.1
"""Of a period: an edge so near to its place is where it should be; further off, up to `OUT_OF_STEP`, late."""
OUT_OF_STEP = 0.3
MIN_EDGES = 10
"""So many make a wave; fewer may be a few pulses, and are not judged unless a frequency is configured."""
WRONG_FREQUENCY = 0.01
"""Of the configured one: function generators err by less, crystals by far less."""


def judge_edges(
    edges_ns: Sequence[int],
    *,
    nominal_hz: float | None,
    end_ns: int,
    rejected_ns: Sequence[int] = (),
    line_is_high: bool | None = None,
) -> tuple[WaveSection, list[str]]:
    """Return counts over a train of rising edges, and what is wrong with it in words.

    Parameters
    ----------
    edges_ns : sequence of int, strictly increasing
        From t = 0 on.
    nominal_hz : float or None
        The frequency as configured.
    end_ns : int
        Until when edges were listened for and are asked for.
    rejected_ns : sequence of int
        Edges before t = 0 that did not count; only handed on.
    line_is_high : bool or None
        The line's level at the end, said where the wave stopped.
    """
    rejected = list(rejected_ns)
    words = _words_of_rejected(rejected, edges_ns)
    period_ns = _period_ns(edges_ns, nominal_hz)
    if not edges_ns or period_ns is None or (nominal_hz is None and len(edges_ns) < MIN_EDGES):
        last = edges_ns[-1] if edges_ns else None
        return WaveSection(last_edge_ns=last, rejected_ns=rejected), words
    t0 = last_ns = edges_ns[0]
    n_steps = 0
    taken, late_places, n_extra = {0}, set[int](), 0
    for t_ns in edges_ns[1:]:
        steps = (t_ns - last_ns) / period_ns
        k = round(steps)
        if k >= 1 and abs(steps - k) <= IN_STEP:
            n_steps, last_ns = n_steps + k, t_ns
            taken.add(n_steps)
        elif k >= 1 and IN_STEP < steps - k <= OUT_OF_STEP and n_steps + k not in late_places:
            late_places.add(n_steps + k)  # an interrupt may be late, never early
        else:
            n_extra += 1
    n_late = len(late_places - taken)
    n_extra += len(late_places & taken)  # the edge itself came too
    n_missed = max(taken | late_places) + 1 - len(taken | late_places)
    hz = n_steps * 1e9 / (last_ns - t0) if n_steps else None
    n_after = max(0, int((end_ns - edges_ns[-1]) / period_ns + IN_STEP) - 1) if end_ns > edges_ns[-1] else 0
    wave = WaveSection(
        hz=hz, n_missed=n_missed, n_extra=n_extra, n_late=n_late, last_edge_ns=last_ns,
        n_after_last=n_after, rejected_ns=rejected,
    )  # fmt: skip
    return wave, words + _words_of_wave(wave, t0, nominal_hz, line_is_high)


def _period_ns(edges_ns: Sequence[int], nominal_hz: float | None) -> float | None:
    """Return the period that most intervals have, or the configured one where they do not tell."""
    intervals = [b - a for a, b in pairwise(edges_ns)]
    if len(intervals) < 4:
        return None if nominal_hz is None else 1e9 / nominal_hz
    if nominal_hz is not None:
        near = [i for i in intervals if abs(i * nominal_hz * 1e-9 - 1) <= IN_STEP]
        if 2 * len(near) >= len(intervals):
            return median(near)
    return median(intervals)


def _words_of_rejected(rejected_ns: Sequence[int], edges_ns: Sequence[int]) -> list[str]:
    if not rejected_ns:
        return []
    words = f"trigger: {len(rejected_ns)} rising edges before t = 0 did not count"
    if edges_ns:
        words += f", the last {(edges_ns[0] - rejected_ns[-1]) / 1e6:.1f} ms before it"
    return [words + "; the manifest keeps their stamps"]


def _words_of_wave(
    wave: WaveSection, t0_ns: int, nominal_hz: float | None, line_is_high: bool | None
) -> list[str]:
    words = []
    if nominal_hz is not None and wave.hz is not None and abs(wave.hz / nominal_hz - 1) > WRONG_FREQUENCY:
        words.append(
            f"trigger: the wave has {wave.hz:.4g} Hz where trigger.nominal_hz is {nominal_hz:g}; t = 0 is "
            "its first edge. Correct the configuration or the generator"
        )
    counts = {"missed": wave.n_missed, "extra, out of step": wave.n_extra, "late": wave.n_late}
    wrong = [f"{n} {what}" for what, n in counts.items() if n]
    if wrong:
        words.append(f"trigger: edges of the wave: {', '.join(wrong)}; all that came are in the stream")
    if wave.n_after_last and wave.last_edge_ns is not None:
        words.append(
            f"trigger: the wave stopped {(wave.last_edge_ns - t0_ns) / 1e9:.3f} s after t = 0; "
            f"{wave.n_after_last} more edges were expected until the run's end"
            + ("" if line_is_high is None else f"; the line is {'high' if line_is_high else 'low'} now")
        )
    return words
