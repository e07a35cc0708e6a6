"""Polynomials of the pixel: evaluation with derivatives, least-squares fit, Newton inverse.

Both ray models are made of them. Pixels are first scaled so that the picture spans [-1, 1] on either axis:
in raw pixels the design matrix of order 5 has a condition number of 2e17.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import FloatArray, IntArray, as_float_array
from bricktrack_common.camera_model import SensorMode
from bricktrack_common.errors import CalibrationError

CHUNK_POINTS = 1024
"""Points evaluated at once: their monomials fit into a core's second-level cache."""
PICTURE_MARGIN = 0.1
"""Scaled pixels beyond the border up to which a projection is given: 96 px of 1920."""
UNDETERMINED = 1e-5
"""Least ratio of the design's pivots: 2e-3 at order 11 with dots all over, 3e-6 at order 5 with 3 rows."""
NEAREST_SHARE = 0.05
"""Points nearer to the rays' centre than this share of plane A's distance are in the lens, not before it."""
NEWTON_DONE_SCALED = 1e-8
"""A step this small (1e-5 px) leaves less than 1e-12 px, because Newton's error squares."""
NEWTON_MAX_STEPS = 12


@dataclass(frozen=True, slots=True)
class PixelScaling:
    """Affine map of pixels to [-1, 1] across the picture, per axis.

    Attributes
    ----------
    centre_px, half_px : (float, float), px
        Middle of the picture and half its extent, for u and v.
    """

    centre_px: tuple[float, float]
    half_px: tuple[float, float]

    @classmethod
    def of_mode(cls, mode: SensorMode) -> "PixelScaling":
        """Return the scaling of a picture: its first and last pixel centres become -1 and 1."""
        half = ((mode.width - 1) / 2, (mode.height - 1) / 2)
        return cls(centre_px=half, half_px=half)

    def scaled(self, uv_px: FloatArray) -> FloatArray:
        """Return pixels, shape (n, 2), as scaled coordinates, shape (2, n), contiguous."""
        st = np.empty((2, len(uv_px)))
        for axis in (0, 1):
            np.subtract(uv_px[:, axis], self.centre_px[axis], out=st[axis])
            st[axis] /= self.half_px[axis]
        return st

    def pixels(self, st: FloatArray) -> FloatArray:
        """Return scaled coordinates, shape (2, n), as pixels, shape (n, 2)."""
        return np.stack([st[axis] * self.half_px[axis] + self.centre_px[axis] for axis in (0, 1)], axis=1)


def n_terms(order: int) -> int:
    """Return the number of monomials s^i t^j with i + j <= order.

    Examples
    --------
    >>> n_terms(5)
    21
    """
    return (order + 1) * (order + 2) // 2


def exponents(order: int) -> list[tuple[int, int]]:
    """Return the exponents (i, j) of s^i t^j in the order of the coefficients: by degree, then by j.

    Examples
    --------
    >>> exponents(2)
    [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]
    """
    return [(degree - j, j) for degree in range(order + 1) for j in range(degree + 1)]


def monomials(st: FloatArray, order: int) -> FloatArray:
    """Return s^i t^j, shape (n_terms, n), of scaled pixels, shape (2, n).

    Each degree is the one before times s, and its last monomial times t: two products a degree.
    """
    s, t = st
    rows = np.empty((n_terms(order), st.shape[1]))
    rows[0] = 1.0
    start = 0
    for degree in range(1, order + 1):
        end = start + degree
        np.multiply(rows[start:end], s, out=rows[end : end + degree])
        np.multiply(rows[end - 1], t, out=rows[end + degree])
        start = end
    return rows


class PixelPolynomial:
    """Several polynomials of the same order of the scaled pixel, evaluated together.

    Parameters
    ----------
    coefficients : ndarray, shape (n_outputs, n_terms)
        In the order of `exponents`.
    order : int
    """

    def __init__(self, coefficients: FloatArray, order: int) -> None:
        self.order = order
        self.coefficients = as_float_array("coefficients", coefficients, (None, n_terms(order))).copy()
        self.n_outputs = len(self.coefficients)
        by_s, by_t = np.zeros_like(self.coefficients), np.zeros_like(self.coefficients)
        powers = exponents(order)
        place = {power: k for k, power in enumerate(powers)}
        for (i, j), k in place.items():
            if i:
                by_s[:, place[i - 1, j]] += i * self.coefficients[:, k]
            if j:
                by_t[:, place[i, j - 1]] += j * self.coefficients[:, k]
        self._with_derivatives = np.vstack([self.coefficients, by_s, by_t])

    def values(self, st: FloatArray) -> FloatArray:
        """Return the values, shape (n_outputs, n), at scaled pixels, shape (2, n)."""
        return np.asarray(self.coefficients @ monomials(st, self.order))

    def values_and_derivatives(self, st: FloatArray) -> FloatArray:
        """Return values, d/ds and d/dt, shape (3, n_outputs, n), at scaled pixels, shape (2, n)."""
        both = self._with_derivatives @ monomials(st, self.order)
        return np.asarray(both.reshape(3, self.n_outputs, -1))


