"""The tables of a processed run, built from its tracks; `tables_to_tracks` reads them back.

`docs/results-format.md` describes every column; a test compares the two.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.imu_records import ImuFlag
from bricktrack_common.rotations import (
    angles_xyz_from_matrix,
    continuous_quaternions,
    quaternion_from_matrix,
    rvec_from_matrix,
)
from bricktrack_host.quality import LedFlag
from bricktrack_host.results.daq_clock import EdgeFit
from bricktrack_host.results.rest_pose import FromRest, RestPose
from bricktrack_host.results.table_columns import (
    Column,
    Columns,
    covariance_column,
    flag_columns,
    flag_words,
    make_table,
    vector_columns,
)
from bricktrack_host.tracks import FusedTrack, ImuTrack, LedObservations, OpticalTrack

FusedKind = Literal["imu", "frame", "edge"]
FUSED_KINDS: tuple[FusedKind, ...] = ("imu", "frame", "edge")


def optical_table(
    optical: OpticalTrack,
    observations: LedObservations,
    *,
    t0_ns: int | None,
    from_rest: FromRest | None,
    edge_fit: EdgeFit | None,
    metadata: dict[str, str],
) -> "pa.Table":
    """Return the table of optical poses, one row a frame."""
    n_used = np.isfinite(optical.residual_px).all(axis=2).sum(axis=1).astype(np.int64)
    squares = np.nansum(optical.residual_px**2, axis=(1, 2))
    rms_px = np.sqrt(np.divide(squares, n_used, out=np.full(len(n_used), np.nan), where=n_used > 0))
    columns: Columns = [
        (Column("frame", "1", "number of the frame record in the run"),
         pa.array(np.arange(len(optical.t_ns)))),
        *_time_columns(optical.t_ns, t0_ns, edge_fit),
        *_pose_columns(optical.R_camera_brick, optical.t_camera_brick_mm, optical.covariance,
                       from_rest),
        (Column("n_leds", "1", "LEDs that the pose is of"), pa.array(n_used)),
        (Column("residual_rms_px", "px", "root of the mean squared distance, seen less predicted"),
         pa.array(rms_px)),
        (Column("sensor_timestamp_ns", "ns", "start of read-out of the first row"),
         pa.array(observations.sensor_timestamp_ns)),
        (Column("exposure_ns", "ns", "exposure time"), pa.array(observations.exposure_ns)),
        *flag_columns(optical.flags),
        (Column("frame_flags", "bits", "PoseFlag bits known before any pose was sought"),
         pa.array(observations.frame_flags)),
    ]  # fmt: skip
    return make_table(columns, metadata)


def fused_table(
    fused: dict[FusedKind, FusedTrack],
    *,
    edge_index: IntArray,
    t0_ns: int | None,
    rest: RestPose | None,
    from_rest: Mapping[str, FromRest],
    edge_fit: EdgeFit | None,
    metadata: dict[str, str],
) -> "pa.Table":
    """Return the table of fused poses at inertial slots, frames and edges, in order of time."""
    kinds = [kind for kind in FUSED_KINDS if kind in fused]
    tracks = [fused[kind] for kind in kinds]
    if not tracks:
        tracks, kinds = [_empty_track()], ["imu"]

    kind_of = np.repeat(np.arange(len(kinds)), [len(track.t_ns) for track in tracks])
    t_ns = np.concatenate([track.t_ns for track in tracks])
    order = np.lexsort((kind_of, t_ns))
    row_of = np.empty_like(order)
    row_of[order] = np.arange(len(order))
    ends = np.cumsum([len(track.t_ns) for track in tracks])[:-1]

    def in_order(parts: Sequence[Any]) -> Any:
        """Return arrays of all kinds as one, in order of time; of all that are large there is one copy."""
        together = np.empty((len(order), *parts[0].shape[1:]), dtype=parts[0].dtype)
        for rows, part in zip(np.split(row_of, ends), parts, strict=True):
            together[rows] = part
        return together

    number = np.full(len(t_ns), -1, dtype=np.int64)
    if "edge" in fused:
        number[kind_of == kinds.index("edge")] = edge_index
    is_edge = (number >= 0)[order]
    omega = in_order([track.omega_brick_radps for track in tracks])
    v_mmps = in_order([track.v_camera_mmps for track in tracks])
    moved = [from_rest[kind] for kind in kinds if kind in from_rest]
    seen = None
    if moved:
        seen = FromRest(
            in_order([m.R for m in moved]), in_order([m.t_mm for m in moved]),
            in_order([m.covariance for m in moved]),
        )  # fmt: skip
    columns: Columns = [
        (Column("kind", "", "what fixes the instant: imu (slot), frame (picture) or edge (square wave)"),
         pa.array([kinds[k] for k in kind_of[order]], type=pa.string())),
        (Column("edge_index", "1", "number of the rising edge, 0 at the first; empty in other rows"),
         pa.array(number[order], mask=~is_edge)),
        *_time_columns(t_ns[order], t0_ns, edge_fit),
        *_pose_columns(in_order([track.R_camera_brick for track in tracks]),
                       in_order([track.t_camera_brick_mm for track in tracks]),
                       in_order([track.covariance for track in tracks]), seen),
        *vector_columns("omega_{}_radps", "rad/s", "angular rate in brick axes", omega),
        *vector_columns("v_{}_mmps", "mm/s", "velocity of the first LED, camera axes", v_mmps),
        *vector_columns("dv_{}_mmps", "mm/s", "velocity of the first LED, brick axes at rest",
                         _turned(v_mmps, rest)),
        *flag_columns(in_order([track.flags for track in tracks])),
    ]  # fmt: skip
    return make_table(columns, metadata)


def leds_table(
    observations: LedObservations,
    optical: OpticalTrack,
    led_names: tuple[str, ...],
    *,
    t0_ns: int | None,
    metadata: dict[str, str],
) -> "pa.Table":
    """Return the table of LEDs, one row for each frame and LED."""
    n_frames, n_leds = observations.led_flags.shape
    uv = observations.uv_px.reshape(-1, 2)
    cov = observations.cov_px2.reshape(-1, 2, 2)
    residual = optical.residual_px.reshape(-1, 2)
    flags = observations.led_flags.reshape(-1)
    led_t_ns = optical.led_t_ns.reshape(-1)
    columns: Columns = [
        (Column("frame", "1", "number of the frame record in the run"),
         pa.array(np.repeat(np.arange(n_frames), n_leds))),
        (Column("led", "", "name in the layout file"),
         pa.array(list(led_names) * n_frames, type=pa.string())),
        *_time_columns(led_t_ns, t0_ns, None)[:2],
        (Column("u_px", "px", "centroid, to the right; 0 is the first pixel's centre"), pa.array(uv[:, 0])),
        (Column("v_px", "px", "centroid, downwards; 0 is the first pixel's centre"), pa.array(uv[:, 1])),
        (Column("var_u_px2", "px^2", "variance of u"), pa.array(cov[:, 0, 0])),
        (Column("cov_uv_px2", "px^2", "covariance of u and v"), pa.array(cov[:, 0, 1])),
        (Column("var_v_px2", "px^2", "variance of v"), pa.array(cov[:, 1, 1])),
        (Column("area_px2", "px^2", "area of the light in the picture"),
         pa.array(observations.area_px2.reshape(-1))),
        (Column("residual_u_px", "px", "u seen less predicted; NaN where the LED is not used"),
         pa.array(residual[:, 0])),
        (Column("residual_v_px", "px", "v seen less predicted; NaN where the LED is not used"),
         pa.array(residual[:, 1])),
        (Column("flags", "bits", "LedFlag bits"), pa.array(flags)),
        (Column("flag_words", "", "names of the LedFlag bits, parted by |"),
         pa.array(flag_words(flags, LedFlag), type=pa.string())),
    ]  # fmt: skip
    return make_table(columns, metadata)


def imu_table(
    imu: ImuTrack, camera_t_ns: IntArray | None, *, t0_ns: int | None, metadata: dict[str, str]
) -> "pa.Table":
    """Return the table of inertial samples in brick axes, as the fusion used them.

    ``camera_t_ns``, shape (n,), ns: when each was taken, on the camera's time; `None` if that is not known.
    """
    taken: Columns = []
    if camera_t_ns is not None:
        column = Column("camera_t_ns", "ns", "when the sample was taken, on the camera's time")
        taken.append((column, pa.array(camera_t_ns)))
    columns: Columns = [
        *_time_columns(imu.t_ns, t0_ns, None)[:2],
        *taken,
        *vector_columns("acc_{}_mps2", "m/s^2", "specific force in brick axes", imu.acc_mps2),
        *vector_columns("gyro_{}_radps", "rad/s", "angular rate in brick axes, with bias", imu.gyro_radps),
        (Column("flags", "bits", "ImuFlag bits"), pa.array(imu.flags)),
        (Column("flag_words", "", "names of the ImuFlag bits, parted by |"),
         pa.array(flag_words(imu.flags, ImuFlag), type=pa.string())),
    ]  # fmt: skip
    return make_table(columns, metadata)


def edges_table(edge_fit: EdgeFit, *, t0_ns: int | None, metadata: dict[str, str]) -> "pa.Table":
    """Return the table of recorded edges and their numbers."""
    columns: Columns = [
        *_time_columns(edge_fit.edges_ns, t0_ns, None)[:2],
        (Column("edge_index", "1", "number in the square wave; empty where the edge belongs to no sample"),
         pa.array(edge_fit.index, mask=edge_fit.is_extra)),
        (Column("residual_ns", "ns", "edge less fitted line, positive when late"),
         pa.array(edge_fit.residual_ns)),
    ]  # fmt: skip
    return make_table(columns, metadata)


def _time_columns(t_ns: IntArray, t0_ns: int | None, edge_fit: EdgeFit | None) -> Columns:
    t_s = np.full(len(t_ns), np.nan) if t0_ns is None else (t_ns - t0_ns) / 1e9
    sample = np.full(len(t_ns), np.nan) if edge_fit is None else edge_fit.sample_index_of(t_ns)
    return [
        (Column("t_ns", "ns", "instant, CLOCK_MONOTONIC of the unit"), pa.array(t_ns)),
        (Column("t_s", "s", "instant since the trigger (first rising edge); NaN without one"), pa.array(t_s)),
        (Column("daq_sample", "1", "instant as the laboratory's sample number with its fraction; NaN without "
                "edges"), pa.array(sample)),
    ]  # fmt: skip


def _sd(covariance: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)))


def _pose_columns(
    R: FloatArray, t_mm: FloatArray, covariance: FloatArray, from_rest: FromRest | None
) -> Columns:
    q = continuous_quaternions(quaternion_from_matrix(R))
    sd = _sd(covariance)
    if from_rest is None:
        from_rest = FromRest(*(np.full_like(values, np.nan) for values in (R, t_mm, covariance)))
    d_sd = _sd(from_rest.covariance)
    return [
        *vector_columns("{}_mm", "mm", "position of the first LED, camera frame", t_mm),
        *(
            (Column(f"q_{c}", "1", "unit quaternion, brick to camera"), pa.array(q[:, i].copy()))
            for i, c in enumerate("wxyz")
        ),
        *vector_columns("rvec_{}_rad", "rad", "rotation vector, brick to camera", rvec_from_matrix(R)),
        *vector_columns(
            "angle_{}_deg",
            "deg",
            "intrinsic XYZ angle, brick to camera",
            np.rad2deg(angles_xyz_from_matrix(R)),
        ),
        *vector_columns(
            "d{}_mm", "mm", "displacement of the first LED from rest, brick axes at rest", from_rest.t_mm
        ),
        *vector_columns("drvec_{}_rad", "rad", "rotation vector from rest", rvec_from_matrix(from_rest.R)),
        *vector_columns(
            "dangle_{}_deg",
            "deg",
            "intrinsic XYZ angle from rest",
            np.rad2deg(angles_xyz_from_matrix(from_rest.R)),
        ),
        *vector_columns("sd_{}_mm", "mm", "standard deviation of the position, camera axes", sd[:, 3:]),
        *vector_columns(
            "sd_d{}_mm", "mm", "standard deviation of the displacement, brick axes at rest", d_sd[:, 3:]
        ),
        *vector_columns(
            "sd_rot_{}_deg", "deg", "standard deviation of the rotation, brick axes", np.rad2deg(sd[:, :3])
        ),
        *vector_columns(
            "sd_drot_{}_deg",
            "deg",
            "standard deviation of the rotation from rest, brick axes",
            np.rad2deg(d_sd[:, :3]),
        ),
        covariance_column(covariance),
        covariance_column(from_rest.covariance, name="dcovariance"),
    ]


def _turned(v_camera: FloatArray, rest: RestPose | None) -> FloatArray:
    return np.full_like(v_camera, np.nan) if rest is None else np.asarray(v_camera @ rest.R_camera_rest)


def _empty_track() -> FusedTrack:
    none = np.empty(0, dtype=np.int64)
    zero3 = np.empty((0, 3))
    return FusedTrack(none, np.empty((0, 3, 3)), zero3, zero3, zero3, np.empty((0, 6, 6)), none)
