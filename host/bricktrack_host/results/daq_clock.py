"""The laboratory's sample clock as a unit saw it: a robust line through the edges of the square wave.

Rising edge number i comes at ``t(i) = t0 + i * period`` on the unit's clock. The wave is the laboratory's own
sample clock, so the line is at once the rate of the two clocks against each other and the map between a time
of the unit and a sample of the data acquisition.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.errors import BricktrackError, ShapeError

MIN_EDGES = 5
_SEARCH = 0.02  # the period is looked for within 2 % of the first guess: no crystal is off by more
_NEAR = 0.25  # an edge further than this from its grid point, in periods, belongs to no sample
_MIN_CONCENTRATION = 0.6  # edges jittering uniformly over a quarter period still reach 0.9
_MAX_EXTRA = 0.2
_HUBER = 1.345  # 95 % efficiency on Gaussian jitter (Huber 1964)
_STANDS_NS = 1e-3  # what a further round would move any edge by, when rounds end


class EdgeFitError(BricktrackError, ValueError):
    """The edges are no square wave of the frequency expected."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeFit:
    """The line through the edges, and what is wrong with single edges.

    Attributes
    ----------
    edges_ns : ndarray of int64, shape (n,), CLOCK_MONOTONIC of the unit
        As recorded.
    index : ndarray of int64, shape (n,)
        Number of each edge in the wave, from 0 at the first true edge; -1 where `is_extra`.
    residual_ns : ndarray, shape (n,), ns
        Edge less line, positive when late; NaN where `is_extra`.
    is_extra : ndarray of bool, shape (n,)
        Edges that fall on no grid point, or share one with a better edge: bounce or interference.
    missed_index : ndarray of int64, shape (m,)
        Numbers between the first and the last edge at which none was recorded.
    nominal_hz : float or None
        The wave's frequency by the laboratory's clock.
    period_ns, period_sd_ns : float, ns
        On the unit's clock, with its standard deviation.
    t0_ns : int, ns, CLOCK_MONOTONIC of the unit
        Whole part of the fitted rise of edge 0; `t0_fraction_ns` is the rest.
    t0_fraction_ns, t0_sd_ns : float, ns
    rate_ppm, rate_sd_ppm : float, parts per million
        How much longer the period is on the unit's clock than nominal; NaN without `nominal_hz`.
    residual_rms_ns, residual_max_ns : float, ns
        Over all edges of the wave, late ones included; the maximum is of the magnitude.
    jitter_sd_ns : float, ns
        Robust standard deviation of the residuals (1.4826 times the median magnitude).
    """

    edges_ns: IntArray
    index: IntArray
    residual_ns: FloatArray
    is_extra: BoolArray
    missed_index: IntArray
    nominal_hz: float | None
    period_ns: float
    period_sd_ns: float
    t0_ns: int
    t0_fraction_ns: float
    t0_sd_ns: float
    rate_ppm: float
    rate_sd_ppm: float
    residual_rms_ns: float
    residual_max_ns: float
    jitter_sd_ns: float

    @property
    def n_edges(self) -> int:
        """Number of recorded edges that belong to the wave."""
        return int(np.count_nonzero(~self.is_extra))

    @property
    def last_index(self) -> int:
        """Number of the last recorded edge of the wave."""
        return int(self.index.max())

    def sample_index_of(self, t_ns: ArrayLike) -> FloatArray:
        """Return the wave's sample number, with its fraction, at times of the unit's clock.

        Beyond the recorded edges the line goes on; compare with 0 and `last_index`.
        """
        since_ns = np.asarray(t_ns, dtype=np.int64) - self.t0_ns
        return np.asarray((since_ns - self.t0_fraction_ns) / self.period_ns)

    def time_of_index(self, index: ArrayLike) -> IntArray:
        """Return when samples rise on the unit's clock, int64 ns; fractions of a sample are welcome."""
        i = np.asarray(index, dtype=np.float64)
        offset_ns = np.rint(self.t0_fraction_ns + i * self.period_ns).astype(np.int64)
        return np.asarray(self.t0_ns + offset_ns)

    def problems(self) -> list[str]:
        """Return what a reader must know of the edges, in words; empty when all is well."""
        found = []
        n_extra = int(np.count_nonzero(self.is_extra))
        if self.missed_index.size:
            share = self.missed_index.size / (self.last_index + 1)
            n_missed = self.missed_index.size
            was = "was" if n_missed == 1 else "were"
            words = f"{n_missed} of {self.last_index + 1} edges of the square wave {was} missed"
            if share > 0.3:
                words += f"; is its frequency really {self.nominal_hz or 1e9 / self.period_ns:g} Hz?"
            found.append(words)
        if n_extra:
            belong = "1 edge belongs" if n_extra == 1 else f"{n_extra} edges belong"
            found.append(f"{belong} to no sample of the square wave (bounce or interference)")
            if self.is_extra[0]:
                found.append("the first edge, which started the run, is one: time zero is not a sample")
        if abs(self.rate_ppm) > 300:
            found.append(
                f"the square wave is {self.rate_ppm:+.0f} ppm off its nominal {self.nominal_hz:g} Hz by the "
                "unit's clock; crystals differ by less than 100 ppm"
            )
        if self.residual_max_ns > 200_000:
            found.append(f"an edge was stamped {self.residual_max_ns / 1e6:.2f} ms off the line")
        return found


