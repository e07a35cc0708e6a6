"""What a dome LED shows: where the centroid of its lit area falls, for a given pose.

The lit body is a hemisphere on a lit cylinder, the collar, of the same radius. Seen from the pupil its
outline is the hull of a circle (the tangent cone of the sphere, cut by the plane across the line of sight)
and of an ellipse (the collar's rear rim), joined by straight lines: area and centroid have closed forms,
perspective included. By symmetry the centroid is off the sphere's centre along the projected axis only. From
the plane across the line of sight to the picture it goes by the rays' derivatives, to second order with the
area's second moments and the growth of the magnification: distortion across an LED is some 0.1 px.

Where the collar was never fitted (`BrickModel.led_profile` is `None`) the outline is taken for the sphere's,
with an uncertainty along the projected axis that all LEDs share: the pose is then had from what is across the
axes, and from the LEDs' disagreement.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import FloatArray, IntArray, as_float_array
from bricktrack_common.brick_model import DEFAULT_SHIFT_SD_PER_RADIUS, BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_host.compiled import compiled
from bricktrack_host.tracking.led_model.hit_polynomials import expand_at, hit_polynomials
from bricktrack_host.tracking.led_model.led_outline import outline, outlines_of
from bricktrack_host.tracking.led_model.led_view import AREA, N_SHAPE, led_shape, led_view
from bricktrack_host.tracking.led_model.projection import project_points

UNKNOWN_SHIFT_PER_RADIUS = 0.1
"""Standard deviation of the unknown shift, in LED radii times the sine of the view angle: between a bare
hemisphere (+0.19 r at 57 degrees) and a collar of two thirds of r (-0.09 r)."""


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
    """

    uv_px: FloatArray
    J_px_per_mm: FloatArray
    J_px_per_axis: FloatArray
    area_px2: FloatArray
    facing: FloatArray
    model_shift_px: FloatArray


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
    given = np.broadcast_arrays(facing, radius_mm, collar_mm, distance_mm)
    flat = np.stack([np.asarray(x, dtype=np.float64).ravel() for x in given])
    area, centroid, half_length = _outlines(flat).reshape(3, *given[0].shape)
    return area, centroid, half_length


@compiled
def _outlines(given: FloatArray) -> FloatArray:
    out = np.empty((3, given.shape[1]))
    for i in range(given.shape[1]):
        out[0, i], out[1, i], out[2, i] = outline(given[0, i], given[1, i], given[2, i], given[3, i])
    return out


