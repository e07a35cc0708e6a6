"""From the dots of target pictures to the ray model that serves best, with what speaks for the choice.

Gross outliers are taken out and the centroids corrected for the discs' bias. Central rays are tested against
the models that have them as a special case, and models are compared by leaving out blocks of dots and
predicting them (a random choice of dots would be surrounded by others and say nothing of the rim), together
with what the covariance says of the places without dots.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np
import scipy

from bricktrack_common.camera_model import SensorMode
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dots.disc_bias import disc_bias_px, disc_diameter_mm
from bricktrack_host.calibration.rays.central_rays import CentralRays, central_rays_of
from bricktrack_host.calibration.rays.cross_validation import CrossValidatedError, ModelKind, cross_validate
from bricktrack_host.calibration.rays.dot_data import Planes, central_start, gather
from bricktrack_host.calibration.rays.gross_outliers import gross_outliers
from bricktrack_host.calibration.rays.irt import PAPER_ORDER, TwoPlaneIrt, two_plane_irt_of
from bricktrack_host.calibration.rays.pixel_polynomials import n_terms, picture_grid
from bricktrack_host.calibration.rays.ray_families import CentralFamily, RayFamily, TwoPlaneFamily
from bricktrack_host.calibration.rays.ray_fit import FREE_ORDER, RayFit, fit_rays, terms_needed
from bricktrack_host.calibration.rays.rig_tolerance import RigTolerance, RigUnknown

ModelWish = Literal["auto", "central", "walking-pupil", "two-plane"]
OrderWish = int | Literal["held", "cross-validated"]

CANDIDATE_ORDERS = (3, 5, 7, 9, 11)
"""Odd orders: a lens distorts the slopes by odd powers of the distance from its axis."""
DOTS_PER_COEFFICIENT = 3
NOT_CENTRAL_P = 1e-3
NOT_CENTRAL_GAIN: dict[ModelKind, float] = {"walking-pupil": 1.0, "two-plane": 0.9}
"""Another model is taken only where it is also expected to err less, by this factor. A walking pupil costs
one number; two free planes cost twice as many as central rays and are no guide where a plane has no dots."""
DOUBTED_TURN_RAD = 0.01
"""Turns of a plane up to about this are looked for where the rig is said to be exact."""
DOUBTED_SIGMAS = 4.0


class ModelChoice(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which model was taken, and why.

    Attributes
    ----------
    model : "central", "walking-pupil" or "two-plane"
    order : int
        Highest degree of the polynomials.
    held : bool
        High degrees are held as the data say, not free.
    reason : str
        In words, for the report.
    candidates : tuple of CrossValidatedError
    f_statistic, p_value : float or None
        Of the test of central rays against the other models, where it was made; the one that speaks most
        against central rays. For a walking pupil F is the square of the walk in its standard deviations.
    """

    model: ModelKind
    order: int
    held: bool = False
    reason: str
    candidates: tuple[CrossValidatedError, ...]
    f_statistic: float | None = None
    p_value: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FittedModel:
    """A ray model, the fit that it is of, and how well it predicts."""

    fit: RayFit
    model: CentralRays | TwoPlaneIrt
    error: CrossValidatedError


@dataclass(frozen=True, slots=True, eq=False)
class RayCalibration:
    """A fitted ray model with its evidence.

    Attributes
    ----------
    model : CentralRays or TwoPlaneIrt
    choice : ModelChoice
    planes : tuple of (float, DotObservations)
        The dots used, corrected, nearest plane first.
    n_left_out : tuple of int
        Dots of each plane that contradict their neighbourhood.
    dot_diameter_mm : float, mm
        The diameter that the correction used.
    fit : RayFit
    tolerance : RigTolerance
    doubts : tuple of RigUnknown
        Turns of planes that were taken as exact and that the pictures contradict.
    """

    model: CentralRays | TwoPlaneIrt
    choice: ModelChoice
    planes: Planes
    n_left_out: tuple[int, ...]
    dot_diameter_mm: float
    fit: RayFit
    tolerance: RigTolerance
    doubts: tuple[RigUnknown, ...]


