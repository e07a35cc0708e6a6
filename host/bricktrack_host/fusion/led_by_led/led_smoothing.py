"""The smoother LED by LED: pictures predicted, noise and standing errors found, and once more from there."""

from dataclasses import dataclass, field, replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import TrackingError
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.led_by_led.led_measurements import (
    LedNoise,
    Pictured,
    SeenLeds,
    led_arrays,
    led_chi2,
    picture,
)
from bricktrack_host.fusion.led_by_led.led_noise import (
    ALL_NEW,
    STATED_SCALES,
    believed_covariance_px2,
    centroid_scales,
    choose_inertial_noise,
    pictures_alike,
    still_sightings,
)
from bricktrack_host.fusion.led_by_led.shared_with_rest import shared_with_rest
from bricktrack_host.fusion.led_by_led.standing_errors import (
    StandingErrors,
    StandingPrior,
    StandingWay,
    views_told,
)
from bricktrack_host.fusion.pose_by_pose.fused_output import sample_motion, sample_poses
from bricktrack_host.fusion.pose_by_pose.fusion_problem import Nodes, Run, build_problem, place_nodes
from bricktrack_host.fusion.pose_by_pose.inertial_noise import NoiseLevel, NoiseParts
from bricktrack_host.fusion.pose_by_pose.pose_level import Smoothed, relinearised
from bricktrack_host.fusion.smoothing.linearisation import Linearisation
from bricktrack_host.fusion.smoothing.smoother import POS, SEEN, VEL, Filter, Problem
from bricktrack_host.fusion.smoothing.standing_doubt import Doubt

