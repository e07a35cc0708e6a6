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
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.refine import OWN_SHARE

_FLOOR_PX = 0.05  # calibration and rendering leave this at least
_CUT_SD_RADII = 0.3  # what is left of an LED that a border or a card cuts has its centroid elsewhere
_MISPLACED_RADII = {True: (0.0, 0.01, 0.04), False: (0.003, 0.01, 0.04)}
"""Centroids are off by so much more, in LED radii, by whether the profile was fitted: as usual, and where
codec, glare, lens, or a profile that no collar describes, do worse."""
_MISPLACED_SHARE = {True: (0.8, 0.15, 0.05), False: (0.5, 0.3, 0.2)}
_SPEEDS = np.array([0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0])
"""Shares of what is not known of the motion that the brick may move at: at rest, or at any speed alike."""
_AT_REST = 0.5
_AREA_SDS = np.array([0.03, 0.1, 0.2])
"""Of the logarithm of an LED's area over the predicted one, in one picture, alike likely: clean ones leave
0.01, glare, limb darkening and the profile more."""
_AREA_OTHER = 0.05  # share of LEDs whose area says nothing: partly covered, run together with another light
_LOG_AREAS = np.log(81.0)  # of other lights: what segmentation lets pass is a third to three times the radius
_SCATTERED = 2.0  # chi-square of so many times its freedom: one in ten at four, one in fifteen at six
_COMMON_AREA_SD = 0.25  # of the logarithm of the factor that all areas share
_COMMON_AREA = 0.5  # limit of the logarithm of the factor that all areas share
_HIDDEN = 0.2  # share of LEDs facing the camera that show no light
_FALSE = 5.0  # false lights to be expected in a picture, the more the less likely
_TURNED_TO_CAMERA = 8.0
"""By how much likelier, as a logarithm, all LEDs facing the camera are than none: layouts are made for it.
With axes 45 degrees about their mean, half of all pictures show a brick within 30 degrees of facing the
camera, nineteen in twenty within 60."""
_PRIOR = np.diag([0.1, 0.1, 0.1, 4e-4, 4e-4, 4e-4, 1.0])
"""Inverse variances of turn, rad, and shift, mm, about the fitted pose, both wide, and of the profile."""
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
    radius2 = np.where(kept, shown.area_px2 / np.pi, 1.0)
    own2 = OWN_SHARE**2 * (shown.profile_px**2).sum(axis=-1) if is_fitted else 0.0
    extra = _FLOOR_PX**2 + own2 + np.where(given.is_whole, 0.0, _CUT_SD_RADII**2 * radius2)
    extra = np.where(kept, extra, 0.0)
    residual = given.uv_px - shown.uv_px
    X = np.concatenate([shown.J_px_per_pose, shown.profile_px[..., None], residual[..., None]], axis=-1)
    X = np.where(kept[..., None, None], X, 0.0)
    per_twist = np.where(kept, given.dt_s, 0.0)[..., None, None] * given.twist_sd[:, None, None]
    X = np.concatenate([X[..., :7], X[..., :6] * per_twist, X[..., 7:]], axis=-1)
    cov = np.where(kept[..., None, None], given.cov_px2, np.eye(2))
    J_tilt, tilt = shown.J_tilt_per_turn, shown.tilt
    X_tilt = np.zeros((len(kept), 3, X.shape[-1]))
    X_tilt[..., :3], X_tilt[..., -1] = J_tilt, -tilt  # what is left of it, as the residual of the lights
    by_tilt = turned * np.swapaxes(X_tilt, -1, -2) @ X_tilt
    log_density, chi2 = [], []
    for share, radii in zip(_MISPLACED_SHARE[is_fitted], _MISPLACED_RADII[is_fitted], strict=True):
        by_speed, at_rest = _by_speed(
            X, cov + (extra + radii**2 * radius2)[..., None, None] * np.eye(2), kept, by_tilt
        )
        log_density.append(np.log(share) + by_speed)
        chi2.append(at_rest - turned * (tilt**2).sum(axis=-1))
    shares = np.full(len(_SPEEDS), (1 - _AT_REST) / (len(_SPEEDS) - 1))
    shares[0] = _AT_REST
    places = np.logaddexp.reduce(np.logaddexp.reduce(log_density, axis=0) + np.log(shares), axis=1)
    return places + _of_areas(given.area_px2, shown.area_px2, kept & given.is_whole), chi2[0]


