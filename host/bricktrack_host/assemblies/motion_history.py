"""Motion from rest over time as plain arrays, of a run's brick or of a component."""

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.errors import BricktrackError
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.assemblies.component_motion import motion_from_rest
from bricktrack_host.quality import PoseFlag
from bricktrack_host.results.result_store import RunResult
from bricktrack_host.results.result_tables import FusedKind
from bricktrack_host.tracks import FusedTrack, OpticalTrack

NOT_MEASURED = PoseFlag.EXTRAPOLATED | PoseFlag.NO_POSE
"""Flags of what no sensor saw: left out of charts, peaks and spectra."""


class HistoryError(BricktrackError, LookupError):
    """The results at hand hold no such motion."""


@dataclass(frozen=True, slots=True, eq=False)
class MotionHistory:
    """Displacement and rotation from rest at a row of instants.

    Attributes
    ----------
    name : str
        Of the unit or the component.
    t_s : ndarray, shape (n,), s
        Of a run: since the trigger (first frame where no trigger came). Of a component: sample number over
        the wave's nominal frequency, NaN if that is not told.
    sample : ndarray, shape (n,)
        The laboratory's sample number with its fraction; NaN without a square wave.
    displacement_mm : ndarray, shape (n, 3), mm, brick axes at rest
    rotation_deg : ndarray, shape (n, 3), deg
        Rotation vector, brick axes.
    displacement_sd_mm, rotation_sd_deg : ndarray, shape (n, 3)
        Standard deviations, that of the rest pose included.
    flags : ndarray of int64, shape (n,), `PoseFlag`
    """

    name: str
    t_s: FloatArray
    sample: FloatArray
    displacement_mm: FloatArray
    rotation_deg: FloatArray
    displacement_sd_mm: FloatArray
    rotation_sd_deg: FloatArray
    flags: IntArray

    @property
    def measured(self) -> BoolArray:
        """Return where the motion is known and not extrapolated."""
        known = np.isfinite(self.displacement_mm).all(axis=1)
        return np.asarray(known & (self.flags & int(NOT_MEASURED) == 0))

    def flagged(self, bits: PoseFlag) -> BoolArray:
        """Return where any of the bits is set."""
        return np.asarray(self.flags & int(bits) != 0)


def run_history(
    result: RunResult, at: FusedKind | None = None, *, point_mm: ArrayLike = (0.0, 0.0, 0.0)
) -> MotionHistory:
    """Return a run's motion from rest.

    Parameters
    ----------
    result : RunResult
    at : "imu", "frame" or "edge", optional
        Which instants of the fused motion; without it the optical poses.
    point_mm : array_like, shape (3,), mm, the layout's axes, at rest
        Whose displacement is wanted; by default that of the first LED.

    Raises
    ------
    HistoryError
        If the run has no rest pose, or no motion at such instants.
    """
    run_id = result.manifest.run_id
    if result.rest is None:
        raise HistoryError(f"{run_id}: no rest pose, so no displacement from rest. See 't_camera_brick_mm'")
    track: FusedTrack | OpticalTrack
    if at is None:
        track = result.optical
    elif at in result.fused:
        track = result.fused[at]
    else:
        there = ", ".join(result.fused) or "none"
        raise HistoryError(f"{run_id}: no fused motion at {at!r} instants; there are: {there}")
    origin_ns = result.t0_ns
    if origin_ns is None:
        stamps = result.observations.sensor_timestamp_ns
        origin_ns = int(stamps[0]) if len(stamps) else 0
    if at == "edge":
        sample = result.edge_index.astype(np.float64)
    elif result.edge_fit is not None:
        sample = result.edge_fit.sample_index_of(track.t_ns)
    else:
        sample = np.full(len(track.t_ns), np.nan)
    motion = motion_from_rest(result.from_rest[at or "optical"], track).about(point_mm)
    sd = np.sqrt(np.diagonal(motion.covariance, axis1=1, axis2=2))
    return MotionHistory(
        name=result.manifest.unit,
        t_s=np.asarray((track.t_ns - origin_ns) / 1e9),
        sample=sample,
        displacement_mm=motion.t_mm,
        rotation_deg=np.rad2deg(rvec_from_matrix(motion.R)),
        displacement_sd_mm=sd[:, 3:],
        rotation_sd_deg=np.rad2deg(sd[:, :3]),
        flags=motion.flags,
    )


def component_histories(table: "pa.Table") -> dict[str, MotionHistory]:
    """Return the motion of each component, in the order of an assembly's table, by name.

    Parameters
    ----------
    table : pyarrow.Table
        As `bricktrack_host.assemblies.combined_summary.read_components` gives it.
    """
    component = np.array(table.column("component").to_pylist(), dtype=object)
    whole = {
        name: np.asarray(table.column(name).to_numpy(), dtype=np.float64)
        for name in table.column_names
        if name not in ("component", "covariance", "flags", "flag_words")
    }
    flags = np.asarray(table.column("flags").to_numpy(), dtype=np.int64)

    def vectors(name: str, rows: BoolArray) -> FloatArray:
        return np.stack([whole[name.format(c)][rows] for c in "xyz"], axis=1)

    histories = {}
    for name in dict.fromkeys(component.tolist()):
        rows = np.asarray(component == name)
        histories[str(name)] = MotionHistory(
            name=str(name),
            t_s=whole["lab_s"][rows],
            sample=whole["sample"][rows],
            displacement_mm=vectors("d{}_mm", rows),
            rotation_deg=np.rad2deg(vectors("drvec_{}_rad", rows)),
            displacement_sd_mm=vectors("sd_d{}_mm", rows),
            rotation_sd_deg=vectors("sd_rot_{}_deg", rows),
            flags=flags[rows],
        )
    return histories
