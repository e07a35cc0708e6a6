"""The smoother LED by LED: pictures predicted, noise and standing errors found, and once more from there."""

from dataclasses import dataclass, fields, replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
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
    centroid_scales,
    choose_inertial_noise,
    still_sightings,
)
from bricktrack_host.fusion.led_by_led.standing_errors import StandingErrors, StandingPrior, StandingWay
from bricktrack_host.fusion.pose_by_pose.fused_output import sample_motion, sample_poses
from bricktrack_host.fusion.pose_by_pose.fusion_problem import Nodes, Run, build_problem, place_nodes
from bricktrack_host.fusion.pose_by_pose.inertial_noise import NoiseLevel
from bricktrack_host.fusion.pose_by_pose.pose_level import Smoothed, relinearised
from bricktrack_host.fusion.smoothing.smoother import Filter
from bricktrack_host.tracks import FusedTrack

_PASSES = 5
_NOISE_CHOSEN_AFTER = 1  # pass: by then the pictures are predicted from what LEDs say
_GATE_CHI2 = 20.7  # of 2 degrees of freedom; passed by all but one in 30 000
_SCALES_STAND = 0.1  # of the logarithm


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
class _Belief:
    """What is believed of noise and errors when a pass begins."""

    run: Run
    scales: FloatArray
    levels: tuple[NoiseLevel, NoiseLevel]
    settings: FusionSettings
    errors: StandingErrors


@dataclass(frozen=True, slots=True, eq=False)
class _Pass:
    """One pass over the LEDs that could be placed, by what was believed."""

    leds: SeenLeds
    pictured: Pictured
    still: BoolArray
    use: BoolArray
    states: Smoothed
    chi2: FloatArray


def smooth_leds(
    leds: SeenLeds,
    first: Smoothed,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    lever_arm_m: FloatArray,
    settings: FusionSettings,
) -> SmoothedLeds:
    """Return the smoothed states, and how far each LED lies from what all others say.

    Pictures are predicted for the pose-level motion ``first``, then for what came of it, and so on. Outliers
    are judged with hindsight each time and may come back; the noise, and errors that stand still, are taken
    anew from each pass until they stand.
    """
    n_leds = brick_model.n_leds
    errors = StandingErrors.before(first.run, lever_arm_m, n_leds)
    belief = _Belief(first.run, STATED_SCALES, first.levels, settings, errors)
    now, use = first, np.ones(len(leds.t_ns), dtype=np.bool_)
    for i in range(_PASSES):
        done = _pass(leds, use, now, first, belief, ray_model, brick_model)
        leds, now = done.leds, done.states
        prior = StandingPrior.of(leds, done.pictured, n_leds, settings)
        way = StandingWay(now.problem, now.passed, leds, done.pictured, n_leds, of=now.estimate.of)
        errors = way.estimate(prior, belief.errors.value)
        scales = centroid_scales(done.chi2, done.still, done.use, belief.scales)
        more = (scales / belief.scales)[done.still.astype(np.int64)]
        use = (done.chi2 < _GATE_CHI2 * np.maximum(more, 1.0) ** 2) & done.pictured.is_facing
        stands = np.abs(np.log(scales / belief.scales)).max() < _SCALES_STAND
        is_settled = i > _NOISE_CHOSEN_AFTER and stands and np.array_equal(use, done.use)
        if is_settled or i == _PASSES - 1:
            break
        levels, believed = belief.levels, belief.settings
        if i == _NOISE_CHOSEN_AFTER:
            noise = choose_inertial_noise(now.problem, now.run, now.nodes, now.lin, levels, believed)
            levels, believed = noise.levels(levels), noise.settings(believed)
        run = belief.run.with_sensor(errors.of_sensor(since=belief.errors))
        belief = _Belief(run, scales, levels, believed, errors)
    states = replace(now, estimate=way.with_doubt(now.estimate, errors))
    return SmoothedLeds(leds, states, done.chi2, done.use, belief.scales, errors)


def _pass(
    leds: SeenLeds,
    use: BoolArray,
    now: Smoothed,
    first: Smoothed,
    belief: _Belief,
    ray_model: RayModel,
    brick_model: BrickModel,
) -> _Pass:
    """Smooth once, with pictures predicted for the motion ``now``."""
    settings = belief.settings
    leds, pictured, placed = _pictured(leds, now, first.run.t_cam_s, ray_model, brick_model, settings)
    use = use[placed]
    off_px = belief.errors.in_picture_px(leds, pictured, brick_model.n_leds)
    pictured = replace(pictured, residual_px=pictured.residual_px - off_px)
    still, use = still_sightings(leds), use & pictured.is_facing
    lin = relinearised(now.run, now.estimate, now.b, len(now.nodes.t_s), settings)
    run = _without_frames(belief.run.with_acc_loss(lin.loss_s2))
    nodes = Nodes(place_nodes(first.run, lin).t_s, np.zeros(0, dtype=np.int64))
    problem, _ = build_problem(
        [run], [nodes], [lin], settings=settings, use_frame=[np.zeros(0, dtype=np.bool_)],
        noise_scale=[np.ones(2)], levels=[belief.levels],
    )  # fmt: skip
    arrays = led_arrays(
        leds, pictured, run, nodes, lin, belief.levels,
        scale=belief.scales[still.astype(np.int64)], use=use, settings=settings,
    )  # fmt: skip
    problem = replace(problem, leds=arrays)
    passed = Filter(problem)
    estimate = passed.smooth()
    states = replace(
        first, run=run, nodes=nodes, lin=lin, problem=problem, passed=passed, estimate=estimate, b=0,
        levels=belief.levels,
    )  # fmt: skip
    return _Pass(leds, pictured, still, use, states, led_chi2(problem, estimate))


def _pictured(
    leds: SeenLeds,
    s: Smoothed,
    seen_cam_s: FloatArray,
    ray_model: RayModel,
    brick_model: BrickModel,
    settings: FusionSettings,
) -> tuple[SeenLeds, Pictured, BoolArray]:
    """Return the LEDs at whose instants a smoothed motion is known, their pictures, and which those are."""
    motion = sample_motion(
        s.run, s.nodes, s.problem, s.estimate, s.b, output_t_ns=leds.t_ns, seen_cam_s=seen_cam_s,
        common=np.zeros((6, 6)), settings=settings, is_smoothed=True,
    )  # fmt: skip
    beside_ns = leds.beside_ns()
    R, t_mm = sample_poses(s.run, s.nodes, s.estimate.state, s.b, beside_ns.ravel())
    R, t_mm = R.reshape(*beside_ns.shape, 3, 3), t_mm.reshape(*beside_ns.shape, 3)
    all_mm = np.concatenate([motion.t_camera_brick_mm, *t_mm], axis=1)
    placed = np.asarray(np.isfinite(all_mm).all(axis=1))
    known = FusedTrack(*(getattr(motion, f.name)[placed] for f in fields(motion)))
    leds = leds.take(placed)
    return leds, picture(leds, known, (R[:, placed], t_mm[:, placed]), ray_model, brick_model), placed


def _without_frames(run: Run) -> Run:
    """Return the run without its poses."""
    return replace(
        run,
        t_cam_s=np.zeros(0),
        R_seen=np.zeros((0, 3, 3)),
        p_seen_m=np.zeros((0, 3)),
        cov_seen=np.zeros((0, 6, 6)),
    )
