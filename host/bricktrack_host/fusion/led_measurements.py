"""LEDs one by one as the smoother's measurements: each at its own row's instant, through the ray model."""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_host.fusion.fusion_problem import Linearisation, Nodes, NoiseLevel, Run, noise_parts
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.imu_signal import seconds_since
from bricktrack_host.fusion.observation_kernel import LedArrays
from bricktrack_host.fusion.smoother import Estimate, Problem
from bricktrack_host.tracking.led_profile import collar_of, predict_brick
from bricktrack_host.tracking.led_tracker import NOT_USED
from bricktrack_host.tracking.optical_track import led_times_ns
from bricktrack_host.tracks import LedObservations


@dataclass(frozen=True, slots=True, eq=False)
class SeenLeds:
    """The LEDs of a run that were seen and identified, one row for each.

    Attributes
    ----------
    frame, led : ndarray of int64, shape (m,)
    t_ns : ndarray of int64, shape (m,), camera time
        Mid-exposure of the LED's row.
    uv_px, cov_px2 : ndarray, shape (m, 2), (m, 2, 2)
    """

    frame: IntArray
    led: IntArray
    t_ns: IntArray
    uv_px: FloatArray
    cov_px2: FloatArray

    @classmethod
    def of(cls, observations: LedObservations, ray_model: RayModel) -> "SeenLeds":
        """Return the LEDs that may be used, in the order of their instants."""
        _, t_ns = led_times_ns(observations, ray_model)
        usable = (observations.led_flags & NOT_USED) == 0
        usable &= np.isfinite(observations.uv_px).all(axis=2)
        usable &= np.isfinite(observations.cov_px2).all(axis=(2, 3))
        frame, led = np.nonzero(usable)
        order = np.argsort(t_ns[frame, led], kind="stable")
        frame, led = frame[order], led[order]
        return cls(frame, led, t_ns[frame, led], observations.uv_px[frame, led],
                   observations.cov_px2[frame, led])  # fmt: skip

    def take(self, rows: BoolArray) -> "SeenLeds":
        """Return some of the rows."""
        return SeenLeds(
            self.frame[rows], self.led[rows], self.t_ns[rows], self.uv_px[rows], self.cov_px2[rows]
        )


@dataclass(frozen=True, slots=True, eq=False)
class Pictured:
    """Where seen LEDs were expected by poses at their instants.

    Attributes
    ----------
    R_camera_brick, t_camera_brick_mm : ndarray, shape (m, 3, 3), (m, 3)
    residual_px : ndarray, shape (m, 2)
        Seen less predicted.
    J_px : ndarray, shape (m, 2, 6)
        Of the prediction, by [dtheta rad, dt mm].
    cov_px2 : ndarray, shape (m, 2, 2)
        Of the centroid, with what the profile leaves unknown.
    is_facing : ndarray of bool, shape (m,)
        Whether the dome can be seen at all from there.
    """

    R_camera_brick: FloatArray
    t_camera_brick_mm: FloatArray
    residual_px: FloatArray
    J_px: FloatArray
    cov_px2: FloatArray
    is_facing: BoolArray


def picture(
    leds: SeenLeds, R: FloatArray, t_mm: FloatArray, ray_model: RayModel, brick_model: BrickModel
) -> Pictured:
    """Predict seen LEDs for poses at their instants, shapes (m, 3, 3) and (m, 3)."""
    # `predict_brick` predicts whole bricks: one for each frame, of which the LEDs seen are put in place.
    frames, row = np.unique(leds.frame, return_inverse=True)
    shape = (len(frames), brick_model.n_leds)
    R_all, t_all = np.empty((*shape, 3, 3)), np.empty((*shape, 3))
    R_all[row], t_all[row] = R[:, None], t_mm[:, None]
    R_all[row, leds.led], t_all[row, leds.led] = R, t_mm
    prediction, J = predict_brick(R_all, t_all, ray_model, brick_model, collar_mm=collar_of(brick_model))
    at = row, leds.led
    shift = prediction.model_shift_px[at]
    return Pictured(
        R_camera_brick=R,
        t_camera_brick_mm=t_mm,
        residual_px=leds.uv_px - prediction.uv_px[at],
        J_px=J[at],
        cov_px2=leds.cov_px2 + shift[:, :, None] * shift[:, None, :],
        is_facing=np.asarray(prediction.facing[at] > 0, dtype=np.bool_),
    )


