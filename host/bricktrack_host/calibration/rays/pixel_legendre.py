"""Products of Legendre polynomials of the scaled pixel: the basis in which ray models are fitted.

They span the same polynomials as the monomials that `calibration.rays.pixel_polynomials` evaluates, but are
nearly orthogonal over a picture: coefficients of one degree are of one size, and a covariance keeps its
meaning when it is written with nine digits.
"""

from functools import lru_cache

import numpy as np
from numpy.polynomial import legendre

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.calibration.rays.pixel_polynomials import exponents, n_terms


def legendre_terms(st: FloatArray, order: int) -> FloatArray:
    """Return P_i(s) P_j(t), i + j <= order, shape (n, n_terms), at scaled pixels, shape (2, n).

    In the order of `pixel_polynomials.exponents`.
    """
    in_s, in_t = (legendre.legvander(st[axis], order) for axis in (0, 1))
    i, j = np.array(exponents(order)).T
    return np.asarray(in_s[:, i] * in_t[:, j])


def term_degrees(order: int) -> IntArray:
    """Return the degree i + j of each term, shape (n_terms,).

    Examples
    --------
    >>> term_degrees(2).tolist()
    [0, 1, 1, 2, 2, 2]
    """
    return np.asarray(np.array(exponents(order), dtype=np.int64).sum(axis=1))


@lru_cache(maxsize=32)
def monomials_of_legendre(order: int) -> FloatArray:
    """Return T, shape (n_terms, n_terms): monomial coefficients = T @ coefficients of Legendre products."""
    powers = exponents(order)
    place = {power: k for k, power in enumerate(powers)}
    T = np.zeros((n_terms(order), n_terms(order)))
    for k, (i, j) in enumerate(powers):
        of_s, of_t = (legendre.leg2poly(np.eye(order + 1)[d]) for d in (i, j))
        for a, in_s in enumerate(of_s):
            for b, in_t in enumerate(of_t):
                if in_s * in_t:
                    T[place[a, b], k] = in_s * in_t
    T.setflags(write=False)
    return T
