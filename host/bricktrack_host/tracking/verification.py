"""What makes an identity believed, whichever way it was proposed: a pose that explains the blobs.

`verify` fits a pose and keeps the LEDs whose blobs it explains. Where two assignments explain the picture
equally well, that is the answer; none is chosen.
"""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_host.tracking.finite import all_finite
from bricktrack_host.tracking.prsoi import prsoi_starts
from bricktrack_host.tracking.refine import RefinedPoses, refine_poses
from bricktrack_host.tracking.segment import Blobs

MIN_INLIERS = 4
MIN_FACING = 0.05
"""Cosine between an LED's axis and the line of sight below which it is not believed to be seen."""
_IDENTITY_SD_PX = 1.5
"""Trust in a blob while identities are decided: far above centroid noise, so that rolling shutter and an
unfitted profile do not refuse a true assignment, far below the distance between two LEDs."""


@dataclass(frozen=True, slots=True, eq=False)
class Correspondence:
    """Identities in one picture, verified by a pose, or why there are none.

    Attributes
    ----------
    blob_of_led : ndarray of int64, shape (n_leds,)
        Index of the blob, -1 where the LED was not found.
    R_camera_brick, t_camera_brick_mm : ndarray, shapes (3, 3) and (3,)
        The pose that verified it; NaN where there is none.
    rms_px : float
        Of its residuals; NaN where there is none.
    is_ambiguous : bool
        Another assignment or pose fits as well.
    reason : str
        In words, why there is no assignment; empty where there is one.
    """

    blob_of_led: IntArray
    R_camera_brick: FloatArray
    t_camera_brick_mm: FloatArray
    rms_px: float
    is_ambiguous: bool
    reason: str

    @property
    def n_found(self) -> int:
        """Number of LEDs with a blob."""
        return int((self.blob_of_led >= 0).sum())


def no_correspondence(n_leds: int, reason: str, *, ambiguous: bool = False) -> Correspondence:
    """Return the answer "none", with its reason."""
    return Correspondence(
        blob_of_led=np.full(n_leds, -1, dtype=np.int64),
        R_camera_brick=np.full((3, 3), np.nan),
        t_camera_brick_mm=np.full(3, np.nan),
        rms_px=float("nan"),
        is_ambiguous=ambiguous,
        reason=reason,
    )


def verified_correspondence(blob_of_led: IntArray, poses: RefinedPoses, i: int) -> Correspondence:
    """Return an assignment with the ``i``-th of the poses, which explains it."""
    r = poses.residual_px[i][blob_of_led >= 0]
    return Correspondence(
        blob_of_led=blob_of_led,
        R_camera_brick=poses.R_camera_brick[i],
        t_camera_brick_mm=poses.t_camera_brick_mm[i],
        rms_px=float(np.sqrt(np.mean(np.sum(r**2, axis=-1)))),
        is_ambiguous=False,
        reason="",
    )


def verify(
    uv_px: FloatArray,
    starts: tuple[FloatArray, FloatArray] | None,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    collar_mm: float | None,
    gate_px: float,
) -> tuple[BoolArray, RefinedPoses]:
    """Fit poses to assignments and keep the LEDs that each pose explains.

    Parameters
    ----------
    uv_px : ndarray, shape (n, n_leds, 2), px
        The blob of each LED under each hypothesis; NaN for none.
    starts : (R, t) or None
        Shapes (n, 3, 3) and (n, 3); `None`: by PRSOI.
    gate_px : float
        Largest residual that is believed.

    Returns
    -------
    kept : ndarray of bool, shape (n, n_leds)
        All false where fewer than four LEDs remain.
    poses : RefinedPoses
    """
    uv = uv_px.copy()
    n = len(uv)
    R, t = starts if starts is not None else prsoi_starts(uv, ray_model, brick_model)
    cov = np.broadcast_to(_IDENTITY_SD_PX**2 * np.eye(2), (n, brick_model.n_leds, 2, 2))
    poses = refine_poses(uv, cov, R, t, ray_model, brick_model, collar_mm=collar_mm, max_steps=6)
    for last in (False, False, True):
        length = np.linalg.norm(poses.residual_px, axis=-1)
        seen = all_finite(uv)
        bad = seen & ~((length <= gate_px) & (poses.facing > MIN_FACING))
        rows = np.flatnonzero(bad.any(axis=1))
        if rows.size == 0:
            break
        if last:
            uv[rows] = np.nan
            break
        # One at a time, the worst: a false blob drags its neighbours' residuals with it.
        worst = np.where(bad[rows], np.nan_to_num(length[rows], nan=np.inf), -1.0)
        uv[rows, worst.argmax(axis=1)] = np.nan
        again = refine_poses(
            uv[rows],
            cov[rows],
            np.where(np.isfinite(poses.R_camera_brick[rows]), poses.R_camera_brick[rows], R[rows]),
            np.where(np.isfinite(poses.t_camera_brick_mm[rows]), poses.t_camera_brick_mm[rows], t[rows]),
            ray_model,
            brick_model,
            collar_mm=collar_mm,
            max_steps=6,
        )
        poses = poses.replaced(rows, again)
    kept = all_finite(uv)
    kept[kept.sum(axis=1) < MIN_INLIERS] = False
    return kept, poses


def blob_pixels(blobs: Blobs, blob_of_led: IntArray) -> FloatArray:
    """Return the blobs' centroids in the order of the LEDs, shape (..., n_leds, 2), NaN for none."""
    return np.where((blob_of_led >= 0)[..., None], blobs.uv_px[np.maximum(blob_of_led, 0)], np.nan)


def identity_gate_px(radius_px: float) -> float:
    """Return the residual up to which a blob is believed to be its LED: a third of its radius, over 4 px.

    An unfitted profile shifts centroids by up to a fifth of the radius, a rolling shutter by more at times;
    LEDs are more than three radii apart.
    """
    return max(4.0, radius_px / 3)