def _by_speed(
    X: FloatArray, S: FloatArray, kept: BoolArray, by_tilt: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return logarithms of densities, (n, speeds), and the chi-square at rest, (n,).

    Parameters
    ----------
    X : ndarray, shape (n, n_leds, 2, 14), px
        By pose, profile and motion (the latter two per standard deviation), and the residual itself; zero for
        LEDs without a light.
    S : ndarray, shape (n, n_leds, 2, 2), px^2
        Of the lights.
    """
    det = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] * S[..., 1, 0]
    W = (
        np.stack([S[..., 1, 1], -S[..., 0, 1], -S[..., 1, 0], S[..., 0, 0]], axis=-1).reshape(S.shape)
        / det[..., None, None]
    )
    n, n_leds = kept.shape
    flat = X.reshape(n, 2 * n_leds, X.shape[-1])
    weighted = (W @ X).reshape(flat.shape)
    M = np.swapaxes(flat, -1, -2) @ weighted + by_tilt
    A = M[:, :7, :7] + _PRIOR
    back = np.linalg.solve(A, M[:, :7, 7:])
    left = M[:, 7:, 7:] - M[:, 7:, :7] @ back  # what pose and profile do not explain
    at_rest = left[:, 6, 6]
    size, axes = np.linalg.eigh(left[:, :6, :6])
    pull2 = np.einsum("nij,ni->nj", axes, left[:, :6, 6]) ** 2
    spread = 1 + _SPEEDS[:, None] ** 2 * np.maximum(size, 0.0)[:, None]
    explained = (_SPEEDS[:, None] ** 2 * pull2[:, None] / spread).sum(axis=-1)
    by_motion = 0.5 * (explained - np.log(spread).sum(axis=-1))
    n_kept = kept.sum(axis=1)
    of_lights = np.where(kept, np.log(det), 0.0).sum(axis=1) + np.linalg.slogdet(A)[1] + at_rest
    rest = (3 - n_kept) * np.log(2 * np.pi) - 0.5 * of_lights
    return rest[:, None] + by_motion, at_rest


def _of_areas(area_px2: FloatArray, predicted_px2: FloatArray, kept: BoolArray) -> FloatArray:
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.log(area_px2 / predicted_px2)
    known = kept & np.isfinite(ratio)
    ratio = np.where(known, ratio, 0.0)
    n = np.maximum(known.sum(axis=1), 1)
    # The median of those known, the others at infinity: a covered LED does not shift it.
    ordered = np.sort(np.where(known, ratio, np.inf), axis=1)
    rows = np.arange(len(ratio))
    common = 0.5 * (ordered[rows, (n - 1) // 2] + ordered[rows, n // 2])
    common = np.clip(np.where(known.any(axis=1), common, 0.0), -_COMMON_AREA, _COMMON_AREA)
    gain = np.where(known[..., None], _of_area(ratio - common[:, None]), 0.0).sum(axis=1)
    gain = np.logaddexp.reduce(gain, axis=1) - np.log(len(_AREA_SDS))
    return np.asarray(gain - 0.5 * (common / _COMMON_AREA_SD) ** 2)


def _of_area(log_ratio: FloatArray) -> FloatArray:
    """Return what an LED's area says by each scatter of areas, (..., scatters)."""
    own = np.exp(-0.5 * (log_ratio[..., None] / _AREA_SDS) ** 2) / (np.sqrt(2 * np.pi) * _AREA_SDS)
    return np.asarray(np.log((1 - _AREA_OTHER) * own * _LOG_AREAS + _AREA_OTHER))


def log_area_ratio(log_ratio: FloatArray) -> FloatArray:
    """Return how much likelier areas are an LED's than another light's, as logarithms.

    Parameters
    ----------
    log_ratio : ndarray
        Logarithm of the area over the predicted one, less what all LEDs of the picture have in common; NaN
        where one is not known, and in what is returned.
    """
    return np.asarray(np.log(np.exp(_of_area(log_ratio)).mean(axis=-1)))