def calibrate_rays(
    planes: Planes,
    *,
    sensor_mode: SensorMode,
    model: ModelWish = "auto",
    order: OrderWish | None = None,
    dot_diameter_mm: float | None = None,
    tolerance: RigTolerance | None = None,
    progress: Callable[[str], None] = lambda stage: None,
) -> RayCalibration:
    """Fit a ray model to the dots of two or more planes.

    Parameters
    ----------
    planes : sequence of (float, DotObservations)
        With centroids as `bricktrack_host.calibration.dots.dot_detection` measures them.
    sensor_mode : SensorMode
    model : "auto", "central", "walking-pupil" or "two-plane", optional
    order : int, "held" or "cross-validated", optional
        Of the polynomials. "held" lets the data hold high degrees; "cross-validated" takes the order that
        predicts best. By default "held", or for ``model="two-plane"`` the source paper's 5.
    dot_diameter_mm : float, optional, mm
        Measured from the pictures where not given.
    tolerance : RigTolerance, optional
        How well the planes are known; exactly by default.
    progress : callable, optional
        Told in words what is done next.

    Raises
    ------
    CalibrationError
        If the dots are too few, contradict each other, or allow no fit.
    """
    tolerance = tolerance or RigTolerance()
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
    progress("disc correction")
    # The bias is a second-order effect: any model that fits serves to find it.
    first = _fitted(cleaned, "two-plane" if model == "two-plane" else "central", "held", sensor_mode).model
    diameter = dot_diameter_mm or float(
        np.mean(
            [disc_diameter_mm(first, d.uv_px, d.area_px2 / np.square(d.size), z_mm=z) for z, d in cleaned]
        )
    )
    final = tuple(
        (z, d.moved_to(d.uv_px - disc_bias_px(first, d.xy_mm, z_mm=z, diameter_mm=diameter * d.size)))
        for z, d in cleaned
    )
    choice, chosen = choose_model(
        final, sensor_mode=sensor_mode, model=model, order=order, tolerance=tolerance, progress=progress
    )
    return RayCalibration(
        model=chosen.model,
        choice=choice,
        planes=final,
        n_left_out=tuple(n_left_out),
        dot_diameter_mm=diameter,
        fit=chosen.fit,
        tolerance=tolerance,
        doubts=() if choice.model == "two-plane" else doubted_turns(final, choice, tolerance, sensor_mode),
    )


def choose_model(
    planes: Planes,
    *,
    sensor_mode: SensorMode,
    model: ModelWish = "auto",
    order: OrderWish | None = None,
    tolerance: RigTolerance | None = None,
    progress: Callable[[str], None] = lambda stage: None,
) -> tuple[ModelChoice, FittedModel]:
    """Choose between central rays, a walking pupil and two planes, and the order.

    Parameters
    ----------
    planes : sequence of (float, DotObservations)
    sensor_mode : SensorMode
    model : "auto", "central", "walking-pupil" or "two-plane", optional
        A model given is not questioned.
    order : int, "held" or "cross-validated", optional
        As for `calibrate_rays`.
    tolerance : RigTolerance, optional
    progress : callable, optional

    Notes
    -----
    Central rays are the special case w = 0 of a walking pupil, so that under their truth w over its standard
    deviation is normal; and of two planes of the same order, so that ``F = ((S_c - S_t) / (p_t - p_c)) / (S_t
    / (2 n - p_t))`` follows the F distribution; S are sums of squares in units of the dots' scatter, p the
    numbers of parameters. Another model is taken only if the test rejects central rays *and* it is expected
    to err less over the picture: with many dots the test also sees errors far below what matters.
    """
    tolerance = tolerance or RigTolerance()
    kinds: tuple[ModelKind, ...] = ("central", "walking-pupil", "two-plane") if model == "auto" else (model,)
    if order is None:
        order = PAPER_ORDER if model == "two-plane" else "held"
    orders: tuple[OrderWish, ...] = _affordable_orders(planes) if order == "cross-validated" else (order,)
    tried: dict[ModelKind, list[FittedModel]] = {}
    for kind in kinds:
        progress(f"{kind} rays")
        tried[kind] = []
        for q in orders:
            try:
                tried[kind].append(_fitted(planes, kind, q, sensor_mode, tolerance))
            except CalibrationError:
                # What the dots do not determine is no candidate, if something else is.
                if not tried[kind] and len(tried) == 1:
                    raise
    best = {kind: min(fits, key=lambda f: f.error.expected_um) for kind, fits in tried.items() if fits}
    candidates = [f.error for fits in tried.values() for f in fits]
    if model != "auto":
        chosen = best[model]
        why = (
            "order predicts left-out dots best"
            if order == "cross-validated"
            else "high degrees held as the dots say"
            if order == "held"
            else "order as in the paper"
            if model == "two-plane" and order == PAPER_ORDER
            else "order as asked"
        )
        return _choice(chosen, f"{chosen.error.name}: model as asked, {why}", candidates), chosen
    if order == "held":
        with suppress(CalibrationError):  # for comparison only
            candidates.append(_fitted(planes, "two-plane", PAPER_ORDER, sensor_mode, tolerance).error)
    progress("test of one centre")
    central = best["central"]
    F, p = {}, {}
    if "walking-pupil" in best:
        F["walking-pupil"], p["walking-pupil"] = _walk_test(best["walking-pupil"].fit)
    if "two-plane" in best:
        F["two-plane"], p["two-plane"] = centrality_test(planes, central.error.order, sensor_mode=sensor_mode)
    others = [best[k] for k in kinds[1:] if k in best]
    if not others:
        return _choice(central, "central: the dots are too few for another model", candidates), central
    other = min(others, key=lambda f: f.error.expected_um)
    kind = other.error.model
    rejected = p[kind] < NOT_CENTRAL_P
    better = other.error.expected_um < NOT_CENTRAL_GAIN[kind] * central.error.expected_um
    chosen = other if rejected and better else central
    test = f"test of a common centre p = {p[kind]:.2g}"
    errors = (
        f"expected error {central.error.expected_um:.2f} µm central, {other.error.expected_um:.2f} µm {kind}"
    )
    if chosen is other:
        reason = f"{kind}: the rays do not meet in one point ({test}; {errors})"
    elif rejected:
        reason = f"central: {kind} does not predict better, though the {test} ({errors})"
    else:
        reason = (
            f"central: the dots do not rule out one centre ({test}, below {NOT_CENTRAL_P:g} would; {errors})"
        )
    return _choice(chosen, reason, candidates, F[kind], p[kind]), chosen


