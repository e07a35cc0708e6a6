"""The clocks of both inertial sensors at once, where the camera moves with one of them.

Each sensor feels the camera's rocking, so an error in the offset of one shows as an error in that of the
other. Taken in turns they creep towards the truth; here one least squares holds both: the rotation that the
camera saw against those that both gyros integrated to.
"""

from dataclasses import dataclass, replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.fusion.clocks.posed_frames import MIN_POSES
from bricktrack_host.fusion.clocks.rotation_fit import DISPERSION_PRIOR_SD_S3, LOSS_PRIOR_SD_S2, left_out_s2
from bricktrack_host.fusion.clocks.time_alignment import MIN_ROTATION_SD_RAD, TimeAlignment, has_pose
from bricktrack_host.fusion.inertial.attitude import Attitude
from bricktrack_host.fusion.inertial.imu_samples import seconds_since
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.tracks import ImuTrack, OpticalTrack

_KNOT_S = 0.5  # of the slow drift between the gyros and the optics: noise, biases and scale errors
_ROUNDS = 15
_STANDS_S = 2e-7
_FARTHEST_STEP_S = 0.02
_SKEW_PRIOR_SD = 1e-4
_FILTER_SIGMA = 2.5  # a filter that is not there shall cost nothing


@dataclass(frozen=True, slots=True, eq=False)
class _Sensor:
    """One sensor at the present estimate: its own samples, sharpened, and where its clock lies."""

    imu: ImuTrack
    offset_s: float
    skew: float
    bias_radps: FloatArray


