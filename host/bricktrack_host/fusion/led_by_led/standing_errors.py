"""Errors that stand still over a run seen LED by LED: of the inertial sensor, and of the LEDs' pictures.

What calibration, layout and profile leave of error in a centroid hardly changes while the brick moves by a
few millimetres, and slowly as it turns. Taken for noise it would average out over the frames, as it does not;
taken for nothing the noise would be overstated; and what changes with the view is taken for a pose that is
off where it is believed to be constant, the more firmly the better the samples know how the brick turned. So
a centroid's error is a noise that is new in every picture, and a part that stands still: of the profile, of
the shape at each angle and of the picture's size, common to all LEDs, and of each LED for itself, at each
view its own. How large the latter is the LEDs say among themselves (`leds_among_themselves`).

Like the errors of the inertial sensor (`sensor_errors`, which see for the method) these need not be states of
the filter: one weighted least squares over the run gives them, and what stays unsure of them makes the motion
unsure by the same derivatives.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.led_by_led.led_measurements import Pictured, SeenLeds
from bricktrack_host.fusion.led_by_led.leds_among_themselves import AmongThemselves
from bricktrack_host.fusion.led_by_led.shape_errors import N_SHAPES, shape_shifts_px
from bricktrack_host.fusion.pose_by_pose.fusion_problem import Run
from bricktrack_host.fusion.smoothing.camera_errors import CameraErrors, CameraWay, camera_prior_sd
from bricktrack_host.fusion.smoothing.sensor_errors import N_ERRORS, SensorErrors, sensor_prior_sd
from bricktrack_host.fusion.smoothing.smoother import Filter, Problem
from bricktrack_host.fusion.smoothing.standing_doubt import ARM, Doubt, ErrorWay, root_of
from bricktrack_host.fusion.smoothing.standing_errors_kernel import N_GAINS, Sight
from bricktrack_host.tracking.pose.refine import OWN_SHARE

_PROFILE, _SCALE, _SPREAD, _SMEAR, _SHAPE = range(N_ERRORS, N_ERRORS + 5)
_FIRST_LED = _SHAPE + N_SHAPES
N_VIEWS = 6  # see `_by_view`
_N_LINEAR = 3
_CURVED_TELLS = 0.2
"""Of an LED's own error, at the farthest view: where its square changes less of it, it is left out."""
_SCALE_SD = 5e-5
"""Of the picture's size: light falls off towards its corners, also across the width of one LED, and draws the
centroid inwards by some 0.02 px at 400 px from the centre; a lens that warms up does as much."""
_SPREAD_SD = 0.3
"""Of how far acceleration draws a moving light's centroid, over what it would were all light weighed alike. A
pixel that is full counts no more light, and neither rim nor plateau counts all of theirs: in recordings by
another renderer with 6 to 12 ms of exposure 0.7 to 0.9 of it was left (simulated). The samples do not tell
it, for their low-pass has the same shape; so it is not estimated, but leaves the motion unsure.
"""
_SMEAR_SD = 0.01
"""Of how far a smear draws a centroid aside, over the smear; see `led_measurements.Pictured.leaning_px`. By
recording -0.003 to 0.016, in those of another renderer with 1 to 15 ms of exposure (simulated)."""
_ALIKE_RAD = 0.2
"""Turned by so much, an LED's error is another one. In recordings by another renderer than this project's
LEDs' errors changed by 5 to 10 times their size per radian (simulated)."""
_OFFSET_SDS_PX = np.geomspace(0.005, 1.0, 30)
"""That single LEDs may be off by; any factor is as likely as the next before the run speaks."""
_CHANGE_SDS_PX = np.geomspace(0.005, 1.0, 10)
"""That they may change by within `_ALIKE_RAD`. It goes its own way: a misplaced LED's error hardly changes,
what lens, light and coding do to an LED is another error some pixels further on."""
_GYRO_LOSS_SD_S2 = 5e-6
"""Of what the gyro's low-pass takes from its second derivative, beside what the alignment finds: a critically
damped one of 32 Hz takes 1.2e-5, one that is flat to second order nothing, and poses alone hardly tell. Left
alone it was taken for a gyro's scale, a lever arm and LEDs beside their places in 300 s (simulated)."""
_HIDDEN_SHARE = np.sqrt(2)
"""Of single LEDs' errors, what is believed over what they show among themselves. To the pictures that show it
the shape of the LEDs was fitted, and often their places: what looks like a pose was left. Recordings by
another renderer than this project's had 1.4 times as much on the median (simulated)."""


