"""Refine where the LEDs sit on the brick, from many frames of one recording, together with the poses.

What pictures can tell is the shape of the pattern, not where it lies: every frame has a pose of its own, and
a camera whose rays meet in a point sees a larger brick farther away alike. So the gauge is stated: the first
LED stays the origin, and against the layout as given the others are, as a whole, neither turned about it nor
made larger. LEDs that all the others contradict do not count in that, or one that is set beside its place
would move the rest. Judged by cross-validation, as the profile is.
"""

from dataclasses import dataclass, replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_common.brick_model import BrickModel, ProfileEntry
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import CalibrationError
from bricktrack_common.rotations import skew
from bricktrack_host.tracking.frame_errors import FrameErrors
from bricktrack_host.tracking.led_model.led_profile import collar_of, predict_brick, shift_per_radius
from bricktrack_host.tracking.odd_leds import odd_leds_px, oddest_led
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.first_poses import first_poses
from bricktrack_host.tracking.pose.refine import RefinedPoses, refine_poses
from bricktrack_host.tracking.sweep_frames import (
    errors_of_sweep,
    rms_px,
    sweep_frames,
    without_led,
    words_on_left_out,
)
from bricktrack_host.tracks import LedObservations

_MIN_LEDS = 6  # five tell of a pose and four coordinates more, of twelve that are sought
_MIN_FRAMES = 10
_N_FOLDS = 5
_MAX_ROUNDS = 20
_STEP_MM = 0.02
_LONGEST_STEP_MM = 0.5
_HARDLY = 30.0  # an LED that all the others contradict is anywhere
_HELD = 1e12  # 1/mm^2: the collar stays where it is
_SETTLED_MM = 1e-4
_OUTLIER_SIGMAS = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class PositionsFit:
    """Refined positions.

    Attributes
    ----------
    positions_mm : ndarray, shape (n_leds, 3), mm, brick axes
        The first is the origin.
    sd_mm : ndarray, shape (n_leds, 3), mm
        Of each coordinate in this gauge, frames taken as independent groups.
    collar_mm, collar_sd_mm : float
        Of the LEDs' profile: that of the layout, sd 0, or fitted together with the positions. From few angles
        a longer collar and LEDs that sit deeper look alike, which its sd says.
    rms_px, cross_validated_rms_px : float
        Of the residuals with these positions; and of frames that were left out of the fit.
    rms_before_px : float
        With the positions of the layout.
    n_frames : int
    odd_px : ndarray, shape (n_leds,), px
        How far LEDs that the layout puts elsewhere than all the others say are from there; 0 of the others.
    left_out_px : ndarray, shape (n_leds,), px
        The same of LEDs that no place explains, and that were left out: theirs is the layout's.
    """

    positions_mm: FloatArray
    sd_mm: FloatArray
    collar_mm: float
    collar_sd_mm: float
    rms_px: float
    cross_validated_rms_px: float
    rms_before_px: float
    n_frames: int
    odd_px: FloatArray
    left_out_px: FloatArray

    @property
    def is_believable(self) -> bool:
        """Tell whether frames that the fit did not see are described better."""
        return self.cross_validated_rms_px < self.rms_before_px


