"""How much likelier an assignment of lights to LEDs is than false lights that fell anywhere.

The lights of LEDs lie where a pose shows them, off by their centroids' noise, by what the profile leaves
unknown and, read out row by row, by how the brick moves within the picture; false lights lie anywhere. What
is not known of a picture (pose, motion, the profile's common part) is integrated over near the fitted pose,
where pixels depend on it linearly: so LEDs whose places the others hardly tell speak little, and so do all of
a picture that any motion would explain. How fast the brick moves, and how well lens and profile are known,
are sums over a few guesses. Sizes: LEDs of one picture show areas in the ratios that the pose predicts, but
for a factor of exposure and threshold that is common to all; other lights are of any size.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray, rows_of, with_rows
from bricktrack_host.tracking.identity.evidence_kernel import Placed, log_area_odds, log_areas, log_places
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.refine import OWN_SHARE

_FLOOR_PX = 0.05  # calibration and rendering leave this at least
_CUT_SD_RADII = 0.3  # what is left of an LED that a border or a card cuts has its centroid elsewhere
_MISPLACED = {
    True: np.array([[0.0, 0.8], [0.01, 0.15], [0.04, 0.05]]),
    False: np.array([[0.003, 0.5], [0.01, 0.3], [0.04, 0.2]]),
}
"""Centroids are off by so much more, in LED radii, in such shares of pictures, by whether the profile was
fitted: as usual, and where codec, glare, lens, or a profile that no collar describes, do worse."""
_SCATTERED = 2.0  # chi-square of so many times its freedom: one in ten at four, one in fifteen at six
_HIDDEN = 0.2  # share of LEDs facing the camera that show no light
_FALSE = 5.0  # false lights to be expected in a picture, the more the less likely
_TURNED_TO_CAMERA = 8.0
"""By how much likelier, as a logarithm, all LEDs facing the camera are than none: layouts are made for it.
With axes 45 degrees about their mean, half of all pictures show a brick within 30 degrees of facing the
camera, nineteen in twenty within 60."""
_DEPTHS = 2.6  # integral of (z / z0)^2 from half the distance to twice that: where bricks may be


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What speaks for assignments.

    Attributes
    ----------
    log_ratio : ndarray, shape (n,)
        Logarithm of the odds over lights that are all false.
    is_scattered : ndarray of bool, shape (n,)
        The residuals are larger than those of a brick at rest.
    """

    log_ratio: FloatArray
    is_scattered: BoolArray

    def take(self, rows: IntArray) -> "Evidence":
        """Return that of some assignments."""
        return rows_of(self, rows)

    def replaced(self, rows: IntArray, by: "Evidence") -> "Evidence":
        """Return this with that of some assignments replaced."""
        return with_rows(self, rows, by)


