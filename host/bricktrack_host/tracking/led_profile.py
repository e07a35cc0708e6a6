"""What a dome LED shows: where the centroid of its lit area falls, for a given pose.

The lit body is a hemisphere on a lit cylinder, the collar, of the same radius. Seen from the pupil its
outline is the hull of a circle (the tangent cone of the sphere, cut by the plane across the line of sight)
and of an ellipse (the collar's rear rim), joined by straight lines: area and centroid have closed forms,
perspective included. By symmetry the centroid is off the sphere's centre along the projected axis only. From
the plane across the line of sight to the picture it goes through the ray model, at four points that carry the
area's second moments, weighted by the local magnification: distortion across an LED is some 0.1 px.

Where the collar was never fitted (`BrickModel.led_profile` is `None`) the outline is taken for the sphere's,
with an uncertainty along the projected axis that all LEDs share: the pose is then had from what is across the
axes, and from the LEDs' disagreement.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import FloatArray, IntArray, as_float_array
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.rotations import skew

UNKNOWN_SHIFT_PER_RADIUS = 0.1
"""Standard deviation of the unknown shift, in LED radii times the sine of the view angle: between a bare
hemisphere (+0.19 r at 57 degrees) and a collar of two thirds of r (-0.09 r)."""

FITTED_SHIFT_PER_RADIUS = 0.005
"""The same for a fitted profile, which is one of shape, not of brightness: limb darkening and the lens's blur
leave thresholded centroids up to 0.3 px off the outline's at a radius of 60 px (path-traced sample)."""


@dataclass(frozen=True, slots=True, eq=False)
class LensTerms:
    """What the curvature of the map to the picture adds across an LED, beyond its derivative at the centre.

    Some 0.3 px that change by a thousandth of that while a pose is refined: had once, they serve for all its
    steps, which then cost one projection in place of five.

    Attributes
    ----------
    uv_px : ndarray, shape (..., 2), px
    J_px_per_mm : ndarray, shape (..., 2, 3), px/mm
    """

    uv_px: FloatArray
    J_px_per_mm: FloatArray

    def take(self, which: IntArray) -> "LensTerms":
        """Return the terms of some frames."""
        return LensTerms(self.uv_px[which], self.J_px_per_mm[which])


@dataclass(frozen=True, slots=True, eq=False)
class LedPrediction:
    """Where LEDs should be seen.

    Attributes
    ----------
    uv_px : ndarray, shape (..., 2), px
        Centroid of the lit area.
    J_px_per_mm : ndarray, shape (..., 2, 3), px/mm
        By the sphere's centre, camera frame.
    J_px_per_axis : ndarray, shape (..., 2, 3), px
        By the LED's axis, camera frame.
    area_px2 : ndarray, shape (...,), px^2
        Of the outline; of the full disc where the profile is unknown.
    facing : ndarray, shape (...,)
        Cosine between the axis and the line of sight to the camera; an LED with 0 or less cannot be seen.
    model_shift_px : ndarray, shape (..., 2), px
        One standard deviation of what the profile leaves unknown, the same way in all LEDs of a type.
    lens : LensTerms
        What the map's curvature across the LED contributed.
    """

    uv_px: FloatArray
    J_px_per_mm: FloatArray
    J_px_per_axis: FloatArray
    area_px2: FloatArray
    facing: FloatArray
    model_shift_px: FloatArray
    lens: LensTerms


