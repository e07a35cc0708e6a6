"""Squares of errors over their covariance, against numbers by hand and the law they follow."""

import numpy as np
import pytest

from bricktrack_host.normalised_errors import normalised_squares


def test_a_square_is_what_it_is_by_hand():
    # 2 x 2 with det 3: C^-1 = [[2, -1], [-1, 2]] / 3, so [1, 1] gives 2 / 3 and [1, -1] gives 6 / 3.
    covariance = np.tile([[2.0, 1.0], [1.0, 2.0]], (2, 1, 1))
    squares = normalised_squares(np.array([[1.0, 1.0], [1.0, -1.0]]), covariance)
    assert squares == pytest.approx([2 / 3, 2.0])


def test_what_is_not_known_or_singular_is_nan_and_nothing_else_is():
    covariance = np.tile(np.eye(6), (5, 1, 1))
    covariance[1, 2, 2] = 0.0  # singular
    covariance[2] = 1.0  # of rank one
    covariance[3, 0, 0] = np.nan
    errors = np.ones((5, 6))
    errors[4, 5] = np.nan
    squares = normalised_squares(errors, covariance)
    assert squares[0] == pytest.approx(6.0)
    assert np.isnan(squares[1:]).all()


def test_a_negative_variance_is_no_covariance():
    assert np.isnan(normalised_squares(np.ones((1, 2)), np.diag([1.0, -1.0])[None])).all()


def test_units_that_differ_by_orders_lose_nothing():
    # rad of 1e-5 beside mm, correlated by 0.999: the whitened answer is known in units of their sd.
    sd = np.array([1e-5, 1e-5, 1e-5, 1.0, 1.0, 1.0])
    correlation = 0.999 * np.ones((6, 6)) + 0.001 * np.eye(6)
    e = np.array([1.0, -1.0, 0.0, 0.0, 0.0, 0.0])  # across the common direction: 2 / 0.001
    squares = normalised_squares((e * sd)[None], (correlation * sd[:, None] * sd)[None])
    assert squares[0] == pytest.approx(2000.0, rel=1e-9)


def test_draws_of_a_covariance_have_their_degrees_of_freedom():
    rng = np.random.default_rng(4)
    root = rng.normal(size=(6, 6))
    errors = root @ rng.standard_normal((3, 6, 4000))
    squares = normalised_squares(errors, np.tile(root @ root.T, (3, 1, 1)))
    assert squares.shape == (3, 4000)
    assert squares.mean() == pytest.approx(6.0, abs=4 * np.sqrt(12 / 12000))  # four sd of the mean of chi2(6)