def fit_edges(edges_ns: ArrayLike, nominal_hz: float | None = None) -> EdgeFit:
    """Return the robust line through the rising edges of a square wave.

    The period is first found where the edges' phases agree best (the maximum of the periodogram of the
    edge train within 2 % of the first guess), which neither missing nor extra edges nor a few late ones
    disturb; edges then get their numbers by that phase, and a line with Huber weights is put through them.

    Parameters
    ----------
    edges_ns : array_like of int, shape (n,), ns
        Rising edges in order of time, CLOCK_MONOTONIC of the unit.
    nominal_hz : float, optional
        The wave's frequency by the laboratory's clock. Without it the median spacing is the first guess,
        and more than half of the edges must be there.

    Raises
    ------
    ShapeError
        If they are no whole numbers, or do not increase.
    EdgeFitError
        If there are fewer than five edges, or they are no wave of this frequency.

    Examples
    --------
    >>> fit = fit_edges([1000, 6000, 11000, 21000, 26000], nominal_hz=200_000)
    >>> fit.period_ns, fit.missed_index.tolist(), int(fit.time_of_index(3))
    (5000.0, [3], 16000)
    """
    edges = np.asarray(edges_ns)
    if edges.size < MIN_EDGES:
        raise EdgeFitError(f"{edges.size} edges; a line through the square wave needs at least {MIN_EDGES}")
    if edges.ndim != 1 or not np.issubdtype(edges.dtype, np.integer):
        raise ShapeError(
            f"edges_ns has shape {edges.shape} and type {edges.dtype}; expected (any,) whole nanoseconds"
        )
    edges = edges.astype(np.int64)
    steps = np.diff(edges)
    if steps.min() <= 0:
        raise ShapeError(f"edge {int(np.argmin(steps)) + 1} does not come after the one before")
    if nominal_hz is not None and not (np.isfinite(nominal_hz) and nominal_hz > 0):
        raise EdgeFitError(f"nominal frequency {nominal_hz!r} Hz; expected a positive number")

    since_ns = (edges - edges[0]).astype(np.float64)
    guess_ns = float(np.median(steps)) if nominal_hz is None else 1e9 / nominal_hz
    period_ns, phase_ns = _strongest_period(since_ns, guess_ns, nominal_hz)
    index, is_extra = _number_edges(since_ns, period_ns, phase_ns)
    for _ in range(3):
        line = _huber_line(index[~is_extra], since_ns[~is_extra], period_ns)
        index, is_extra = _number_edges(since_ns, line.period_ns, line.t0_ns)
        period_ns = line.period_ns
    if np.count_nonzero(is_extra) > _MAX_EXTRA * edges.size or np.count_nonzero(~is_extra) < MIN_EDGES:
        raise EdgeFitError(
            f"{np.count_nonzero(is_extra)} of {edges.size} edges belong to no sample of a "
            f"{1e9 / period_ns:.4g} Hz wave. Check the trigger cable, its ground and the configured frequency"
        )
    first = int(index[~is_extra].min())
    index = np.where(is_extra, -1, index - first)
    line = _huber_line(index[~is_extra], since_ns[~is_extra], period_ns)
    residual_ns = np.where(is_extra, np.nan, since_ns - line.t0_ns - index * line.period_ns)
    whole_ns = int(np.floor(line.t0_ns))
    good = residual_ns[~is_extra]
    ppm_per_ns = np.nan if nominal_hz is None else nominal_hz * 1e-9 * 1e6
    return EdgeFit(
        edges_ns=edges,
        index=index,
        residual_ns=residual_ns,
        is_extra=is_extra,
        missed_index=np.setdiff1d(np.arange(index.max() + 1), index[~is_extra]),
        nominal_hz=nominal_hz,
        period_ns=line.period_ns,
        period_sd_ns=line.period_sd_ns,
        t0_ns=int(edges[0]) + whole_ns,
        t0_fraction_ns=line.t0_ns - whole_ns,
        t0_sd_ns=line.t0_sd_ns,
        rate_ppm=line.period_ns * ppm_per_ns - 1e6,
        rate_sd_ppm=line.period_sd_ns * ppm_per_ns,
        residual_rms_ns=float(np.sqrt(np.mean(good**2))),
        residual_max_ns=float(np.abs(good).max()),
        jitter_sd_ns=_robust_sd(good),
    )