@dataclass(frozen=True, slots=True, eq=False)
class StandingErrors:
    """Errors that stand still, in one vector of q = 31 + 2 V L, or 54 + 2 V L where the camera moves.

    In this order: gyro and accelerometer, row by row, and lever arm, m, as in `sensor_errors.SensorErrors`;
    the profile's, in units of its stated sd; the picture's size over what it should be, less 1; how far
    acceleration draws the centroid, likewise, which is not estimated and stays 0; how far the smear draws it,
    over the smear; what the shape shows at other angles, in units of `shape_shifts_px`; (u, v) of each of L
    LEDs, px, and V - 1 times as many that change with the view, see `_by_view`; what the gyro's
    low-pass takes from the second derivative, s^2, over what the alignment says; those of the sensor that
    moves with the camera, as in `CameraErrors.values`.

    Attributes
    ----------
    value : ndarray, shape (q,)
        As estimated.
    covariance : ndarray, shape (q, q)
    offset_sd_px : float
        Of the errors of single LEDs, as they show among themselves; NaN where too few are seen at once.
    n_leds, n_views : int
    """

    value: FloatArray
    covariance: FloatArray
    offset_sd_px: float
    n_leds: int
    n_views: int = N_VIEWS

    @classmethod
    def before(
        cls, run: Run, lever_arm_m: FloatArray, n_leds: int, *, n_views: int = N_VIEWS
    ) -> "StandingErrors":
        """Return what was taken out of a run's sensor already, given where it was said to be."""
        gains = [(gain - np.eye(3)).ravel() for gain in (run.gyro_gain, run.acc_gain)]
        theirs = np.zeros(0) if run.camera is None else run.camera.errors.values()
        of_pictures = np.zeros(_FIRST_LED - N_ERRORS + 2 * n_views * n_leds)
        value = np.concatenate(
            [*gains, run.lever_arm_m - lever_arm_m, of_pictures, [run.gyro_loss_s2], theirs]
        )
        return cls(value, np.zeros((len(value), len(value))), 0.0, n_leds, n_views)

    def of_sensor(self, *, since: "StandingErrors") -> SensorErrors:
        """Return what the inertial sensor's errors have changed by."""
        change = self.value - since.value
        gyro, acc = change[:N_GAINS].reshape(2, 3, 3)
        loss = _FIRST_LED + 2 * self.n_views * self.n_leds
        theirs = loss + 1
        at = np.append(np.arange(N_ERRORS), np.arange(theirs, len(change)))
        camera = CameraErrors.of(change[theirs:]) if theirs < len(change) else None
        return SensorErrors(
            gyro, acc, change[ARM], self.covariance[np.ix_(at, at)], camera, gyro_loss_s2=float(change[loss])
        )

    def in_picture_px(self, leds: SeenLeds, pictured: Pictured) -> FloatArray:
        """Return by how much the centroids are off for them, shape (m, 2)."""
        of_leds = self.value[_FIRST_LED : _FIRST_LED + 2 * self.n_views * self.n_leds].reshape(
            self.n_views, self.n_leds, 2
        )
        own = np.einsum("mk,kmi->mi", _by_view(pictured, self.n_views), of_leds[:, leds.led])
        common = _of_all_leds(pictured) @ self.value[_PROFILE:_FIRST_LED]
        return np.asarray(common + own)


