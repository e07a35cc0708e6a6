"""How far centroids and inertial samples are to be believed, found from how well they agree LED by LED.

Frames 30 times a second say little of what happens between them; LEDs, each at its own row's instant, say
more. So what poses have settled (`noise_choice`) is settled once more: the noise of the centroids from their
residuals, and what of the inertial samples is error from how likely the LEDs are.
"""

from dataclasses import dataclass, replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.fusion.led_by_led.led_measurements import SeenLeds
from bricktrack_host.fusion.pose_by_pose.inertial_noise import NoiseLevel, NoiseParts
from bricktrack_host.fusion.smoothing.smoother import Problem, score_noise
from bricktrack_host.fusion.smoothing.smoother_kernel import NIS_CAP

STATED_SCALES = np.ones(2)
ALL_NEW = np.ones(2)  # `pictures_alike` of noise that is new in each picture
_STILL_PX = 0.3
_MIN_SIGHTINGS = 60
_LEAST_SCALE = 0.1
_MOST_LAG = 30
_LEAST_ALIKE = 0.05  # correlation from which on errors are new: of 1000 sightings it is known to 0.02
_ODD_SDS = 3.0  # what is farther off says no more
_CHI_2_MEDIAN = 1.386  # median of chi-square with 2 degrees of freedom
_STEP = 2.0
_EARN_PER_STEP = 2.0  # log-likelihood that a step away from what is stated must earn
_MOST_STEPS = 5
_MIN_IMPACTS = 4  # fewer count as many


def still_sightings(leds: SeenLeds) -> BoolArray:
    """Return which LEDs are seen where they were a frame before, shape (m,).

    There mosaic, pixel grid and codec make the same error again, and the noise is that of the light alone.
    An LED that no frame before shows stands where it does not move to the next one.
    """
    order = np.lexsort((leds.frame, leds.led))
    frame, led, uv = leds.frame[order], leds.led[order], leds.uv_px[order]
    follows = (np.diff(led) == 0) & (np.diff(frame) == 1)
    again = follows & (np.linalg.norm(np.diff(uv, axis=0), axis=1) < _STILL_PX)
    still = np.zeros(len(frame), dtype=np.bool_)
    still[order[1:]] = again
    still[order[:-1]] |= again & ~np.append(False, follows[:-1])
    return still


def believed_covariance_px2(
    leds: SeenLeds, still: BoolArray, scales: FloatArray, pictures_alike: FloatArray
) -> FloatArray:
    """Return the covariance of centroids whose stated sd is off by ``scales``, shape (m, 2, 2), px^2.

    ``still``, shape (m,), says which are of pictures at rest; ``scales``, shape (2,), hold what those of
    moving pictures and of such at rest are multiplied by, and ``pictures_alike``, shape (2,), in how many of
    them in a row the error is one: so many are believed as much as one would be.

    What is stated of a picture that moves is mostly its smear, and may be several times too much. What a
    picture at rest is unsure by, one that moves slowly is unsure by as well.
    """
    cov_px2 = np.square(scales[still.astype(np.int64)])[:, None, None] * leds.cov_px2
    if still.any():
        at_rest_px2 = np.median(0.5 * np.trace(leds.cov_px2[still], axis1=1, axis2=2))
        more_px2 = max(scales[1] ** 2 - scales[0] ** 2, 0.0) * at_rest_px2
        cov_px2[~still] += more_px2 * np.eye(2)
    return np.asarray(pictures_alike[still.astype(np.int64)][:, None, None] * cov_px2)


def centroid_scales(chi2: FloatArray, still: BoolArray, use: BoolArray, scale: FloatArray) -> FloatArray:
    """Return what the stated sd of the centroids is to be multiplied by, shape (2,): moving, and still.

    ``chi2``: squared residuals of each LED to all others, over covariances with ``scale``; NaN says nothing.
    """
    out, use = scale.copy(), use & np.isfinite(chi2)
    enough = [int((use & (still == c)).sum()) >= _MIN_SIGHTINGS for c in (False, True)]
    for i, c in enumerate((False, True)):
        part = use & (still == c) if enough[i] else use
        if part.any():
            out[i] = max(scale[i] * float(np.sqrt(np.median(chi2[part]) / _CHI_2_MEDIAN)), _LEAST_SCALE)
    if not enough[0]:
        out[0] = max(out.max(), 1.0)  # a picture at rest says nothing of one that moves
    if not enough[1]:
        out[1] = out[0]
    return out


def pictures_alike(residual_px: FloatArray, leds: SeenLeds, still: BoolArray, use: BoolArray) -> FloatArray:
    """Return in how many pictures in a row the error of a centroid is one, shape (2,): moving, and still.

    What lies behind an LED, or on the lens, draws its centroid by an error that changes as the LED moves on
    by a part of its width, which in a slow motion takes many frames. To the smoother noise is new in each, so
    it is to believe n frames no more than their mean is known: with noise alike by r_k in frames k apart its
    variance is ``1 + 2 (r_1 + r_2 + ...)`` times that over n. ``residual_px``, shape (m, 2), are of LEDs by a
    smoothed motion.
    """
    n_frames, n_leds = int(leds.frame.max(initial=-1)) + 1, int(leds.led.max(initial=-1)) + 1
    out = np.ones(2)
    for i, of in enumerate((~still, still)):
        some = use & of
        if np.count_nonzero(some) >= _MIN_SIGHTINGS:
            at = leds.frame[some], leds.led[some]
            seen, off_px = np.zeros((n_frames, n_leds)), np.zeros((n_frames, n_leds, 2))
            seen[at], off_px[at] = 1.0, residual_px[some]
            out[i] = _frames_alike(off_px, seen)
    out[1] = out.max()  # an error that changes with the place in the picture does not while it stands
    return out


