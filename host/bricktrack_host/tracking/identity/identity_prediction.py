"""Where an LED is seen by all that is known but its own light, and how well.

Known are the frame's other LEDs, each at its own row's instant; how the run moves within the frame; and where
the neighbouring frames show the brick, as far as they usually do. All are small corrections to the frame's
pose and twist, solved for together.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import percentile_filter

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix
from bricktrack_host.tracking.identity.identity_motion import RunMotion
from bricktrack_host.tracking.identity.run_identities import RunIdentities
from bricktrack_host.tracking.identity.verification import motion_of
from bricktrack_host.tracking.led_model.led_profile import predict_brick
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.neighbour_poses import poses_between, turn_between

_NEAR_FRAMES, _USUAL_PERCENT = 31, 90
_CONTRADICTED = 25.0  # chi-square of six, one in 3000: an impact, and the neighbours do not show the frame
_FLOOR = np.array([1e-4, 0.01])  # rad, mm: of poses between others
_ANYWHERE = np.repeat([1.0, 100.0], 3)  # rad, mm
_STILL = np.repeat([1e-3, 0.1], 3)  # rad/s, mm/s
_FITS = 4.0  # chi-square over its freedom
_STEPS = 2


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What lights of LEDs are beside where all else shows the LEDs.

    Attributes
    ----------
    residual_px : ndarray, shape (m, 2), px
    covariance_px2 : ndarray, shape (m, 2, 2), px^2
        Of the light's place and of what is known.
    log_area_ratio : ndarray, shape (m,)
        Logarithm of the area over the predicted one, less what the frame's other LEDs have in common.
    others_fit : ndarray of bool, shape (m,)
        The frame's other LEDs are where all that is known shows them.
    """

    residual_px: FloatArray
    covariance_px2: FloatArray
    log_area_ratio: FloatArray
    others_fit: BoolArray