def outline_moments(
    facing: ArrayLike, *, radius_mm: ArrayLike, collar_mm: ArrayLike, distance_mm: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return area, centroid and half length of a lit body's outline in the plane across the line of sight.

    Parameters
    ----------
    facing : array_like, shape (...,)
        Cosine c of the angle psi between the LED's axis and the line of sight to the camera.
    radius_mm, collar_mm, distance_mm : array_like, broadcast against ``facing``, mm
        Of dome and collar; from the pupil to the sphere's centre.

    Returns
    -------
    area_mm2, centroid_mm, half_length_mm : ndarray, shape (...,)
        In the plane through the sphere's centre across the line of sight; centroid and half length are along
        the projected axis, positive towards where the dome points.

    Notes
    -----
    Without collar and from afar the centroid is ``(4 r / 3 pi)(1 - c)``. Green's theorem over half the
    outline: the circle's arc to the common tangent, the tangent, the ellipse's arc.
    """
    c, r, h, D = np.broadcast_arrays(
        *(np.asarray(x, dtype=np.float64) for x in (facing, radius_mm, collar_mm, distance_mm))
    )
    s = np.sqrt(np.maximum(1 - c * c, 0.0))
    rho = r / np.sqrt(1 - (r / D) ** 2)
    far, near = (-h * s + r * c) / (D + h * c + r * s), (-h * s - r * c) / (D + h * c - r * s)
    x_e, p = 0.5 * D * (far + near), 0.5 * D * np.abs(far - near)
    k = r * s / (D + h * c)
    q = r * D / ((D + h * c) * np.sqrt(1 - k * k))
    # Common tangent: (rho - x_e x)^2 = q^2 + (p^2 - q^2) x^2 with x the cosine of its normal's angle.
    root = np.sqrt(np.maximum(rho**2 * x_e**2 - (x_e**2 + q**2 - p**2) * (rho**2 - q**2), 0.0))
    x = np.clip((rho**2 - q**2) / np.minimum(rho * x_e - root, -1e-12), -1.0, 1.0)
    phi = np.arccos(x)
    sin_phi = np.sin(phi)
    theta = np.arctan2(q * sin_phi, p * x)
    sin_t, cos_t = np.sin(theta), np.cos(theta)
    cos2 = 0.5 * (np.pi - theta) - 0.5 * sin_t * cos_t  # integral of cos^2 from theta to pi
    cos3 = -(sin_t - sin_t**3 / 3)
    x1, y1 = rho * x, rho * sin_phi
    x2, y2 = x_e + p * cos_t, q * sin_t
    half_area = (
        0.5 * rho**2 * (phi + sin_phi * x) + 0.5 * (x1 + x2) * (y2 - y1) + q * (-x_e * sin_t + p * cos2)
    )
    half_moment = (
        0.5 * rho**3 * (sin_phi - sin_phi**3 / 3)
        + (x1 * x1 + x1 * x2 + x2 * x2) * (y2 - y1) / 6
        + 0.5 * q * (-(x_e**2) * sin_t + 2 * x_e * p * cos2 + p**2 * cos3)
    )
    rear = np.minimum(x_e - p, -rho * (x <= -1 + 1e-12))
    return 2 * half_area, half_moment / half_area, 0.5 * (rho - rear)


def predict_leds(
    centres_camera_mm: ArrayLike,
    axes_camera: ArrayLike,
    radii_mm: ArrayLike,
    ray_model: RayModel,
    *,
    collar_mm: float | None,
    lens: LensTerms | None = None,
) -> LedPrediction:
    """Predict what a camera sees of LEDs.

    Parameters
    ----------
    centres_camera_mm : array_like, shape (..., 3), mm
        Centres of the domes' spheres.
    axes_camera : array_like, shape (..., 3)
        Unit vectors out of the wall.
    radii_mm : array_like, shape (...,) or broadcastable, mm
    ray_model : RayModel
    collar_mm : float or None
        `None`: not fitted; see the module.
    lens : LensTerms, optional
        Of a prediction nearby; default from four more projections.
    """
    centres = as_float_array("centres_camera_mm", centres_camera_mm, (..., 3))
    axes = as_float_array("axes_camera", axes_camera, (..., 3))
    radii = np.broadcast_to(np.asarray(radii_mm, dtype=np.float64), centres.shape[:-1])
    at_centre = ray_model.project(centres)
    J0 = at_centre.J_px_per_mm
    # The line of sight is the direction that does not move the image; no projection centre is needed.
    d = np.cross(J0[..., 0, :], J0[..., 1, :])
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    d *= np.where(d[..., 2:] < 0, -1.0, 1.0)
    along = np.einsum("...i,...i->...", axes, d)
    facing = -along
    across = axes - along[..., None] * d
    s = np.linalg.norm(across, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        other = np.cross(d, np.broadcast_to([1.0, 0.0, 0.0], d.shape))
        other /= np.linalg.norm(other, axis=-1, keepdims=True)
        e1 = np.where(s[..., None] > 1e-6, across / s[..., None], other)
    e2 = np.cross(d, e1)
    distance = centres[..., 2] / d[..., 2]
    if collar_mm is None:  # the sphere's own outline, and a shift along the projected axis that is not known
        half_length = radii / np.sqrt(1 - (radii / distance) ** 2)
        area, per_s, slope = np.pi * half_length**2, np.zeros_like(s), np.zeros_like(s)
        unknown_mm = UNKNOWN_SHIFT_PER_RADIUS * radii * s
    else:
        step = 1e-4
        c = np.clip(facing, -1 + 2 * step, 1 - 2 * step)
        near = np.stack([c, c - step, c + step])
        areas, shifts, half_lengths = outline_moments(
            near, radius_mm=radii, collar_mm=collar_mm, distance_mm=distance
        )
        ratio = shifts / np.sqrt(1 - near**2)
        area, half_length, per_s = areas[0], half_lengths[0], ratio[0]
        slope = (ratio[2] - ratio[1]) / (2 * step)
        unknown_mm = FITTED_SHIFT_PER_RADIUS * radii * s
    offset = (per_s * s)[..., None] * e1
    uv_flat = at_centre.uv_px + np.einsum("...ij,...j->...i", J0, offset)
    if lens is None:
        # Four points with the area's second moments: exact for a quadratic map.
        spread = np.sqrt(0.5) * np.stack([half_length, radii])[..., None] * np.stack([e1, e2])
        seen = ray_model.project(centres + offset + np.concatenate([spread, -spread]))
        weight = _magnification(seen.J_px_per_mm, e1, e2)
        weight /= weight.sum(axis=0)
        lens = LensTerms(
            uv_px=np.einsum("k...,k...i->...i", weight, seen.uv_px) - uv_flat,
            J_px_per_mm=np.einsum("k...,k...ij->...ij", weight, seen.J_px_per_mm) - J0,
        )
    J = J0 + lens.J_px_per_mm
    # shift = per_s(c) * across(n), c = -n.d: its derivative by the axis n.
    dd = d[..., :, None] * d[..., None, :]
    d_shift = per_s[..., None, None] * (np.eye(3) - dd) - slope[..., None, None] * (
        across[..., :, None] * d[..., None, :]
    )
    # Moving the LED turns its line of sight d, and with it what is seen of the shift.
    turned = (facing * per_s / distance)[..., None, None] * (np.eye(3) - dd)
    turned -= (slope / distance)[..., None, None] * across[..., :, None] * across[..., None, :]
    return LedPrediction(
        uv_px=uv_flat + lens.uv_px,
        J_px_per_mm=J @ (np.eye(3) + turned),
        J_px_per_axis=J @ d_shift,
        area_px2=area * _magnification(J, e1, e2),
        facing=facing,
        model_shift_px=unknown_mm[..., None] * np.einsum("...ij,...j->...i", J, e1),
        lens=lens,
    )


def _magnification(J_px_per_mm: FloatArray, e1: FloatArray, e2: FloatArray) -> FloatArray:
    """Return the picture's area per area of the plane that e1 and e2 span, px^2/mm^2."""
    a = np.einsum("...ij,...j->...i", J_px_per_mm, e1)
    b = np.einsum("...ij,...j->...i", J_px_per_mm, e2)
    return np.asarray(np.abs(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]))


