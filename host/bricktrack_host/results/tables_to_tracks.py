"""The tables of a processed run back to the tracks that `result_tables` made them of."""

from typing import Any

import numpy as np
import pyarrow as pa

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.errors import RunFormatError
from bricktrack_common.rotations import matrix_from_quaternion
from bricktrack_host.results.result_tables import FUSED_KINDS, FusedKind
from bricktrack_host.results.table_columns import TRIANGLE, XYZ
from bricktrack_host.tracks import FusedTrack, ImuTrack, LedObservations, OpticalTrack


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
        covariance=_covariances(optical, "covariance"),
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


def fused_from_table(
    table: "pa.Table",
) -> tuple[dict[FusedKind, FusedTrack], dict[FusedKind, FloatArray], IntArray]:
    """Return the fused tracks and the covariances of their motion from rest by kind, and the edges' numbers.

    Version 2 of the results holds no such covariances.
    """
    kind = np.array(table.column("kind").to_pylist(), dtype=object)
    R, covariance = _rotations(table), _covariances(table, "covariance")
    moved = _covariances(table, "dcovariance") if "dcovariance" in table.column_names else None
    fused: dict[FusedKind, FusedTrack] = {}
    from_rest: dict[FusedKind, FloatArray] = {}
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
        if moved is not None:
            from_rest[name] = moved[rows]
        if name == "edge":
            numbers = table.column("edge_index").to_pylist()
            number = np.array([numbers[i] for i in rows], dtype=np.int64)
    return fused, from_rest, number


def imu_from_table(table: "pa.Table", acc_range_mps2: float) -> ImuTrack:
    """Return what `imu_table` was made of."""
    return ImuTrack(
        t_ns=_ints(table, "t_ns"),
        acc_mps2=_vectors(table, "acc_{}_mps2"),
        gyro_radps=_vectors(table, "gyro_{}_radps"),
        flags=_ints(table, "flags"),
        acc_range_mps2=acc_range_mps2,
    )


def imu_camera_times(table: "pa.Table") -> IntArray | None:
    """Return when the samples of `imu_table` were taken, on the camera's time; `None` if it does not say."""
    return _ints(table, "camera_t_ns") if "camera_t_ns" in table.column_names else None


def _column(table: "pa.Table", name: str) -> Any:
    if name not in table.column_names:
        raise RunFormatError(f"results table without the column '{name}'; was it written by bricktrack?")
    return table.column(name).to_numpy()


def _floats(table: "pa.Table", name: str) -> FloatArray:
    return np.array(_column(table, name), dtype=np.float64)


def _ints(table: "pa.Table", name: str) -> IntArray:
    return np.array(_column(table, name), dtype=np.int64)


def _vectors(table: "pa.Table", name: str) -> FloatArray:
    return np.stack([_floats(table, name.format(c)) for c in XYZ], axis=1)


def _rotations(table: "pa.Table") -> FloatArray:
    return matrix_from_quaternion(np.stack([_floats(table, f"q_{c}") for c in "wxyz"], axis=1))


def _covariances(table: "pa.Table", name: str) -> FloatArray:
    column: Any = table.column(name).combine_chunks()
    triangle = np.asarray(column.flatten().to_numpy(zero_copy_only=False)).reshape(-1, 21)
    covariance = np.empty((len(triangle), 6, 6))
    covariance[:, TRIANGLE[0], TRIANGLE[1]] = triangle
    covariance[:, TRIANGLE[1], TRIANGLE[0]] = triangle
    return covariance
