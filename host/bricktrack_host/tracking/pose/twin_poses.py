"""The other pose that LEDs in a plane have: mirrored about the line of sight, and nearly as good a fit.

From far away a plane tilted to either side looks the same. What tells the two poses apart is perspective
alone, often less than what a frame's own motion moves its LEDs by: so both are fitted with the same motion.
"""

from collections.abc import Callable

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.normalised_errors import normalised_squares
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.first_poses import RIVAL_CHI2, SAME_POSE_RAD, believe_neighbours
from bricktrack_host.tracking.pose.refine import MIN_LEDS, RefinedPoses

_FLAT_SHARE = 0.1  # of their lesser extent in the plane: beyond it a mirrored pose is off by many pixels
_COVERED_SIGMAS = 3.0

FitFrames = Callable[[IntArray, FloatArray, FloatArray], RefinedPoses]
"""Fits some frames of a run, from attitudes and places to start from."""


def better_of_twins(
    poses: RefinedPoses,
    uv_px: FloatArray,
    t_ns: IntArray,
    fit: FitFrames,
    centre_mm: FloatArray,
    brick_model: BrickModel,
) -> tuple[RefinedPoses, BoolArray]:
    """Return the better of each frame's two poses, and which frames have two that nothing tells apart.

    Parameters
    ----------
    poses : RefinedPoses
        Of n frames, as ``fit`` gives them.
    uv_px : ndarray, shape (n, n_leds, 2), px
        The centroids fitted; NaN where an LED is not seen or not used.
    t_ns : ndarray of int64, shape (n,)
        Instants of the frames.
    fit : callable
        With it the other poses are fitted, from where the mirror puts them.
    centre_mm : ndarray, shape (3,), mm
        What the lines of sight start from, camera axes.
    brick_model : BrickModel

    Notes
    -----
    Where the pixels leave both (chi-square apart by less than three sigma, attitudes by more than the
    covariance covers), the frame beside it decides as in `first_poses`.
    """
    R, t_mm = mirrored_poses(
        all_finite(uv_px), poses.R_camera_brick, poses.t_camera_brick_mm, centre_mm, brick_model
    )
    is_open = np.zeros(len(uv_px), dtype=np.bool_)
    frames = np.flatnonzero(all_finite(R, 2) & np.isfinite(poses.chi2))
    if frames.size == 0:
        return poses, is_open
    twins, own = fit(frames, R[frames], t_mm[frames]), poses.take(frames)
    better = np.flatnonzero(_chi2(twins) < _chi2(own))
    own, twins = own.replaced(better, twins.take(better)), twins.replaced(better, own.take(better))
    poses = poses.replaced(frames, own)
    rival = np.flatnonzero(_is_rival(own, twins, uv_px[frames]))
    if rival.size == 0:
        return poses, is_open
    frames, own, twins = frames[rival], own.take(rival), twins.take(rival)
    is_open[frames] = True
    chosen_R, chosen_t_mm = poses.R_camera_brick.copy(), poses.t_camera_brick_mm.copy()
    both_R = np.stack([own.R_camera_brick, twins.R_camera_brick], axis=1)
    both_t_mm = np.stack([own.t_camera_brick_mm, twins.t_camera_brick_mm], axis=1)
    alike = np.zeros((frames.size, 2))  # their chi-squares
    believe_neighbours(is_open, chosen_R, chosen_t_mm, both_R, both_t_mm, alike, frames, t_ns)
    turned = np.flatnonzero((chosen_R[frames] != own.R_camera_brick).any(axis=(1, 2)))
    return poses.replaced(frames[turned], twins.take(turned)), is_open


def _chi2(poses: RefinedPoses) -> FloatArray:
    """Return chi-squares, infinite where there is no pose or it would hide an LED that is seen."""
    hides = (np.where(np.isfinite(poses.facing), poses.facing, 1.0) <= 0).any(axis=1)
    return np.where(np.isfinite(poses.chi2) & ~hides, poses.chi2, np.inf)


def _is_rival(own: RefinedPoses, twins: RefinedPoses, uv_px: FloatArray) -> BoolArray:
    """Tell which twins fit nearly as well, at an attitude that the frame's covariance does not cover."""
    spare = np.maximum(2.0 * all_finite(uv_px).sum(axis=1) - 6.0, 1.0)
    scale = np.maximum(own.chi2 / spare, 1.0)
    out = np.asarray(_chi2(twins) < own.chi2 + RIVAL_CHI2 * scale)
    rows = np.flatnonzero(out)
    turn = rvec_from_matrix(np.swapaxes(own.R_camera_brick[rows], 1, 2) @ twins.R_camera_brick[rows])
    of_attitude = own.covariance[rows, :3, :3] * scale[rows, None, None]
    is_covered = normalised_squares(turn, of_attitude) <= _COVERED_SIGMAS**2  # not where that is singular
    out[rows] = (np.linalg.norm(turn, axis=1) > SAME_POSE_RAD) & ~is_covered
    return out


def mirrored_poses(
    seen: BoolArray,
    R_camera_brick: FloatArray,
    t_camera_brick_mm: FloatArray,
    centre_mm: FloatArray,
    brick_model: BrickModel,
) -> tuple[FloatArray, FloatArray]:
    """Return where to look for the other pose of frames whose seen LEDs lie in a plane.

    Parameters
    ----------
    seen : ndarray of bool, shape (n, n_leds)
        LEDs that the poses rest on.
    R_camera_brick, t_camera_brick_mm : ndarray, shapes (n, 3, 3) and (n, 3)
    centre_mm : ndarray, shape (3,), mm
        What the lines of sight start from, camera axes.
    brick_model : BrickModel

    Returns
    -------
    R_camera_brick, t_camera_brick_mm : ndarray, shapes (n, 3, 3) and (n, 3)
        NaN where the LEDs do not lie in a plane, or there was no pose.

    Notes
    -----
    Depths about the LEDs' middle change their sign: the mirror across the line of sight, times the mirror in
    the LEDs' plane, which leaves them where they are and makes it a rotation.
    """
    R_out, t_out = np.full_like(R_camera_brick, np.nan), np.full_like(t_camera_brick_mm, np.nan)
    for pattern in np.unique(seen, axis=0):
        if pattern.sum() < MIN_LEDS:
            continue
        places_mm = brick_model.led_positions_mm[pattern]
        middle_mm = places_mm.mean(axis=0)
        _, extent, axes = np.linalg.svd(places_mm - middle_mm, full_matrices=False)
        if extent[2] > _FLAT_SHARE * extent[1]:
            continue
        rows = np.flatnonzero((seen == pattern).all(axis=1))
        R = R_camera_brick[rows]
        middle_seen_mm = t_camera_brick_mm[rows] + R @ middle_mm
        sight = middle_seen_mm - centre_mm
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        across_sight = np.eye(3) - 2 * sight[:, :, None] * sight[:, None, :]
        in_plane = np.eye(3) - 2 * np.outer(axes[2], axes[2])
        R_out[rows] = across_sight @ R @ in_plane
        t_out[rows] = middle_seen_mm - R_out[rows] @ middle_mm
    return R_out, t_out
