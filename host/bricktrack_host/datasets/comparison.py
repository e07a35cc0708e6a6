"""What another processing changed: two results of one recording, row by row, against what they state as sd.

Rows are those of the same laboratory sample, or where a run has none, of the same picture: instants that no
processing changes. Both results are of the same data, so their difference is not noise: one that is a good
part of the stated standard deviation is a change that somebody should understand.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.errors import RunFormatError
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix
from bricktrack_host.assemblies.motion_history import MotionHistory, run_history
from bricktrack_host.results.result_store import Details, RunResult
from bricktrack_host.results.run_summary import key_figures, verdict

At = Literal["edge", "frame", "optical"]
AT_WORDS: dict[At, str] = {
    "edge": "laboratory samples",
    "frame": "pictures, fused",
    "optical": "pictures, camera alone",
}
_BAND = 1.96  # of standard deviations, 95 % of a normal distribution


@dataclass(frozen=True, slots=True)
class Change:
    """One thing that is another than before, in words."""

    what: str
    before: str
    after: str


@dataclass(frozen=True, slots=True, eq=False)
class Alike:
    """Two motions at the same instants; NaN where one has none that was measured.

    Attributes
    ----------
    name : str
        As ``b7-1``, or ``brick-7: C``.
    at : "edge", "frame" or "optical"
    t_s : ndarray, shape (n,)
    before, after : ndarray, shape (n, 6)
        Displacement, mm, then rotation vector, deg, from rest.
    difference : ndarray, shape (n, 6)
        After less before, mm; then the rotation from before to after as its vector, deg.
    sd : ndarray, shape (n, 6)
        The larger of the two stated standard deviations.
    appeared, disappeared : int
        Instants that are measured after only, before only.
    changes : tuple of Change
        What else is another: software, settings, calibration, rest pose, problems.
    """

    name: str
    at: At
    t_s: FloatArray
    before: FloatArray
    after: FloatArray
    difference: FloatArray
    sd: FloatArray
    appeared: int
    disappeared: int
    changes: tuple[Change, ...] = ()

    @property
    def n(self) -> int:
        """Return how many instants both have."""
        return len(self._known())

    @property
    def largest(self) -> FloatArray:
        """Return the largest differences, without sign, of each axis, shape (6,)."""
        known = self._known()
        return np.abs(known).max(axis=0) if len(known) else np.full(6, np.nan)

    @property
    def rms(self) -> FloatArray:
        """Return the root mean squared differences of each axis, shape (6,)."""
        known = self._known()
        return np.asarray(np.sqrt(np.mean(known**2, axis=0))) if len(known) else np.full(6, np.nan)

    @property
    def in_sd(self) -> FloatArray:
        """Return the largest differences over their standard deviations, of each axis, shape (6,)."""
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.abs(self.difference) / self.sd
        ratio[self.difference == 0] = 0.0
        known = ratio[np.isfinite(self.difference).all(axis=1)]
        return np.asarray(np.fmax.reduce(known, axis=0)) if len(known) else np.full(6, np.nan)

    @property
    def worst_s(self) -> float:
        """Return when an axis differs by most of its standard deviations, s; NaN where nothing differs."""
        if not np.nan_to_num(self.difference).any():
            return float("nan")
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.nan_to_num(np.abs(self.difference) / self.sd, nan=0.0).max(axis=1)
        return float(self.t_s[int(np.argmax(ratio))])

    @property
    def share_beyond(self) -> float:
        """Return the share of instants at which an axis differs by more than its 95 % band; NaN of none."""
        known = np.isfinite(self.difference).all(axis=1)
        if not known.any():
            return float("nan")
        return float(np.mean((np.abs(self.difference[known]) > _BAND * self.sd[known]).any(axis=1)))

    @property
    def is_same(self) -> bool:
        """Return whether no number differs and no instant came or went."""
        return not (self.appeared or self.disappeared) and not np.nan_to_num(self.difference).any()

    def _known(self) -> FloatArray:
        return np.asarray(self.difference[np.isfinite(self.difference).all(axis=1)])


def compare_runs(before: RunResult, after: RunResult, *, name: str | None = None) -> Alike:
    """Return what differs between two results of one recording.

    Raises
    ------
    RunFormatError
        If they are of different recordings.
    """
    if before.provenance.manifest_sha256 != after.provenance.manifest_sha256:
        raise RunFormatError(
            f"{before.manifest.run_id} and {after.manifest.run_id} are different recordings: only two "
            "processings of one recording are compared row by row"
        )
    at: At = "optical"
    if "edge" in before.fused and "edge" in after.fused:
        at = "edge"
    elif "frame" in before.fused and "frame" in after.fused:
        at = "frame"
    return _alike(
        name or after.manifest.unit, at, _keyed(before, at), _keyed(after, at), tuple(changes(before, after))
    )


def compare_components(name: str, before: MotionHistory, after: MotionHistory) -> Alike:
    """Return what differs between two motions of a component at the laboratory's samples."""
    keys = [np.rint(history.sample).astype(np.int64) for history in (before, after)]
    return _alike(name, "edge", (keys[0], before), (keys[1], after), ())