def _strongest_period(since_ns: FloatArray, guess_ns: float, nominal_hz: float | None) -> tuple[float, float]:
    """Return period and phase, ns, at which the edges' phases agree best; in stages of growing length."""
    period_ns = guess_ns
    width = _SEARCH
    n_periods = 16.0
    while True:
        # Over n periods a relative error e of the period turns the last phase by n * e turns.
        part = since_ns[since_ns <= n_periods * period_ns]
        part = part if part.size >= MIN_EDGES else since_ns[:MIN_EDGES]
        span = max(part[-1] / period_ns, 1.0)
        trial = period_ns * (1 + np.linspace(-width, width, 2 * int(np.ceil(width * span * 8)) + 1))
        total = np.exp(2j * np.pi * part[None, :] / trial[:, None]).mean(axis=1)
        best = int(np.argmax(np.abs(total)))
        period_ns = float(trial[best])
        concentration = float(np.abs(total[best]))
        if part.size == since_ns.size:
            break
        width = min(width, 0.5 / span)
        n_periods = 4 * max(n_periods, span)
    if concentration < _MIN_CONCENTRATION:
        expected = f"{nominal_hz:g} Hz" if nominal_hz is not None else "any one frequency"
        raise EdgeFitError(
            f"{since_ns.size} edges, median spacing {np.median(np.diff(since_ns)) / 1e6:.4g} ms, are no "
            f"square wave of {expected} (phases agree to {concentration:.2f}; expected 0.9 or more). Check "
            "the configured frequency and the trigger cable"
        )
    return period_ns, float(np.angle(total[best])) / (2 * np.pi) * period_ns


def _number_edges(since_ns: FloatArray, period_ns: float, phase_ns: float) -> tuple[IntArray, BoolArray]:
    """Return the nearest grid point of each edge, and which edges belong to none."""
    turns = (since_ns - phase_ns) / period_ns
    index = np.rint(turns).astype(np.int64)
    off = np.abs(turns - index)
    is_extra = off > _NEAR
    # Of several edges near one grid point the nearest is the wave's.
    order = np.lexsort((off, index))
    same = np.zeros(len(index), dtype=np.bool_)
    same[order[1:]] = index[order[1:]] == index[order[:-1]]
    return index, np.asarray(is_extra | same)


@dataclass(frozen=True, slots=True)
class _Line:
    period_ns: float
    period_sd_ns: float
    t0_ns: float
    t0_sd_ns: float


def _huber_line(index: IntArray, since_ns: FloatArray, period_ns: float) -> _Line:
    """Fit ``since = t0 + index * period`` with Huber weights; the deviations come from the robust spread."""
    if index.size < MIN_EDGES:
        raise EdgeFitError(
            f"only {index.size} edges belong to a {1e9 / period_ns:.4g} Hz wave; a line needs {MIN_EDGES}"
        )
    centre = float(index.mean())
    x = index - centre
    y = since_ns - index * period_ns  # small numbers: the fit keeps its digits
    weight = np.ones(index.size)
    slope = level = 0.0
    reach = float(np.abs(x).max())
    for _ in range(20):
        before = level, slope
        xm = float(np.average(x, weights=weight))
        ym = float(np.average(y, weights=weight))
        slope = float(np.sum(weight * (x - xm) * (y - ym)) / np.sum(weight * (x - xm) ** 2))
        level = ym - slope * xm
        residual = y - level - slope * x
        if abs(level - before[0]) + abs(slope - before[1]) * reach < _STANDS_NS:
            break
        sd = _robust_sd(residual)
        if sd == 0.0:
            break
        weight = np.minimum(1.0, _HUBER * sd / np.maximum(np.abs(residual), 1e-12 * sd))
    # Sandwich variance of a Huber estimate: psi^2 over the squared share of edges inside the knee.
    psi2 = float(np.sum((weight * residual) ** 2)) / max(index.size - 2, 1)
    inside = max(float(np.mean(weight >= 1.0)), 0.1)
    variance = psi2 / inside**2
    x_variance = float(np.sum((x - x.mean()) ** 2))
    slope_sd = float(np.sqrt(variance / x_variance))
    return _Line(
        period_ns=period_ns + slope,
        period_sd_ns=slope_sd,
        t0_ns=level - slope * centre,
        t0_sd_ns=float(np.sqrt(variance / index.size + (centre * slope_sd) ** 2)),
    )


def _robust_sd(residual: FloatArray) -> float:
    return float(1.4826 * np.median(np.abs(residual - np.median(residual))))
