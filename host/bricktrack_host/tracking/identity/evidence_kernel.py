"""Compiled: the density of lights that a pose explains, over all poses near it and all motions."""

import math
from typing import NamedTuple

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_host.compiled import compiled, compiled_fast

_SPEEDS = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
"""Shares of what is not known of the motion that the brick may move at: at rest, or at any speed alike."""
_AT_REST = 0.5
_PRIOR = (0.1, 0.1, 0.1, 4e-4, 4e-4, 4e-4, 1.0)
"""Inverse variances of turn, rad, and shift, mm, about the fitted pose, both wide, and of the profile."""
_AREA_SDS = (0.03, 0.1, 0.2)
"""Of the logarithm of an LED's area over the predicted one, in one picture, alike likely: clean ones leave
0.01, glare, limb darkening and the profile more."""
_AREA_OTHER = 0.05  # share of LEDs whose area says nothing: partly covered, run together with another light
_LOG_AREAS = math.log(81.0)  # of other lights: segmentation lets pass a third to three times the radius
_COMMON_AREA_SD = 0.25  # of the logarithm of the factor that all areas share
_COMMON_AREA = 0.5  # limit of the logarithm of the factor that all areas share
_KNOWN, _UNKNOWNS, _ALL = 7, 13, 14  # pose and profile; these and the twist; these and the residual itself


class Placed(NamedTuple):
    """Lights of L LEDs under n assignments beside where poses show them.

    ``kept`` (n, L), ``residual`` (n, L, 2), ``J`` (n, L, 2, 6) by pose, ``profile`` (n, L, 2), ``dt_s``
    (n, L) and ``twist_sd`` (n, 6) are of `evidence.Given` and `evidence.Shown`, ``cov`` (n, L, 2, 2) of the
    lights with what stands beside it in every case; ``radius2`` (n, L) is the LEDs' squared radius, px^2.
    ``tilt`` (n, 3) and ``J_tilt`` (n, 3, 3) count by ``turned``.
    """

    kept: BoolArray
    residual: FloatArray
    cov: FloatArray
    J: FloatArray
    profile: FloatArray
    dt_s: FloatArray
    twist_sd: FloatArray
    radius2: FloatArray
    tilt: FloatArray
    J_tilt: FloatArray
    turned: float


