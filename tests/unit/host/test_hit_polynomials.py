from dataclasses import dataclass

import numpy as np
import pytest
from pinhole import PinholeCamera

from bricktrack_common.errors import TrackingError
from bricktrack_host.tracking.led_model.hit_polynomials import expand_at, hit_polynomials

CAMERA = PinholeCamera()


def pixels(n, seed):
    return np.random.default_rng(seed).uniform([0, 0], [1919, 1079], (n, 2))


def test_hits_are_those_of_the_model_on_both_planes():
    uv = pixels(300, seed=1).reshape(10, 30, 2)
    hits = expand_at(hit_polynomials(CAMERA), uv)
    assert hits.shape == (10, 30, 6, 4)
    # A micrometre over a thousand: 1e-5 px.
    np.testing.assert_allclose(hits[..., 0, :2], CAMERA.points_on_plane(uv, CAMERA.plane_a_mm), atol=1e-6)
    np.testing.assert_allclose(hits[..., 0, 2:], CAMERA.points_on_plane(uv, CAMERA.plane_b_mm), atol=1e-6)


def test_derivatives_meet_finite_differences_of_the_model():
    uv, h = pixels(50, seed=2), 0.5
    hits = expand_at(hit_polynomials(CAMERA), uv)

    def at(du, dv):
        return np.hstack(
            [
                CAMERA.points_on_plane(uv + np.array([du, dv]), z)
                for z in (CAMERA.plane_a_mm, CAMERA.plane_b_mm)
            ]
        )

    # Third derivatives of this lens make 1e-9 mm/px of a difference over half a pixel.
    np.testing.assert_allclose(hits[:, 1], (at(h, 0) - at(-h, 0)) / (2 * h), atol=1e-7)
    np.testing.assert_allclose(hits[:, 2], (at(0, h) - at(0, -h)) / (2 * h), atol=1e-7)
    np.testing.assert_allclose(hits[:, 3], (at(h, 0) - 2 * at(0, 0) + at(-h, 0)) / h**2, atol=3e-8)
    np.testing.assert_allclose(hits[:, 5], (at(0, h) - 2 * at(0, 0) + at(0, -h)) / h**2, atol=3e-8)
    cross = (at(h, h) - at(h, -h) - at(-h, h) + at(-h, -h)) / (4 * h**2)
    np.testing.assert_allclose(hits[:, 4], cross, atol=3e-8)


def test_a_pixel_that_was_not_seen_has_no_hits():
    hits = expand_at(hit_polynomials(CAMERA), np.array([[np.nan, np.nan], [900.0, 500.0]]))
    assert np.isnan(hits[0]).all()
    assert np.isfinite(hits[1]).all()


def test_a_model_is_put_into_polynomials_once():
    assert hit_polynomials(CAMERA) is hit_polynomials(CAMERA)


@dataclass(frozen=True)
class Creased(PinholeCamera):
    """Rays with a step of 0.1 mm in the middle of the picture."""

    def points_on_plane(self, uv_px, z_mm):
        xy = super().points_on_plane(uv_px, z_mm)
        return xy + 0.1 * (np.asarray(uv_px)[..., :1] > 960)


def test_rays_that_are_not_smooth_are_refused():
    with pytest.raises(TrackingError, match="its rays bend by"):
        hit_polynomials(Creased())
