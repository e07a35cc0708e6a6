"""Poses that fit the pixels best: Gauss-Newton from a start, robust, batched over frames, with covariance.

The residual of an LED is its centroid less the predicted one (`led_profile`), weighted by the centroid's
covariance, and taken at the LED's own instant: the caller gives how far the brick has moved between the
frame's instant and the LED's.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray, rows_of, with_rows
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import TrackingError
from bricktrack_host.tracking.led_model.hit_polynomials import hit_polynomials
from bricktrack_host.tracking.led_model.led_outline import outlines_of
from bricktrack_host.tracking.led_model.led_profile import shift_per_radius
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.reduced_kernel import reduce_frames
from bricktrack_host.tracking.pose.refine_equations import RATE_PER_TWIST
from bricktrack_host.tracking.pose.refine_kernel import fit_frames
from bricktrack_host.tracking.pose.refine_problem import (
    N_MORE,
    N_UNKNOWNS,
    PROFILE,
    TWIST,
    Fitted,
    Model,
    Observed,
    room_for,
)

HUBER_SIGMAS = 2.5
"""Length of a whitened 2-D residual beyond which its pull grows no more; 4 % of normal ones are longer."""
OUTLIER_SIGMAS = 5.0
MIN_LEDS = 4
OWN_SHARE = 0.5
"""Of what the profile leaves unknown, each LED's own part beside the common one: bodies between a bare
hemisphere and one with a collar of 2 r / 3, seen at 5 to 57 degrees, differ so much from one factor."""
_CHUNK_FRAMES = 1024  # what one thread takes at a time


@dataclass(frozen=True, slots=True, eq=False)
class LedMotion:
    """How the brick at each LED's instant differs from the brick at the frame's.

    Attributes
    ----------
    rvec_brick_rad : ndarray, shape (n, n_leds, 3), rad
        ``R_led = R @ Exp(rvec)``.
    shift_camera_mm : ndarray, shape (n, n_leds, 3), mm
        ``t_led = t + shift``.
    dt_s : ndarray, shape (n, n_leds), s
        From the frame's instant to the LED's.
    twist_sd : ndarray, shape (n, 6), rad/s and mm/s, or None
        How well that motion is known, as a twist, and with it the twist's rate: the frame's own rows then
        correct both, as far as they can. `None`: the motion is taken as given.
    jump_sd : ndarray, shape (n, 6), rad/s and mm/s, or None
        How far a change of velocity may go that is sudden, as at an impact; `None`: not known.
    """

    rvec_brick_rad: FloatArray
    shift_camera_mm: FloatArray
    dt_s: FloatArray
    twist_sd: FloatArray | None = None
    jump_sd: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RefinedPoses:
    """Fitted poses, one a frame.

    Attributes
    ----------
    R_camera_brick : ndarray, shape (n, 3, 3)
        NaN where there is none: fewer than four LEDs, no start, or no convergence.
    t_camera_brick_mm : ndarray, shape (n, 3), mm
    covariance : ndarray, shape (n, 6, 6)
        Of ``[dtheta rad, dt mm]``, `bricktrack_host.tracks`.
    by_centroids : ndarray, shape (n, 6, 6)
        What of it is by the errors of single LEDs' centroids; the rest is by profile and twist.
    by_profile : ndarray, shape (n, 6)
        Change of the pose by one standard deviation of what the profile leaves unknown in all LEDs alike.
    residual_px : ndarray, shape (n, n_leds, 2), px
        Seen less predicted, for every seen LED, also those weighted down.
    sigmas : ndarray, shape (n, n_leds)
        Length of the whitened residual; NaN where not seen.
    is_outlier : ndarray of bool, shape (n, n_leds)
        Beyond `OUTLIER_SIGMAS`.
    chi2 : ndarray, shape (n,)
        Robust (Huber) cost, twice: about ``2 n_used - 6`` where the model holds.
    n_used : ndarray of int, shape (n,)
    area_px2, facing : ndarray, shape (n, n_leds)
        Predicted, see `led_profile.LedPrediction`; NaN where not seen.
    """

    R_camera_brick: FloatArray
    t_camera_brick_mm: FloatArray
    covariance: FloatArray
    by_centroids: FloatArray
    by_profile: FloatArray
    residual_px: FloatArray
    sigmas: FloatArray
    is_outlier: BoolArray
    chi2: FloatArray
    n_used: FloatArray
    area_px2: FloatArray
    facing: FloatArray

    def take(self, rows: IntArray) -> "RefinedPoses":
        """Return the poses of some frames."""
        return rows_of(self, rows)

    def replaced(self, rows: IntArray, by: "RefinedPoses") -> "RefinedPoses":
        """Return these poses with those of some frames replaced."""
        return with_rows(self, rows, by)


def refine_poses(
    uv_px: FloatArray,
    cov_px2: FloatArray,
    R_start: FloatArray,
    t_start_mm: FloatArray,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    collar_mm: float | None,
    motion: LedMotion | None = None,
    max_steps: int = 12,
    profile_is_exact: bool = False,
    n_threads: int = 1,
) -> RefinedPoses:
    """Fit poses to centroids.

    Parameters
    ----------
    uv_px : ndarray, shape (n, n_leds, 2), px
        Centroids; NaN where an LED is not seen or not to be used.
    cov_px2 : ndarray, shape (n, n_leds, 2, 2), px^2
    R_start, t_start_mm : ndarray, shapes (n, 3, 3) and (n, 3)
        Starts, from `prsoi` or a track; frames with NaN get no pose.
    ray_model : RayModel
    brick_model : BrickModel
    collar_mm : float or None
        The LEDs' fitted profile; `None` widens the covariance.
    motion : LedMotion, optional
        Rolling shutter; default none.
    max_steps : int
        Frames stop when their step is a thousandth of their uncertainty; two to four do from PRSOI.
    profile_is_exact : bool
        True: no uncertainty of the profile, for fitting it and for tests.
    n_threads : int
        That share the frames of large batches; the poses are the same for any number.

    Notes
    -----
    Levenberg-Marquardt damping frame by frame, so that no step raises the Huber cost. What the profile leaves
    unknown shifts all LEDs of a type alike: it is one more unknown of the frame, with its prior; in part it
    differs from LED to LED, as their views do, and adds to their covariances. The pose's covariance is its
    block of the inverse of the normal matrix with the robust weights, undamped.
    """
    n, n_leds = uv_px.shape[:2]
    if uv_px.shape != (n, brick_model.n_leds, 2) or cov_px2.shape != (n, n_leds, 2, 2):
        raise TrackingError(
            f"centroids have shape {uv_px.shape} and covariances {cov_px2.shape} for "
            f"{brick_model.n_leds} LEDs; expected (n, n_leds, 2) and (n, n_leds, 2, 2)"
        )
    seen = all_finite(uv_px) & all_finite(cov_px2, 2)
    started = all_finite(R_start, 2) & all_finite(t_start_mm)
    model = _model(ray_model, brick_model, collar_mm, profile_is_exact)
    out = _started(R_start, t_start_mm, n_leds)
    out.cost[~started | (seen.sum(axis=1) < MIN_LEDS)] = np.nan

    def fit(first: int) -> None:
        rows = slice(first, first + _CHUNK_FRAMES)
        observed = _observed(uv_px, cov_px2, seen, motion, rows)
        fit_frames(observed, model, Fitted(*(field[rows] for field in out)), room_for(n_leds), max_steps)

    firsts = range(0, n, _CHUNK_FRAMES)
    if n_threads > 1 and len(firsts) > 1:
        with ThreadPoolExecutor(n_threads) as pool:
            list(pool.map(fit, firsts))
    else:
        for first in firsts:
            fit(first)
    missing = ~np.isfinite(out.cost)
    for field in out:
        field[missing] = np.nan
    with np.errstate(invalid="ignore"):
        is_outlier = np.asarray(out.sigmas > OUTLIER_SIGMAS)
    return RefinedPoses(
        R_camera_brick=out.R,
        t_camera_brick_mm=out.t,
        covariance=out.covariance[:, :6].copy(),
        by_centroids=_by_centroids(out.covariance, motion),
        by_profile=out.covariance[:, PROFILE].copy(),
        residual_px=out.residual,
        sigmas=out.sigmas,
        is_outlier=is_outlier,
        chi2=out.cost,
        n_used=np.asarray((np.isfinite(out.sigmas) & ~is_outlier).sum(axis=1), dtype=np.float64),
        area_px2=out.area,
        facing=out.facing,
    )


def pose_equations(
    uv_px: FloatArray,
    cov_px2: FloatArray,
    R: FloatArray,
    t_mm: FloatArray,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    collar_mm: float | None,
    motion: LedMotion,
) -> tuple[FloatArray, FloatArray]:
    """Return normal matrices, (n, 6, 6), and right sides, (n, 6), of what poses to expand about are off by.

    Profile and twist are taken out of them. Parameters are those of `refine_poses`, steps are ``[dtheta rad,
    dt mm]`` of `bricktrack_host.tracks`; frames that tell nothing have zeros.
    """
    observed = _observed(uv_px, cov_px2, all_finite(uv_px) & all_finite(cov_px2, 2), motion, slice(None))
    fitted = _started(R, t_mm, uv_px.shape[1])
    A, g = np.zeros((len(R), 6, 6)), np.zeros((len(R), 6))
    model = _model(ray_model, brick_model, collar_mm, False)
    reduce_frames(observed, model, fitted, room_for(uv_px.shape[1]), A, g)
    return A, g


def _by_centroids(with_pose: FloatArray, motion: LedMotion | None) -> FloatArray:
    """Return what centroids' own errors make of the covariance: what the unknowns' priors do not, (n, 6, 6).

    With N the normal matrix and D the inverse covariance of the priors, ``N^-1 = N^-1 (N - D) N^-1 +
    N^-1 D N^-1``: the former is of the centroids.
    """
    at_profile = with_pose[:, PROFILE]
    out = with_pose[:, :6] - at_profile[:, :, None] * at_profile[:, None, :]
    if motion is not None and motion.twist_sd is not None:
        sd = np.concatenate([motion.twist_sd, RATE_PER_TWIST * motion.twist_sd], axis=1)
        by_twist = with_pose[:, TWIST:] / sd[:, :, None]
        out -= np.swapaxes(by_twist, 1, 2) @ by_twist
    return np.asarray(out)


def _model(
    ray_model: RayModel, brick_model: BrickModel, collar_mm: float | None, profile_is_exact: bool
) -> Model:
    polynomials = hit_polynomials(ray_model)
    outlines = outlines_of(brick_model.led_radii_mm, collar_mm)
    return Model(
        P=np.ascontiguousarray(brick_model.led_positions_mm),
        N=np.ascontiguousarray(brick_model.led_axes),
        radii=np.ascontiguousarray(brick_model.led_radii_mm),
        tables=outlines.tables,
        kind=outlines.kind,
        shift_per_radius=shift_per_radius(collar_mm, brick_model),
        profile_sd=0.0 if profile_is_exact else 1.0,
        own_sd=OWN_SHARE,
        cells=polynomials.cells,
        cell_px=polynomials.cell_px,
        plane_a=float(polynomials.plane_a_mm),
        apart=float(polynomials.plane_b_mm - polynomials.plane_a_mm),
        huber=HUBER_SIGMAS,
    )


def _observed(
    uv: FloatArray, cov: FloatArray, seen: BoolArray, motion: LedMotion | None, rows: slice
) -> Observed:
    n_leds = seen.shape[1]
    if motion is None:
        nothing = np.empty((0, n_leds, 3))
        rvec, shift, dt, twist_sd = nothing, nothing, nothing[..., 0], None
    else:
        rvec, shift, dt = motion.rvec_brick_rad[rows], motion.shift_camera_mm[rows], motion.dt_s[rows]
        twist_sd = None if motion.twist_sd is None else motion.twist_sd[rows]
    return Observed(
        uv=np.ascontiguousarray(uv[rows], dtype=np.float64),
        cov=np.ascontiguousarray(cov[rows], dtype=np.float64),
        seen=seen[rows],
        has_motion=motion is not None,
        rvec=np.ascontiguousarray(rvec),
        shift=np.ascontiguousarray(shift),
        dt=np.ascontiguousarray(dt),
        has_twist=twist_sd is not None,
        twist_sd=np.empty((0, 6)) if twist_sd is None else np.ascontiguousarray(twist_sd),
    )


def _started(R: FloatArray, t_mm: FloatArray, n_leds: int) -> Fitted:
    n = len(R)
    return Fitted(
        R=np.array(R, dtype=np.float64, order="C"),
        t=np.array(t_mm, dtype=np.float64, order="C"),
        more=np.zeros((n, N_MORE)),
        covariance=np.zeros((n, N_UNKNOWNS, 6)),
        residual=np.full((n, n_leds, 2), np.nan),
        sigmas=np.full((n, n_leds), np.nan),
        cost=np.zeros(n),
        area=np.full((n, n_leds), np.nan),
        facing=np.full((n, n_leds), np.nan),
    )
