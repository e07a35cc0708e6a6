"""Poses that fit the pixels best: Gauss-Newton from a start, robust, batched over frames, with covariance.

The residual of an LED is its centroid less the predicted one (`led_profile`), weighted by the centroid's
covariance, and taken at the LED's own instant: the caller gives how far the brick has moved between the
frame's instant and the LED's.
"""

from dataclasses import dataclass, fields

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import TrackingError
from bricktrack_common.rotations import matrix_from_rvec
from bricktrack_host.tracking.finite import all_finite
from bricktrack_host.tracking.led_profile import LedPrediction, LensTerms, predict_brick

HUBER_SIGMAS = 2.5
"""Length of a whitened 2-D residual beyond which its pull grows no more; 4 % of normal ones are longer."""
OUTLIER_SIGMAS = 5.0
MIN_LEDS = 4
_LENS_MM, _LENS_RAD = 0.5, 0.02
"""Moved less than this, the lens terms of the start are good to 0.002 px."""
_DONE_SIGMAS = 1e-3  # a last step this small, and the next smaller still, is far below the pose's own error


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
        How well that motion is known, as a twist: the frame's own rows then correct it, as far as they can.
        `None`: it is taken as given.
    """

    rvec_brick_rad: FloatArray
    shift_camera_mm: FloatArray
    dt_s: FloatArray
    twist_sd: FloatArray | None = None


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
        Predicted, see `led_profile.LedPrediction`.
    """

    R_camera_brick: FloatArray
    t_camera_brick_mm: FloatArray
    covariance: FloatArray
    residual_px: FloatArray
    sigmas: FloatArray
    is_outlier: BoolArray
    chi2: FloatArray
    n_used: FloatArray
    area_px2: FloatArray
    facing: FloatArray

    def replaced(self, rows: IntArray, by: "RefinedPoses") -> "RefinedPoses":
        """Return these poses with those of some frames replaced."""
        values = {f.name: getattr(self, f.name).copy() for f in fields(self)}
        for name, value in values.items():
            value[rows] = getattr(by, name)
        return RefinedPoses(**values)


@dataclass(frozen=True, slots=True, eq=False)
class _Evaluation:
    cost: FloatArray
    A: FloatArray
    g: FloatArray
    shift: FloatArray
    residual: FloatArray
    sigmas: FloatArray
    area: FloatArray
    facing: FloatArray
    lens: LensTerms

    def put(self, rows: IntArray, by: "_Evaluation", which: BoolArray | slice) -> None:
        """Replace the frames ``rows`` by the frames ``which`` of another evaluation."""
        for name in ("cost", "A", "g", "shift", "residual", "sigmas", "area", "facing"):
            getattr(self, name)[rows] = getattr(by, name)[which]


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

    Notes
    -----
    Levenberg-Marquardt damping frame by frame, so that no step raises the Huber cost. The covariance is the
    inverse of the normal matrix with the robust weights, undamped. An unfitted LED profile shifts all LEDs of
    a type alike, so its part of the covariance is that of one common unknown, not of independent ones.
    """
    n, n_leds = uv_px.shape[:2]
    if uv_px.shape != (n, brick_model.n_leds, 2) or cov_px2.shape != (n, n_leds, 2, 2):
        raise TrackingError(
            f"centroids have shape {uv_px.shape} and covariances {cov_px2.shape} for "
            f"{brick_model.n_leds} LEDs; expected (n, n_leds, 2) and (n, n_leds, 2, 2)"
        )
    out = _nothing(n, n_leds)
    seen = all_finite(uv_px) & all_finite(cov_px2, 2)
    started = all_finite(R_start, 2) & all_finite(t_start_mm)
    frames = np.flatnonzero((seen.sum(axis=1) >= MIN_LEDS) & started)
    if frames.size == 0:
        return out
    state_R, state_t = R_start[frames].copy(), t_start_mm[frames].copy()
    start = _State(state_R, state_t, np.zeros((frames.size, 6)))
    problem = _Problem(uv_px, cov_px2, seen, ray_model, brick_model, collar_mm, profile_is_exact, motion)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        # A false start may put LEDs beside or behind the pupil: its cost is then infinite or NaN.
        state = problem.evaluate(frames, start, None)
        _descend(problem, state, frames, start, max_steps)
        moved = np.linalg.norm(start.t - t_start_mm[frames], axis=1) > _LENS_MM
        moved |= np.linalg.norm(start.R - R_start[frames], axis=(1, 2)) > _LENS_RAD
        moved &= np.isfinite(state.cost)
        if moved.any():  # the lens terms are of the start: have them anew
            again = np.flatnonzero(moved)
            there = start.take(again)
            fresh = problem.evaluate(frames[again], there, None)
            _descend(problem, fresh, frames[again], there, 3)
            start.put(again, there, slice(None))
            state.put(again, fresh, slice(None))
    R, t = start.R, start.t
    good = np.isfinite(state.cost)
    condition = np.linalg.cond(state.A[good]) if good.any() else np.zeros(0)
    good[np.flatnonzero(good)[condition > 1e14]] = False
    rows = frames[good]
    out.R_camera_brick[rows], out.t_camera_brick_mm[rows] = R[good], t[good]
    inverse = np.linalg.inv(state.A[good])
    shared = np.einsum("nij,nj->ni", inverse, state.shift[good])
    out.covariance[rows] = (inverse + shared[:, :, None] * shared[:, None, :])[:, :6, :6]
    out.residual_px[rows], out.sigmas[rows] = state.residual[good], state.sigmas[good]
    out.is_outlier[rows] = np.nan_to_num(state.sigmas[good]) > OUTLIER_SIGMAS
    out.chi2[rows] = state.cost[good]
    out.n_used[rows] = (seen[rows] & ~out.is_outlier[rows]).sum(axis=1)
    out.area_px2[rows], out.facing[rows] = state.area[good], state.facing[good]
    return out


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """Poses of some frames, and what is added to the twist that their LEDs' motion was had from."""

    R: FloatArray
    t: FloatArray
    twist: FloatArray

    def take(self, which: IntArray) -> "_State":
        return _State(self.R[which], self.t[which], self.twist[which])

    def put(self, rows: IntArray, by: "_State", which: BoolArray | slice) -> None:
        self.R[rows], self.t[rows], self.twist[rows] = by.R[which], by.t[which], by.twist[which]

    def moved(self, step: FloatArray) -> "_State":
        twist = self.twist + step[:, 6:] if step.shape[1] > 6 else self.twist
        return _State(self.R @ matrix_from_rvec(step[:, :3]), self.t + step[:, 3:6], twist)


