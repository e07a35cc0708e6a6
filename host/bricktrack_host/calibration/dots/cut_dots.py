"""The centre of a dot that the picture's border cuts, from what is left of its rim.

A moment of the visible part is not the dot's. Instead a blurred ellipse, of the shape of the whole dots next
to it but of free size, is fitted to the visible light. These dots are few, but they lie where whole ones
end and a polynomial would have to be extrapolated.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from bricktrack_common.arrays import FloatArray

MAX_STEPS = 15
CONVERGED_PX = 1e-3
MAX_SIZE_CHANGE = 0.08
"""Sizes of neighbouring dots differ by one or two per cent; more means that something else was fitted."""
MIN_CENTRE_INSIDE = 0.2
"""The centre must lie this share of the radius inside the picture: 200 degrees of rim."""
MAX_RMS = 0.08
"""Share of the contrast by which light and model may differ."""
MODEL_ERROR_PX = 0.05
"""The rim's true profile moves a one-sided rim by about this much: 0.02 to 0.06 px rms on drawn and on
path-traced (simulated) dots of 8 to 16 px radius."""


@dataclass(frozen=True, slots=True, eq=False)
class CompletedDot:
    """A cut dot that was fitted.

    Attributes
    ----------
    uv_px : ndarray, shape (2,), px
        Its centre.
    cov_px2 : ndarray, shape (2, 2), px^2
    shape_px2 : ndarray, shape (2, 2), px^2
        Matrix E of its ellipse d' E^-1 d = 1.
    rms : float
        By which light and model differ, share of the contrast.
    """

    uv_px: FloatArray
    cov_px2: FloatArray
    shape_px2: FloatArray
    rms: float


def complete_cut_dot(
    uv_px: FloatArray,
    light: FloatArray,
    *,
    box_px: tuple[float, float, float, float],
    shape_px2: FloatArray,
    blur_px: float,
    noise: float,
    size_px: tuple[int, int],
) -> CompletedDot | None:
    """Fit a blurred ellipse to the visible part of a dot.

    Parameters
    ----------
    uv_px : ndarray, shape (2, n), px
        The pixels around the dot.
    light : ndarray, shape (n,)
        Their light, 0 for background and 1 for the plateau.
    box_px : (left, top, right, bottom), px
        Outermost pixel centres of the visible region.
    shape_px2 : ndarray, shape (2, 2), px^2
        Matrix E of the ellipse d' E^-1 d = 1, from the whole dots nearby.
    blur_px : float, px
        Standard deviation of the rim's blur.
    noise : float
        Standard deviation of ``light``.
    size_px : (width, height), px
        Of the picture.

    Returns
    -------
    CompletedDot or None
        None where too little is visible or the fit does not hold.
    """
    half_u, half_v = np.sqrt(shape_px2[0, 0]), np.sqrt(shape_px2[1, 1])
    left, top, right, bottom = box_px
    width, height = size_px
    # The sides of the box that the border has not cut say where the ellipse is.
    u = (
        (left + right) / 2
        if left > 0 and right < width - 1
        else right - half_u
        if left <= 0
        else left + half_u
    )
    v = (
        (top + bottom) / 2
        if top > 0 and bottom < height - 1
        else bottom - half_v
        if top <= 0
        else top + half_v
    )
    # What a picture shows next to its border is made up in part: demosaicing, sharpening and lens blur lack
    # their neighbours there.
    rim = np.ceil(2 * blur_px)
    sound = np.all((uv_px >= rim) & (uv_px <= np.array([[width - 1], [height - 1]]) - rim), axis=0)
    uv_px, light = uv_px[:, sound], light[sound]
    if len(light) < 20:
        return None
    inverse = np.linalg.inv(shape_px2)
    p = np.array([u, v, 0.0])
    steps = np.array([1e-3, 1e-3, 1e-4])

    def model(p: FloatArray) -> FloatArray:
        d = uv_px - p[:2, None]
        rho = np.sqrt(np.maximum(np.einsum("in,ij,jn->n", d, inverse, d), 1e-12)) * np.exp(-p[2])
        return np.asarray(ndtr(np.hypot(d[0], d[1]) * (1 / rho - 1) / max(blur_px, 0.3)))

    for _ in range(MAX_STEPS):
        residual = light - model(p)
        J = np.stack(
            [(model(p + h) - model(p - h)) / (2 * s) for h, s in zip(np.diag(steps), steps, strict=True)]
        )
        normal = J @ J.T
        if np.linalg.cond(normal * np.outer(1 / np.sqrt(np.diag(normal) + 1e-12), 1)) > 1e8:
            return None
        step = np.linalg.solve(normal, J @ residual)
        p = p + np.clip(step, -2.0, 2.0)
        if np.abs(step[:2]).max() < CONVERGED_PX:
            break
    else:
        return None
    inside = min(p[0] / half_u, p[1] / half_v, (width - 1 - p[0]) / half_u, (height - 1 - p[1]) / half_v)
    rms = float(np.sqrt(np.mean(residual**2)))
    if abs(p[2]) > MAX_SIZE_CHANGE or inside < MIN_CENTRE_INSIDE or rms > max(MAX_RMS, 2 * noise):
        return None
    cov = np.linalg.inv(normal)[:2, :2] * noise**2 + MODEL_ERROR_PX**2 * np.eye(2)
    return CompletedDot(p[:2].copy(), cov, shape_px2 * np.exp(2 * p[2]), rms)