@compiled
def log_places(placed: Placed, misplaced: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return logarithms of the density of lights' places, the pose's taken as one, and chi-squares at rest.

    Parameters
    ----------
    placed : Placed
    misplaced : ndarray, shape (k, 2)
        By how many radii centroids are off beside that, and the share of pictures in which they are.

    Returns
    -------
    log_density, chi2 : ndarray, shape (n,)
    """
    n, n_leds = placed.kept.shape
    X, M = np.zeros((n_leds, 2, _ALL)), np.zeros((_ALL, _ALL))
    B, by_speed = np.zeros((_ALL - _KNOWN, _ALL - _KNOWN)), np.empty(len(_SPEEDS) + 1)
    out, chi2 = np.empty(n), np.empty(n)
    for i in range(n):
        _take_rows(i, placed, X)
        total = -np.inf
        for case in range(len(misplaced)):
            at_rest = _by_speed(i, placed, misplaced[case, 0], X, M, B, by_speed)
            if case == 0:
                tilt = placed.tilt[i]
                chi2[i] = at_rest - placed.turned * (tilt[0] ** 2 + tilt[1] ** 2 + tilt[2] ** 2)
            largest = by_speed.max()
            density = _AT_REST * math.exp(by_speed[0] - largest)
            for s in range(len(_SPEEDS)):
                density += (1 - _AT_REST) / len(_SPEEDS) * math.exp(by_speed[s + 1] - largest)
            total = _log_sum(total, math.log(misplaced[case, 1]) + largest + math.log(density))
        out[i] = total
    return out, chi2


@compiled_fast
def _take_rows(i: int, placed: Placed, X: FloatArray) -> None:
    """Fill in rows, (L, 2, 14): by pose, by a deviation of profile and of twist, and the residual."""
    for k in range(placed.kept.shape[1]):
        if placed.kept[i, k]:
            for row in range(2):
                for c in range(6):
                    by = placed.J[i, k, row, c]
                    X[k, row, c] = by
                    X[k, row, _KNOWN + c] = by * placed.dt_s[i, k] * placed.twist_sd[i, c]
                X[k, row, _KNOWN - 1] = placed.profile[i, k, row]
                X[k, row, _UNKNOWNS] = placed.residual[i, k, row]


@compiled_fast
def _by_speed(
    i: int,
    placed: Placed,
    misplaced: float,
    X: FloatArray,
    M: FloatArray,
    B: FloatArray,
    by_speed: FloatArray,
) -> float:
    """Fill in logarithms of densities at rest and at each speed; return the chi-square at rest."""
    M[:] = 0.0
    log_det, n_kept = 0.0, 0
    for k in range(placed.kept.shape[1]):
        if placed.kept[i, k]:
            n_kept += 1
            more = misplaced * misplaced * placed.radius2[i, k]
            s00, s11 = placed.cov[i, k, 0, 0] + more, placed.cov[i, k, 1, 1] + more
            s01 = placed.cov[i, k, 0, 1]
            det = s00 * s11 - s01 * s01
            log_det += math.log(det)
            for c in range(_ALL):
                u, v = X[k, 0, c], X[k, 1, c]
                wu, wv = (s11 * u - s01 * v) / det, (s00 * v - s01 * u) / det
                for b in range(c + 1):
                    M[c, b] += wu * X[k, 0, b] + wv * X[k, 1, b]
    tilt, J_tilt = placed.tilt, placed.J_tilt
    for r in range(3):  # what is left of the tilt is as the residual of the lights
        for c in range(3):
            for b in range(c + 1):
                M[c, b] += placed.turned * J_tilt[i, r, c] * J_tilt[i, r, b]
            M[_UNKNOWNS, c] -= placed.turned * tilt[i, r] * J_tilt[i, r, c]
        M[_UNKNOWNS, _UNKNOWNS] += placed.turned * tilt[i, r] ** 2
    for p in range(_KNOWN):
        M[p, p] += _PRIOR[p]
    for p in range(_KNOWN):
        log_det += _eliminate(M, p)
    at_rest = M[_UNKNOWNS, _UNKNOWNS]
    by_speed[0] = (3 - n_kept) * math.log(2 * math.pi) - 0.5 * (log_det + at_rest)
    m = _UNKNOWNS - _KNOWN
    for s in range(len(_SPEEDS)):
        speed2 = _SPEEDS[s] * _SPEEDS[s]
        for c in range(m + 1):
            scale = speed2 if c < m else _SPEEDS[s]
            for b in range(c + 1):
                B[c, b] = scale * M[_KNOWN + c, _KNOWN + b]
            if c < m:
                B[c, c] += 1.0
        B[m, m] = 0.0
        log_spread = 0.0
        for p in range(m):
            log_spread += _eliminate(B, p)
        by_speed[s + 1] = by_speed[0] - 0.5 * (log_spread + B[m, m])
    return float(at_rest)


@compiled_fast
def _eliminate(A: FloatArray, p: int) -> float:
    """Take unknown ``p`` out of those behind it, in A's lower half; return the logarithm of its pivot."""
    for c in range(p + 1, len(A)):
        share = A[c, p] / A[p, p]
        for b in range(p + 1, c + 1):
            A[c, b] -= share * A[b, p]
    return math.log(A[p, p])


@compiled
def log_areas(area_px2: FloatArray, predicted_px2: FloatArray, known: BoolArray) -> FloatArray:
    """Return how much likelier areas of LEDs (n, L), those known, are than other lights' ones, (n,)."""
    n, n_leds = area_px2.shape
    out, ratio = np.empty(n), np.empty(n_leds)
    for i in range(n):
        m = 0
        for k in range(n_leds):
            value = math.log(area_px2[i, k] / predicted_px2[i, k]) if known[i, k] else np.nan
            if math.isfinite(value):
                ratio[m] = value
                m += 1
        # The median: a covered LED does not shift it.
        common = np.median(ratio[:m]) if m else 0.0
        common = min(max(common, -_COMMON_AREA), _COMMON_AREA)
        total = -np.inf
        for sd in _AREA_SDS:
            gain = 0.0
            for k in range(m):
                gain += math.log(_area_odds(ratio[k] - common, sd))
            total = _log_sum(total, gain)
        out[i] = total - math.log(len(_AREA_SDS)) - 0.5 * (common / _COMMON_AREA_SD) ** 2
    return out


@compiled
def log_area_odds(log_ratio: FloatArray) -> FloatArray:
    """Return how much likelier areas, (n,), each for itself, are an LED's than another light's."""
    out = np.empty(len(log_ratio))
    for i in range(len(log_ratio)):
        odds = 0.0
        for sd in _AREA_SDS:
            odds += _area_odds(log_ratio[i], sd)
        out[i] = math.log(odds / len(_AREA_SDS))
    return out


@compiled_fast
def _area_odds(log_ratio: float, sd: float) -> float:
    own = math.exp(-0.5 * (log_ratio / sd) ** 2) / (math.sqrt(2 * math.pi) * sd)
    return (1 - _AREA_OTHER) * own * _LOG_AREAS + _AREA_OTHER


@compiled
def _log_sum(a: float, b: float) -> float:
    """Return the logarithm of the sum of two numbers' exponentials; one may be minus infinity."""
    high, low = max(a, b), min(a, b)
    return high + math.log1p(math.exp(low - high)) if math.isfinite(high) else high