def predict_brick(
    R_camera_brick: FloatArray,
    t_camera_brick_mm: FloatArray,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    collar_mm: float | None,
    lens: LensTerms | None = None,
) -> tuple[LedPrediction, FloatArray]:
    """Predict all LEDs of bricks, and the derivative of their pixels by the pose.

    Parameters
    ----------
    R_camera_brick : ndarray, shape (n, 3, 3) or (n, n_leds, 3, 3)
        One for each frame, or for each LED at its own instant.
    t_camera_brick_mm : ndarray, shape (n, 3) or (n, n_leds, 3), mm

    Returns
    -------
    prediction : LedPrediction, shape (n, n_leds)
    J_px_per_pose : ndarray, shape (n, n_leds, 2, 6)
        By ``[dtheta rad, dt mm]`` of `bricktrack_host.tracks`.
    """
    R = R_camera_brick if R_camera_brick.ndim == 4 else R_camera_brick[:, None]
    t = t_camera_brick_mm if t_camera_brick_mm.ndim == 3 else t_camera_brick_mm[:, None]
    P, N = brick_model.led_positions_mm, brick_model.led_axes
    centres = np.einsum("nlij,lj->nli", np.broadcast_to(R, (R.shape[0], len(P), 3, 3)), P) + t
    axes = np.einsum("nlij,lj->nli", np.broadcast_to(R, (R.shape[0], len(P), 3, 3)), N)
    prediction = predict_leds(
        centres, axes, brick_model.led_radii_mm, ray_model, collar_mm=collar_mm, lens=lens
    )
    J = np.empty((*centres.shape[:2], 2, 6))
    J[..., :3] = -(prediction.J_px_per_mm @ (R @ skew(P)) + prediction.J_px_per_axis @ (R @ skew(N)))
    J[..., 3:] = prediction.J_px_per_mm
    return prediction, J


def collar_of(brick_model: BrickModel) -> float | None:
    """Return the fitted collar of a layout, mm, or `None`."""
    return None if brick_model.led_profile is None else brick_model.led_profile.collar_mm