def fit_positions(
    observations: LedObservations,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    tolerance_mm: float = 0.2,
    with_collar: bool = False,
) -> PositionsFit:
    """Refine the LEDs' positions.

    Parameters
    ----------
    observations : LedObservations
        Of a brick at rest in many poses, or moving slowly: rolling shutter is not taken off.
    ray_model : RayModel
    brick_model : BrickModel
        With the LEDs' profile: without it, what domes do to centroids would be taken for their places.
    tolerance_mm : float
        How far off the given positions may be, as a standard deviation; holds what the views do not tell.
    with_collar : bool
        Fit the LEDs' collar together with the positions, from the layout's: a wrong place passes for a wrong
        shape, and back.

    Raises
    ------
    CalibrationError
        If the profile is not known, fewer than ten frames show six LEDs that agree, the first LED is not
        where the others say, or a position goes five tolerances away.

    Notes
    -----
    Gauss-Newton with the poses eliminated in every frame, in the coordinates that the gauge leaves free.
    """
    if brick_model.led_profile is None:
        raise CalibrationError(
            f"the layout '{brick_model.name}' has no [led_profile]; domes would pass for other places. "
            "Fit the profile first"
        )
    sweep, odd_px = _sweep(observations), np.zeros(brick_model.n_leds)
    problem = _Problem(sweep, ray_model, brick_model, tolerance_mm, with_collar, odd_px == 0)
    odd_px = odd_leds_px(problem.errors(problem.start))
    if odd_px[0] > 0:
        raise CalibrationError(
            f"LED {brick_model.led_names[0]}, from which all the others are measured, is {odd_px[0]:.2f} px "
            "from where they put it, in every frame alike. Is it clean and uncovered, and are its place and "
            "axis right in the layout?"
        )
    left_out_px = np.zeros(brick_model.n_leds)
    while True:
        problem = _Problem(sweep, ray_model, brick_model, tolerance_mm, with_collar, odd_px == 0)
        solved = problem.solve(np.ones(len(sweep.uv_px), dtype=np.bool_))
        errors = problem.errors(solved)
        odd = oddest_led(errors, errors.seen)
        if odd is None:
            break
        odd_px[odd[0]] = left_out_px[odd[0]] = odd[1]
        try:
            sweep = _sweep(without_led(sweep, odd[0]))
        except CalibrationError as e:
            raise CalibrationError(f"{words_on_left_out(left_out_px, brick_model)} Then: {e}") from e
    uv = sweep.uv_px
    positions = problem.positions_mm(solved)
    sd_mm, collar_sd_mm = problem.sd_mm(solved)
    poses = problem.poses(solved)
    off_mm = np.linalg.norm(positions - brick_model.led_positions_mm, axis=1)
    if not off_mm.max() < 5 * tolerance_mm:
        k = int(np.nanargmax(off_mm))
        raise CalibrationError(
            f"LED {brick_model.led_names[k]} comes out {off_mm[k]:.2f} mm from where the layout has it; "
            f"expected within {5 * tolerance_mm:g} mm. Check the layout, or allow more by the tolerance"
        )
    folds = np.arange(len(uv)) % _N_FOLDS
    held_out = np.full(uv.shape, np.nan)
    for fold in range(_N_FOLDS):
        out = folds == fold
        held_out[out] = problem.poses(problem.solve(~out)).residual_px[out]
    return PositionsFit(
        positions_mm=positions,
        sd_mm=sd_mm,
        collar_mm=float(solved[-1]),
        collar_sd_mm=collar_sd_mm if with_collar else 0.0,
        rms_px=rms_px(poses.residual_px),
        cross_validated_rms_px=rms_px(held_out),
        rms_before_px=rms_px(problem.poses(problem.start).residual_px),
        n_frames=len(uv),
        odd_px=np.where(left_out_px > 0, 0.0, odd_px),
        left_out_px=left_out_px,
    )


def _sweep(observations: LedObservations) -> LedObservations:
    return sweep_frames(observations, wanted="LED positions need", min_leds=_MIN_LEDS, min_frames=_MIN_FRAMES)


def free_directions(positions_mm: FloatArray, counts: BoolArray | None = None) -> FloatArray:
    """Return an orthonormal basis of the changes that the gauge leaves, shape (3 n_leds, 3 n_leds - 7).

    Orthogonal to: any change of the first LED, turns about it, and a change of scale, of those that count.
    """
    n_leds = len(positions_mm)
    if counts is not None:
        positions_mm = np.where(counts[:, None], positions_mm, 0.0)
    fixed = np.zeros((3 * n_leds, 7))
    fixed[:3, :3] = np.eye(3)
    fixed[:, 3:6] = skew(positions_mm).reshape(3 * n_leds, 3)
    fixed[:, 6] = positions_mm.ravel()
    Q, _ = np.linalg.qr(fixed, mode="complete")
    return np.asarray(Q[:, 7:])