def align_jointly(
    optical: OpticalTrack,
    imu: ImuTrack,
    brick: TimeAlignment,
    camera_imu: ImuTrack,
    camera: TimeAlignment,
    *,
    camera_bias_radps: FloatArray,
) -> tuple[TimeAlignment, TimeAlignment]:
    """Return both alignments refined together: offsets, skews, and the gyros' common low-pass.

    They come back as given where too few poses lie within both sensors' samples.

    Parameters
    ----------
    optical : OpticalTrack
    imu, camera_imu : ImuTrack
        With the stamps of their reads; in brick axes and in camera axes.
    brick, camera : TimeAlignment
        Where to begin; both found from the motion, to some milliseconds.
    camera_bias_radps : ndarray, shape (3,), rad/s, camera axes
        Of the camera's gyro.

    Notes
    -----
    ``M_i = A_i R_i B_i^T`` is constant but for slow drift, with the attitude A of the camera and B of the
    brick by their gyros, and R as the camera saw it. Of its error in B's axes an offset takes ``B omega_B``
    or ``-M^T A omega_A``, and a low-pass that takes c of the second derivative of a rate, and d of the third,
    minus c times the rate's first derivative and d times its second in their place.
    """
    seen = has_pose(optical)
    t_ns, R = optical.t_ns[seen], optical.R_camera_brick[seen]
    since_mid_s = seconds_since(t_ns, brick.t_mid_ns)
    variance = np.trace(optical.covariance[seen][:, :3, :3], axis1=1, axis2=2) / 3
    inverse_sd = 1 / np.maximum(np.sqrt(variance), MIN_ROTATION_SD_RAD)
    of_brick = _sensor(imu, brick, brick.gyro_bias_radps)
    of_camera = _sensor(camera_imu, camera, camera_bias_radps)
    filter_s, covariance, residual_sd = 0.0, np.eye(6), float("nan")
    has_filter, weight = False, np.ones(len(t_ns))
    prior_sd = [np.inf, _SKEW_PRIOR_SD, np.inf, _SKEW_PRIOR_SD, LOSS_PRIOR_SD_S2, DISPERSION_PRIOR_SD_S3]
    prior = np.diag(np.array(prior_sd) ** -2.0)
    for _ in range(_ROUNDS):
        B, rates_B, in_B = _turned(of_brick, t_ns, since_mid_s, filter_s)
        A, rates_A, in_A = _turned(of_camera, t_ns, since_mid_s, filter_s)
        inside = in_A & in_B
        if inside.sum() < MIN_POSES:
            return brick, camera
        M = A @ R @ np.swapaxes(B, 1, 2)
        first = M[np.flatnonzero(inside)[inside.sum() // 2]]
        error = rvec_from_matrix(first.T @ M)
        (rate_A, slow_A, curve_A), (rate_B, slow_B, curve_B) = -rates_A @ first, rates_B
        column = since_mid_s[:, None]
        design = np.stack(
            [rate_B, column * rate_B, rate_A, column * rate_A, -(slow_B + slow_A), -(curve_B + curve_A)],
            axis=2,
        )  # (n, 3, [offset, skew of the brick's, offset, skew of the camera's, c, d])
        w = np.where(inside, weight * inverse_sd, 0.0)
        basis = _hats(since_mid_s)
        Q, _ = np.linalg.qr(w[:, None] * basis)
        a, y = w[:, None, None] * design, w[:, None] * error
        a = a - np.einsum("nk,mk,mij->nij", Q, Q, a, optimize=True)
        y = y - Q @ (Q.T @ y)
        past = np.array([0.0, of_brick.skew, 0.0, of_camera.skew, filter_s**2, 0.0])
        normal = np.einsum("nij,nik->jk", a, a) + prior
        step = np.linalg.solve(normal, np.einsum("nij,ni->j", a, y) - prior @ past)
        left = np.linalg.norm(y - a @ step, axis=1)[inside] / np.sqrt(3)
        usual = np.median(left / np.maximum(weight[inside], 1e-9)) / 0.888
        residual_sd = max(float(usual), 1e-6)  # the median of the root of chi-square of 3 over 3 is 0.888
        weight[inside] = (1 + (left / weight[inside] / (2.5 * residual_sd)) ** 2) ** -0.5
        covariance = np.linalg.inv(normal) * residual_sd**2
        moved = np.clip(step[[0, 2]], -_FARTHEST_STEP_S, _FARTHEST_STEP_S)
        of_brick = _moved(of_brick, moved[0], step[1])
        of_camera = _moved(of_camera, moved[1], step[3])
        loss_s2 = filter_s**2 + step[4]
        has_filter = loss_s2 > _FILTER_SIGMA * np.sqrt(covariance[4, 4])
        settled = abs(float(np.sqrt(max(loss_s2, 0.0))) - filter_s) < 2e-5 or not has_filter
        filter_s = float(np.sqrt(loss_s2)) if has_filter else 0.0
        if np.abs(moved).max() < _STANDS_S and settled:
            break
    for i in (0, 2):
        covariance[i, i] += left_out_s2(covariance[i, 5], covariance[5, 5], float(step[5]))
    sd = np.sqrt(np.diagonal(covariance))

    def found(alignment: TimeAlignment, sensor: _Sensor, i: int) -> TimeAlignment:
        return replace(
            alignment, offset_ns=sensor.offset_s * 1e9, offset_sd_ns=float(sd[i] * 1e9), skew=sensor.skew,
            skew_sd=float(sd[i + 1]), gyro_filter_s=filter_s, rotation_residual_sd=residual_sd,
        )  # fmt: skip

    return found(brick, of_brick, 0), found(camera, of_camera, 2)


def _sensor(imu: ImuTrack, alignment: TimeAlignment, bias_radps: FloatArray) -> _Sensor:
    return _Sensor(alignment.restamped(imu), alignment.offset_ns * 1e-9, alignment.skew, bias_radps)


def _moved(sensor: _Sensor, offset_s: float, skew: float) -> _Sensor:
    return replace(sensor, offset_s=sensor.offset_s + float(offset_s), skew=sensor.skew + float(skew))


def _turned(
    sensor: _Sensor, t_ns: IntArray, since_mid_s: FloatArray, filter_s: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return attitudes by a gyro at frames, rate and two derivatives in still axes, and which are known."""
    signal = ImuSignal.from_track(sensor.imu, gyro_filter_s=filter_s)
    at_s = seconds_since(t_ns, signal.epoch_ns) + sensor.offset_s + sensor.skew * since_mid_s
    R = Attitude(signal, sensor.bias_radps).at(at_s)
    rates = np.stack([signal.gyro_at(at_s) - sensor.bias_radps, *signal.gyro_derivatives_at(at_s)])
    return R, np.einsum("nij,dnj->dni", R, rates), np.asarray(~signal.in_gap(at_s))


def _hats(t_s: FloatArray) -> FloatArray:
    """Return hat functions of time, shape (n, n_knots): drift that is linear between knots."""
    n_knots = max(2, round((t_s[-1] - t_s[0]) / _KNOT_S) + 1)
    knots = np.linspace(t_s[0] - 1e-6, t_s[-1] + 1e-6, n_knots)
    return np.stack([np.interp(t_s, knots, row) for row in np.eye(n_knots)], axis=1)