def _descend(problem: "_Problem", state: _Evaluation, frames: IntArray, at: _State, max_steps: int) -> None:
    """Take damped Gauss-Newton steps, in place, until each frame's step is far below its uncertainty."""
    damping = np.full(frames.size, 1e-6)
    live = np.isfinite(state.cost)
    for _ in range(max_steps):
        todo = np.flatnonzero(live)
        if todo.size == 0:
            break
        A = state.A[todo]
        damped = damping[todo, None] * np.einsum("nii->ni", A) + 1e-12
        step = np.linalg.solve(A + damped[..., None] * np.eye(A.shape[-1]), state.g[todo][..., None])[..., 0]
        size = np.linalg.norm(step[:, :3], axis=1)
        step *= np.minimum(1.0, 0.5 / np.maximum(size, 1e-12))[:, None]
        there = at.take(todo).moved(step)
        new = problem.evaluate(frames[todo], there, state.lens.take(todo))
        better = new.cost <= state.cost[todo] * (1 + 1e-12) + 1e-12
        took, kept = todo[better], todo[~better]
        at.put(took, there, better)
        state.put(took, new, better)
        damping[took] = np.maximum(damping[took] / 10, 1e-9)
        damping[kept] = np.maximum(damping[kept] * 100, 1e-4)
        small = np.einsum("ni,nij,nj->n", step, A, step) < _DONE_SIGMAS**2
        live[todo[small & better]] = False
        live[damping > 1e6] = False


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """What does not change while poses are fitted."""

    uv_px: FloatArray
    cov_px2: FloatArray
    seen: BoolArray
    ray_model: RayModel
    brick_model: BrickModel
    collar_mm: float | None
    profile_is_exact: bool
    motion: LedMotion | None

    def evaluate(self, which: IntArray, at: _State, lens: LensTerms | None) -> _Evaluation:
        """Return cost, normal equations and residuals of the frames ``which`` at their poses ``at``."""
        R_led, t_led, E, dt, sd = at.R, at.t, None, None, None
        if self.motion is not None:
            dt = self.motion.dt_s[which][..., None]
            E = matrix_from_rvec(self.motion.rvec_brick_rad[which] + at.twist[:, None, :3] * dt)
            R_led = at.R[:, None] @ E
            t_led = at.t[:, None] + self.motion.shift_camera_mm[which] + at.twist[:, None, 3:] * dt
            sd = None if self.motion.twist_sd is None else self.motion.twist_sd[which]
        prediction, J = predict_brick(
            R_led, t_led, self.ray_model, self.brick_model, collar_mm=self.collar_mm, lens=lens
        )
        if E is not None and dt is not None:
            own = J
            # R_led = R E: a turn dtheta of the frame's brick is E^T dtheta of the LED's.
            J = np.concatenate([own[..., :3] @ np.swapaxes(E, -1, -2), own[..., 3:]], axis=-1)
            if sd is not None:
                J = np.concatenate([J, own * dt[..., None]], axis=-1)
        behind = np.asarray((t_led[..., 2] <= 0).reshape(len(which), -1).any(axis=-1), dtype=np.bool_)
        result = _normal_equations(
            self.uv_px[which],
            self.cov_px2[which],
            self.seen[which],
            prediction,
            J,
            behind,
            self.profile_is_exact,
        )
        if sd is not None:
            index = np.arange(6, 12)
            result.A[:, index, index] += 1 / sd**2
            result.g[:, 6:] -= at.twist / sd**2
            result.cost[:] += np.sum((at.twist / sd) ** 2, axis=1)
        return result


