"""From the dots of target pictures to the ray model that serves best, with what speaks for the choice.

Gross outliers are taken out and the centroids corrected for the discs' bias. The order is found by leaving
out blocks of dots and predicting them (a random choice of dots would be surrounded by others and say nothing
of the rim), together with what the dots' scatter makes of the places without dots. Central rays are tested
against the models that have them as a special case.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np
from scipy.stats import f as f_distribution

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.camera_model import SensorMode
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration import central_rays, irt, walking_pupil
from bricktrack_host.calibration.central_rays import CentralRays, fit_central_rays
from bricktrack_host.calibration.disc_bias import disc_bias_px, disc_diameter_mm
from bricktrack_host.calibration.dot_observations import DotObservations
from bricktrack_host.calibration.irt import PAPER_ORDER, TwoPlaneIrt, fit_two_plane_irt
from bricktrack_host.calibration.neighbours import median_spacing
from bricktrack_host.calibration.pixel_polynomials import (
    PixelScaling,
    least_squares,
    monomials,
    n_terms,
    picture_grid,
)
from bricktrack_host.calibration.walking_pupil import fit_walking_pupil

ModelKind = Literal["central", "walking-pupil", "two-plane"]
ModelWish = Literal["auto", "central", "walking-pupil", "two-plane"]
Planes = Sequence[tuple[float, DotObservations]]
"""Depth z, mm, and the dots seen there."""

CANDIDATE_ORDERS = (3, 5, 7, 9, 11)
"""Odd orders: a lens distorts the slopes by odd powers of the distance from its axis."""
DOTS_PER_COEFFICIENT = 3
N_FOLDS = 8
BLOCK_STEPS = 2.0
"""Side of the blocks left out, in dot spacings: what lies between the last whole dots and the border."""
OUTLIER_SIGMAS = 6.0
OUTLIER_STEPS = 0.01
"""No dot is gross that errs by less than this share of the pitch (40 um of 4 mm: a printer's error)."""
MAX_OUTLIER_SHARE = 0.05
"""Past this share the dots are not a few smears: the grid is misread or the board is bent."""
NOT_CENTRAL_P = 1e-3
NOT_CENTRAL_GAIN: dict[ModelKind, float] = {"walking-pupil": 1.0, "two-plane": 0.9}
"""Another model is taken only where it is also expected to err less, by this factor. A walking pupil costs
one number; two free planes cost twice as many as central rays and are no guide where a plane has no dots."""


class CrossValidatedError(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How well a model predicts dots that it was not fitted to.

    Attributes
    ----------
    model : "central", "walking-pupil" or "two-plane"
    order : int
    rms_um : float, um
        Over the left-out dots of all planes, each as seen by the fit without its block.
    max_um : float, um
    picture_noise_um : float, um
        What the dots' scatter makes of the fit over the whole picture, on all planes, root mean square. It
        grows fast where there are no dots and the order is high.
    """

    model: ModelKind
    order: int
    rms_um: float
    max_um: float
    picture_noise_um: float

    @property
    def expected_um(self) -> float:
        """Error to expect over the whole picture, among dots and beyond; orders are chosen by it."""
        return float(np.hypot(self.rms_um, self.picture_noise_um))


class ModelChoice(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which model was taken, and why.

    Attributes
    ----------
    model : "central", "walking-pupil" or "two-plane"
    order : int
    reason : str
        In words, for the report.
    candidates : tuple of CrossValidatedError
    f_statistic, p_value : float or None
        Of the test of central rays against two planes of the same order, where it was made.
    """

    model: ModelKind
    order: int
    reason: str
    candidates: tuple[CrossValidatedError, ...]
    f_statistic: float | None = None
    p_value: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RayCalibration:
    """A fitted ray model with its evidence.

    Attributes
    ----------
    model : CentralRays or TwoPlaneIrt
    choice : ModelChoice
    planes : tuple of (float, DotObservations)
        The dots used, corrected.
    n_left_out : tuple of int
        Dots of each plane that contradict their neighbourhood.
    dot_diameter_mm : float, mm
        The diameter that the correction used.
    """

    model: CentralRays | TwoPlaneIrt
    choice: ModelChoice
    planes: tuple[tuple[float, DotObservations], ...]
    n_left_out: tuple[int, ...]
    dot_diameter_mm: float


def calibrate_rays(
    planes: Planes,
    *,
    sensor_mode: SensorMode,
    model: ModelWish = "auto",
    order: int | None = None,
    dot_diameter_mm: float | None = None,
) -> RayCalibration:
    """Fit a ray model to the dots of two planes (central rays: two or more).

    Parameters
    ----------
    planes : sequence of (float, DotObservations)
        With centroids as `bricktrack_host.calibration.dot_detection` measures them.
    sensor_mode : SensorMode
    model : "auto", "central", "walking-pupil" or "two-plane", optional
    order : int, optional
        Of the polynomials; cross-validated where not given.
    dot_diameter_mm : float, optional, mm
        Measured from the pictures where not given.

    Raises
    ------
    CalibrationError
        If the dots are too few, contradict each other, or allow no fit.
    """
    planes = tuple(sorted(planes, key=lambda p: p[0]))
    if len(planes) < 2 or not 0 < planes[0][0] < planes[-1][0]:
        raise CalibrationError(
            f"planes at z = {[z for z, _ in planes]} mm: expected two or more different depths over 0"
        )
    cleaned, n_left_out = [], []
    for k, (z_mm, dots) in enumerate(planes):
        keep = ~gross_outliers(dots, sensor_mode=sensor_mode, what=f"plane {k + 1} at z = {z_mm:g} mm")
        cleaned.append((z_mm, dots.select(keep)))
        n_left_out.append(int(np.count_nonzero(~keep)))
    # The bias is a second-order effect: any model that fits serves to find it.
    first = _fit(cleaned, "two-plane" if model == "two-plane" else "central", 5, sensor_mode)
    diameter = dot_diameter_mm or float(
        np.mean([disc_diameter_mm(first, d.uv_px, d.area_px2, z_mm=z) for z, d in cleaned])
    )

    def corrected(by: CentralRays | TwoPlaneIrt) -> Planes:
        return tuple(
            (z, d.moved_to(d.uv_px - disc_bias_px(by, d.xy_mm, z_mm=z, diameter_mm=diameter)))
            for z, d in cleaned
        )

    choice = choose_model(corrected(first), sensor_mode=sensor_mode, model=model, order=order)
    final = corrected(_fit(corrected(first), choice.model, choice.order, sensor_mode))
    return RayCalibration(
        model=_fit(final, choice.model, choice.order, sensor_mode),
        choice=choice,
        planes=tuple(final),
        n_left_out=tuple(n_left_out),
        dot_diameter_mm=diameter,
    )


def gross_outliers(dots: DotObservations, *, sensor_mode: SensorMode, what: str) -> BoolArray:
    """Return which dots contradict the others of their plane: smeared, dirty, or not of the grid.

    A polynomial as flexible as the dots allow is fitted to the plane; residuals count by what each dot
    would show had it been left out.
    """
    order = max(q for q in (2, 3, 5, 7) if q == 2 or 4 * n_terms(q) <= len(dots))
    design = monomials(PixelScaling.of_mode(sensor_mode).scaled(dots.uv_px), order).T
    step_mm = median_spacing(dots.xy_mm)
    out = np.zeros(len(dots), dtype=np.bool_)
    for _ in range(10):
        c, inverse_normal = least_squares(design[~out], dots.xy_mm[~out], what=what)
        leverage = np.einsum("ni,ij,nj->n", design, inverse_normal, design, optimize=True)
        distance = np.hypot(*(design @ c - dots.xy_mm).T)
        distance = np.where(out, distance, distance / np.maximum(1 - leverage, 1e-3))
        # The distance of two equal normal errors has its median at 1.177 sigma.
        sigma = float(np.median(distance[~out])) / 1.1774
        now_out = distance > max(OUTLIER_SIGMAS * sigma, OUTLIER_STEPS * step_mm)
        if np.array_equal(now_out, out):
            break
        # The worst first: a single wrong dot at the rim bends the fit for its neighbours.
        worst = float(distance[~out].max())
        out = now_out & (out | (distance >= 0.5 * worst))
    n_out = int(np.count_nonzero(out))
    if n_out > max(2.0, MAX_OUTLIER_SHARE * len(dots)):
        raise CalibrationError(
            f"{what}: {n_out} of {len(dots)} dots lie more than {OUTLIER_SIGMAS:g} standard deviations off a "
            f"smooth map (order {order}); is the board flat and its grid read rightly?"
        )
    return out


def choose_model(
    planes: Planes,
    *,
    sensor_mode: SensorMode,
    model: ModelWish = "auto",
    order: int | None = None,
) -> ModelChoice:
    """Choose between central rays, a walking pupil and two planes, and the order.

    Parameters
    ----------
    planes : sequence of (float, DotObservations)
    sensor_mode : SensorMode
    model : "auto", "central", "walking-pupil" or "two-plane", optional
        A model given is not questioned.
    order : int, optional
        An order given is not questioned.

    Notes
    -----
    With ``model="two-plane"`` and no order, the source paper's order 5 is taken. For "auto", central rays of
    order q are the special case of either other model of order q, so that under their truth
    ``F = ((S_c - S_t) / (p_t - p_c)) / (S_t / (2 n - p_t))`` follows the F distribution; S are sums of
    squares, each plane in units of its own scatter, p the numbers of parameters. Another model is taken only
    if the test rejects central rays *and* it is expected to err less over the picture: with many dots the
    test also sees errors far below what matters.
    """
    kinds: tuple[ModelKind, ...] = ("central", "walking-pupil", "two-plane") if model == "auto" else (model,)
    if len(planes) > 2:
        if model not in ("auto", "central"):
            raise CalibrationError(f"{len(planes)} planes given; the {model} model takes two")
        kinds = ("central",)
    orders = (order,) if order is not None else _affordable_orders(planes)
    candidates: list[CrossValidatedError] = []
    for kind in kinds:
        if kind == "walking-pupil" and model == "auto":
            # The costliest fit, and near to the central one: the orders next to that one's best suffice.
            best_central = min(candidates, key=lambda c: c.expected_um).order
            candidates += [
                cross_validate(planes, kind, q, sensor_mode=sensor_mode)
                for q in orders
                if abs(q - best_central) <= 2
            ]
            continue
        only_paper = model == "two-plane" and order is None and PAPER_ORDER in orders
        for q in (PAPER_ORDER,) if only_paper else orders:
            candidates.append(cross_validate(planes, kind, q, sensor_mode=sensor_mode))
    best = {
        kind: min((c for c in candidates if c.model == kind), key=lambda c: c.expected_um) for kind in kinds
    }
    if len(kinds) == 1:
        chosen = best[kinds[0]]
        why = f"{chosen.model} as asked" if model != "auto" else "central: more than two planes"
        return ModelChoice(
            model=chosen.model,
            order=chosen.order,
            reason=f"{why}; order {chosen.order} "
            + (
                "as asked"
                if order is not None
                else "as in the paper"
                if model == "two-plane"
                else "is expected to err least"
            ),
            candidates=tuple(candidates),
        )
    central = best["central"]
    other = min((best[kind] for kind in kinds if kind != "central"), key=lambda c: c.expected_um)
    F, p = centrality_test(planes, max(central.order, other.order), other.model, sensor_mode=sensor_mode)
    rejected = p < NOT_CENTRAL_P
    better = other.expected_um < NOT_CENTRAL_GAIN[other.model] * central.expected_um
    chosen = other if rejected and better else central
    test = f"F test of a common centre p = {p:.2g}"
    errors = f"expected error {central.expected_um:.2f} um central, {other.expected_um:.2f} um {other.model}"
    if chosen is other:
        reason = f"{other.model}: the rays do not meet in one point ({test}; {errors})"
    elif rejected:
        reason = f"central: {other.model} does not predict better, though the {test} ({errors})"
    else:
        reason = f"central: nothing speaks against one centre ({test}; {errors})"
    return ModelChoice(
        model=chosen.model,
        order=chosen.order,
        reason=reason,
        candidates=tuple(candidates),
        f_statistic=F,
        p_value=p,
    )


def centrality_test(
    planes: Planes, order: int, against: ModelKind = "two-plane", *, sensor_mode: SensorMode
) -> tuple[float, float]:
    """Return F and its p-value for central rays against a model that has them as a special case."""
    central = fit_central_rays(planes, sensor_mode=sensor_mode, order=order)
    wider = _fit(planes, against, order, sensor_mode)
    m = n_terms(order)
    p_wider, p_central = 4 * m if against == "two-plane" else 2 * m + 4, 2 * m + 3
    ratio, freedom = 0.0, 0.0
    for c, t in zip(central.residuals, wider.residuals, strict=True):
        own_freedom = max(2 * t.n_dots - p_wider / 2, 1.0)
        scatter = t.n_dots * t.rms_um**2 / own_freedom
        ratio += c.n_dots * (c.rms_um**2 - t.rms_um**2) / max(scatter, 1e-12)
        freedom += own_freedom
    F = max(ratio, 0.0) / (p_wider - p_central)
    return F, float(f_distribution.sf(F, p_wider - p_central, freedom))


def cross_validate(
    planes: Planes, kind: ModelKind, order: int, *, sensor_mode: SensorMode
) -> CrossValidatedError:
    """Return how well a model of this order predicts blocks of dots left out of its fit.

    The blocks are squares of the picture, common to all planes: what one plane loses is not handed over by
    another.
    """
    spacing_px = median_spacing(planes[0][1].uv_px)
    folds = [_folds(dots.uv_px, spacing_px) for _, dots in planes]
    if kind == "central":
        errors = central_rays.left_out_errors_mm(planes, folds, sensor_mode=sensor_mode, order=order)
    elif kind == "walking-pupil":
        errors = walking_pupil.left_out_errors_mm(
            (planes[0], planes[1]), (folds[0], folds[1]), sensor_mode=sensor_mode, order=order
        )
    else:
        errors = [
            irt.left_out_errors_mm(dots, fold, sensor_mode=sensor_mode, order=order)
            for (_, dots), fold in zip(planes, folds, strict=True)
        ]
    distance_um = 1e3 * np.hypot(*np.concatenate(errors).T)
    fitted = _fit(planes, kind, order, sensor_mode)
    everywhere = picture_grid(sensor_mode)
    # Of x and of y, hence the 2.
    variance = [2 * np.mean(fitted.point_sd_mm(everywhere, z) ** 2) for z, _ in planes]
    return CrossValidatedError(
        model=kind,
        order=order,
        rms_um=float(np.sqrt(np.mean(distance_um**2))),
        max_um=float(distance_um.max()),
        picture_noise_um=float(1e3 * np.sqrt(np.mean(variance))),
    )


def _fit(planes: Planes, kind: ModelKind, order: int, mode: SensorMode) -> CentralRays | TwoPlaneIrt:
    if kind == "central":
        return fit_central_rays(planes, sensor_mode=mode, order=order)
    if len(planes) != 2:
        raise CalibrationError(f"{len(planes)} planes given; the {kind} model takes two")
    (a_mm, dots_a), (b_mm, dots_b) = planes
    if kind == "walking-pupil":
        return fit_walking_pupil(dots_a, dots_b, a_mm=a_mm, b_mm=b_mm, sensor_mode=mode, order=order)
    return fit_two_plane_irt(dots_a, dots_b, a_mm=a_mm, b_mm=b_mm, sensor_mode=mode, order=order)


def _affordable_orders(planes: Planes) -> tuple[int, ...]:
    """Return the candidate orders that the plane with fewest dots can carry."""
    fewest = min(len(dots) for _, dots in planes)
    orders = tuple(q for q in CANDIDATE_ORDERS if DOTS_PER_COEFFICIENT * n_terms(q) <= fewest)
    if not orders:
        needed = DOTS_PER_COEFFICIENT * n_terms(CANDIDATE_ORDERS[0])
        raise CalibrationError(
            f"a plane has only {fewest} dots; the lowest order needs {needed}; "
            "take a target with more dots or bring it nearer to filling the picture"
        )
    return orders


def _folds(uv_px: FloatArray, spacing_px: float) -> IntArray:
    """Return the fold of each pixel, shape (n,): blocks of the picture, neighbours in different folds."""
    block = np.floor(uv_px / (BLOCK_STEPS * spacing_px)).astype(np.int64)
    return np.asarray((block[:, 0] + 3 * block[:, 1]) % N_FOLDS, dtype=np.int64)
