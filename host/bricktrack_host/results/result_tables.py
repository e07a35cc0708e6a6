"""The tables of a processed run: each column with its unit and meaning, built from the tracks and read back.

`docs/results-format.md` describes every column; a test compares the two.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.errors import RunFormatError
from bricktrack_common.imu_records import ImuFlag
from bricktrack_common.rotations import (
    angles_xyz_from_matrix,
    continuous_quaternions,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rvec_from_matrix,
)
from bricktrack_host.quality import LedFlag, PoseFlag
from bricktrack_host.results.daq_clock import EdgeFit
from bricktrack_host.results.rest_pose import RestPose
from bricktrack_host.tracks import FusedTrack, ImuTrack, LedObservations, OpticalTrack

FusedKind = Literal["imu", "frame", "edge"]
FUSED_KINDS: tuple[FusedKind, ...] = ("imu", "frame", "edge")
_TRIANGLE = np.triu_indices(6)
_XYZ = "xyz"

CONVENTIONS = {
    "time": "t_ns is CLOCK_MONOTONIC of the unit, int64 ns; t_s counts from the first rising edge, in s",
    "camera frame": "origin at the projection centre, x right (u), y down (v), z out through the lens, mm",
    "brick frame": "origin at the first LED of the layout, axes as in the drawing, mm",
    "rest frame": "the brick frame where it stood before the shake; columns in d are seen from it",
    "quaternion": "order w, x, y, z; takes brick to camera coordinates; the sign is chosen to be continuous",
    "rotation vector": "axis times angle, rad, of the rotation that takes brick to camera coordinates",
    "angles": "intrinsic XYZ, degrees: R = Rx(angle_x) @ Ry(angle_y) @ Rz(angle_z)",
    "covariance": "upper triangle, row by row, of the 6 x 6 covariance of [dtheta rad, dt mm]: "
    "R_true = R Exp(dtheta), brick axes; t_true = t + dt, camera axes",
    "missing": "NaN, with a bit in flags that says why",
}


@dataclass(frozen=True, slots=True)
class Column:
    """One column: name, unit, and what it means, for the schema and for people."""

    name: str
    unit: str
    meaning: str


Columns = list[tuple[Column, "pa.Array[Any]"]]


def pose_flag_words(flags: IntArray) -> list[str]:
    """Return the names of the set `PoseFlag` bits of each value, as ``"dropout|impact"``."""
    return _words(flags, PoseFlag)


def led_flag_words(flags: IntArray) -> list[str]:
    """Return the names of the set `LedFlag` bits of each value, as ``"border|merged"``."""
    return _words(flags, LedFlag)


def _words(flags: IntArray, kind: type[PoseFlag] | type[LedFlag] | type[ImuFlag]) -> list[str]:
    names = [(int(f), (f.name or "").lower()) for f in kind if int(f)]
    values, which = np.unique(flags, return_inverse=True)
    known = ["|".join(name for bit, name in names if bit & value) for value in values.tolist()]
    return [known[i] for i in which.tolist()]


# Tracks to tables.


def optical_table(
    optical: OpticalTrack,
    observations: LedObservations,
    *,
    t0_ns: int | None,
    rest: RestPose | None,
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
        *_pose_columns(optical.R_camera_brick, optical.t_camera_brick_mm, optical.covariance, rest),
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
    edge_fit: EdgeFit | None,
    metadata: dict[str, str],
) -> "pa.Table":
    """Return the table of fused poses at inertial slots, frames and edges, in order of time."""
    kinds = [kind for kind in FUSED_KINDS if kind in fused]
    tracks = [fused[kind] for kind in kinds]
    if not tracks:
        tracks, kinds = [_empty_track()], ["imu"]

    def joined(name: str) -> Any:
        return np.concatenate([getattr(track, name) for track in tracks])

    kind_of = np.repeat(np.arange(len(kinds)), [len(track.t_ns) for track in tracks])
    t_ns = joined("t_ns")
    order = np.lexsort((kind_of, t_ns))
    number = np.full(len(t_ns), -1, dtype=np.int64)
    if "edge" in fused:
        number[kind_of == kinds.index("edge")] = edge_index
    is_edge = (number >= 0)[order]
    omega = joined("omega_brick_radps")[order]
    v_mmps = joined("v_camera_mmps")[order]
    columns: Columns = [
        (Column("kind", "", "what fixes the instant: imu (slot), frame (picture) or edge (square wave)"),
         pa.array([kinds[k] for k in kind_of[order]], type=pa.string())),
        (Column("edge_index", "1", "number of the rising edge, 0 at the first; empty in other rows"),
         pa.array(number[order], mask=~is_edge)),
        *_time_columns(t_ns[order], t0_ns, edge_fit),
        *_pose_columns(joined("R_camera_brick")[order], joined("t_camera_brick_mm")[order],
                       joined("covariance")[order], rest),
        *vector_columns("omega_{}_radps", "rad/s", "angular rate in brick axes", omega),
        *vector_columns("v_{}_mmps", "mm/s", "velocity of the first LED, camera axes", v_mmps),
        *vector_columns("dv_{}_mmps", "mm/s", "velocity of the first LED, brick axes at rest",
                         _turned(v_mmps, rest)),
        *flag_columns(joined("flags")[order]),
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
         pa.array(led_flag_words(flags), type=pa.string())),
    ]  # fmt: skip
    return make_table(columns, metadata)


def imu_table(imu: ImuTrack, *, t0_ns: int | None, metadata: dict[str, str]) -> "pa.Table":
    """Return the table of inertial samples in brick axes, as the fusion used them."""
    columns: Columns = [
        *_time_columns(imu.t_ns, t0_ns, None)[:2],
        *vector_columns("acc_{}_mps2", "m/s^2", "specific force in brick axes", imu.acc_mps2),
        *vector_columns("gyro_{}_radps", "rad/s", "angular rate in brick axes, with bias", imu.gyro_radps),
        (Column("flags", "bits", "ImuFlag bits"), pa.array(imu.flags)),
        (Column("flag_words", "", "names of the ImuFlag bits, parted by |"),
         pa.array(_words(imu.flags, ImuFlag), type=pa.string())),
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


def _pose_columns(R: FloatArray, t_mm: FloatArray, covariance: FloatArray, rest: RestPose | None) -> Columns:
    q = continuous_quaternions(quaternion_from_matrix(R))
    if rest is None:
        R_rest, d_mm = np.full_like(R, np.nan), np.full_like(t_mm, np.nan)
        d_cov = np.full_like(covariance, np.nan)
    else:
        relative = rest.relative(R, t_mm)
        R_rest, d_mm = relative.R, relative.t_mm
        d_cov = rest.relative_covariance(R, t_mm, covariance)
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    d_sd = np.sqrt(np.diagonal(d_cov, axis1=1, axis2=2))
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
        *vector_columns("d{}_mm", "mm", "displacement of the first LED from rest, brick axes at rest", d_mm),
        *vector_columns("drvec_{}_rad", "rad", "rotation vector from rest", rvec_from_matrix(R_rest)),
        *vector_columns(
            "dangle_{}_deg",
            "deg",
            "intrinsic XYZ angle from rest",
            np.rad2deg(angles_xyz_from_matrix(R_rest)),
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
    ]


def covariance_column(covariance: FloatArray) -> tuple[Column, "pa.Array[Any]"]:
    """Return the upper triangles of covariances, shape (n, 6, 6), as one column of lists."""
    triangle = np.ascontiguousarray(covariance[:, _TRIANGLE[0], _TRIANGLE[1]])
    packed = pa.FixedSizeListArray.from_arrays(pa.array(triangle.reshape(-1)), 21)
    return Column("covariance", "rad, mm", "see the table's conventions; left out of the CSV"), packed


def vector_columns(name: str, unit: str, meaning: str, values: FloatArray) -> Columns:
    """Return three columns, x, y and z; ``{}`` in the name stands for the letter."""
    return [
        (Column(name.format(c), unit, f"{meaning}: {c}"), pa.array(np.ascontiguousarray(values[:, i])))
        for i, c in enumerate(_XYZ)
    ]


def flag_columns(flags: IntArray) -> Columns:
    """Return `PoseFlag` bits and their names."""
    return [
        (Column("flags", "bits", "PoseFlag bits"), pa.array(flags)),
        (
            Column("flag_words", "", "names of the PoseFlag bits, parted by |"),
            pa.array(pose_flag_words(flags), type=pa.string()),
        ),
    ]


def _turned(v_camera: FloatArray, rest: RestPose | None) -> FloatArray:
    return np.full_like(v_camera, np.nan) if rest is None else np.asarray(v_camera @ rest.R_camera_rest)


def make_table(columns: Columns, metadata: dict[str, str]) -> "pa.Table":
    """Return a table whose schema carries unit and meaning of each column."""
    fields = [
        pa.field(c.name, array.type, metadata={"unit": c.unit, "meaning": c.meaning}) for c, array in columns
    ]
    keys: dict[str | bytes, str | bytes] = dict(metadata.items())
    return pa.Table.from_arrays([array for _, array in columns], schema=pa.schema(fields, metadata=keys))


def _empty_track() -> FusedTrack:
    none = np.empty(0, dtype=np.int64)
    zero3 = np.empty((0, 3))
    return FusedTrack(none, np.empty((0, 3, 3)), zero3, zero3, zero3, np.empty((0, 6, 6)), none)


# Tables back to tracks.


def optical_from_tables(
    optical: "pa.Table", leds: "pa.Table", n_leds: int
) -> tuple[OpticalTrack, LedObservations]:
    """Return what `optical_table` and `leds_table` were made of."""
    n = optical.num_rows
    if leds.num_rows != n * n_leds:
        raise RunFormatError(f"leds table has {leds.num_rows} rows; expected {n} frames x {n_leds} LEDs")
    uv = np.stack([_floats(leds, "u_px"), _floats(leds, "v_px")], axis=1)
    residual = np.stack([_floats(leds, "residual_u_px"), _floats(leds, "residual_v_px")], axis=1)
    cov = np.empty((n * n_leds, 2, 2))
    cov[:, 0, 0], cov[:, 1, 1] = _floats(leds, "var_u_px2"), _floats(leds, "var_v_px2")
    cov[:, 0, 1] = cov[:, 1, 0] = _floats(leds, "cov_uv_px2")
    track = OpticalTrack(
        t_ns=_ints(optical, "t_ns"),
        R_camera_brick=_rotations(optical),
        t_camera_brick_mm=_vectors(optical, "{}_mm"),
        covariance=_covariances(optical),
        flags=_ints(optical, "flags"),
        residual_px=residual.reshape(n, n_leds, 2),
        led_t_ns=_ints(leds, "t_ns").reshape(n, n_leds),
    )
    observations = LedObservations(
        sensor_timestamp_ns=_ints(optical, "sensor_timestamp_ns"),
        exposure_ns=_ints(optical, "exposure_ns"),
        uv_px=uv.reshape(n, n_leds, 2),
        cov_px2=cov.reshape(n, n_leds, 2, 2),
        area_px2=_floats(leds, "area_px2").reshape(n, n_leds),
        led_flags=_ints(leds, "flags").reshape(n, n_leds),
        frame_flags=_ints(optical, "frame_flags"),
    )
    return track, observations


def fused_from_table(table: "pa.Table") -> tuple[dict[FusedKind, FusedTrack], IntArray]:
    """Return the fused tracks by kind, and the numbers of the edges."""
    kind = np.array(table.column("kind").to_pylist(), dtype=object)
    R, covariance = _rotations(table), _covariances(table)
    fused: dict[FusedKind, FusedTrack] = {}
    number = np.empty(0, dtype=np.int64)
    for name in FUSED_KINDS:
        rows = np.flatnonzero(kind == name)
        if not rows.size:
            continue
        fused[name] = FusedTrack(
            t_ns=_ints(table, "t_ns")[rows],
            R_camera_brick=R[rows],
            t_camera_brick_mm=_vectors(table, "{}_mm")[rows],
            omega_brick_radps=_vectors(table, "omega_{}_radps")[rows],
            v_camera_mmps=_vectors(table, "v_{}_mmps")[rows],
            covariance=covariance[rows],
            flags=_ints(table, "flags")[rows],
        )
        if name == "edge":
            numbers = table.column("edge_index").to_pylist()
            number = np.array([numbers[i] for i in rows], dtype=np.int64)
    return fused, number


def imu_from_table(table: "pa.Table", acc_range_mps2: float) -> ImuTrack:
    """Return what `imu_table` was made of."""
    return ImuTrack(
        t_ns=_ints(table, "t_ns"),
        acc_mps2=_vectors(table, "acc_{}_mps2"),
        gyro_radps=_vectors(table, "gyro_{}_radps"),
        flags=_ints(table, "flags"),
        acc_range_mps2=acc_range_mps2,
    )


def _column(table: "pa.Table", name: str) -> Any:
    if name not in table.column_names:
        raise RunFormatError(f"results table without the column '{name}'; was it written by bricktrack?")
    return table.column(name).to_numpy()


def _floats(table: "pa.Table", name: str) -> FloatArray:
    return np.array(_column(table, name), dtype=np.float64)


def _ints(table: "pa.Table", name: str) -> IntArray:
    return np.array(_column(table, name), dtype=np.int64)


def _vectors(table: "pa.Table", name: str) -> FloatArray:
    return np.stack([_floats(table, name.format(c)) for c in _XYZ], axis=1)


def _rotations(table: "pa.Table") -> FloatArray:
    return matrix_from_quaternion(np.stack([_floats(table, f"q_{c}") for c in "wxyz"], axis=1))


def _covariances(table: "pa.Table") -> FloatArray:
    column: Any = table.column("covariance").combine_chunks()
    triangle = np.asarray(column.flatten().to_numpy(zero_copy_only=False)).reshape(-1, 21)
    covariance = np.empty((len(triangle), 6, 6))
    covariance[:, _TRIANGLE[0], _TRIANGLE[1]] = triangle
    covariance[:, _TRIANGLE[1], _TRIANGLE[0]] = triangle
    return covariance