@dataclass(frozen=True, slots=True, eq=False)
class StandingPrior:
    """What is believed of errors that stand still before the run speaks.

    Attributes
    ----------
    sensor_sd : ndarray, shape (21,)
        Zero where none are believed.
    led_shift_px : ndarray, shape (L, 2)
        One standard deviation of each LED's profile, of which a share is its own.
    camera_sd : ndarray, shape (23,), or (0,) where the camera stands still
    n_views : int
    """

    sensor_sd: FloatArray
    led_shift_px: FloatArray
    camera_sd: FloatArray
    n_views: int

    @classmethod
    def of(
        cls,
        leds: SeenLeds,
        pictured: Pictured,
        n_leds: int,
        settings: FusionSettings,
        *,
        n_views: int,
        camera_moves: bool,
    ) -> "StandingPrior":
        """Return the belief for a run: the profile's share as it is on the mean over the run."""
        count = np.maximum(np.bincount(leds.led, minlength=n_leds), 1)
        mean = [np.bincount(leds.led, part, minlength=n_leds) / count for part in pictured.profile_shift_px.T]
        camera_sd = camera_prior_sd(settings) if camera_moves else np.zeros(0)
        return cls(sensor_prior_sd(settings), np.stack(mean, axis=1), camera_sd, n_views)

    def covariance(self, offset_sd_px: ArrayLike, change_sd_px: ArrayLike) -> FloatArray:
        """Return the covariance of all, shape (..., q, q), where single LEDs are off by so much (...).

        And where this changes with the view by ``change_sd_px``, shape (...). Without what is not estimated.
        """
        own = OWN_SHARE * self.led_shift_px
        last_led = _FIRST_LED + own.size
        by_view = slice(last_led, _FIRST_LED + self.n_views * own.size)
        q = by_view.stop + 1 + len(self.camera_sd)
        out = np.zeros((*np.broadcast_shapes(np.shape(offset_sd_px), np.shape(change_sd_px)), q, q))
        at = np.arange(q)
        of_all = [1.0, _SCALE_SD**2, 0.0, _SMEAR_SD**2, *np.ones(N_SHAPES)]
        out[..., at, at] = np.concatenate(
            [
                self.sensor_sd**2,
                of_all,
                np.zeros(self.n_views * own.size),
                [_GYRO_LOSS_SD_S2**2],
                self.camera_sd**2,
            ]
        )
        for led, shift in enumerate(own):
            part = slice(_FIRST_LED + 2 * led, _FIRST_LED + 2 * led + 2)
            out[..., part, part] = np.outer(shift, shift)
        of_leds = at[_FIRST_LED:last_led]
        out[..., of_leds, of_leds] += np.square(offset_sd_px)[..., None]
        of_profile = np.tile(np.repeat(0.5 * np.square(own).sum(axis=1), 2), self.n_views - 1)
        out[..., at[by_view], at[by_view]] = np.square(change_sd_px)[..., None] + of_profile
        return out


class StandingWay:
    """A filter's way over a run's LEDs with the derivatives by all errors that stand still.

    Parameters
    ----------
    problem, passed : Problem, Filter
        Of LEDs; a run alone.
    leds, pictured : SeenLeds, Pictured
        Those of the problem.
    n_leds, n_views : int
    R_still_camera : ndarray, shape (K, 3, 3), optional
        Attitudes of a moving camera at the nodes.
    """

    def __init__(
        self,
        problem: Problem,
        passed: Filter,
        leds: SeenLeds,
        pictured: Pictured,
        n_leds: int,
        *,
        n_views: int = N_VIEWS,
        R_still_camera: FloatArray | None = None,
    ) -> None:
        arrays = problem.leds
        if arrays is None:
            raise ValueError("the problem has no LEDs")
        of_all = _of_all_leds(pictured)
        views = _by_view(pictured, n_views)
        self._among_themselves = AmongThemselves.of(arrays, leds, of_all, views, n_leds)
        camera, last = None, np.zeros((len(of_all), 2, 1))
        if R_still_camera is not None:
            camera = CameraWay.of(problem, R_still_camera, 0)
            node = np.repeat(np.arange(len(problem.has_frame)), np.diff(arrays.first[:, 0]))
            t_s = camera.t_s[node] + arrays.dt_s
            moved = arrays.J @ camera.of_seen(arrays.R_lin, arrays.t_lin_m, t_s)
            last = np.concatenate([last, moved], axis=2)
        sight = Sight(
            first=np.ascontiguousarray(arrays.first[:, 0]),
            use=arrays.use,
            shared=np.concatenate([arrays.J[..., 3:] @ arrays.R_lin, -of_all], axis=2),
            by_view=views,
            led=leds.led,
            n_leds=n_leds,
            last=last,
        )
        self._way = ErrorWay.of(passed, 0, sight, camera, turning=_turned_by_loss(problem))

    def estimate(self, prior: StandingPrior, known: FloatArray) -> StandingErrors:
        """Return the likeliest errors and their covariance, where ``known``, shape (q,), was taken out.

        The sd of single LEDs' errors is the root of its mean square given what they say among themselves.
        """
        normal, pull = self._way.normal, self._way.pull
        n_leds = len(prior.led_shift_px)
        part = slice(_PROFILE, _FIRST_LED + 2 * prior.n_views * n_leds)

        def likely_px(sizes_px: FloatArray, of_pictures: FloatArray) -> float:
            belief = self._among_themselves.belief(of_pictures[:, part, part], known[part])
            weight = np.exp(belief - belief.max())
            return float(np.sqrt((weight * sizes_px**2).sum() / weight.sum()))

        # How large what stays is says nothing of how much changes.
        change_sd_px = likely_px(_CHANGE_SDS_PX, prior.covariance(_OFFSET_SDS_PX[-1], _CHANGE_SDS_PX))
        offset_sd_px = likely_px(_OFFSET_SDS_PX, prior.covariance(_OFFSET_SDS_PX, change_sd_px))
        believed = prior.covariance(_HIDDEN_SHARE * offset_sd_px, _HIDDEN_SHARE * change_sd_px)
        _, value = _likeliest(believed, known, normal, pull)
        covariance = np.linalg.solve(np.eye(len(known)) + believed @ normal, believed)
        # What is not estimated draws the others after it.
        drawn = np.eye(len(known))[_SPREAD] - covariance @ normal[:, _SPREAD]
        covariance += _SPREAD_SD**2 * np.outer(drawn, drawn)
        told_px = offset_sd_px if len(self._among_themselves.value) else float("nan")
        return StandingErrors(value, 0.5 * (covariance + covariance.T), told_px, n_leds, prior.n_views)

    def doubt(self, errors: StandingErrors, of: IntArray) -> Doubt:
        """Return what the errors leave unsure of smoothed states ``of``, shape (c,)."""
        return Doubt(self._way, root_of(errors.covariance), of)


