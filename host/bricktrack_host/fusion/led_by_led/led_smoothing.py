"""The smoother LED by LED: pictures predicted, noise and standing errors found, and once more from there."""

from dataclasses import dataclass, replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import TrackingError
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.led_by_led.led_measurements import (
    Pictured,
    SeenLeds,
    led_arrays,
    led_chi2,
    picture,
)
from bricktrack_host.fusion.led_by_led.led_noise import (
    STATED_SCALES,
    believed_covariance_px2,
    centroid_scales,
    choose_inertial_noise,
    still_sightings,
)
from bricktrack_host.fusion.led_by_led.standing_errors import (
    StandingErrors,
    StandingPrior,
    StandingWay,
    views_told,
)
from bricktrack_host.fusion.pose_by_pose.fused_output import sample_motion, sample_poses
from bricktrack_host.fusion.pose_by_pose.fusion_problem import Nodes, Run, build_problem, place_nodes
from bricktrack_host.fusion.pose_by_pose.inertial_noise import NoiseLevel
from bricktrack_host.fusion.pose_by_pose.pose_level import Smoothed, relinearised
from bricktrack_host.fusion.smoothing.linearisation import Linearisation
from bricktrack_host.fusion.smoothing.smoother import POS, Filter, Problem

_MOST_PASSES = 5
_NOISE_CHOSEN_IN = 1  # the second pass: there the pictures are predicted from what LEDs say
_STANDS_SDS = 0.2
"""A pass that moves the motion by less is the last. In seven simulated runs 0.13 sd at most were left to go
after three passes, which makes the errors greater by a hundredth."""
_PICTURES_HOLD_PX = 0.2
"""Within which a picture moves in proportion to the motion, of focal lengths about 1500 px: the square leaves
0.0001 px, and of the few that move by a pixel, at impacts, 0.003 px."""
_HELD_SHARE = 0.99
_GATE_CHI2 = 20.7  # of 2 degrees of freedom; passed by all but one in 30 000


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedLeds:
    """What came of the LEDs of a run.

    Attributes
    ----------
    leds : SeenLeds
        Those that could be placed, m.
    states : Smoothed
        With what the errors that stand still leave unsure.
    chi2 : ndarray, shape (m,)
        Of each LED by all others, squared over its covariance (2 degrees of freedom).
    use : ndarray of bool, shape (m,)
    noise_scales : ndarray, shape (2,)
        On the stated sd of centroids: of pictures that move, and that stand still.
    errors : StandingErrors
    """

    leds: SeenLeds
    states: Smoothed
    chi2: FloatArray
    use: BoolArray
    noise_scales: FloatArray
    errors: StandingErrors


@dataclass(frozen=True, slots=True, eq=False)
class _Sights:
    """LEDs with the pictures that a motion lets expect, and which of them stand still."""

    leds: SeenLeds
    pictured: Pictured
    still: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class LedStart:
    """All that the LEDs' smoother takes from the pose-level one, which memory need not hold any longer.

    Attributes
    ----------
    sights : _Sights
        Of the LEDs at whose instants that motion is sure enough.
    run, lin : Run, Linearisation
    origin_m : ndarray, shape (K, 3)
        Where the brick's origin was at its nodes.
    used, scale, levels, chi2
        As in `Smoothed`.
    """

    sights: _Sights
    run: Run
    lin: Linearisation
    origin_m: FloatArray
    used: BoolArray
    scale: FloatArray
    levels: tuple[NoiseLevel, NoiseLevel]
    chi2: FloatArray

    @classmethod
    def of(
        cls,
        leds: SeenLeds,
        first: Smoothed,
        ray_model: RayModel,
        brick_model: BrickModel,
        settings: FusionSettings,
    ) -> "LedStart":
        """Return it from the pose-level smoother's states.

        Raises
        ------
        TrackingError
            If these are nowhere sure enough.
        """
        placeable = _placeable(leds, first, settings)
        if not len(placeable.t_ns):
            raise TrackingError("the motion pose by pose is too unsure to say where any LED should be seen")
        sights, _ = _sights(placeable, first, ray_model, brick_model)
        lin = relinearised(first.run, first.estimate, first.b, len(first.nodes.t_s), settings)
        origin_m = _origin_m(first)[: len(first.nodes.t_s)]
        return cls(sights, first.run, lin, origin_m, first.used, first.scale, first.levels, first.chi2)