def _frames_alike(off_px: FloatArray, seen: FloatArray) -> float:
    """Return in how many frames in a row errors, shape (n, L, 2), are one; ``seen``, (n, L), is 1 or 0."""
    mean_px = off_px.sum(axis=0) / np.maximum(seen.sum(axis=0), 1.0)[:, None]
    off_px = seen[..., None] * (off_px - mean_px)
    limit_px = _ODD_SDS * np.sqrt(np.square(off_px).sum() / (2 * seen.sum()))
    off_px = np.clip(off_px, -limit_px, limit_px)
    variance_px2, alike = float(np.square(off_px).sum() / seen.sum()), 1.0
    for lag in range(1, min(_MOST_LAG, len(seen) - 1) + 1):
        n_pairs = float((seen[lag:] * seen[:-lag]).sum())
        if n_pairs < _MIN_SIGHTINGS:
            break
        share = float((off_px[lag:] * off_px[:-lag]).sum()) / (n_pairs * variance_px2)
        if share < _LEAST_ALIKE:
            break
        alike += 2 * share
    return alike


@dataclass(frozen=True, slots=True)
class InertialNoise:
    """What of the inertial samples is believed to be error, in steps of a factor of two from what is stated.

    Attributes
    ----------
    gyro_rough, acc_rough, gyro_systematic, acc_systematic, impact : int
    n_impacts : int
        From so few pulses the share of impacts was chosen; 0: it was not.
    """

    gyro_rough: int = 0
    acc_rough: int = 0
    gyro_systematic: int = 0
    acc_systematic: int = 0
    impact: int = 0
    n_impacts: int = 0

    @property
    def n_steps(self) -> int:
        """Return how far from what is stated."""
        return sum(abs(getattr(self, kind)) for kind in _KINDS)

    def levels(self, stated: tuple[NoiseLevel, NoiseLevel]) -> tuple[NoiseLevel, NoiseLevel]:
        """Return the levels of gyro and accelerometer."""
        gyro, acc = stated
        impact = _STEP**self.impact
        if self.n_impacts:
            # Student's t: what a few pulses were off by tells their spread no better.
            n = max(self.n_impacts, _MIN_IMPACTS)
            impact *= float(np.sqrt(n / (n - 2)))

        def moved(level: NoiseLevel, rough: int, systematic: int) -> NoiseLevel:
            return NoiseLevel(
                level.roughness * _STEP**rough, level.systematic * _STEP**systematic, level.impact * impact
            )

        return (
            moved(gyro, self.gyro_rough, self.gyro_systematic),
            moved(acc, self.acc_rough, self.acc_systematic),
        )


_KINDS = ("acc_rough", "gyro_rough", "impact", "acc_systematic", "gyro_systematic")


def choose_inertial_noise(
    problem: Problem,
    parts: NoiseParts,
    signal: ImuSignal,
    stated: tuple[NoiseLevel, NoiseLevel],
    settings: FusionSettings,
) -> InertialNoise:
    """Return the noise of the inertial samples under which the LEDs of a run are likeliest.

    One kind after the other, down as long as each step earns its price, or else up; not where a step down was
    the likelier one and only too dear. ``parts``: at the steps.
    """

    def likelihood(choice: InertialNoise) -> float:
        gyro, acc = choice.levels(stated)
        return _log_likelihood(problem, parts.gyro(gyro), parts.acc(acc))

    chosen = InertialNoise()
    best = likelihood(chosen)
    for kind in _KINDS:
        for step in (-1, 1):
            start, reached = chosen, best
            while abs(getattr(chosen, kind)) < _MOST_STEPS:
                tried = replace(chosen, **{kind: getattr(chosen, kind) + step})
                reached = likelihood(tried)
                if reached - best <= _EARN_PER_STEP * (tried.n_steps - chosen.n_steps):
                    break
                chosen, best = tried, reached
            if chosen is not start or reached > best:
                break
    pulse = signal.acc_impact_mps2 > settings.impact_mps2
    n_impacts = int(np.count_nonzero(pulse[1:] & ~pulse[:-1]))
    return replace(chosen, n_impacts=n_impacts if chosen.impact else 0)


def _log_likelihood(problem: Problem, gyro_var: FloatArray, acc_var: FloatArray) -> float:
    """Return how likely the LEDs are; unlike the filter's own this knows no bound to what one may take away.

    False LEDs are left out by now: what is far off is so because the samples were believed too much.
    """
    if problem.leds is None:
        raise ValueError("the problem has no LEDs")
    bounded = float(score_noise(problem, gyro_var[None, None], acc_var[None, None])[0][0, 0])
    beyond = np.maximum(problem.leds.nis[problem.leds.use] - NIS_CAP, 0.0)
    return bounded - 0.5 * float(beyond.sum())