def views_told(pictured: Pictured) -> int:
    """Return how many of `_by_view` tell: where LEDs are seen from nearly one side, their squares do not."""
    curved = np.square(pictured.from_side_rad / _ALIKE_RAD).sum(axis=1) / np.sqrt(2)
    return N_VIEWS if curved.max(initial=0.0) > _CURVED_TELLS else _N_LINEAR


def _turned_by_loss(problem: Problem) -> FloatArray:
    """Return by how much a gyro turns each step less for each s^2 of loss, shape (K - 1, 3, 1), rad/s^2."""
    t_s = np.concatenate([[0.0], np.cumsum(problem.dt_s[:, 0])])
    return np.asarray(-np.diff(np.gradient(problem.omega_radps[:, 0], t_s, axis=0), axis=0)[..., None])


def _by_view(pictured: Pictured, n_views: int) -> FloatArray:
    """Return what of an LED's errors of one px each sight has, shape (m, n_views), at most 6.

    The first stays as it is; the others are the first terms of errors alike within `_ALIKE_RAD`, whose
    likeness falls off as a Gaussian does.
    """
    x, y = pictured.from_side_rad.T / _ALIKE_RAD
    terms = [np.ones_like(x), x, y]
    if n_views > _N_LINEAR:
        terms += [x * x / np.sqrt(2), x * y, y * y / np.sqrt(2)]
    return np.stack(terms, axis=1)


def _of_all_leds(pictured: Pictured) -> FloatArray:
    """Return what each error that all LEDs share moves their centroids by, shape (m, 2, 4 + N_SHAPES), px."""
    of_all = [
        pictured.profile_shift_px,
        pictured.from_centre_px,
        pictured.accelerated_px,
        pictured.leaning_px,
    ]
    shapes = shape_shifts_px(pictured.facing, pictured.side_on_px)
    return np.concatenate([np.stack(of_all, axis=2), shapes], axis=2)


def _likeliest(
    prior: FloatArray, known: FloatArray, normal: FloatArray, pull: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return log-likelihoods, shape (...), and the likeliest errors, shape (..., q), of priors (..., q, q).

    With prior P about zero and normal matrix N these are (1 + P N)^-1 P b: nothing is asked of P's inverse,
    and an error without variance is none. ``known`` was taken out already; where there is no variance, it
    was so before, and stays.
    """
    stays = np.diagonal(prior, axis1=-2, axis2=-1) == 0
    b = (normal @ np.where(stays, 0.0, known)[..., None])[..., 0] - pull
    whole = np.eye(len(known)) + prior @ normal
    value = np.linalg.solve(whole, prior @ b[..., None])[..., 0]
    belief = 0.5 * ((b * value).sum(axis=-1) - np.linalg.slogdet(whole)[1])
    return belief, np.where(stays, known, value)