@dataclass(frozen=True, slots=True, eq=False)
class Given:
    """The lights that n assignments give to LEDs; NaN for none.

    Attributes
    ----------
    uv_px : ndarray, shape (n, n_leds, 2), px
    cov_px2 : ndarray, shape (n, n_leds, 2, 2), px^2
        Of the lights' centroids.
    area_px2 : ndarray, shape (n, n_leds), px^2
    is_whole : ndarray of bool, shape (n, n_leds)
        False: a light that is cut, or two in one.
    dt_s : ndarray, shape (n, n_leds), s
        From the picture's instant to the LED's.
    twist_sd : ndarray, shape (n, 6), rad/s and mm/s
        What is not known of the motion within the picture.
    n_lights : ndarray of int64, shape (n,)
        Of the picture that each assignment is of.
    """

    uv_px: FloatArray
    cov_px2: FloatArray
    area_px2: FloatArray
    is_whole: BoolArray
    dt_s: FloatArray
    twist_sd: FloatArray
    n_lights: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What the assignments' fitted poses show, by one guess of the LEDs' profile.

    Attributes
    ----------
    uv_px : ndarray, shape (n, n_leds, 2), px
        NaN where there is no pose.
    area_px2, facing : ndarray, shape (n, n_leds)
        See `led_profile.LedPrediction`.
    J_px_per_pose : ndarray, shape (n, n_leds, 2, 6)
        By ``[dtheta rad, dt mm]``.
    profile_px : ndarray, shape (n, n_leds, 2), px
        One standard deviation of what this guess leaves unknown in all LEDs alike.
    tilt : ndarray, shape (n, 3)
        Of the LEDs' mean axis from the line of sight; zero where it faces the camera.
    J_tilt_per_turn : ndarray, shape (n, 3, 3)
        By dtheta, rad.
    """

    uv_px: FloatArray
    area_px2: FloatArray
    facing: FloatArray
    J_px_per_pose: FloatArray
    profile_px: FloatArray
    tilt: FloatArray
    J_tilt_per_turn: FloatArray


def evidence_of(
    given: Given,
    guesses: Sequence[Shown],
    kept: BoolArray,
    depth_mm: FloatArray,
    *,
    n_pixels: int,
    min_leds: int,
    axes_length: float,
) -> Evidence:
    """Return what speaks for n assignments of lights to LEDs.

    Parameters
    ----------
    given : Given
    guesses : sequence of Shown
        One where the profile is known, several alike likely ones where it is not.
    kept : ndarray of bool, shape (n, n_leds)
        LEDs that the assignment gives a light; what is seen of others does not matter.
    depth_mm : ndarray, shape (n,), mm
        Of the brick in the pose.
    n_pixels : int
        Of the picture.
    min_leds : int
        Assignments of fewer LEDs, or without a pose, have minus infinity.
    axes_length : float
        Length of the mean of the LEDs' axes: 1 where all are one, 0 where they point all around.

    Notes
    -----
    Of a brick: each LED that faces the camera shows a light but for one in five; poses are alike likely
    wherever the camera sees a brick, at any roll, the likelier the better the LEDs face it. Of false lights:
    each anywhere, by a geometric law of their number. By Markov's inequality false lights alone reach odds of
    x to one in one picture out of x at most.
    """
    n = len(kept)
    n_leds = kept.sum(axis=1)
    placed = all_finite(given.uv_px) & all_finite(guesses[0].uv_px)
    possible = (n_leds >= min_leds) & (placed | ~kept).all(axis=1)
    log_ratio, is_scattered = np.full(n, -np.inf), np.zeros(n, dtype=bool)
    rows = np.flatnonzero(possible)
    if rows.size == 0:
        return Evidence(log_ratio, is_scattered)
    given, kept, n_leds = rows_of(given, rows), kept[rows], n_leds[rows]
    guesses = [rows_of(shown, rows) for shown in guesses]
    turned = _TURNED_TO_CAMERA * axes_length
    by_guess, chi2 = zip(
        *(_of_lights(given, shown, kept, len(guesses) == 1, turned) for shown in guesses), strict=True
    )
    lights = np.logaddexp.reduce(by_guess, axis=0) - np.log(len(guesses))
    is_scattered[rows] = np.min(chi2, axis=0) > _SCATTERED * np.maximum(2 * n_leds - 6, 1)
    n_false = np.maximum(given.n_lights - n_leds, 0)
    # Lights that are LEDs' are not false ones, which the fewer there are, the less likely come to be so many.
    elsewhere = (
        n_leds * np.log(n_pixels * (1 + 1 / _FALSE)) + gammaln(n_false + 1) - gammaln(n_false + n_leds + 1)
    )
    n_hidden = (~kept & (guesses[0].facing > 0)).sum(axis=1)
    hidden = n_leds * np.log(1 - _HIDDEN) + n_hidden * np.log(_HIDDEN)
    J = np.where(kept[..., None, None], guesses[0].J_px_per_pose[..., 3:5], 0.0)
    mm2_per_px2 = n_leds / np.abs(J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]).sum(axis=1)
    log_poses = np.log(_DEPTHS * n_pixels * mm2_per_px2 * np.maximum(depth_mm[rows], 1.0))
    log_poses += _log_turns(turned)
    log_ratio[rows] = lights + elsewhere + hidden - log_poses
    return Evidence(log_ratio, is_scattered)


def _log_turns(turned: float) -> float:
    """Return the logarithm of the integral over all attitudes of von Mises' and Fisher's law, one at most.

    Of the LEDs' mean axis about the line of sight, at any roll.
    """
    k = max(turned, 1e-6)
    return float(np.log(4 * np.pi**2 * -np.expm1(-2 * k) / k))


def _of_lights(
    given: Given, shown: Shown, kept: BoolArray, is_fitted: bool, turned: float
) -> tuple[FloatArray, FloatArray]:
    """Return the logarithm of the density of lights, the pose's taken as one, and the chi-square at rest."""
    radius2 = shown.area_px2 / np.pi
    own2 = OWN_SHARE**2 * (shown.profile_px**2).sum(axis=-1) if is_fitted else 0.0
    extra = _FLOOR_PX**2 + own2 + np.where(given.is_whole, 0.0, _CUT_SD_RADII**2 * radius2)
    placed = Placed(
        kept=kept,
        residual=given.uv_px - shown.uv_px,
        cov=given.cov_px2 + extra[..., None, None] * np.eye(2),
        J=shown.J_px_per_pose,
        profile=shown.profile_px,
        dt_s=given.dt_s,
        twist_sd=given.twist_sd,
        radius2=radius2,
        tilt=shown.tilt,
        J_tilt=shown.J_tilt_per_turn,
        turned=turned,
    )
    places, chi2 = log_places(placed, _MISPLACED[is_fitted])
    return places + log_areas(given.area_px2, shown.area_px2, kept & given.is_whole), chi2


def log_area_ratio(log_ratio: FloatArray) -> FloatArray:
    """Return how much likelier areas are an LED's than another light's, as logarithms.

    Parameters
    ----------
    log_ratio : ndarray, shape (n,)
        Logarithm of the area over the predicted one, less what all LEDs of the picture have in common; NaN
        where one is not known, and in what is returned.
    """
    return log_area_odds(log_ratio)