class _Problem:
    """Residuals of all frames for given positions, with the poses fitted.

    The unknowns x are coordinates in the directions that the gauge leaves free, from the layout, and the
    collar, mm.
    """

    def __init__(
        self,
        sweep: LedObservations,
        ray_model: RayModel,
        brick_model: BrickModel,
        tolerance_mm: float,
        with_collar: bool,
        counts: BoolArray,
    ) -> None:
        self._sweep = sweep
        self._uv, self._cov = sweep.uv_px, sweep.cov_px2
        self._rays, self._brick = ray_model, brick_model
        self._shift_sd = shift_per_radius(collar_of(brick_model), brick_model)
        self._nominal = brick_model.led_positions_mm
        self._free = free_directions(self._nominal, counts)
        self._tolerance_mm = tolerance_mm
        n = self._free.shape[1]
        self.start = np.append(np.zeros(n), collar_of(brick_model) or 0.0)
        self._looseness = np.where(counts, 1.0, _HARDLY)
        precision = np.repeat((tolerance_mm * self._looseness) ** -2, 3)
        self._prior = np.zeros((n + 1, n + 1))
        self._prior[:n, :n] = self._free.T @ (precision[:, None] * self._free)
        self._prior[n, n] = 0.0 if with_collar else _HELD
        apart_px = np.nanstd(self._uv, axis=1).max()
        self._px_per_mm = float(apart_px / np.std(self._nominal, axis=0).max())
        loose = self._covariance(tolerance_mm)
        start = first_poses(self._uv, loose, sweep.sensor_timestamp_ns, ray_model, brick_model)
        self._R, self._t = start.R_camera_brick, start.t_camera_brick_mm

    def positions_mm(self, x: FloatArray) -> FloatArray:
        """Return the positions, shape (n_leds, 3)."""
        return self._nominal + (self._free @ x[:-1]).reshape(-1, 3)

    def errors(self, x: FloatArray) -> FrameErrors:
        """Return the errors of the frames with these positions and this collar."""
        profile = ProfileEntry(
            collar_mm=float(x[-1]), source="being fitted", shift_sd_per_radius=self._shift_sd
        )
        brick = replace(self._brick, led_positions_mm=self.positions_mm(x), led_profile=profile)
        return errors_of_sweep(self._sweep, self.poses(x), self._rays, brick)

    def poses(self, x: FloatArray, loose_mm: float = 0.0) -> RefinedPoses:
        """Return the poses and residuals for positions that are believed to ``loose_mm``."""
        brick = replace(self._brick, led_positions_mm=self.positions_mm(x))
        cov = self._covariance(loose_mm)
        collar_mm = float(x[-1])
        return refine_poses(self._uv, cov, self._R, self._t, self._rays, brick, collar_mm=collar_mm)

    def _covariance(self, loose_mm: float) -> FloatArray:
        loose_px = loose_mm * self._px_per_mm * self._looseness
        return np.asarray(self._cov + (loose_px**2)[:, None, None] * np.eye(2))

    def _equations(self, x: FloatArray, loose_mm: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Return each frame's normal matrix and right side, (n, m, m) and (n, m)."""
        brick = replace(self._brick, led_positions_mm=self.positions_mm(x))
        collar_mm = float(x[-1])
        poses = self.poses(x, loose_mm)
        ok = all_finite(poses.R_camera_brick, 2)
        R = np.where(ok[:, None, None], poses.R_camera_brick, np.eye(3))
        t = np.where(ok[:, None], poses.t_camera_brick_mm, [0.0, 0.0, 150.0])
        here, J = predict_brick(R, t, self._rays, brick, collar_mm=collar_mm)
        longer, _ = predict_brick(R, t, self._rays, brick, collar_mm=collar_mm + _STEP_MM)
        # Far from the solution every residual is long: outliers are those long beside the others.
        limit = _OUTLIER_SIGMAS * max(1.0, 1.5 * float(np.nanmedian(poses.sigmas)))
        seen = all_finite(self._uv) & ok[:, None] & (np.nan_to_num(poses.sigmas) <= limit)
        n, n_leds = seen.shape
        shift = here.model_shift_px
        cov = self._covariance(loose_mm) + shift[..., :, None] * shift[..., None, :]
        W = np.linalg.inv(np.linalg.cholesky(np.where(seen[..., None, None], cov, np.eye(2))))
        W = np.where(seen[..., None, None], W, 0.0)
        r = np.einsum("nlij,nlj->nli", W, np.where(seen[..., None], self._uv - here.uv_px, 0.0))
        by_place = np.zeros((n, n_leds, 2, n_leds, 3))
        for k in range(n_leds):
            by_place[:, k, :, k] = W[:, k] @ here.J_px_per_mm[:, k] @ R
        by_free = by_place.reshape(n, 2 * n_leds, 3 * n_leds) @ self._free
        by_collar = np.einsum("nlij,nlj->nli", W, (longer.uv_px - here.uv_px) / _STEP_MM)
        D = np.concatenate([by_free, by_collar.reshape(n, -1, 1)], axis=2)
        Q, _ = np.linalg.qr((W @ J).reshape(n, 2 * n_leds, 6))
        D = D - Q @ (np.swapaxes(Q, 1, 2) @ D)
        D = np.where((seen.sum(axis=1) >= _MIN_LEDS - 1)[:, None, None], D, 0.0)
        Dt = np.swapaxes(D, 1, 2)
        return Dt @ D, (Dt @ r.reshape(n, -1, 1))[..., 0]

    def solve(self, which: BoolArray) -> FloatArray:
        """Return the unknowns that fit the given frames best."""
        x = self.start.copy()
        loose_mm = self._tolerance_mm  # at first an LED off its place is no outlier
        for _ in range(_MAX_ROUNDS):
            N, g = self._equations(x, loose_mm)
            toward = g[which].sum(axis=0) - self._prior @ (x - self.start)
            step = np.linalg.solve(N[which].sum(axis=0) + self._prior, toward)
            x = x + np.clip(step, -_LONGEST_STEP_MM, _LONGEST_STEP_MM)
            if np.abs(step).max() < _SETTLED_MM and loose_mm == 0:
                break
            loose_mm = 0.2 * loose_mm if loose_mm > 0.01 * self._tolerance_mm else 0.0
        return x

    def sd_mm(self, x: FloatArray) -> tuple[FloatArray, float]:
        """Return the sd of each coordinate and of the collar; frames' scores scatter as they do."""
        N, g = self._equations(x)
        bread = np.linalg.inv(N.sum(axis=0) + self._prior)
        cov = bread @ (np.einsum("ni,nj->ij", g, g) + self._prior) @ bread
        variance = np.einsum("ij,jk,ik->i", self._free, cov[:-1, :-1], self._free)
        return np.sqrt(np.maximum(variance, 0.0)).reshape(-1, 3), float(np.sqrt(cov[-1, -1]))