@dataclass(frozen=True, slots=True, eq=False)
class _Belief:
    """What is believed of noise and errors when a pass begins."""

    run: Run
    scales: FloatArray
    levels: tuple[NoiseLevel, NoiseLevel]
    settings: FusionSettings
    errors: StandingErrors


@dataclass(frozen=True, slots=True, eq=False)
class _Ready:
    """All that a pass needs; ``pictured`` is without the errors that stand still."""

    pictured: Pictured
    use: BoolArray
    run: Run
    nodes: Nodes
    lin: Linearisation
    problem: Problem


@dataclass(frozen=True, slots=True, eq=False)
class _Pass:
    """One pass over sights by what was believed; ``pictured`` is without the errors that stand still."""

    pictured: Pictured
    use: BoolArray
    states: Smoothed
    chi2: FloatArray

    def holds(self) -> bool:
        """Return whether the motion found is near to the one that the pictures were predicted for."""
        moved_px = np.abs(self.pictured.residual_px - self.states.estimate.led_residual_px)
        facing = moved_px[self.pictured.is_facing]
        return not facing.size or bool(np.quantile(facing, _HELD_SHARE) < _PICTURES_HOLD_PX)


def smooth_leds(
    first: LedStart,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    lever_arm_m: FloatArray,
    settings: FusionSettings,
) -> SmoothedLeds:
    """Return the smoothed states, and how far each LED lies from what all others say.

    Pictures are predicted for the pose-level motion, then for what came of it, and so on. Outliers
    are judged with hindsight each time and may come back; the noise, and errors that stand still, are taken
    anew from each pass, until what a pass changes is little beside what is not known anyway.
    """
    n_leds = brick_model.n_leds
    sights, lin, before_m = first.sights, first.lin, first.origin_m
    n_views = views_told(sights.pictured)
    errors = StandingErrors.before(first.run, lever_arm_m, n_leds, n_views=n_views)
    belief = _Belief(first.run, STATED_SCALES, first.levels, settings, errors)
    use = np.ones(len(sights.leds.t_ns), dtype=np.bool_)
    i = 0
    while True:
        ready = _prepared(sights, use, lin, first, belief)
        if i == _NOISE_CHOSEN_IN:
            noise = choose_inertial_noise(
                ready.problem, ready.run, ready.nodes, ready.lin, belief.levels, belief.settings
            )
            belief = replace(
                belief, levels=noise.levels(belief.levels), settings=noise.settings(belief.settings)
            )
            del ready
            ready = _prepared(sights, use, lin, first, belief)
        done = _pass(ready, first, belief)
        leds, now = sights.leds, done.states
        moved_sds = _moved_sds(before_m, now)
        still = now.nodes.camera_attitudes(now.run)
        prior = StandingPrior.of(
            leds, done.pictured, n_leds, settings, n_views=n_views, camera_moves=still is not None
        )
        way = StandingWay(
            now.problem, now.passed, leds, done.pictured, n_leds, n_views=n_views, R_still_camera=still
        )  # fmt: skip
        errors = way.estimate(prior, belief.errors.value)
        if i == _MOST_PASSES - 1 or (i > _NOISE_CHOSEN_IN and moved_sds < _STANDS_SDS):
            doubt = way.doubt(errors, now.estimate.of)
            states = replace(now, estimate=doubt.added_to(now.estimate, 0), doubt=doubt)
            return SmoothedLeds(leds, states, done.chi2, done.use, belief.scales, errors)
        scales = centroid_scales(done.chi2, sights.still, done.use, belief.scales)
        more = (scales / belief.scales)[sights.still.astype(np.int64)]
        use = (done.chi2 < _GATE_CHI2 * np.maximum(more, 1.0) ** 2) & done.pictured.is_facing
        run = belief.run.with_sensor(errors.of_sensor(since=belief.errors))
        belief = replace(belief, run=run, scales=scales, errors=errors)
        if not done.holds():
            sights, placed = _sights(leds, now, ray_model, brick_model)
            use = use[placed]
        lin, before_m = relinearised(now.run, now.estimate, 0, len(now.nodes.t_s), settings), _origin_m(now)
        i += 1
        del ready, done, now, way  # of each pass only what the next one needs: memory holds one


