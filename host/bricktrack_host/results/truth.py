"""How far results are from the truth of a simulated run: errors, and whether the covariances are honest."""

from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np
from rich import box
from rich.table import Table
from scipy.special import chdtri

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray, rows_of
from bricktrack_common.errors import TrackingError
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix
from bricktrack_host.normalised_errors import normalised_squares
from bricktrack_host.quality import PoseFlag
from bricktrack_host.results.rest_pose import FromRest
from bricktrack_host.results.result_store import RunResult
from bricktrack_host.results.true_motion import TrueMotion
from bricktrack_host.tracks import FusedTrack, OpticalTrack

IMPACT_MPS2 = 30.0  # about 3 g: above the strongest shaking of the table, below the weakest impact
NEAR_IMPACT_NS = 50_000_000
_CHI2_95 = float(chdtri(6, 0.05))

Source = Literal["optical", "fused"]
COMPONENTS = ("x", "y", "z", "rot x", "rot y", "rot z")


class GroupErrors(msgspec.Struct, frozen=True, kw_only=True):
    """Errors of one track over one group of instants.

    Attributes
    ----------
    source : "optical" or "fused"
    group : str
        Which instants, in words.
    n : int
        Instants compared.
    n_without : int
        Instants of the group with a truth but without a pose, or the reverse.
    rms, largest, mean : list of float
        x, y, z in mm (camera axes), then the rotation error in degrees (brick axes): root mean square,
        largest magnitude, mean. NaN (null in JSON) where nothing could be compared.
    nees_mean : float
        Mean normalised error squared over its 6 degrees of freedom: 1 if the covariances are honest,
        larger if they promise too much.
    nees_within_95 : float
        Share of instants within the 95 % region of their covariance.
    """

    source: Source
    group: str
    n: int
    n_without: int
    rms: list[float]
    largest: list[float]
    mean: list[float]
    nees_mean: float
    nees_within_95: float


@dataclass(frozen=True, slots=True, eq=False)
class ErrorSeries:
    """Errors of one track over time.

    Attributes
    ----------
    t_ns : ndarray of int64, shape (n,)
    error : ndarray, shape (n, 6)
        Estimate less truth: x, y, z, mm, camera axes; rotation vector of R_true^T R_est, deg, brick axes.
    sd : ndarray, shape (n, 6)
        What the covariance promises, same units.
    """

    t_ns: IntArray
    error: FloatArray
    sd: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class TruthComparison:
    """A run against its truth.

    Attributes
    ----------
    groups : list of GroupErrors
        In camera axes with nothing zeroed.
    from_rest : list of GroupErrors
        The same instants as displacements from rest, x, y, z in brick axes at rest: constant errors are gone.
        Empty where the run has no rest pose.
    series : dict
        `ErrorSeries` of ``"optical"`` and ``"fused"`` (at inertial slots, or frames if there are none).
    impacts_ns : ndarray of int64, shape (k,)
        When the true acceleration first passed 30 m/s^2, for each impact.
    """

    groups: list[GroupErrors]
    from_rest: list[GroupErrors]
    series: dict[Source, ErrorSeries]
    impacts_ns: IntArray

    def to_json(self) -> bytes:
        """Return the figures as indented JSON; NaN becomes null."""
        data = {
            "schema": "bricktrack.truth-comparison",
            "version": 1,
            "simulated": True,
            "components": ["x_mm", "y_mm", "z_mm", "rot_x_deg", "rot_y_deg", "rot_z_deg"],
            "camera_frame": self.groups,
            "from_rest": self.from_rest,
            "impacts_ns": self.impacts_ns.tolist(),
        }
        return msgspec.json.format(msgspec.json.encode(data), indent=2) + b"\n"


