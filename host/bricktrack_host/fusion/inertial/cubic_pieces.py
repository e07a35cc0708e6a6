"""Vectors over time, piece by piece a polynomial: the cubic through samples, its derivatives and integrals.

The same as SciPy's ``CubicSpline``, whose package takes as long to load as a run to fuse.
"""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_host.compiled import compiled_in_place
from bricktrack_host.tracking.pose.spline_kernel import knot_slopes

_NEAR = 8  # pieces: so many are passed sooner one by one than by halving


@dataclass(frozen=True, slots=True, eq=False)
class CubicPieces:
    """A vector of polynomials; beyond its knots the first and the last go on.

    Attributes
    ----------
    x : ndarray, shape (n,)
        Knots, increasing.
    c : ndarray, shape (k, n - 1, 3)
        Coefficients of each piece, the highest power of the way from its knot first.
    """

    x: FloatArray
    c: FloatArray

    def __call__(self, at: FloatArray, order: int = 0) -> FloatArray:
        """Return values, or derivatives of an order, shape (..., 3), at instants of any shape; NaN at NaN."""
        flat = np.ascontiguousarray(at, dtype=np.float64).reshape(-1)
        out = np.empty((len(flat), 3))
        _evaluate(self.x, self.c, flat, order, out)
        return out.reshape(*np.shape(at), 3)

    def antiderivative(self) -> "CubicPieces":
        """Return the integral from the first knot."""
        n_powers, n_pieces = self.c.shape[:2]
        c = np.zeros((n_powers + 1, n_pieces, 3))
        c[:-1] = self.c / np.arange(n_powers, 0, -1)[:, None, None]
        width, over = np.diff(self.x)[:-1, None], np.zeros((n_pieces - 1, 3))
        for of_power in c[:-1]:
            over = (over + of_power[:-1]) * width
        c[-1, 1:] = np.cumsum(over, axis=0)
        return CubicPieces(self.x, c)


def cubic_through(x: FloatArray, y: FloatArray) -> CubicPieces:
    """Return the cubic spline ("not a knot") through values, shape (n, 3), at two or more knots, shape (n,).

    Raises
    ------
    ValueError
        If a value is not finite, or the knots do not increase.
    """
    width = np.diff(x)[:, None]
    if not len(width) or not (width > 0).all() or not np.isfinite(y).all():
        raise ValueError("a spline needs two or more finite values at increasing knots")
    y = np.ascontiguousarray(y, dtype=np.float64)
    slopes, rise = knot_slopes(y, x), np.diff(y, axis=0) / width
    bend = (slopes[:-1] + slopes[1:] - 2 * rise) / width
    return CubicPieces(x, np.stack([bend / width, (rise - slopes[:-1]) / width - bend, slopes[:-1], y[:-1]]))


@compiled_in_place
def _evaluate(x: FloatArray, c: FloatArray, at: FloatArray, order: int, out: FloatArray) -> None:
    last, i = len(x) - 2, 0
    n_powers = len(c)
    for k in range(len(at)):
        t = at[k]
        if i < last and t >= x[i + 1]:  # instants mostly rise: one of the next pieces
            stop = min(i + _NEAR, last)
            while i < stop and t >= x[i + 1]:
                i += 1
        if not (x[i] <= t and (i == last or t < x[i + 1])):
            i = min(max(np.searchsorted(x, t, side="right") - 1, 0), last)
        h = t - x[i]
        if order == 0:
            u, v, w = c[0, i, 0], c[0, i, 1], c[0, i, 2]
            for p in range(1, n_powers):
                u, v, w = u * h + c[p, i, 0], v * h + c[p, i, 1], w * h + c[p, i, 2]
            out[k, 0], out[k, 1], out[k, 2] = u, v, w
            continue
        for axis in range(3):
            value = 0.0
            for p in range(n_powers - 1, order - 1, -1):
                factor = 1.0
                for q in range(order):
                    factor *= p - q
                value = value * h + factor * c[n_powers - 1 - p, i, axis]
            out[k, axis] = value