def predict_leds(
    centres_camera_mm: ArrayLike,
    axes_camera: ArrayLike,
    radii_mm: ArrayLike,
    ray_model: RayModel,
    *,
    collar_mm: float | None,
    shift_sd_per_radius: float = UNKNOWN_SHIFT_PER_RADIUS,
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
    shift_sd_per_radius : float
        What the profile leaves unknown, see `shift_per_radius`.
    """
    centres = as_float_array("centres_camera_mm", centres_camera_mm, (..., 3))
    axes = as_float_array("axes_camera", axes_camera, (..., 3))
    lead = centres.shape[:-1]
    given_radii = np.asarray(radii_mm, dtype=np.float64)
    radii = np.broadcast_to(given_radii, lead)
    outlines = outlines_of(given_radii.ravel(), collar_mm)
    kind = np.broadcast_to(outlines.kind.reshape(given_radii.shape), lead)
    uv = project_points(centres, ray_model)
    polynomials = hit_polynomials(ray_model)
    hits = expand_at(polynomials, uv)
    a, b = polynomials.plane_a_mm, polynomials.plane_b_mm
    n = uv.size // 2
    flat, shape = np.empty((n, 6)), np.empty((n, N_SHAPE))
    J_centre, J_axis = np.empty((n, 2, 3)), np.empty((n, 2, 3))
    _predict_all(
        uv.reshape(-1, 2),
        np.ascontiguousarray(centres.reshape(-1, 3)),
        np.ascontiguousarray(axes.reshape(-1, 3)),
        radii.reshape(-1),
        outlines.tables,
        kind.reshape(-1),
        hits.reshape(-1, 6, 4),
        a,
        b - a,
        shape,
        flat,
        J_centre,
        J_axis,
    )
    out = flat.reshape(*lead, 6)
    return LedPrediction(
        uv_px=out[..., :2],
        J_px_per_mm=J_centre.reshape(*lead, 2, 3),
        J_px_per_axis=J_axis.reshape(*lead, 2, 3),
        area_px2=out[..., 2],
        facing=out[..., 3],
        model_shift_px=shift_sd_per_radius * radii[..., None] * out[..., 4:],
    )


def shift_per_radius(collar_mm: float | None, brick_model: BrickModel) -> float:
    """Return one standard deviation of what the profile leaves unknown, over radius times sine."""
    if collar_mm is None:
        return UNKNOWN_SHIFT_PER_RADIUS
    profile = brick_model.led_profile
    return DEFAULT_SHIFT_SD_PER_RADIUS if profile is None else profile.shift_sd_per_radius


@compiled
def _predict_all(
    uv: FloatArray,
    centres: FloatArray,
    axes: FloatArray,
    radii: FloatArray,
    tables: FloatArray,
    kind: IntArray,
    hits: FloatArray,
    plane_a: float,
    apart: float,
    shape: FloatArray,
    out: FloatArray,
    J_centre: FloatArray,
    J_axis: FloatArray,
) -> None:
    """Write centroid, area, facing and what is across the axis, (n, 6), and both Jacobians, (n, 2, 3)."""
    for i in range(len(uv)):
        led_shape(centres[i], axes[i], radii[i], tables, kind[i], hits, i, plane_a, apart, shape)
        du, dv, facing, magnification, shown_u, shown_v = led_view(
            centres[i], axes[i], hits, i, plane_a, apart, shape, J_centre[i], J_axis[i]
        )
        out[i, 0], out[i, 1] = uv[i, 0] + du, uv[i, 1] + dv
        out[i, 2], out[i, 3] = shape[i, AREA] * magnification, facing
        out[i, 4], out[i, 5] = shown_u, shown_v


def predict_brick(
    R_camera_brick: FloatArray,
    t_camera_brick_mm: FloatArray,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    collar_mm: float | None,
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
    P, N = brick_model.led_positions_mm, brick_model.led_axes
    R = np.ascontiguousarray(R_camera_brick if R_camera_brick.ndim == 4 else R_camera_brick[:, None])
    t = np.ascontiguousarray(t_camera_brick_mm if t_camera_brick_mm.ndim == 3 else t_camera_brick_mm[:, None])
    lead = len(R), len(P)
    centres, axes, J = np.empty((*lead, 3)), np.empty((*lead, 3)), np.empty((*lead, 2, 6))
    _place(R, t, P, N, centres, axes)
    prediction = predict_leds(
        centres,
        axes,
        brick_model.led_radii_mm,
        ray_model,
        collar_mm=collar_mm,
        shift_sd_per_radius=shift_per_radius(collar_mm, brick_model),
    )
    _by_pose(R, P, N, prediction.J_px_per_mm, prediction.J_px_per_axis, J)
    return prediction, J


@compiled
def _place(
    R: FloatArray, t: FloatArray, P: FloatArray, N: FloatArray, centres: FloatArray, axes: FloatArray
) -> None:
    """Write LEDs' centres and axes, (n, n_leds, 3), of poses (n, m, ...), one for all LEDs or each one's."""
    for i in range(len(R)):
        for k in range(len(P)):
            at, from_ = min(k, R.shape[1] - 1), min(k, t.shape[1] - 1)
            for r in range(3):
                x, y, z = R[i, at, r, 0], R[i, at, r, 1], R[i, at, r, 2]
                centres[i, k, r] = x * P[k, 0] + y * P[k, 1] + z * P[k, 2] + t[i, from_, r]
                axes[i, k, r] = x * N[k, 0] + y * N[k, 1] + z * N[k, 2]


@compiled
def _by_pose(
    R: FloatArray, P: FloatArray, N: FloatArray, J_centre: FloatArray, J_axis: FloatArray, J: FloatArray
) -> None:
    """Write derivatives of pixels by turn and shift, (n, n_leds, 2, 6), of those by centres and axes.

    A turn theta, brick axes, moves a centre by R (theta x P): its row is P x (R' J).
    """
    n, n_leds = J_centre.shape[:2]
    c, a = np.empty(3), np.empty(3)
    for i in range(n):
        for k in range(n_leds):
            M = R[i, min(k, R.shape[1] - 1)]
            for row in range(2):
                by, of_axis, out = J_centre[i, k, row], J_axis[i, k, row], J[i, k, row]
                for r in range(3):
                    c[r] = M[0, r] * by[0] + M[1, r] * by[1] + M[2, r] * by[2]
                    a[r] = M[0, r] * of_axis[0] + M[1, r] * of_axis[1] + M[2, r] * of_axis[2]
                    out[3 + r] = by[r]
                out[0] = P[k, 1] * c[2] - P[k, 2] * c[1] + N[k, 1] * a[2] - N[k, 2] * a[1]
                out[1] = P[k, 2] * c[0] - P[k, 0] * c[2] + N[k, 2] * a[0] - N[k, 0] * a[2]
                out[2] = P[k, 0] * c[1] - P[k, 1] * c[0] + N[k, 0] * a[1] - N[k, 1] * a[0]


def collar_of(brick_model: BrickModel) -> float | None:
    """Return the fitted collar of a layout, mm, or `None`."""
    return None if brick_model.led_profile is None else brick_model.led_profile.collar_mm