def compare_with_truth(result: RunResult, truth: TrueMotion) -> TruthComparison:
    """Return the errors of a run's optical and fused poses against its true motion.

    Instants fall in one group each: during dropouts (the truth's, and what the fusion flagged as such),
    within 50 ms of an impact, at frames, and between frames; "all" joins the four. What was extrapolated
    beyond the first or last optical pose stands apart and is not in "all".

    Raises
    ------
    TrackingError
        If no instant of the run has a truth: another run's file, or another clock.
    """
    shift_ns = 0
    if truth.is_relative:
        # Such a file counts from the first stamp; poses hold at the instant of the frame's own pose.
        if not len(result.optical.t_ns):
            raise TrackingError("a run without frames cannot be laid over a truth that counts from the first")
        shift_ns = int(result.optical.t_ns[0] - truth.t_ns[0])
    impacts_ns = _impacts(truth) + shift_ns
    dropouts_ns = truth.dropouts_ns + shift_ns
    groups: list[GroupErrors] = []
    from_rest: list[GroupErrors] = []
    series: dict[Source, ErrorSeries] = {}
    true_rest = _true_rest(result, truth, shift_ns)

    def compare(source: Source, tracks: dict[str, OpticalTrack | FusedTrack], shown: str) -> None:
        true = {kind: truth.at(track.t_ns - shift_ns) for kind, track in tracks.items()}
        parts = {kind: _Errors.of(track, *true[kind]) for kind, track in tracks.items()}
        series[source] = ErrorSeries(tracks[shown].t_ns, parts[shown].error, parts[shown].sd)
        masks = {k: _group_masks(tracks[k], k, dropouts_ns, impacts_ns) for k in tracks}
        names = dict.fromkeys(name for m in masks.values() for name in m)
        zeroed = {}
        if true_rest is not None:
            seen = {k: result.from_rest["optical" if source == "optical" else k] for k in tracks}
            zeroed = {k: _rest_errors(seen[k], *true[k], true_rest) for k in tracks}
        for name in names:
            chosen = [(k, masks[k][name]) for k in tracks if name in masks[k]]
            if not any(mask.any() for _, mask in chosen):
                continue
            groups.append(_summarise(source, name, [parts[k].select(m) for k, m in chosen]))
            if zeroed:
                from_rest.append(_summarise(source, name, [zeroed[k].select(m) for k, m in chosen]))

    compare("optical", {"frame": result.optical}, "frame")
    if result.fused:
        tracks: dict[str, OpticalTrack | FusedTrack] = dict(result.fused.items())
        compare("fused", tracks, "imu" if "imu" in tracks else next(iter(tracks)))
    if not any(g.n for g in groups):
        raise TrackingError(
            f"the truth covers {truth.t_ns[0]}..{truth.t_ns[-1]} ns and no pose of run "
            f"{result.manifest.run_id} lies there: it belongs to another run, or to another clock"
        )
    return TruthComparison(groups, from_rest, series, impacts_ns)


@dataclass(frozen=True, slots=True, eq=False)
class _Errors:
    """Errors, promised deviations and normalised errors of a track; rows as the track."""

    error: FloatArray
    sd: FloatArray
    nees: FloatArray
    has_truth: BoolArray
    has_pose: BoolArray

    @classmethod
    def of(cls, track: OpticalTrack | FusedTrack, R_true: FloatArray, t_true_mm: FloatArray) -> "_Errors":
        shift_mm = track.t_camera_brick_mm - t_true_mm
        turn_rad = rvec_from_matrix(np.swapaxes(R_true, -1, -2) @ track.R_camera_brick)
        # The covariance is of [dtheta, dt] with R_true = R Exp(dtheta): minus this error, same size.
        raw = np.concatenate([turn_rad, shift_mm], axis=1)
        sd = np.sqrt(np.diagonal(track.covariance, axis1=1, axis2=2))
        return cls(
            error=np.concatenate([shift_mm, np.rad2deg(turn_rad)], axis=1),
            sd=np.concatenate([sd[:, 3:], np.rad2deg(sd[:, :3])], axis=1),
            nees=normalised_squares(raw, track.covariance),
            has_truth=_known(t_true_mm),
            has_pose=_known(track.t_camera_brick_mm),
        )

    def select(self, mask: BoolArray) -> "_Errors":
        return rows_of(self, mask)


def _rest_errors(
    moved: FromRest, R_true: FloatArray, t_true_mm: FloatArray, true_rest: tuple[FloatArray, FloatArray]
) -> _Errors:
    """Return the errors of displacements from rest, each seen from its own rest pose."""
    off_mm = moved.t_mm - (t_true_mm - true_rest[1]) @ true_rest[0]
    true_turned = true_rest[0].T @ R_true
    turn_rad = rvec_from_matrix(np.swapaxes(true_turned, -1, -2) @ moved.R)
    sd = np.sqrt(np.diagonal(moved.covariance, axis1=1, axis2=2))
    return _Errors(
        error=np.concatenate([off_mm, np.rad2deg(turn_rad)], axis=1),
        sd=np.concatenate([sd[:, 3:], np.rad2deg(sd[:, :3])], axis=1),
        nees=normalised_squares(np.concatenate([turn_rad, off_mm], axis=1), moved.covariance),
        has_truth=_known(t_true_mm),
        has_pose=_known(moved.t_mm),
    )


def _known(vectors: FloatArray) -> BoolArray:
    return np.asarray(np.isfinite(vectors).all(axis=1))