def shown_by_the_rest(
    run: RunIdentities, frames: IntArray, leds: IntArray, usual_px: FloatArray, *, still: bool = False
) -> Shown:
    """Return how the lights of LEDs, one in each of some frames, lie to where all else shows them.

    Parameters
    ----------
    frames, leds : ndarray of int64, shape (m,)
    usual_px : ndarray, shape (n,)
        What residuals usually scatter by about each frame of the run.
    still : bool
        True: not moving within the frames, wherever the neighbours show the brick.
    """
    motion = run.motion()
    lights = run.lights_of(frames)
    row = np.arange(frames.size)
    others = all_finite(lights.uv_px) & lights.is_whole
    others[row, leds] = False
    noise = np.where(all_finite(lights.uv_px)[..., None, None], lights.cov_px2, 0.0)
    noise = noise + (usual_px[frames] ** 2)[:, None, None, None] * np.eye(2)
    weight = np.where(others[..., None, None], np.linalg.inv(noise), 0.0)
    fit = _Fit(run, motion, frames, lights.uv_px, weight, still=still)
    fit.solve(None)
    if not still:
        fit.solve(_by_neighbours(run, frames, fit))
    r = np.where(others[..., None], fit.residual_px, 0.0)
    chi2 = np.einsum("nli,nlij,nlj->n", r, weight, r)
    J = fit.J[row, leds]
    ratio = np.log(lights.area_px2 / fit.area_px2)
    common = np.array([np.median(x[o]) if o.any() else 0.0 for x, o in zip(ratio, others, strict=True)])
    return Shown(
        residual_px=fit.residual_px[row, leds],
        covariance_px2=noise[row, leds] + J @ fit.covariance @ np.swapaxes(J, -1, -2),
        log_area_ratio=ratio[row, leds] - common,
        others_fit=chi2 < _FITS * np.maximum(2 * others.sum(axis=1) - 6, 1),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Prior:
    """Poses that others show frames in, (m, 3, 3) and (m, 3), and the inverse covariance, (m, 6, 6)."""

    R_camera_brick: FloatArray
    t_camera_brick_mm: FloatArray
    information: FloatArray


class _Fit:
    """Least squares for pose and twist of some frames, by Gauss and Newton, from the run's motion."""

    def __init__(
        self,
        run: RunIdentities,
        motion: RunMotion,
        frames: IntArray,
        uv_px: FloatArray,
        weight: FloatArray,
        *,
        still: bool,
    ) -> None:
        self._run, self._uv_px, self._weight = run, uv_px, weight
        self._within = motion_of(motion.within, frames)
        assert self._within.twist_sd is not None  # noqa: S101 - of a run
        twist_sd = np.where(still, _STILL, self._within.twist_sd)
        self._moves = 0.0 if still else 1.0
        self._known = 1 / np.concatenate([np.tile(_ANYWHERE, (frames.size, 1)), twist_sd], axis=1) ** 2
        self.R, self.t_mm = motion.R_camera_brick[frames], motion.t_camera_brick_mm[frames]
        self._twist = np.zeros((frames.size, 6))
        self._linearise()

    def solve(self, prior: _Prior | None) -> None:
        """Take the steps that the lights ask for, and a prior."""
        for _ in range(_STEPS):
            A = np.einsum("nlic,nlij,nljd->ncd", self.J, self._weight, self.J)
            r = np.where(np.isfinite(self.residual_px), self.residual_px, 0.0)
            g = np.einsum("nlic,nlij,nlj->nc", self.J, self._weight, r)
            A[:, range(12), range(12)] += self._known
            g[:, 6:] -= self._known[:, 6:] * self._twist
            if prior is not None:
                A[:, :6, :6] += prior.information
                g[:, :6] += np.einsum("nij,nj->ni", prior.information, self.to(prior))
            self.covariance = np.linalg.inv(A)
            step = np.einsum("nij,nj->ni", self.covariance, g)
            self.R = self.R @ matrix_from_rvec(step[:, :3])
            self.t_mm = self.t_mm + step[:, 3:6]
            self._twist = self._twist + step[:, 6:]
            self._linearise()

    def to(self, prior: _Prior) -> FloatArray:
        """Return the steps, (m, 6), from the present poses to others."""
        turn = rvec_from_matrix(np.swapaxes(self.R, -1, -2) @ prior.R_camera_brick)
        return np.concatenate([turn, prior.t_camera_brick_mm - self.t_mm], axis=1)

    def _linearise(self) -> None:
        dt = self._within.dt_s[..., None]
        rvec = self._moves * self._within.rvec_brick_rad + self._twist[:, None, :3] * dt
        shift = self._moves * self._within.shift_camera_mm + self._twist[:, None, 3:] * dt
        prediction, J = predict_brick(
            self.R[:, None] @ matrix_from_rvec(rvec),
            self.t_mm[:, None] + shift,
            self._run.ray_model,
            self._run.brick_model,
            collar_mm=self._run.collar_mm,
        )
        self.J = np.concatenate([J, J * dt[..., None]], axis=-1)
        self.residual_px = self._uv_px - prediction.uv_px
        self.area_px2 = prediction.area_px2


def _by_neighbours(run: RunIdentities, frames: IntArray, fit: _Fit) -> _Prior:
    """Return where neighbours show frames, trusted as far as they usually do; not against the lights."""
    R, t_mm = run.found.R_camera_brick, run.found.t_camera_brick_mm
    between_R, between_t = poses_between(run.stamps_ns, R, t_mm)
    off = np.stack([turn_between(R, between_R), np.linalg.norm(t_mm - between_t, axis=1)], axis=1)
    judged = np.flatnonzero(np.isfinite(off).all(axis=1))
    prior = _Prior(between_R[frames], between_t[frames], np.zeros((frames.size, 6, 6)))
    if judged.size == 0:
        prior.R_camera_brick[:], prior.t_camera_brick_mm[:] = np.eye(3), 0.0
        return prior
    usual = np.stack([percentile_filter(x[judged], _USUAL_PERCENT, _NEAR_FRAMES) for x in off.T], axis=1)
    at = np.arange(len(R))
    sd = np.stack([np.interp(at, judged, u) for u in usual.T], axis=1)[frames]
    P = np.repeat(np.maximum(sd, _FLOOR), 3, axis=1)[..., None] ** 2 * np.eye(6)
    known = all_finite(between_R[frames], 2)
    prior.R_camera_brick[~known], prior.t_camera_brick_mm[~known] = np.eye(3), 0.0
    d = fit.to(prior)
    chi2 = np.einsum("ni,nij,nj->n", d, np.linalg.inv(fit.covariance[:, :6, :6] + P), d)
    use = known & (chi2 < _CONTRADICTED)
    prior.information[use] = np.linalg.inv(P[use])
    return prior