def least_squares(design: FloatArray, targets: FloatArray, *, what: str) -> tuple[FloatArray, FloatArray]:
    """Return coefficients, shape (n_columns, n_targets), and the inverse of the normal matrix.

    Parameters
    ----------
    design : ndarray, shape (n, n_columns)
    targets : ndarray, shape (n, n_targets)
    what : str
        What is being fitted, for the message.

    Raises
    ------
    CalibrationError
        If there are too few data, or they leave some coefficient undetermined.
    """
    n, n_columns = design.shape
    if n < n_columns:
        raise CalibrationError(
            f"{what}: {n} dots for {n_columns} coefficients; take a lower order or more dots"
        )
    scale = np.sqrt(np.mean(design * design, axis=0))
    scale[scale == 0] = 1.0
    q, r = np.linalg.qr(design / scale)
    diagonal = np.abs(np.diag(r))
    if diagonal.min() < UNDETERMINED * diagonal.max():
        raise CalibrationError(
            f"{what}: the dots leave some of the {n_columns} coefficients undetermined (they lie on too few "
            "lines); take a lower order or dots spread over the picture"
        )
    r_inverse = np.linalg.solve(r, np.eye(n_columns)) / scale[:, None]
    return r_inverse @ (q.T @ targets), r_inverse @ r_inverse.T


Which = slice | IntArray
Evaluate = Callable[[FloatArray, Which], tuple[FloatArray, FloatArray]]
"""Scaled pixels (2, n) and which points they are for -> residual (2, n) and its derivative (2, 2, n)."""


def newton_inverse(start: FloatArray, evaluate: Evaluate) -> tuple[FloatArray, FloatArray]:
    """Return the scaled pixels, shape (2, n), where the residual vanishes, and the derivative there.

    Parameters
    ----------
    start : ndarray, shape (2, n)
        First guess; NaN gives NaN.
    evaluate : callable
        ``evaluate(st, which)`` returns the residual (2, n) and ``M[i, j]`` = d residual i / d scaled
        pixel j, shape (2, 2, n), for the points ``which`` (a slice or indices).

    Returns
    -------
    st : ndarray, shape (2, n)
        NaN where no root is found in the picture and its margin.
    M : ndarray, shape (2, 2, n)
        Taken within `NEWTON_DONE_SCALED` of ``st``.
    """
    limit = 1.0 + PICTURE_MARGIN
    n = start.shape[1]
    found, M_found = np.full((2, n), np.nan), np.full((2, 2, n), np.nan)
    st = start
    which: Which = slice(None)
    for _ in range(NEWTON_MAX_STEPS):
        residual, M = evaluate(st, which)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            determinant = M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0]
            step = np.stack(
                [
                    M[1, 1] * residual[0] - M[0, 1] * residual[1],
                    M[0, 0] * residual[1] - M[1, 0] * residual[0],
                ]
            )
            step /= determinant
            size = np.abs(step).max(axis=0)
            # A long step is shortened: outside the picture a polynomial of high order is no guide.
            st = st - step * np.minimum(1.0, 0.5 / np.maximum(size, 1e-300))
            reach = np.abs(st).max(axis=0)
            done = size < NEWTON_DONE_SCALED
            inside = done & (reach <= limit)
            going = ~done & (reach < 2 * limit)
        if inside.all() and isinstance(which, slice):
            return st, M
        indices = np.arange(n) if isinstance(which, slice) else which
        found[:, indices[inside]] = st[:, inside]
        M_found[:, :, indices[inside]] = M[:, :, inside]
        if not going.any():
            break
        which, st = indices[going], st[:, going]
    return found, M_found


START_ORDER = 7
"""Order of the polynomial that starts the Newton inverse; leaves some hundredths of a pixel."""


class InverseStart:
    """First guess of the pixel that sees a given slope: a polynomial of the slopes.

    Parameters
    ----------
    slopes : ndarray, shape (2, n)
        Slopes dx/dz, dy/dz of rays spread over the picture.
    st : ndarray, shape (2, n)
        The scaled pixels they belong to.
    """

    def __init__(self, slopes: FloatArray, st: FloatArray) -> None:
        low, high = slopes.min(axis=1), slopes.max(axis=1)
        self._centre, self._half = (low + high)[:, None] / 2, (high - low)[:, None] / 2
        scaled = (slopes - self._centre) / self._half
        coefficients, _ = least_squares(
            monomials(scaled, START_ORDER).T, st.T, what="start of the inverse mapping"
        )
        self._polynomial = PixelPolynomial(coefficients.T, START_ORDER)

    def __call__(self, slopes: FloatArray) -> FloatArray:
        """Return scaled pixels, shape (2, n), near those that see ``slopes``, shape (2, n)."""
        scaled = np.clip((slopes - self._centre) / self._half, -1.2, 1.2)
        return self._polynomial.values(scaled)


COVERAGE_GRID = (65, 37)
"""Columns and rows of pixels by which it is told how much of the picture dots surround."""


def picture_grid(mode: SensorMode, columns: int = 33, rows: int = 19) -> FloatArray:
    """Return pixels, shape (rows * columns, 2), spread over the whole picture, border included."""
    u, v = np.meshgrid(np.linspace(0, mode.width - 1, columns), np.linspace(0, mode.height - 1, rows))
    return np.stack([u.ravel(), v.ravel()], axis=1)


def as_points(name: str, values: ArrayLike, width: int) -> tuple[FloatArray, tuple[int, ...]]:
    """Return ``values``, shape (..., width), as (n, width), and the leading shape."""
    array = as_float_array(name, values, (..., width))
    return array.reshape(-1, width), array.shape[:-1]


def in_chunks(n: int) -> list[slice]:
    """Return the slices that cut n points into pieces of at most `CHUNK_POINTS`."""
    return [slice(k, min(k + CHUNK_POINTS, n)) for k in range(0, n, CHUNK_POINTS)]