def _group_masks(
    track: OpticalTrack | FusedTrack, kind: str, dropouts_ns: IntArray, impacts_ns: IntArray
) -> dict[str, BoolArray]:
    t_ns = track.t_ns
    outside = track.flags & int(PoseFlag.EXTRAPOLATED) != 0
    dropout = track.flags & int(PoseFlag.DROPOUT) != 0
    for first, last in dropouts_ns:
        dropout |= (t_ns >= first) & (t_ns <= last)
    impact = np.zeros(len(t_ns), dtype=np.bool_)
    for t_impact in impacts_ns:
        impact |= np.abs(t_ns - t_impact) <= NEAR_IMPACT_NS
    calm = ~outside & ~dropout & ~impact
    nowhere = np.zeros(len(t_ns), dtype=np.bool_)
    return {
        "all": ~outside,
        "at frames": calm if kind == "frame" else nowhere,
        "between frames": nowhere if kind == "frame" else calm,
        "during dropouts": dropout & ~outside,
        "near impacts": impact & ~dropout & ~outside,
        "extrapolated": outside,
    }


def _summarise(source: Source, group: str, parts: list[_Errors]) -> GroupErrors:
    error = np.concatenate([p.error for p in parts])
    nees = np.concatenate([p.nees for p in parts])
    both = np.concatenate([p.has_truth & p.has_pose for p in parts])
    error = error[both]
    nees = nees[both]
    nees = nees[np.isfinite(nees)]
    nothing = [float("nan")] * 6
    return GroupErrors(
        source=source,
        group=group,
        n=int(both.sum()),
        n_without=int((~both).sum()),
        rms=np.sqrt(np.mean(error**2, axis=0)).tolist() if len(error) else nothing,
        largest=np.abs(error).max(axis=0).tolist() if len(error) else nothing,
        mean=error.mean(axis=0).tolist() if len(error) else nothing,
        nees_mean=float(nees.mean() / 6) if nees.size else float("nan"),
        nees_within_95=float(np.mean(nees <= _CHI2_95)) if nees.size else float("nan"),
    )


def _impacts(truth: TrueMotion) -> IntArray:
    """Return when the true acceleration passes the limit, one instant for each 50 ms."""
    if not truth.is_continuous:
        return np.empty(0, dtype=np.int64)
    seconds = (np.diff(truth.t_ns) / 1e9)[:, None]
    acc_mps2 = np.linalg.norm(np.diff(truth.v_camera_mmps, axis=0) / seconds, axis=1) / 1000
    found: list[int] = []
    for t_ns in truth.t_ns[1:][acc_mps2 > IMPACT_MPS2].tolist():
        if not found or t_ns - found[-1] > NEAR_IMPACT_NS:
            found.append(t_ns)
    return np.array(found, dtype=np.int64)


def _true_rest(result: RunResult, truth: TrueMotion, shift_ns: int) -> tuple[FloatArray, FloatArray] | None:
    """Return the mean of the true poses of the frames at rest, as the rest pose is one; or `None`."""
    if result.rest is None:
        return None
    (first, last), frames_ns = result.rest.interval_ns, result.optical.t_ns
    R, t_mm = truth.at(frames_ns[(frames_ns >= first) & (frames_ns <= last)] - shift_ns)
    known = _known(t_mm)
    if not known.any():
        return None
    R, start = R[known], R[known][0]
    return start @ matrix_from_rvec(rvec_from_matrix(start.T @ R).mean(axis=0)), t_mm[known].mean(axis=0)


def groups_to_show(groups: list[GroupErrors]) -> list[GroupErrors]:
    """Return the groups without those "all" that one other holds alone, as optical poses without dropouts."""
    alone = {
        g.source
        for a in groups
        for g in groups
        if (a.source, a.group, a.n, a.n_without) == (g.source, "all", g.n, g.n_without)
        and g.group not in ("all", "extrapolated")
    }
    return [g for g in groups if g.group != "all" or g.source not in alone]


def comparison_table(comparison: TruthComparison, *, from_rest: bool = False) -> Table:
    """Return the figures as a table for the terminal: root mean squares, below them largest magnitudes."""
    what = "displacements from rest, brick axes" if from_rest else "camera axes, nothing zeroed"
    table = Table(
        title=f"Errors against simulated truth: {what}",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        padding=(0, 1, 0, 0),
        pad_edge=False,
        caption="95 %: the share of errors within what is stated to hold 95 %",
        caption_justify="left",
    )
    table.add_column("rms; below: largest", no_wrap=True)
    table.add_column("n", justify="right")
    for name in COMPONENTS:
        unit = "deg" if name.startswith("rot") else "mm"
        table.add_column(f"{name.replace('rot ', 'r')} {unit}", justify="right")
    table.add_column("95 %", justify="right")
    for g in groups_to_show(comparison.from_rest if from_rest else comparison.groups):
        if g.n:
            honest = f"{100 * g.nees_within_95:.0f} %"
            table.add_row(f"{g.source}, {g.group}", str(g.n), *(f"{x:.3f}" for x in g.rms), honest)
            table.add_row("", "", *(f"{x:.3f}" for x in g.largest), style="dim")
    return table