def _moved_sds(before_m: FloatArray, now: Smoothed) -> float:
    """Return by how much a pass has moved the brick from where it was at the nodes on the mean, in sd."""
    n = min(len(before_m), len(now.nodes.t_s))
    moved_m = _origin_m(now)[:n] - before_m[:n]
    return float(np.sqrt(np.nanmean(moved_m**2 / now.estimate.variance[:n, 0, POS])))


def _origin_m(s: Smoothed) -> FloatArray:
    """Return where the brick's origin was at the nodes, shape (K, 3)."""
    state = s.estimate.state
    return np.asarray(state.x[:, s.b, POS] - state.R[:, s.b] @ s.run.lever_arm_m)


def _prepared(
    sights: _Sights, use: BoolArray, lin: Linearisation, first: LedStart, belief: _Belief
) -> _Ready:
    """Return the problem of sights by what is believed."""
    settings, leds, pictured = belief.settings, sights.leds, sights.pictured
    off_px = belief.errors.in_picture_px(leds, pictured)
    pictured = replace(pictured, residual_px=pictured.residual_px - off_px)
    use = use & pictured.is_facing
    run = _without_frames(belief.run.with_acc_loss(lin.loss_s2))
    nodes = Nodes(place_nodes(first.run, lin).t_s, np.zeros(0, dtype=np.int64))
    problem, _ = build_problem(
        [run], [nodes], [lin], settings=settings, use_frame=[np.zeros(0, dtype=np.bool_)],
        noise_scale=[np.ones(2)], levels=[belief.levels],
    )  # fmt: skip
    arrays = led_arrays(
        leds, pictured, run, nodes, lin, belief.levels,
        cov_px2=believed_covariance_px2(leds, sights.still, belief.scales), use=use, settings=settings,
    )  # fmt: skip
    return _Ready(pictured, use, run, nodes, lin, replace(problem, leds=arrays))


def _pass(ready: _Ready, first: LedStart, belief: _Belief) -> _Pass:
    """Smooth once."""
    passed = Filter(ready.problem)
    estimate = passed.smooth()
    states = Smoothed(
        ready.run, ready.nodes, ready.lin, ready.problem, passed, estimate, 0,
        used=first.used, scale=first.scale, levels=belief.levels, chi2=first.chi2, doubt=None,
    )  # fmt: skip
    return _Pass(ready.pictured, ready.use, states, led_chi2(ready.problem, estimate))


def _placeable(leds: SeenLeds, s: Smoothed, settings: FusionSettings) -> SeenLeds:
    """Return the LEDs at whose instants a smoothed motion is sure enough to predict pictures from."""
    motion = sample_motion(
        s.run, s.nodes, s.problem, s.estimate, s.b, output_t_ns=leds.t_ns, seen_cam_s=s.run.t_cam_s,
        common=np.zeros((6, 6)), settings=settings, is_smoothed=True,
    )  # fmt: skip
    return leds.take(np.asarray(np.isfinite(motion.t_camera_brick_mm).all(axis=1)))


def _sights(
    leds: SeenLeds, s: Smoothed, ray_model: RayModel, brick_model: BrickModel
) -> tuple[_Sights, BoolArray]:
    """Return the LEDs whose instants a smoothed motion covers, with their pictures, and which those are."""
    t_ns = np.concatenate([leds.t_ns[None], leds.beside_ns()])
    R, t_mm = sample_poses(s.run, s.nodes, s.estimate.state, s.b, t_ns.ravel())
    R, t_mm = R.reshape(*t_ns.shape, 3, 3), t_mm.reshape(*t_ns.shape, 3)
    placed = np.asarray(np.isfinite(t_mm).all(axis=(0, 2)))
    leds = leds.take(placed)
    pictured = picture(leds, R[:, placed], t_mm[:, placed], ray_model, brick_model)
    return _Sights(leds, pictured, still_sightings(leds)), placed


def _without_frames(run: Run) -> Run:
    """Return the run without its poses."""
    return replace(
        run,
        t_cam_s=np.zeros(0),
        R_seen=np.zeros((0, 3, 3)),
        p_seen_m=np.zeros((0, 3)),
        cov_seen=np.zeros((0, 6, 6)),
        shared_seen=None,
        still_s=np.zeros(0),
    )
