"""Whether edge 0 of each unit of a test is the same rise of the square wave; if not, by how many it is off.

A unit that missed the first edge numbers all others one too low, and nothing in its own recording shows it.
Three witnesses are heard for each pair of units, each giving the number of samples to add with a deviation:

- **end**: both saw the wave stop; its last edge is the same for both. Exact.
- **date**: both units' real-time clocks, if they were set by the same time server. As good as its 2 ms or so.
- **motion**: both ride on one table; the shift at which their accelerations agree best, in whatever axes.

A witness whose deviation is more than a sixth of a period cannot tell neighbouring edges apart and is silent.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.run_manifest import RunManifest
from bricktrack_host.results.daq_clock import EdgeFit
from bricktrack_host.results.result_store import RunResult, read_result
from bricktrack_host.tracks import ImuTrack

Witness = Literal["end", "date", "motion"]

MAX_SLIP = 50
DATE_SD_S = 0.002  # chrony over a switched network holds 0.1 to 1 ms; the triplet is read within microseconds
_SURE_PERIODS = 1 / 6  # three deviations fit into half a period
_MIN_QUIET_EDGES = 2
_BLOCKS = 6
_MIN_AGREEMENT = 0.5


@dataclass(frozen=True, slots=True)
class Testimony:
    """What one witness says of a unit against the reference.

    Attributes
    ----------
    witness : "end", "date" or "motion"
    samples, sd_samples : float
        To be added to the unit's edge numbers to get the reference's.
    """

    witness: Witness
    samples: float
    sd_samples: float


@dataclass(frozen=True, slots=True)
class UnitSlip:
    """One unit against the reference.

    Attributes
    ----------
    unit : str
    samples : int
        To be added to the unit's edge numbers; 0 where nothing sure is known.
    state : "agrees", "corrected", "contradictory" or "unknown"
    testimonies : tuple of Testimony
    """

    unit: str
    samples: int
    state: Literal["agrees", "corrected", "contradictory", "unknown"]
    testimonies: tuple[Testimony, ...]


@dataclass(frozen=True, slots=True)
class EdgeComparison:
    """The edge trains of all units of a test.

    Attributes
    ----------
    reference : str
        The unit whose numbers most others share.
    units : tuple of UnitSlip
    """

    reference: str
    units: tuple[UnitSlip, ...]

    @property
    def slips(self) -> dict[str, int]:
        """Samples to add to each unit's edge numbers."""
        return {unit.unit: unit.samples for unit in self.units}

    def problems(self) -> list[str]:
        """Return what a reader must know, in words; empty when all units agree."""
        found = []
        for unit in self.units:
            told = ", ".join(
                f"{t.witness} {t.samples:+.2f} (sd {t.sd_samples:.2f})" for t in unit.testimonies
            )
            if unit.state == "corrected":
                found.append(
                    f"{unit.unit}: its edge 0 is the wave's edge {unit.samples:+d} by {self.reference}; its "
                    f"sample numbers are corrected by {unit.samples:+d} ({told})"
                )
            elif unit.state == "contradictory":
                found.append(
                    f"{unit.unit}: witnesses contradict each other about its first edge against "
                    f"{self.reference} ({told}); its sample numbers are left as recorded and "
                    "may be off by whole periods"
                )
            elif unit.state == "unknown":
                found.append(
                    f"{unit.unit}: nothing tells whether its first edge is that of {self.reference}. Let the "
                    "wave stop before recordings end, or set all units' clocks from one time server"
                )
        return found


def compare_edges(results: Mapping[str, RunResult]) -> EdgeComparison | None:
    """Return how the edge numbers of a test's units compare, or `None` where fewer than two have edges.

    Parameters
    ----------
    results : mapping of unit to RunResult
        Of one shake.

    Notes
    -----
    The reference is the unit whose count most others share: the rare miss is found whichever unit it befell.
    """
    fits = {unit: result.edge_fit for unit, result in results.items() if result.edge_fit is not None}
    if len(fits) < 2:
        return None
    first, *_ = fits
    others = _against(first, fits, results)
    # What most units share, the first one's own 0 among them, is the wave's count.
    counts = [0, *(unit.samples for unit in others if unit.state in ("agrees", "corrected"))]
    common = max(set(counts), key=lambda samples: (counts.count(samples), samples == 0))
    if common == 0:
        return EdgeComparison(first, (UnitSlip(first, 0, "agrees", ()), *others))
    reference = next(unit.unit for unit in others if unit.samples == common)
    return EdgeComparison(
        reference, (UnitSlip(reference, 0, "agrees", ()), *_against(reference, fits, results))
    )


def compare_runs(folders: Mapping[str, Path]) -> EdgeComparison | None:
    """Return how the edge numbers of processed runs of one shake compare; see `compare_edges`.

    Parameters
    ----------
    folders : mapping of unit to path
        Results folders.

    Raises
    ------
    RunFormatError
        If one cannot be read.
    """
    # Of each run only what is compared is kept: a hundred units fit into memory.
    return compare_edges({unit: replace(read_result(path), fused={}) for unit, path in folders.items()})


def _against(reference: str, fits: Mapping[str, EdgeFit], results: Mapping[str, RunResult]) -> list[UnitSlip]:
    return [
        _judge(unit, _testimonies(results[unit], results[reference], fits[unit], fits[reference]))
        for unit in fits
        if unit != reference
    ]