def _normal_equations(
    uv: FloatArray,
    cov: FloatArray,
    seen: BoolArray,
    prediction: LedPrediction,
    J: FloatArray,
    behind: BoolArray,
    profile_is_exact: bool,
) -> _Evaluation:
    residual = np.where(seen[..., None], uv - prediction.uv_px, 0.0)
    m = prediction.model_shift_px * (0.0 if profile_is_exact else 1.0)
    m = np.where(seen[..., None], m, 0.0)
    V = _inverse_2x2(np.where(seen[..., None, None], cov, np.eye(2)))
    Vm = np.einsum("nlij,nlj->nli", V, m)
    gain = 1 / (1 + np.einsum("nli,nli->nl", m, Vm))
    W = V - gain[..., None, None] * Vm[..., :, None] * Vm[..., None, :]  # inverse of cov + m m^T
    Wr = np.einsum("nlij,nlj->nli", W, residual)
    sigmas = np.sqrt(np.maximum(np.einsum("nli,nli->nl", residual, Wr), 0.0))
    weight = np.where(seen, np.minimum(1.0, HUBER_SIGMAS / np.maximum(sigmas, 1e-12)), 0.0)
    huber = np.where(sigmas <= HUBER_SIGMAS, sigmas**2, HUBER_SIGMAS * (2 * sigmas - HUBER_SIGMAS))
    J = np.where(seen[..., None, None], J, 0.0)
    WJ = (weight[..., None, None] * W) @ J
    n, n_leds = seen.shape
    k = J.shape[-1]
    A = np.swapaxes(J.reshape(n, 2 * n_leds, k), 1, 2) @ WJ.reshape(n, 2 * n_leds, k)
    g = np.einsum("nlik,nli->nk", WJ, residual)
    shift = np.einsum("nlik,nli->nk", WJ, m)
    cost = np.where(seen, huber, 0.0).sum(axis=1)
    cost = np.where(behind | ~all_finite(A, 2), np.inf, cost)
    return _Evaluation(
        cost=cost,
        A=A,
        g=g,
        shift=shift,
        residual=np.where(seen[..., None], residual, np.nan),
        sigmas=np.where(seen, sigmas, np.nan),
        area=prediction.area_px2,
        facing=prediction.facing,
        lens=prediction.lens,
    )


def _inverse_2x2(C: FloatArray) -> FloatArray:
    det = C[..., 0, 0] * C[..., 1, 1] - C[..., 0, 1] * C[..., 1, 0]
    adjugate = np.stack([C[..., 1, 1], -C[..., 0, 1], -C[..., 1, 0], C[..., 0, 0]], axis=-1)
    return np.asarray((adjugate / det[..., None]).reshape(C.shape))


def _nothing(n: int, n_leds: int) -> RefinedPoses:
    nan = np.nan
    return RefinedPoses(
        R_camera_brick=np.full((n, 3, 3), nan),
        t_camera_brick_mm=np.full((n, 3), nan),
        covariance=np.full((n, 6, 6), nan),
        residual_px=np.full((n, n_leds, 2), nan),
        sigmas=np.full((n, n_leds), nan),
        is_outlier=np.zeros((n, n_leds), dtype=bool),
        chi2=np.full(n, nan),
        n_used=np.zeros(n),
        area_px2=np.full((n, n_leds), nan),
        facing=np.full((n, n_leds), nan),
    )
