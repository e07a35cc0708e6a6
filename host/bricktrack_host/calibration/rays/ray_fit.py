"""Fit a family of rays to dots: high degrees held back as the data say, and what the dots leave unknown.

A polynomial that is too stiff cannot follow the lens; one that is too free swings where dots are few. Here
the coefficients of each degree above a few are expected to be normal about zero with a variance of their own,
found from the dots themselves (empirical Bayes; D. MacKay, Neural Computation 4, 1992: gamma updates). So no
order is chosen, and the posterior covariance says what the dots left open, smooth misfit included. Of a
polynomial of a given order, as the source paper's, the degrees beyond it are estimated in the same way, and
what leaving them out does to the rays enters its covariance.

Dots weigh by their covariances in the picture. What a plane's dots scatter beyond them (print, light) is
found as a variance to be added, or, where they scatter less, as a factor.
"""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.rays.dot_data import DotData, central_start
from bricktrack_host.calibration.rays.pixel_polynomials import UNDETERMINED, n_terms
from bricktrack_host.calibration.rays.ray_families import (
    ALWAYS_FREE,
    NON_CENTRAL,
    CentralFamily,
    RayFamily,
    TwoPlaneFamily,
)
from bricktrack_host.calibration.rays.rig_tolerance import RigTolerance, RigUnknown, RigUnknowns

FREE_ORDER = 3
"""Degrees up to this are never held: scale, aspect and the main distortion."""
HELD_ORDERS = (11, 9, 7, 5)
"""Highest degree of held polynomials: the first for which every plane has a dot for each term."""
MISFIT_DEGREES = 4
"""Degrees beyond a given order whose absence is accounted for."""
FIRST_HELD = 0.01
"""Standard deviation of held slope coefficients before the data are asked: strong distortion has 0.002."""
LEAST_HELD = 1e-8
LEAST_SCALE = 0.1
"""Of stated covariances: a plane that scatters less than a third of what was stated weighs no more for it."""
TRIM_MM = 1e-4
"""Degrees whose terms reach less than this over the picture are left out: 0.1 um."""
MAX_STEPS = 60
CONVERGED = 3e-3
"""Largest last step of any dot, in its standard deviations."""


@dataclass(frozen=True, slots=True)
class PlaneNoise:
    """How a plane's dots scatter: ``scale`` times their covariances plus ``added_px`` squared.

    Attributes
    ----------
    added_px : float, px
    scale : float
        1 or less, `LEAST_SCALE` at least.
    """

    added_px: float = 0.0
    scale: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class RayFit:
    """What a fit found.

    Attributes
    ----------
    family : RayFamily
    order : int
        Highest degree of the rays' polynomials.
    parameters : ndarray, shape (p,)
        Of ``family``, for polynomials of ``covariance_order``; 0 beyond ``order``.
    covariance_order : int
    covariance : ndarray, shape (p, p)
        Of the parameters, with noise, held degrees and those left out.
    residual_mm : tuple of ndarray, shape (n, 2), mm
        Fit less truth at each plane's dots, at their depth, nearest plane first.
    noise : tuple of PlaneNoise
    rig : tuple of RigUnknown
    whitened_rows, whitened_residual : ndarray, shapes (2 n, k) and (2 n,)
        Of the parameters fitted, to leave dots out.
    fitted_covariance : ndarray, shape (k, k)
    whitening : ndarray, shape (n, 2, 2), 1/mm
    """

    family: RayFamily
    order: int
    parameters: FloatArray
    covariance_order: int
    covariance: FloatArray
    residual_mm: tuple[FloatArray, ...]
    noise: tuple[PlaneNoise, ...]
    rig: tuple[RigUnknown, ...]
    whitened_rows: FloatArray
    whitened_residual: FloatArray
    fitted_covariance: FloatArray
    whitening: FloatArray


def terms_needed(order: int | None, n_dots: int) -> int:
    """Return the order of the terms that a fit of ``order`` (None: held) to planes of n_dots works with."""
    if order is not None:
        return order + MISFIT_DEGREES
    return next((q for q in HELD_ORDERS if n_terms(q) <= n_dots), FREE_ORDER + 1)


