"""LEDs one by one as the smoother's measurements: each at its own row's instant, through the ray model."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray, rows_of
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.rotations import skew
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.inertial.imu_samples import seconds_since
from bricktrack_host.fusion.pose_by_pose.fusion_problem import Nodes, Run
from bricktrack_host.fusion.pose_by_pose.inertial_noise import NoiseLevel, NoiseParts
from bricktrack_host.fusion.smoothing.linearisation import Linearisation
from bricktrack_host.fusion.smoothing.observation_kernel import LedArrays
from bricktrack_host.fusion.smoothing.smoother import Estimate, Problem
from bricktrack_host.tracking.led_model.led_profile import (
    LedPrediction,
    collar_of,
    predict_leds,
    shift_per_radius,
)
from bricktrack_host.tracking.led_tracker import NOT_USED
from bricktrack_host.tracking.optical_track import led_times_ns
from bricktrack_host.tracks import LedObservations

_PREDICTED_AT_ONCE = 4096  # LEDs: of more the prediction's own arrays are only more memory


@dataclass(frozen=True, slots=True, eq=False)
class SeenLeds:
    """The LEDs of a run that were seen and identified, one row for each.

    Attributes
    ----------
    frame, led : ndarray of int64, shape (m,)
    t_ns : ndarray of int64, shape (m,), camera time
        Mid-exposure of the LED's row.
    uv_px, cov_px2 : ndarray, shape (m, 2), (m, 2, 2)
    spread_ns : ndarray, shape (m,), ns
        Standard deviation of the instants at which its light was gathered: by exposure, and by its rows.
    exposure_ns : ndarray of int64, shape (m,), ns
    """

    frame: IntArray
    led: IntArray
    t_ns: IntArray
    uv_px: FloatArray
    cov_px2: FloatArray
    spread_ns: FloatArray
    exposure_ns: IntArray

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
        # Even over the exposure; over a disc's rows as a disc is wide.
        rows = np.sqrt(np.nan_to_num(observations.area_px2[frame, led]) / np.pi) / 2
        row_ns = ray_model.sensor_mode.row_delay_ns(1.0) - ray_model.sensor_mode.row_delay_ns(0.0)
        spread_ns = np.hypot(observations.exposure_ns[frame] / np.sqrt(12), rows * row_ns)
        return cls(frame, led, t_ns[frame, led], observations.uv_px[frame, led],
                   observations.cov_px2[frame, led], spread_ns, observations.exposure_ns[frame])  # fmt: skip

    def take(self, rows: BoolArray) -> "SeenLeds":
        """Return some of the rows."""
        return rows_of(self, rows)

    def beside_ns(self) -> IntArray:
        """Return one spread before the middle of each one's light and one after, shape (2, m)."""
        aside = np.rint(self.spread_ns).astype(np.int64)
        return np.stack([self.t_ns - aside, self.t_ns + aside])


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
    profile_shift_px : ndarray, shape (m, 2)
        One standard deviation of what the profile leaves unknown, the same way in all LEDs.
    from_centre_px : ndarray, shape (m, 2)
        The predicted picture less the middle of the sensor's.
    accelerated_px : ndarray, shape (m, 2)
        By how much the prediction is the mean over the light's time, and not where the LED is in its middle.
    from_side_rad : ndarray, shape (m, 2)
        How far beside an LED's mean line of sight, along the camera's first two axes, it is seen from.
    facing : ndarray, shape (m,)
        Cosine of the angle that the LED is seen at; at 0 and less nothing of the dome can be seen.
    side_on_px : ndarray, shape (m, 2)
        One radius along the LED's axis as it is seen.
    leaning_px : ndarray, shape (m, 2)
        What the smear draws a centroid aside by, over a share that is one for all; see `_leaning_px`.
    """

    R_camera_brick: FloatArray
    t_camera_brick_mm: FloatArray
    residual_px: FloatArray
    J_px: FloatArray
    profile_shift_px: FloatArray
    from_centre_px: FloatArray
    accelerated_px: FloatArray
    from_side_rad: FloatArray
    facing: FloatArray
    side_on_px: FloatArray
    leaning_px: FloatArray

    @property
    def is_facing(self) -> BoolArray:
        """Whether the dome can be seen at all from there, shape (m,)."""
        return np.asarray(self.facing > 0, dtype=np.bool_)


def picture(
    leds: SeenLeds,
    R_camera_brick: FloatArray,
    t_camera_brick_mm: FloatArray,
    ray_model: RayModel,
    brick: BrickModel,
) -> Pictured:
    """Predict seen LEDs for poses at their instants and at `beside_ns`, shape (3, m, 3, 3) and (3, m, 3).

    A brick that is accelerated is not, on the mean over the time that its light is gathered, where it is in
    the middle: by half the spread's square times the acceleration. The mean of the pictures a spread before
    and after shows as much.
    """
    poses = zip(R_camera_brick, t_camera_brick_mm, strict=True)
    prediction, before, after = (_predict(leds, R, t_mm, ray_model, brick) for R, t_mm in poses)
    mode = ray_model.sensor_mode
    mean_px = 0.5 * (before.uv_px + after.uv_px)
    exposures = 0.5 * leds.exposure_ns / np.maximum(leds.spread_ns, 1.0)
    return Pictured(
        R_camera_brick=R_camera_brick[0].copy(),  # not a view, which would hold all three
        t_camera_brick_mm=t_camera_brick_mm[0].copy(),
        residual_px=leds.uv_px - mean_px,
        J_px=_by_pose(prediction, leds, R_camera_brick[0], brick),
        profile_shift_px=shift_per_radius(collar_of(brick), brick) * prediction.model_shift_px,
        from_centre_px=prediction.uv_px - 0.5 * np.array([mode.width - 1, mode.height - 1]),
        accelerated_px=mean_px - prediction.uv_px,
        from_side_rad=_from_side(leds, R_camera_brick[0], t_camera_brick_mm[0], brick),
        facing=prediction.facing,
        side_on_px=prediction.model_shift_px,
        leaning_px=_leaning_px(prediction, (after.uv_px - before.uv_px) * exposures[:, None]),
    )


def _leaning_px(prediction: LedPrediction, smear_px: FloatArray) -> FloatArray:
    """Return the smear, shape (m, 2), times how far each LED leans from the line of sight.

    A smear turns the rim of a light into a ramp as wide as the way across it. A bright rim reaches the level
    that counts as light early in the ramp, a dim one later: it grows outwards by more, whichever way the LED
    moves. A dome's rim is not evenly bright, by its limb, collar or hot spot along the axis a as it is seen
    (its length the sine of the angle). With s the smear and n the outward normal, the ramp is ``|s . n|``
    wide: the mean over the rim of that times ``a . n``, along n, is ``|s| (1 + s s' / |s|^2) a`` times a
    share that brightness and exposure decide.
    """
    a = prediction.model_shift_px / np.sqrt(prediction.area_px2 / np.pi)[:, None]
    length = np.linalg.norm(smear_px, axis=1, keepdims=True)
    along = smear_px * np.sum(smear_px * a, axis=1, keepdims=True) / np.maximum(length, 1e-9)
    return np.asarray(length * a + along)


def _from_side(leds: SeenLeds, R: FloatArray, t_mm: FloatArray, brick: BrickModel) -> FloatArray:
    """Return how far each line of sight lies from its LED's mean one, in brick axes, turned as at mid-run."""
    sight = t_mm + np.einsum("mij,mj->mi", R, brick.led_positions_mm[leds.led])
    sight = np.einsum("mji,mj->mi", R, sight / np.linalg.norm(sight, axis=1, keepdims=True))
    count = np.maximum(np.bincount(leds.led, minlength=brick.n_leds), 1)
    mean = np.stack([np.bincount(leds.led, axis, minlength=brick.n_leds) / count for axis in sight.T], axis=1)
    return np.asarray((sight - mean[leds.led]) @ R[len(R) // 2].T[:, :2])


def _predict(
    leds: SeenLeds, R: FloatArray, t_mm: FloatArray, ray_model: RayModel, brick: BrickModel
) -> LedPrediction:
    """Return predictions of single LEDs, shape (m,), each for its own pose; shifts are of whole radii."""
    collar_mm, parts = collar_of(brick), []
    for start in range(0, max(len(leds.led), 1), _PREDICTED_AT_ONCE):
        some = slice(start, start + _PREDICTED_AT_ONCE)
        led = leds.led[some]
        parts.append(
            predict_leds(
                np.einsum("mij,mj->mi", R[some], brick.led_positions_mm[led]) + t_mm[some],
                np.einsum("mij,mj->mi", R[some], brick.led_axes[led]),
                brick.led_radii_mm[led],
                ray_model,
                collar_mm=collar_mm,
                shift_sd_per_radius=1.0,
            )
        )
    of_all = ([getattr(part, field.name) for part in parts] for field in fields(LedPrediction))
    return LedPrediction(*(np.concatenate(values) for values in of_all))


def _by_pose(prediction: LedPrediction, leds: SeenLeds, R: FloatArray, brick: BrickModel) -> FloatArray:
    """Return the derivatives of single LEDs' pictures by their poses, shape (m, 2, 6)."""
    P, N = brick.led_positions_mm[leds.led], brick.led_axes[leds.led]
    turn = prediction.J_px_per_mm @ (R @ skew(P)) + prediction.J_px_per_axis @ (R @ skew(N))
    return np.concatenate([-turn, prediction.J_px_per_mm], axis=2)


@dataclass(frozen=True, slots=True, eq=False)
class LedNoise:
    """What makes the pictures of m LEDs unsure.

    Attributes
    ----------
    cov_px2 : ndarray, shape (m, 2, 2)
        Of the centroids.
    J : ndarray, shape (m, 2, 6)
        Derivatives of the pictures by attitude, rad, and position, m.
    away_s : ndarray, shape (m,)
        From the node.
    parts : NoiseParts
        Between the node and the LED.
    """

    cov_px2: FloatArray
    J: FloatArray
    away_s: FloatArray
    parts: NoiseParts

    def covariance_px2(self, levels: tuple[NoiseLevel, NoiseLevel]) -> FloatArray:
        """Return the covariance by levels of gyro and accelerometer, shape (m, 2, 2)."""
        turn = self.parts.gyro(levels[0]) * self.away_s
        shift = self.parts.acc(levels[1]) * self.away_s**3 / 3
        between = np.repeat(np.stack([turn, shift], axis=1), 3, axis=1)
        return np.asarray(self.cov_px2 + np.einsum("mik,mk,mjk->mij", self.J, between, self.J))


def led_arrays(
    leds: SeenLeds,
    pictured: Pictured,
    run: Run,
    nodes: Nodes,
    lin: Linearisation,
    levels: tuple[NoiseLevel, NoiseLevel],
    *,
    cov_px2: FloatArray,
    use: BoolArray,
    settings: FusionSettings,
) -> tuple[LedArrays, LedNoise]:
    """Return the smoother's measurements of one run: each LED tied to the node nearest in time.

    ``cov_px2``, shape (m, 2, 2), is believed of the centroids; ``use`` says which are shown to the filter.
    What the inertial samples leave unsure between node and LED is added to the covariance; the noise given
    beside tells what other levels make of it.
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
    R_lin, t_lin_m, turned = (
        pictured.R_camera_brick,
        pictured.t_camera_brick_mm * 1e-3,
        np.zeros((len(dt), 3)),
    )
    felt = np.zeros((len(dt), 2, 3))
    if run.camera is not None:
        J[..., 3:] = J[..., 3:] @ np.swapaxes(run.camera.still_attitude(t_s), 1, 2)
        R_lin, t_lin_m = run.camera.to_still(t_s, R_lin, t_lin_m)
        turned = run.camera.still_omega_radps(t_s)
        felt = run.camera.increments(start_s, t_s, acc_lag_s=lin.lag_s)[:, :2]
    parts = run.noise_parts(np.sort(np.stack([start_s, t_s]), axis=0), lin, settings)
    noise = LedNoise(cov_px2, J, np.abs(dt), parts)
    first = np.searchsorted(node, np.arange(len(nodes.t_s) + 1))[:, None].astype(np.int64)
    arrays = LedArrays(
        first=first,
        use=use,
        dt_s=dt,
        since_mid_s=t_cam_s - run.t_mid_s,
        R_step=step.R,
        dv_mps=step.dv_mps,
        dp_m=step.dp_m,
        omega_radps=run.signal.gyro_at(t_s),
        camera_omega_radps=turned,
        camera_dv_mps=felt[:, 0].copy(),
        camera_dp_m=felt[:, 1].copy(),
        R_lin=np.ascontiguousarray(R_lin),  # the smoother is not compiled, and loaded, twice
        t_lin_m=t_lin_m,
        residual_px=pictured.residual_px,
        J=J,
        cov_px2=noise.covariance_px2(levels),
        nis=np.zeros(len(dt)),
        inflation=np.ones(len(dt)),
    )
    return arrays, noise


def led_chi2(problem: Problem, estimate: Estimate, *, beside_px: ArrayLike = 0.0) -> FloatArray:
    """Return how far each LED lies from what all the others say, over its covariance (2 degrees of freedom).

    Or from ``beside_px`` next to it, shape (m, 2). See `noise_choice.frame_chi2`; of one run that is a batch
    alone. NaN where rounding leaves no covariance to judge by.
    """
    leds = problem.leds
    if leds is None:
        raise ValueError("the problem has no LEDs")
    y, A = estimate.led_residual_px - np.asarray(beside_px, dtype=np.float64), estimate.led_cov_px2
    given = leds.cov_px2 * leds.inflation[:, None, None]
    rest = _inverse(1.02 * given - A)
    S = leds.cov_px2 + np.where(leds.use[:, None, None], A + A @ rest @ A, A)
    y = np.where(leds.use[:, None], (given @ rest @ y[..., None])[..., 0], y)
    return np.asarray(np.einsum("mi,mij,mj->m", y, _inverse(S), y))


def _inverse(S: FloatArray) -> FloatArray:
    """Return the inverses of covariances, shape (m, 2, 2); NaN of those that are not positive definite."""
    a, b, c = S[:, 0, 0], 0.5 * (S[:, 0, 1] + S[:, 1, 0]), S[:, 1, 1]
    det = a * c - b * b
    det = np.where((a > 0) & (det > 0), det, np.nan)
    return np.stack([c, -b, -b, a], axis=1).reshape(-1, 2, 2) / det[:, None, None]
