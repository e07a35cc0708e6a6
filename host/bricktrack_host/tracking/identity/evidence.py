"""How much likelier an assignment of lights to LEDs is than lights that fell anywhere.

Residuals: a light that is its LED lies within its own uncertainty of where the fitted pose shows it, in a
brick at rest; what rolling shutter leaves of a moving one is larger, and known by its scatter alone, which is
the same for all its LEDs. A light that is not lies anywhere in the picture. Any three lights can be fitted,
so only what is beyond three LEDs is evidence. Sizes: LEDs of one picture show areas in the ratios that the
pose predicts, but for a factor of exposure and threshold that is common to all; other lights are of any size.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray, rows_of, with_rows
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.refine import OWN_SHARE

_FLOOR_PX = 0.05  # calibration and rendering leave this at least
_CUT_SD_RADII = 0.3  # what is left of an LED that a border or a card cuts has its centroid elsewhere
_AT_REST, _AT_REST_UNFITTED = 0.5, 0.3
"""Share of pictures whose residuals are the centroids' own: of a brick at rest, its LEDs' profile known."""
_LOG_SCALES = np.log(100.0)  # others have residuals up to so many times as large, any factor as likely
_AREA_SD = 0.2  # of the logarithm of an LED's area over the predicted one: glare, limb darkening, the profile
_AREA_OTHER = 0.1  # share of LEDs whose area says nothing: partly covered, run together with another light
_LOG_AREAS = np.log(81.0)  # of other lights: what segmentation lets pass is a third to three times the radius
_SCATTERED = 2.0  # chi-square of so many times its freedom: one in ten at four, one in fifteen at six
_COMMON_AREA = 0.5  # limit of the logarithm of the factor that all areas share


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What speaks for assignments.

    Attributes
    ----------
    log_ratio : ndarray, shape (n,)
        Logarithm of the likelihood over that of lights that fell anywhere.
    is_scattered : ndarray of bool, shape (n,)
        The residuals are larger than the centroids' own uncertainty leaves them.
    """

    log_ratio: FloatArray
    is_scattered: BoolArray

    def take(self, rows: IntArray) -> "Evidence":
        """Return that of some assignments."""
        return rows_of(self, rows)

    def replaced(self, rows: IntArray, by: "Evidence") -> "Evidence":
        """Return this with that of some assignments replaced."""
        return with_rows(self, rows, by)


def evidence_of(
    residual_px: FloatArray,
    cov_px2: FloatArray,
    is_whole: BoolArray,
    kept: BoolArray,
    area_px2: FloatArray,
    predicted_px2: FloatArray,
    facing: FloatArray,
    *,
    shift_sd_per_radius: float | None,
    n_pixels: int,
    min_leds: int,
) -> Evidence:
    """Return what speaks for n assignments of lights to LEDs.

    Parameters
    ----------
    residual_px : ndarray, shape (n, n_leds, 2), px
    cov_px2 : ndarray, shape (n, n_leds, 2, 2), px^2
        Of the lights' centroids.
    is_whole : ndarray of bool, shape (n, n_leds)
        False: a light that is cut, or two in one.
    kept : ndarray of bool, shape (n, n_leds)
        LEDs that the assignment gives a light; what the other arrays hold elsewhere does not matter.
    area_px2, predicted_px2, facing : ndarray, shape (n, n_leds)
        Areas seen and predicted; cosine between an LED's axis and the line of sight.
    shift_sd_per_radius : float or None
        What the fitted profile leaves unknown, see `led_profile.shift_per_radius`; `None`: none was fitted.
    n_pixels : int
        Of the picture.
    min_leds : int
        Assignments of fewer LEDs, or without a pose (residuals NaN), have minus infinity.
    """
    n_leds = kept.sum(axis=1)
    freedom = np.maximum(2.0 * n_leds - 6, 1.0)
    sine2 = 1 - np.clip(np.nan_to_num(facing), 0, 1) ** 2
    radius2 = np.nan_to_num(predicted_px2) / np.pi
    variance = 0.5 * np.trace(cov_px2, axis1=-2, axis2=-1) + _FLOOR_PX**2
    if shift_sd_per_radius is not None:
        variance = variance + (OWN_SHARE * shift_sd_per_radius) ** 2 * radius2 * sine2
    variance = np.where(kept, np.where(is_whole, variance, variance + _CUT_SD_RADII**2 * radius2), 1.0)
    squares = (np.where(kept[..., None], residual_px, 0.0) ** 2).sum(axis=-1) / variance
    squares = np.where(kept, np.nan_to_num(squares), 0.0).sum(axis=1)
    mean_log = np.where(kept, np.log(variance), 0.0).sum(axis=1) / np.maximum(n_leds, 1)
    scale2 = np.maximum(squares, freedom)  # below that many the scale is one, the brick at rest
    # Integral over the logarithm of the scale s of s^-freedom exp(-squares / 2 s^2).
    moving = gammaln(0.5 * freedom) - 0.5 * freedom * np.log(0.5 * scale2) - np.log(2 * _LOG_SCALES)
    at_rest = _AT_REST_UNFITTED if shift_sd_per_radius is None else _AT_REST
    still = np.log(at_rest) - 0.5 * squares
    places = 0.5 * freedom * (np.log(n_pixels / (2 * np.pi)) - mean_log)
    places = places + np.logaddexp(still, np.log(1 - at_rest) + moving)
    evidence = places + _of_areas(area_px2, predicted_px2, kept & is_whole)
    possible = (n_leds >= min_leds) & (all_finite(residual_px) | ~kept).all(axis=1)
    return Evidence(np.where(possible, evidence, -np.inf), squares > _SCATTERED * freedom)


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
    gain = log_area_ratio(ratio - common[:, None])
    return np.asarray(np.where(known, gain, 0.0).sum(axis=1))


def log_area_ratio(log_ratio: FloatArray) -> FloatArray:
    """Return how much likelier areas are an LED's than another light's, as logarithms.

    Parameters
    ----------
    log_ratio : ndarray
        Logarithm of the area over the predicted one, less what all LEDs of the picture have in common.
    """
    own = (1 - _AREA_OTHER) * np.exp(-0.5 * (log_ratio / _AREA_SD) ** 2) / (np.sqrt(2 * np.pi) * _AREA_SD)
    return np.asarray(np.log((own + _AREA_OTHER / _LOG_AREAS) * _LOG_AREAS))