def fit_rays(
    data: DotData, family: RayFamily, *, order: int | None = None, tolerance: RigTolerance | None = None
) -> RayFit:
    """Fit a family's parameters to dots.

    Parameters
    ----------
    data : DotData
        With terms of `terms_needed`; with terms of ``order`` alone, misfit is not looked for.
    family : RayFamily
    order : int, optional
        Of plain polynomials; by default degrees above `FREE_ORDER` are held as the data say.
    tolerance : RigTolerance, optional
        How well the planes are known; exactly by default.

    Raises
    ------
    CalibrationError
        If the dots are too few or leave coefficients undetermined, or the fit does not converge.
    """
    _check_counts(data, family, FREE_ORDER if order is None else order)
    fitter = _Fitter(data, family, order, tolerance or RigTolerance())
    fitter.solve()
    if order is None and fitter.trim():
        fitter.solve()
    return fitter.result()


def _what(family: RayFamily, order: int | None) -> str:
    return family.name if order is None else f"{family.name}, order {order}"


def _check_counts(data: DotData, family: RayFamily, order: int) -> None:
    """Refuse dots fewer than coefficients: on a plane for two planes, in all otherwise."""
    needed = n_terms(order)
    if isinstance(family, TwoPlaneFamily):
        counts, where = np.sort(data.counts())[-2:], "plane with "
    else:
        counts, where = np.array([len(data.plane)]), ""
        needed += 1
    if counts.min() < needed:
        raise CalibrationError(
            f"{_what(family, order)}: {where}{counts.min()} dots for {needed} coefficients; take a lower "
            "order or more dots"
        )


