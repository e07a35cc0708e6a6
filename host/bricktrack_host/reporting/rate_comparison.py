"""Angular rates of gyroscope and optics beside each other: what is left between them is misalignment."""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.reporting.plots import TimeAxis
from bricktrack_host.results.result_store import RunResult
from bricktrack_host.results.run_summary import imu_camera_time_ns

_MIN_SAMPLES = 10


@dataclass(frozen=True, slots=True, eq=False)
class RateComparison:
    """Angular rates in brick axes, on the camera's time, seconds of the page's time axis.

    Attributes
    ----------
    gyro_s, gyro_dps : ndarray, shape (n,), s, and (n, 3), deg/s
        The gyroscope less its offset.
    optical_s, optical_dps : ndarray, shape (k,), s, and (k, 3), deg/s
        The turn from one frame to the next over the time between; NaN over lost frames.
    difference_dps : ndarray, shape (k, 3), deg/s
        The gyroscope averaged over the same time, less the optical rate.
    """

    gyro_s: FloatArray
    gyro_dps: FloatArray
    optical_s: FloatArray
    optical_dps: FloatArray
    difference_dps: FloatArray


def compare_rates(result: RunResult) -> RateComparison | None:
    """Return both angular rates of a run; `None` without either, or where the camera turns as well."""
    imu, optical = result.imu, result.optical
    if imu is None or result.provenance.settings.get("camera", "static") == "imu":
        return None
    usable = np.isfinite(imu.gyro_radps).all(axis=1)
    good = np.isfinite(optical.R_camera_brick).all(axis=(1, 2))
    if np.count_nonzero(usable) < _MIN_SAMPLES or np.count_nonzero(good) < _MIN_SAMPLES:
        return None
    axis = TimeAxis.of(result)
    t_ns, R = optical.t_ns[good], optical.R_camera_brick[good]
    step_s = np.diff(t_ns) / 1e9
    turn = rvec_from_matrix(np.swapaxes(R[:-1], -1, -2) @ R[1:])
    optical_dps = np.rad2deg(turn / step_s[:, None])
    optical_dps[step_s >= 2.5 * np.median(step_s)] = np.nan
    gyro_s = axis.s(imu_camera_time_ns(result)[usable])
    gyro_dps = np.rad2deg(imu.gyro_radps[usable])
    bounds_s = np.stack([axis.s(t_ns[:-1]), axis.s(t_ns[1:])], axis=1)
    mean_dps = _means_over(gyro_s, gyro_dps, bounds_s)
    known = np.isfinite(optical_dps).any()
    offset_dps = np.nanmedian(mean_dps - optical_dps, axis=0) if known else np.zeros(3)
    return RateComparison(
        gyro_s=gyro_s,
        gyro_dps=gyro_dps - offset_dps,
        optical_s=axis.s(t_ns[:-1] + np.diff(t_ns) // 2),
        optical_dps=optical_dps,
        difference_dps=mean_dps - offset_dps - optical_dps,
    )


def _means_over(t_s: FloatArray, values: FloatArray, bounds_s: FloatArray) -> FloatArray:
    """Return the mean of a piecewise linear signal over intervals, shape (k, columns)."""
    step = np.diff(t_s)[:, None]
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * step * (values[1:] + values[:-1]), axis=0)])
    out = np.empty((len(bounds_s), values.shape[1]))
    for c in range(values.shape[1]):
        ends = np.interp(bounds_s, t_s, integral[:, c], left=np.nan, right=np.nan)
        out[:, c] = (ends[:, 1] - ends[:, 0]) / (bounds_s[:, 1] - bounds_s[:, 0])
    return out