def _choice(
    chosen: FittedModel,
    reason: str,
    candidates: list[CrossValidatedError],
    f_statistic: float | None = None,
    p_value: float | None = None,
) -> ModelChoice:
    return ModelChoice(
        model=chosen.error.model,
        order=chosen.error.order,
        held=chosen.error.held,
        reason=reason,
        candidates=tuple(candidates),
        f_statistic=f_statistic,
        p_value=p_value,
    )


def _walk_test(fit: RayFit) -> tuple[float, float]:
    """Return the squared walk in its standard deviations, and its p-value."""
    F = float(fit.parameters[-1] ** 2 / fit.covariance[-1, -1])
    return F, float(2 * scipy.special.ndtr(-np.sqrt(F)))


def centrality_test(planes: Planes, order: int, *, sensor_mode: SensorMode) -> tuple[float, float]:
    """Return F and its p-value for central rays against two planes, both of free polynomials of an order.

    The order is lowered where the dots do not carry it.
    """
    fewest = min(len(dots) for _, dots in planes)
    orders = [q for q in range(1, order + 1) if q == 1 or DOTS_PER_COEFFICIENT * n_terms(q) <= fewest]
    while True:
        order = orders.pop()
        data = gather(planes, sensor_mode=sensor_mode, order=order)
        try:
            wide = fit_rays(data, TwoPlaneFamily(float(central_start(data)[1][2])), order=order)
            central = fit_rays(data, CentralFamily(), order=order)
            break
        except CalibrationError:
            if not orders:
                raise
    # In units of the wider model's scatter: both sums must be in the same.
    squares = []
    for fit in (central, wide):
        whitened = (wide.whitening @ np.concatenate(fit.residual_mm)[:, :, None]).reshape(-1)
        squares.append(float(whitened @ whitened))
    p_wide, p_central = 4 * n_terms(order), 2 * n_terms(order) + 3
    freedom = 2 * sum(len(dots) for _, dots in planes) - p_wide
    F = max(squares[0] - squares[1], 0.0) / (p_wide - p_central) / (squares[1] / freedom)
    return F, float(scipy.special.fdtrc(p_wide - p_central, freedom, F))


def doubted_turns(
    planes: Planes, choice: ModelChoice, tolerance: RigTolerance, sensor_mode: SensorMode
) -> tuple[RigUnknown, ...]:
    """Return turns of planes taken as exact that the pictures contradict, `DOUBTED_SIGMAS` from none."""
    if tolerance.turn_rad > 0:
        return ()
    loose = RigTolerance(tolerance.shift_mm, DOUBTED_TURN_RAD, tolerance.bend_mm)
    order: OrderWish = "held" if choice.held else choice.order
    fit = _fitted(planes, choice.model, order, sensor_mode, loose).fit
    return tuple(
        u for u in fit.rig if u.unit == "rad" and u.is_observed and abs(u.value) > DOUBTED_SIGMAS * u.sd
    )


def _fitted(
    planes: Planes,
    kind: ModelKind,
    order: OrderWish,
    mode: SensorMode,
    tolerance: RigTolerance | None = None,
) -> FittedModel:
    """Fit one model of one order and see how well it predicts."""
    free = order if isinstance(order, int) else None
    fewest = min(len(dots) for _, dots in planes)
    needed = DOTS_PER_COEFFICIENT * n_terms(FREE_ORDER)
    if free is None and fewest < needed:
        raise CalibrationError(
            f"a plane has only {fewest} dots; held degrees need {needed}; take a target with more dots, "
            "bring it nearer to filling the picture, or ask for a low order"
        )
    data = gather(planes, sensor_mode=mode, order=terms_needed(free, fewest))
    family: RayFamily = (
        TwoPlaneFamily(float(central_start(data)[1][2]))
        if kind == "two-plane"
        else CentralFamily(walks=kind == "walking-pupil")
    )
    fit = fit_rays(data, family, order=free, tolerance=tolerance)
    rays = two_plane_irt_of if kind == "two-plane" else central_rays_of
    model = rays(fit, planes, sensor_mode=mode)
    error = cross_validate(fit, model, planes, kind=kind, held=free is None, picture=picture_grid(mode))
    return FittedModel(fit, model, error)


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