def worst_first(pairs: list[Alike]) -> list[Alike]:
    """Return pairs in the order in which somebody should look at them.

    First those that have no instant in common, then by the largest difference over its standard deviation,
    then by how many instants came or went.
    """

    def badness(pair: Alike) -> tuple[bool, float, int]:
        return pair.n == 0, float(np.nan_to_num(pair.in_sd).max()), pair.appeared + pair.disappeared

    return sorted(pairs, key=badness, reverse=True)


def changes(before: RunResult, after: RunResult) -> Iterator[Change]:
    """Yield what is another between two results: origin, settings, alignment, rest pose, problems."""
    old, new = before.provenance, after.provenance
    for what, a, b in (
        ("software", old.software_version, new.software_version),
        ("calibration, SHA-256", _short(old.calibration_sha256), _short(new.calibration_sha256)),
        ("layout, SHA-256", _short(old.layout_sha256), _short(new.layout_sha256)),
    ):
        if a != b:
            yield Change(what, a, b)
    yield from _details("setting", old.settings, new.settings)
    yield from _details("calibration", before.calibration, after.calibration)
    yield from _details("alignment", before.alignment, after.alignment)
    if (before.rest is None) != (after.rest is None):
        yield Change("rest pose", *("none" if r.rest is None else "known" for r in (before, after)))
    problems = [verdict(result, key_figures(result))[1] for result in (before, after)]
    for problem in problems[0]:
        if problem not in problems[1]:
            yield Change("problem", problem, "–")
    for problem in problems[1]:
        if problem not in problems[0]:
            yield Change("problem", "–", problem)


def _details(kind: str, before: Details, after: Details) -> Iterator[Change]:
    for name in dict.fromkeys([*before, *after]):
        a, b = before.get(name), after.get(name)
        if a != b:
            yield Change(f"{kind} {name}", _said(a), _said(b))


def _said(value: object) -> str:
    if value is None:
        return "–"
    if isinstance(value, list):
        return ", ".join(_said(x) for x in value)
    return f"{value:.5g}" if isinstance(value, float) else msgspec.json.encode(value).decode().strip('"')


def _short(sha256: str | None) -> str:
    return "none" if sha256 is None else f"{sha256[:12]}…"


_Keyed = tuple[IntArray, MotionHistory | None]


def _keyed(result: RunResult, at: At) -> _Keyed:
    """Return the instants' numbers, which no processing changes, and the motion there; no rest, no motion."""
    if at == "edge":
        keys = result.edge_index
    else:
        keys = result.observations.sensor_timestamp_ns
        if at == "frame" and len(result.fused["frame"].t_ns) != len(keys):
            raise RunFormatError(
                f"{result.manifest.run_id}: {len(result.fused['frame'].t_ns)} fused rows of {len(keys)} "
                "pictures. Process the run again"
            )
    if result.rest is None:
        return keys, None
    return keys, run_history(result, None if at == "optical" else at)


def _alike(name: str, at: At, before: _Keyed, after: _Keyed, changed: tuple[Change, ...]) -> Alike:
    keys = np.union1d(before[0], after[0])
    (a, sd_a, t_a), (b, sd_b, t_b) = (_on(keys, *one) for one in (before, after))
    known_a, known_b = np.isfinite(a).all(axis=1), np.isfinite(b).all(axis=1)
    difference = b - a
    both = known_a & known_b
    R_a, R_b = (matrix_from_rvec(np.deg2rad(x[both, 3:])) for x in (a, b))
    difference[both, 3:] = np.rad2deg(rvec_from_matrix(np.swapaxes(R_a, -1, -2) @ R_b))
    # Rounding alone turns no rotation into one of 1e-15 rad: equal numbers differ by nothing.
    difference[(a == b).all(axis=1)] = 0.0
    return Alike(
        name=name,
        at=at,
        t_s=np.where(np.isfinite(t_a), t_a, t_b),
        before=a,
        after=b,
        difference=difference,
        sd=np.fmax(sd_a, sd_b),
        appeared=int(np.count_nonzero(known_b & ~known_a)),
        disappeared=int(np.count_nonzero(known_a & ~known_b)),
        changes=changed,
    )


def _on(
    keys: IntArray, own: IntArray, history: MotionHistory | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return motion, standard deviations and times at wanted instants, NaN where it was not measured."""
    values, sd, t_s = (
        np.full((len(keys), 6), np.nan),
        np.full((len(keys), 6), np.nan),
        np.full(len(keys), np.nan),
    )
    if history is None:
        return values, sd, t_s
    rows = np.searchsorted(keys, own)
    t_s[rows] = history.t_s
    known = history.measured
    values[rows[known]] = np.hstack([history.displacement_mm, history.rotation_deg])[known]
    sd[rows[known]] = np.hstack([history.displacement_sd_mm, history.rotation_sd_deg])[known]
    return values, sd, t_s