_MOST_PASSES = 5
_NOISE_CHOSEN_IN = 2  # there the pictures are predicted from what LEDs say
_STANDS_SDS = 0.2
"""A pass that moves the motion by less is the last. In seven simulated runs 0.13 sd at most were left to go
after three passes, which makes the errors greater by a hundredth."""
_PICTURES_HOLD_PX = 0.2
"""Within which a picture moves in proportion to the motion, of focal lengths about 1500 px: the square leaves
0.0001 px, and of the few that move by a pixel, at impacts, 0.003 px."""
_HELD_SHARE = 0.99
_START = VEL.stop  # attitude, position and velocity come first
_START_SHARE = 0.1
"""Of how unsure the start is without a pass before: still 50 times what passes move it by. Single LEDs of
0.005 px tell it: of a start that is as wide as bricks move, rounding left a wrong or negative variance."""
_NONE = SEEN[:0]
_GATE_CHI2 = 20.7  # of 2 degrees of freedom; passed by all but one in 30 000
_MOST_BESIDE_PX = 1.0  # an LED that stands farther beside its place is another light


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
    with_rest : ndarray, shape (K, 8, 6), or None
        As `shared_with_rest` gives it; `None` where the rest is not known or not reached.
    """

    leds: SeenLeds
    states: Smoothed
    chi2: FloatArray
    use: BoolArray
    noise_scales: FloatArray
    errors: StandingErrors
    with_rest: FloatArray | None


@dataclass(frozen=True, slots=True, eq=False)
class _Sights:
    """LEDs with the pictures that a motion lets expect, and which of them stand still."""

    leds: SeenLeds
    pictured: Pictured
    still: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class _Belief:
    """What is believed of noise and errors when a pass begins."""

    run: Run
    scales: FloatArray
    pictures_alike: FloatArray
    levels: tuple[NoiseLevel, NoiseLevel]
    settings: FusionSettings
    errors: StandingErrors


@dataclass(frozen=True, slots=True, eq=False)
class _Ready:
    """All that a pass needs; ``pictured`` is without the errors that stand still.

    ``of``: the states whose covariance it gives, as of `Estimate`.
    """

    pictured: Pictured
    use: BoolArray
    run: Run
    nodes: Nodes
    lin: Linearisation
    problem: Problem
    of: IntArray = field(default_factory=lambda: SEEN)


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


class LedSmoother:
    """The smoother LED by LED of one run.

    It takes of the pose-level one what it needs, which memory need not hold any longer, and of each of its
    own passes only what the next one needs.

    Parameters
    ----------
    leds : SeenLeds
    first : Smoothed
        Pose by pose.
    ray_model, brick_model : RayModel, BrickModel
    lever_arm_m : ndarray, shape (3,)
        As it was said to be.
    settings : FusionSettings
    rest_ns : (int, int), camera time, optional
        When the brick rested.

    Raises
    ------
    TrackingError
        If the pose-level motion is nowhere sure enough.
    """

    def __init__(
        self,
        leds: SeenLeds,
        first: Smoothed,
        ray_model: RayModel,
        brick_model: BrickModel,
        *,
        lever_arm_m: FloatArray,
        settings: FusionSettings,
        rest_ns: tuple[int, int] | None = None,
    ) -> None:
        self._rest_ns = None if rest_ns is None else np.array(rest_ns)
        placeable = _placeable(leds, first, settings)
        if not len(placeable.t_ns):
            raise TrackingError("the motion pose by pose is too unsure to say where any LED should be seen")
        self._models, self._n_leds = (ray_model, brick_model), brick_model.n_leds
        self._sights, _ = _sights(placeable, first, *self._models)
        self._use = np.ones(len(self._sights.leds.t_ns), dtype=np.bool_)
        self._n_views = views_told(self._sights.pictured)
        errors = StandingErrors.before(first.run, lever_arm_m, self._n_leds, n_views=self._n_views)
        self._belief = _Belief(first.run, STATED_SCALES, ALL_NEW, first.levels, settings, errors)
        self._of_poses = first.used, first.scale, first.chi2
        self._go_on_from(first)

    def smooth(self) -> SmoothedLeds:
        """Return the smoothed states, and how far each LED lies from what all others say.

        Pictures are predicted for the pose-level motion, then for what came of it, and so on. Outliers are
        judged with hindsight each time and may come back; the noise, and errors that stand still, are taken
        anew from each pass, until what a pass changes is little beside what is not known anyway.
        """
        i = 1
        while True:
            may_stand = i > _NOISE_CHOSEN_IN  # before, nobody asks how sure the motion is
            ready = self._prepared(chooses_noise=i == _NOISE_CHOSEN_IN)
            done = self._pass(ready if may_stand else replace(ready, of=_NONE))
            way, errors = self._errors_after(done)
            stands = may_stand and _moved_sds(self._origin_m, done.states) < _STANDS_SDS
            if stands or i == _MOST_PASSES:
                return self._with_doubt(done, way.doubt(errors, done.states.estimate.of), errors)
            self._learn(done, errors, knows_errors=i >= _NOISE_CHOSEN_IN)
            i += 1
            del ready, done, way

    def _with_doubt(self, done: _Pass, doubt: Doubt, errors: StandingErrors) -> SmoothedLeds:
        """Return what came of a pass, with what the errors that stand still leave unsure."""
        with_rest, moved_by, estimate = None, None, done.states.estimate
        if self._rest_ns is not None:
            moved_by = np.empty((len(estimate.covariance), len(doubt.of), len(doubt.root)), dtype=np.float32)
        states = replace(done.states, estimate=doubt.added_to(estimate, 0, moved_by=moved_by), doubt=doubt)
        if self._rest_ns is not None and moved_by is not None:
            with_rest = shared_with_rest(states, moved_by, self._rest_ns)
        return SmoothedLeds(
            self._sights.leds, states, done.chi2, done.use, self._belief.scales, errors, with_rest
        )

    def _learn(self, done: _Pass, errors: StandingErrors, *, knows_errors: bool) -> None:
        """Take from a pass what is believed, and where to linearise, in the next one.

        ``knows_errors``: whether the errors that stand still had been taken out of what it was shown.
        """
        belief, still, leds = self._belief, self._sights.still, self._sights.leds
        of_one = done.chi2 * belief.pictures_alike[still.astype(np.int64)]
        scales = centroid_scales(of_one, still, done.use, belief.scales)
        more = (scales / belief.scales)[still.astype(np.int64)]
        # An LED that stands beside its place is no outlier in any frame: by how much is estimated.
        estimate = done.states.estimate
        beside_px = _stands_beside_px(estimate.led_residual_px, leds.led, self._n_leds)
        chi2 = np.fmin(done.chi2, led_chi2(done.states.problem, estimate, beside_px=beside_px))
        self._use = (chi2 < _GATE_CHI2 * np.maximum(more, 1.0) ** 2) & done.pictured.is_facing
        run = belief.run.with_sensor(errors.of_sensor(since=belief.errors))
        alike = pictures_alike(estimate.led_residual_px, leds, still, done.use) if knows_errors else ALL_NEW
        self._belief = replace(belief, run=run, scales=scales, pictures_alike=alike, errors=errors)
        if not done.holds():
            del self._sights
            self._sights, placed = _sights(leds, done.states, *self._models)
            self._use = self._use[placed]
        self._go_on_from(done.states)

    def _go_on_from(self, now: Smoothed) -> None:
        """Keep where a motion was, and where to linearise next."""
        n_nodes = len(now.nodes.t_s)
        self._lin = relinearised(now.run, now.estimate, now.b, n_nodes, self._belief.settings)
        self._origin_m = _origin_m(now)[:n_nodes]

    def _errors_after(self, done: _Pass) -> tuple[StandingWay, StandingErrors]:
        """Return the errors that stand still as a pass tells them, and its way beside them."""
        now, leds = done.states, self._sights.leds
        still = now.nodes.camera_attitudes(now.run)
        prior = StandingPrior.of(
            leds, done.pictured, self._n_leds, self._belief.settings, n_views=self._n_views,
            camera_moves=still is not None,
        )  # fmt: skip
        way = StandingWay(
            now.problem, now.passed, leds, done.pictured, self._n_leds, n_views=self._n_views,
            R_still_camera=still,
        )  # fmt: skip
        return way, way.estimate(prior, self._belief.errors.value)

    def _prepared(self, *, chooses_noise: bool) -> _Ready:
        """Return the problem of the LEDs by what is believed, if asked for with the likeliest noise."""
        belief = self._belief
        ready, of_steps, of_leds = _prepared(self._sights, self._use, self._lin, belief)
        if not chooses_noise:
            return ready
        problem, signal = ready.problem, ready.run.signal
        if problem.leds is None:
            raise ValueError("the problem has no LEDs")
        noise = choose_inertial_noise(problem, of_steps, signal, belief.levels, belief.settings)
        gyro, acc = levels = noise.levels(belief.levels)
        self._belief = replace(belief, levels=levels)
        leds = problem.leds._replace(cov_px2=of_leds.covariance_px2(levels))
        gyro_var, acc_var = of_steps.gyro(gyro)[:, None], of_steps.acc(acc)[:, None]
        return replace(ready, problem=replace(problem, gyro_var=gyro_var, acc_var=acc_var, leds=leds))

    def _pass(self, ready: _Ready) -> _Pass:
        """Smooth once."""
        passed, (used, scale, chi2) = Filter(ready.problem), self._of_poses
        estimate = passed.smooth(ready.of)
        states = Smoothed(
            ready.run, ready.nodes, ready.lin, ready.problem, passed, estimate, 0, used=used, scale=scale,
            levels=self._belief.levels, chi2=chi2, doubt=None,
        )  # fmt: skip
        return _Pass(ready.pictured, ready.use, states, led_chi2(ready.problem, estimate))


def _stands_beside_px(residual_px: FloatArray, led: IntArray, n_leds: int) -> FloatArray:
    """Return how far each LED lies beside its place on the median over the run, at each of its m sightings.

    Shape (m, 2); zero where that is farther than LEDs stand.
    """
    of_leds = np.zeros((n_leds, 2))
    for i in np.unique(led):
        of_leds[i] = np.median(residual_px[led == i], axis=0)
    of_leds[~(np.hypot(*of_leds.T) < _MOST_BESIDE_PX)] = 0.0
    return of_leds[led]


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
    sights: _Sights, use: BoolArray, lin: Linearisation, belief: _Belief
) -> tuple[_Ready, NoiseParts, LedNoise]:
    """Return the problem of sights by what is believed, and the noise of its steps and LEDs."""
    settings, leds, pictured = belief.settings, sights.leds, sights.pictured
    off_px = belief.errors.in_picture_px(leds, pictured)
    pictured = replace(pictured, residual_px=pictured.residual_px - off_px)
    use = use & pictured.is_facing
    run = _without_frames(belief.run.with_acc_loss(lin.loss_s2))
    nodes = Nodes(place_nodes(belief.run, lin).t_s, np.zeros(0, dtype=np.int64))
    problem, (of_steps,) = build_problem(
        [run], [nodes], [lin], settings=settings, use_frame=[np.zeros(0, dtype=np.bool_)],
        noise_scale=[np.ones(2)], levels=[belief.levels],
    )  # fmt: skip
    P_start = problem.P_start.copy()
    P_start[:, :_START, :_START] *= _START_SHARE**2
    arrays, of_leds = led_arrays(
        leds, pictured, run, nodes, lin, belief.levels,
        cov_px2=believed_covariance_px2(leds, sights.still, belief.scales, belief.pictures_alike),
        use=use, settings=settings,
    )  # fmt: skip
    problem = replace(problem, leds=arrays, P_start=P_start)
    return _Ready(pictured, use, run, nodes, lin, problem), of_steps, of_leds


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
    instants_ns = np.concatenate([leds.t_ns[None], leds.beside_ns()])
    R, t_mm = np.empty((*instants_ns.shape, 3, 3)), np.empty((*instants_ns.shape, 3))
    for i, t_ns in enumerate(instants_ns):
        R[i], t_mm[i] = sample_poses(s.run, s.nodes, s.estimate.state, s.b, t_ns)
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
