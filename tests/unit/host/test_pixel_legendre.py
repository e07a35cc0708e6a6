"""Legendre products against the monomials that evaluate them."""

import numpy as np
from scipy.special import eval_legendre

from bricktrack_host.calibration.rays.pixel_legendre import (
    legendre_terms,
    monomials_of_legendre,
    term_degrees,
)
from bricktrack_host.calibration.rays.pixel_polynomials import exponents, monomials

ST = np.random.default_rng(1).uniform(-1, 1, (2, 40))


def test_terms_are_products_of_legendre_polynomials():
    terms = legendre_terms(ST, 6)
    for k, (i, j) in enumerate(exponents(6)):
        np.testing.assert_allclose(terms[:, k], eval_legendre(i, ST[0]) * eval_legendre(j, ST[1]), atol=1e-13)
        assert term_degrees(6)[k] == i + j


def test_coefficients_of_either_basis_give_the_same_values():
    coefficients = np.random.default_rng(2).normal(size=len(exponents(11)))
    as_monomials = monomials_of_legendre(11) @ coefficients
    # P_11 has coefficients of 5e4: five digits of rounding are lost.
    np.testing.assert_allclose(
        as_monomials @ monomials(ST, 11), legendre_terms(ST, 11) @ coefficients, atol=1e-9
    )