class _Fitter:
    """State of one fit: parameters, unknowns of the rig, variances of held degrees, noise of planes."""

    def __init__(self, data: DotData, family: RayFamily, order: int | None, tolerance: RigTolerance) -> None:
        self.data, self.family, self.order = data, family, order
        self.free_order = FREE_ORDER if order is None else order
        self.unknowns = RigUnknowns(tolerance, data.plane, data.z_mm, data.xy_mm)
        self.rig = np.zeros(len(self.unknowns))
        self.noise = [PlaneNoise() for _ in data.z_mm]
        self.theta = family.start(*central_start(data))
        self._set_groups()
        self.variance = {g: self._unit(g) ** 2 * FIRST_HELD**2 for g in self.held}

    def _unit(self, group: int) -> float:
        """N is in millimetres where slopes have none."""
        return float(self.data.z_mm[0]) if group >= NON_CENTRAL else 1.0

    def _set_groups(self) -> None:
        degrees = self.family.degrees(self.data.order)
        own = np.where(degrees == ALWAYS_FREE, -1, degrees % NON_CENTRAL)
        self.held = {int(g): np.flatnonzero(degrees == g) for g in np.unique(degrees[own > self.free_order])}
        self.is_free = own <= self.free_order
        self.n_rays = len(degrees)

    def _precision(self) -> FloatArray:
        """Return the prior's diagonal, of the rays' parameters and then the rig's unknowns."""
        precision = np.zeros(self.n_rays + len(self.unknowns))
        for group, own in self.held.items():
            precision[own] = 1 / self.variance[group]
        precision[self.n_rays :] = 1 / self.unknowns.prior_sd**2
        return precision

    def linearised(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return whitened rows, shape (2 n, k), whitened residuals (truth less fit), and residuals in mm."""
        places, by = self.unknowns.places(self.rig)
        rays = self.family.points(self.theta, self.data.V, places[:, 2])
        residual = places[:, :2] - rays.xy_mm
        of_rig = by[:, :2] - rays.slopes[:, :, None] * by[:, 2:3]
        rows = np.concatenate([rays.D, -of_rig], axis=2)
        L = self.whitening()
        return (
            (L @ rows).reshape(-1, rows.shape[2]),
            np.einsum("nij,nj->ni", L, residual).reshape(-1),
            residual,
        )

    def whitening(self) -> FloatArray:
        """Return what makes each dot's residual in mm unit normal, shape (n, 2, 2)."""
        scale = np.array([p.scale for p in self.noise])[self.data.plane, None, None]
        added = np.array([p.added_px for p in self.noise])[self.data.plane, None, None]
        G = self.data.mm_per_px
        cov = G @ (scale * self.data.cov_px2 + added**2 * np.eye(2)) @ np.swapaxes(G, 1, 2)
        return np.asarray(np.linalg.inv(np.linalg.cholesky(cov)))

    def solve(self) -> None:
        """Iterate parameters, noise and variances until the dots stand still."""
        for step in range(MAX_STEPS):
            A, y, _ = self.linearised()
            ends = 2 * np.cumsum(self.data.counts())[:-1]
            by_plane = [part.T @ part for part in np.split(A, ends)]
            normal = np.sum(by_plane, axis=0)
            if step == 0:
                self._check_determined(normal)
            now = np.concatenate([self.theta, self.rig])
            values, gradient = now, A.T @ y
            # The variances need more rounds than the rays; these cost no pass over the dots.
            for _ in range(1 if step < 2 else 3):
                precision = self._precision()
                S = _inverse(normal + np.diag(precision))
                # In steps: solved at one go, rounding in the large terms swamps those that the prior holds.
                for _ in range(2):
                    values = values + S @ (gradient - normal @ (values - now) - precision * values)
                if step >= 2:
                    self._update_variances(values, S)
            self._take(values)
            moved = A @ (values - now)
            self._update_noise((y - moved).reshape(-1, 2), [float(np.sum(S * N)) for N in by_plane])
            if step >= 6 and np.abs(moved).max() < CONVERGED:
                return
        raise CalibrationError(
            f"{_what(self.family, self.order)}: the fit does not converge; do depths, pitch and origins of "
            "the planes belong together?"
        )

    def _take(self, values: FloatArray) -> None:
        self.theta, self.rig = values[: self.n_rays], values[self.n_rays :]
        if isinstance(self.family, CentralFamily):
            z0 = float(self.theta[-2 if self.family.walks else -1])
            if not -10 * self.data.z_mm[-1] < z0 < self.data.z_mm[0]:
                raise CalibrationError(
                    f"{_what(self.family, self.order)}: the depth of the projection centre is not found "
                    f"(last {z0:g} mm); the planes are too close together or their depths, pitch or origins "
                    "do not belong together"
                )

    def _update_variances(self, values: FloatArray, S: FloatArray) -> None:
        for group, own in self.held.items():
            determined = len(own) - float(np.trace(S[np.ix_(own, own)])) / self.variance[group]
            size = float(values[own] @ values[own]) / max(determined, 1e-3)
            self.variance[group] = max(size, (LEAST_HELD * self._unit(group)) ** 2)

    def _update_noise(self, whitened: FloatArray, spent: list[float]) -> None:
        """Find each plane's scatter such that its squares sum to what the fit has not spent."""
        L = self.whitening()
        mm = np.linalg.solve(L, whitened[:, :, None])
        px = np.linalg.solve(self.data.mm_per_px, mm)[:, :, 0]
        for k in range(len(self.noise)):
            own = self.data.plane == k
            freedom = max(2 * np.count_nonzero(own) - spent[k], 1.0)
            self.noise[k] = _scatter(px[own], self.data.cov_px2[own], freedom)

    def _check_determined(self, normal: FloatArray) -> None:
        free = normal[np.ix_(*2 * [np.flatnonzero(self.is_free)])]
        size = np.sqrt(np.diag(free))
        if size.min() > 0:
            least, *_, most = np.linalg.eigvalsh(free / np.outer(size, size))
            if least > UNDETERMINED**2 * most:
                return
        raise CalibrationError(
            f"{_what(self.family, self.order)}: the dots leave some of the {len(free)} coefficients "
            "undetermined (they lie on too few lines); take a lower order or dots spread over the picture"
        )

    def trim(self) -> bool:
        """Leave out the highest degrees that reach nothing; tell whether there were any."""
        depth = float(self.data.z_mm[-1])
        order = self.data.order
        while order > FREE_ORDER + 1:
            i = np.arange(order + 1)
            mean_square = float(np.sum(1 / ((2 * i + 1) * (2 * (order - i) + 1))))
            reach = max(
                np.sqrt(self.variance[g] * mean_square) * (1.0 if g >= NON_CENTRAL else depth)
                for g in (order, order + NON_CENTRAL)
                if g in self.variance
            )
            if reach > TRIM_MM:
                break
            order -= 1
        if order == self.data.order:
            return False
        keep = self.family.degrees(self.data.order)
        keep_mask = np.where(keep == ALWAYS_FREE, 0, keep % NON_CENTRAL) <= order
        self.theta = self.theta[keep_mask]
        self.data = self.data.of_order(order)
        self._set_groups()
        return True

    def result(self) -> RayFit:
        """Return what was found, of plain polynomials with the degrees beyond their order taken off."""
        A, y, residual = self.linearised()
        n_all = A.shape[1]
        beyond = np.zeros(n_all, dtype=np.bool_)
        if self.order is None:
            S = _inverse(A.T @ A + np.diag(self._precision()))
            covariance, rows = S, A
        else:
            for own in self.held.values():
                beyond[own] = True
            precision = self._precision()[~beyond]
            for _ in range(6):
                self.theta = np.where(beyond[: self.n_rays], 0.0, self.theta)
                A, y, residual = self.linearised()
                rows = A[:, ~beyond]
                S = _inverse(rows.T @ rows + np.diag(precision))
                values = np.concatenate([self.theta, self.rig])
                values[~beyond] += S @ (rows.T @ y - precision * values[~beyond])
                self._take(values)
            A, y, residual = self.linearised()
            covariance = self._with_misfit(A, S, beyond)
            rows = A[:, ~beyond]
        sd = np.sqrt(np.diag(covariance)[self.n_rays :])
        counts = np.cumsum(self.data.counts())[:-1]
        return RayFit(
            family=self.family,
            order=self.data.order if self.order is None else self.order,
            parameters=self.theta,
            covariance_order=self.data.order,
            covariance=covariance[: self.n_rays, : self.n_rays],
            residual_mm=tuple(np.split(-residual, counts)),
            noise=tuple(self.noise),
            rig=self.unknowns.results(self.rig, sd),
            whitened_rows=rows,
            whitened_residual=-y,
            fitted_covariance=S,
            whitening=self.whitening(),
        )

    def _with_misfit(self, A: FloatArray, S: FloatArray, beyond: BoolArray) -> FloatArray:
        """Return the covariance of all parameters where those ``beyond`` are left out.

        The truth has them, normal with variances T: leaving them out errs by -e there and by K e in the
        others, K the fit's answer to their columns.
        """
        if not self.held:
            return S
        T = np.concatenate([np.full(len(own), self.variance[g]) for g, own in self.held.items()])
        out = np.concatenate(list(self.held.values()))
        K = S @ (A[:, ~beyond].T @ A[:, out])
        into = np.zeros((A.shape[1], len(out)))
        into[~beyond] = K
        into[out, np.arange(len(out))] = -1.0
        covariance = (into * T) @ into.T
        covariance[np.ix_(~beyond, ~beyond)] += S
        return np.asarray(covariance)


def _inverse(matrix: FloatArray) -> FloatArray:
    """Return the inverse of a symmetric positive matrix, scaled to a unit diagonal on the way."""
    size = 1 / np.sqrt(np.diag(matrix))
    inverse = np.linalg.inv(matrix * np.outer(size, size)) * np.outer(size, size)
    return np.asarray((inverse + inverse.T) / 2)


def _scatter(residual_px: FloatArray, cov_px2: FloatArray, freedom: float) -> PlaneNoise:
    """Return the noise with which the squares of whitened residuals, shape (n, 2), sum to ``freedom``."""

    def squares(added_px: float) -> float:
        C = cov_px2 + added_px**2 * np.eye(2)
        det = C[:, 0, 0] * C[:, 1, 1] - C[:, 0, 1] ** 2
        u, v = residual_px.T
        return float(np.sum((C[:, 1, 1] * u * u - 2 * C[:, 0, 1] * u * v + C[:, 0, 0] * v * v) / det))

    stated = squares(0.0)
    if stated <= freedom:
        return PlaneNoise(scale=max(float(stated / freedom), LEAST_SCALE))
    low, high = 0.0, float(np.sqrt(np.sum(residual_px**2) / freedom))
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if squares(middle) > freedom else (low, middle)
    return PlaneNoise(added_px=high)