def _judge(unit: str, heard: list[Testimony]) -> UnitSlip:
    sure = [t for t in heard if t.sd_samples <= _SURE_PERIODS]
    whole = {round(t.samples) for t in sure}
    if any(abs(t.samples - round(t.samples)) > 3 * max(t.sd_samples, 0.05) for t in sure) or len(whole) > 1:
        return UnitSlip(unit, 0, "contradictory", tuple(heard))
    if not whole:
        return UnitSlip(unit, 0, "unknown", tuple(heard))
    samples = whole.pop()
    return UnitSlip(unit, samples, "corrected" if samples else "agrees", tuple(heard))


def _testimonies(
    unit: RunResult, reference: RunResult, fit: EdgeFit, reference_fit: EdgeFit
) -> list[Testimony]:
    heard = []
    if _saw_the_end(unit.manifest) and _saw_the_end(reference.manifest):
        heard.append(Testimony("end", float(reference_fit.last_index - fit.last_index), 0.0))
    period_s = reference_fit.period_ns / 1e9
    ours, theirs = _date_of_edge_0(unit.manifest, fit), _date_of_edge_0(reference.manifest, reference_fit)
    if ours is not None and theirs is not None:
        samples = (ours - theirs) / 1e9 / period_s
        if abs(samples) <= MAX_SLIP:  # further off, a clock was never set
            heard.append(Testimony("date", samples, DATE_SD_S / period_s))
    if unit.imu is not None and reference.imu is not None:
        moved = _motion_shift(unit.imu, reference.imu, fit, reference_fit)
        if moved is not None:
            heard.append(moved)
    return heard


def _saw_the_end(manifest: RunManifest) -> bool:
    wave = manifest.trigger.wave
    return wave is not None and wave.n_after_last >= _MIN_QUIET_EDGES


def _date_of_edge_0(manifest: RunManifest, fit: EdgeFit) -> int | None:
    triplet = manifest.clocks.trigger or manifest.clocks.arm
    return None if triplet is None else fit.t0_ns + triplet.realtime_ns - triplet.monotonic_ns


def _motion_shift(unit: ImuTrack, reference: ImuTrack, fit: EdgeFit, other: EdgeFit) -> Testimony | None:
    """Return the shift at which two accelerations agree best, whatever the axes of each sensor.

    For each shift the best rotation between the two is that of Wahba's problem, so the agreement is the sum
    of the singular values of the 3 x 3 cross-covariance over the product of the standard deviations. The
    deviation comes from the scatter of the best shifts of six blocks of the recording.
    """
    step = max(0.005 / (other.period_ns / 1e9), 0.01)  # half a sensor slot, in samples of the wave
    index = np.arange(0.0, min(fit.last_index, other.last_index), step)
    n_shifts = int(np.ceil(min(MAX_SLIP, index.size * step / 4) / step))
    ours, theirs = _at_samples(unit, fit, index), _at_samples(reference, other, index)
    known = np.asarray(np.isfinite(ours).all(axis=1) & np.isfinite(theirs).all(axis=1))
    if known.sum() < max(100, 4 * n_shifts):
        return None
    ours, theirs = (np.where(known[:, None], a - a[known].mean(axis=0), 0.0) for a in (ours, theirs))
    whole, agreement = _best_shift(ours, theirs, n_shifts)
    if agreement < _MIN_AGREEMENT or abs(whole) >= n_shifts - 1:
        return None
    near = max(int(np.ceil(1.5 / step)), 2)
    blocks = []
    for part in np.array_split(np.arange(n_shifts, index.size - n_shifts), _BLOCKS):
        if np.any(ours[part]) and np.any(theirs[part]):
            shift, fits = _best_shift(ours, theirs, near, rows=part, about=round(whole))
            if fits >= _MIN_AGREEMENT:
                blocks.append(shift)
    if len(blocks) < _BLOCKS // 2:
        return None
    sd = float(np.std(blocks, ddof=1)) / np.sqrt(len(blocks))
    return Testimony("motion", whole * step, max(sd * step, 0.1 * step))


def _at_samples(imu: ImuTrack, fit: EdgeFit, index: FloatArray) -> FloatArray:
    """Return the specific force at (fractional) samples of the wave, NaN where it is not known."""
    known = np.isfinite(imu.acc_mps2).all(axis=1)
    if known.sum() < 2:
        return np.full((index.size, 3), np.nan)
    at = fit.sample_index_of(imu.t_ns[known])
    force = np.stack([np.interp(index, at, imu.acc_mps2[known, i]) for i in range(3)], axis=1)
    gap = np.diff(at)[np.clip(np.searchsorted(at, index) - 1, 0, at.size - 2)]
    outside = (index < at[0]) | (index > at[-1]) | (gap > 3 * np.median(np.diff(at)))
    force[outside] = np.nan
    return force


def _best_shift(
    ours: FloatArray, theirs: FloatArray, n_shifts: int, *, rows: IntArray | None = None, about: int = 0
) -> tuple[float, float]:
    """Return the shift, in grid steps, to be added to our index, and the agreement there, 0 to 1."""
    n = len(ours)
    rows = np.arange(n) if rows is None else rows
    shifts = np.arange(about - n_shifts, about + n_shifts + 1)
    agreement = np.zeros(shifts.size)
    for i, shift in enumerate(shifts):
        there = rows + shift
        inside = (there >= 0) & (there < n)
        a, b = ours[rows[inside]], theirs[there[inside]]
        power = np.sqrt(np.sum(a * a) * np.sum(b * b))
        if power > 0:
            agreement[i] = np.linalg.svd(a.T @ b, compute_uv=False).sum() / power
    best = int(np.argmax(agreement))
    if 0 < best < shifts.size - 1:
        left, top, right = agreement[best - 1 : best + 2]
        bend = left - 2 * top + right
        offset = 0.0 if bend >= 0 else float(0.5 * (left - right) / bend)
        return float(shifts[best]) + offset, float(top)
    return float(shifts[best]), float(agreement[best])