def led_arrays(
    leds: SeenLeds,
    pictured: Pictured,
    run: Run,
    nodes: Nodes,
    lin: Linearisation,
    levels: tuple[NoiseLevel, NoiseLevel],
    *,
    scale: float,
    use: BoolArray,
    settings: FusionSettings,
) -> LedArrays:
    """Return the smoother's measurements of one run: each LED tied to the node nearest in time.

    ``scale`` multiplies the stated sd of the centroids; ``use`` says which are shown to the filter. What the
    inertial samples leave unsure between node and LED is added to the covariance.
    """
    t_cam_s = seconds_since(leds.t_ns, run.signal.epoch_ns)
    t_s = run.imu_time_s(t_cam_s, lin)
    after = np.clip(np.searchsorted(nodes.t_s, t_s), 1, len(nodes.t_s) - 1)
    node = np.where(nodes.t_s[after] - t_s < t_s - nodes.t_s[after - 1], after, after - 1)
    start_s = nodes.t_s[node]
    step = run.signal.increments(
        start_s, t_s, gyro_bias_radps=lin.bg_radps, acc_bias_mps2=lin.ba_mps2, acc_lag_s=lin.lag_s
    )
    dt = t_s - start_s
    J = pictured.J_px.copy()
    J[..., 3:] *= 1e3
    parts = noise_parts(run.signal, np.sort(np.stack([start_s, t_s]), axis=0), lin, settings)
    turn = parts.gyro(levels[0]) * np.abs(dt)
    shift = parts.acc(levels[1]) * np.abs(dt) ** 3 / 3
    between = np.repeat(np.stack([turn, shift], axis=1), 3, axis=1)
    cov = scale**2 * pictured.cov_px2 + np.einsum("mik,mk,mjk->mij", J, between, J)
    first = np.searchsorted(node, np.arange(len(nodes.t_s) + 1))[:, None].astype(np.int64)
    return LedArrays(
        first=first,
        use=use,
        dt_s=dt,
        since_mid_s=t_cam_s - run.t_mid_s,
        R_step=step.R,
        dv_mps=step.dv_mps,
        dp_m=step.dp_m,
        omega_radps=run.signal.gyro_at(t_s),
        R_lin=pictured.R_camera_brick,
        t_lin_m=pictured.t_camera_brick_mm * 1e-3,
        residual_px=pictured.residual_px,
        J=J,
        cov_px2=cov,
        nis=np.zeros(len(dt)),
        inflation=np.ones(len(dt)),
    )


def led_chi2(problem: Problem, estimate: Estimate) -> FloatArray:
    """Return how far each LED lies from what all the others say, over its covariance (2 degrees of freedom).

    See `noise_choice.frame_chi2`; of one run that is a batch alone.
    """
    leds = problem.leds
    if leds is None:
        raise ValueError("the problem has no LEDs")
    y, A = estimate.led_residual_px, estimate.led_cov_px2
    given = leds.cov_px2 * leds.inflation[:, None, None]
    rest = np.linalg.inv(1.02 * given - A)
    S = leds.cov_px2 + np.where(leds.use[:, None, None], A + A @ rest @ A, A)
    y = np.where(leds.use[:, None], (given @ rest @ y[..., None])[..., 0], y)
    return np.asarray((y * np.linalg.solve(S, y[..., None])[..., 0]).sum(axis=1))
