"""What a run's motion says of its identities: what scatters, or turns off its course, is mended or refused.

With the poses of all frames the motion within each is known, and with it the brick's shape as a rolling
shutter shows it: the gate is then what its neighbours leave. Frames that scatter beyond it are identified
again, from where the others show the LEDs.
"""

import numpy as np
from scipy.ndimage import maximum_filter, median_filter

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.tracking.identity.assigned_lights import MIN_INLIERS, LedLights
from bricktrack_host.tracking.identity.identity_motion import (
    RunMotion,
    places_px,
    unknown_motion,
)
from bricktrack_host.tracking.identity.identity_newcomers import leave_out_fleeting, leave_out_newcomers
from bricktrack_host.tracking.identity.identity_smoothing import steady_poses
from bricktrack_host.tracking.identity.pattern import assign_predicted
from bricktrack_host.tracking.identity.run_identities import (
    NEAR_FRAMES,
    SUSPECT,
    RunIdentities,
    is_whole,
    scatter_px,
)
from bricktrack_host.tracking.identity.verification import Verified, motion_of
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.neighbour_poses import turn_between
from bricktrack_host.tracking.pose.refine import LedMotion

_LEAST_GATE_PX = 0.5  # what calibration and profile may leave, beside centroid noise
_LEAST_USUAL_PX = 0.1  # usual residuals of few LEDs are small by chance
_LEAST_TURN_RAD = 0.01  # off the cubic through its neighbours; a 2 degree shake at 6 Hz is 0.011 off
_MOST_TURN_RAD = 0.1  # no shaken brick's, where its run is smooth
_ENOUGH_OTHERS = MIN_INLIERS + 2  # agree by no chance, whatever light is left out beside them
_SAME_TURN = 0.7  # share of a turn that is left without any one LED where it is the brick that turned
_NEAR_TURNS = 31
_WARM_ROUNDS, _SETTLE_ROUNDS = 2, 3


def settle(run: RunIdentities) -> None:
    """Judge every frame by how the run moves; what then does not fit is refused."""
    leave_out_fleeting(run)
    _steady(run)
    _refuse_lone(run)
    had = run.n_found > 0
    usual_px = _settle_rounds(run)
    leave_out_newcomers(run, usual_px)
    n_found = run.n_found
    # What is left beside frames that were refused, with no neighbours to judge it by, may be the culprit.
    beside = maximum_filter((had & (n_found == 0)).astype(np.int64), 5, mode="constant") > 0
    turn, _ = run.turns()
    run.refuse(np.flatnonzero(beside & (n_found > 0) & (n_found < run.brick_model.n_leds) & np.isnan(turn)))


def _steady(run: RunIdentities) -> None:
    """Give a run's frames steady poses where it has frames that turn off their neighbours' course."""
    turn, _ = run.turns()
    if not (turn > 3 * _LEAST_TURN_RAD).any():
        return
    known = run.known_frames()
    R, t_mm = steady_poses(run, np.ones(len(run.blobs)))
    run.found.R_camera_brick[known], run.found.t_camera_brick_mm[known] = R[known], t_mm[known]


def _refuse_lone(run: RunIdentities) -> None:
    """Refuse frames of four lights, which fit by chance, that no frame beside them bears out."""
    known = run.known_frames()
    turn, _ = run.turns()
    lone = np.isnan(turn[known]) & (run.n_found[known] <= MIN_INLIERS)
    lone[:2], lone[-2:] = False, False
    run.refuse(known[lone])


def _settle_rounds(run: RunIdentities) -> FloatArray:
    """Return what residuals scatter by about each frame, px."""
    usual_px = np.full(len(run.blobs), run.gate_px / SUSPECT)
    usual_gate = np.full(len(run.blobs), run.gate_px)
    for round_ in range(_WARM_ROUNDS + _SETTLE_ROUNDS):
        frames = run.known_frames()
        if frames.size < NEAR_FRAMES:
            break
        before = run.found.blob_of_led.copy()
        assigned, lights = before[frames], run.lights_of(frames)
        motion = run.motion()
        verified = _verify_known(run, frames, lights, motion, usual_gate)
        scatter = scatter_px(verified)
        if round_ < _WARM_ROUNDS and np.median(scatter) > _LEAST_GATE_PX / SUSPECT:
            # Poses first, which the motion between them makes better.
            run.take(frames, assigned, verified, is_whole(verified, lights))
            continue
        usual = median_filter(scatter, NEAR_FRAMES, mode="nearest")
        tight = np.clip(SUSPECT * usual, _LEAST_GATE_PX, run.gate_px)
        good = is_whole(verified, lights) & (scatter <= tight)
        bad = np.flatnonzero(~good)
        if bad.size:  # the spline may be a neighbour's fault
            some = lights.take(bad)
            unknown = unknown_motion(some.uv_px, run.ray_model)
            again = _verify_known(run, frames[bad], some, motion, usual_gate, within=unknown)
            fits = is_whole(again, some) & (scatter_px(again) <= tight[bad])
            verified = verified.replaced(bad[fits], again.take(np.flatnonzero(fits)))
            good[bad[fits]] = True
        bad = np.flatnonzero(~good)
        if bad.size:  # what a card leaves of an LED lies where no pose has it: the others count, if they
            # are many or turn as their neighbours do
            again = _verify_known(run, frames[bad], lights.take(bad), motion, usual_gate, intruders=True)
            turn, between = run.turns()
            is_calm = turn_between(_attitudes(again), between[frames[bad]]) <= _usual_turn(turn)[frames[bad]]
            n_kept = again.kept.sum(axis=1)
            agree = (n_kept >= _ENOUGH_OTHERS) | (n_kept >= MIN_INLIERS) & is_calm
            fits = agree & (scatter_px(again) <= tight[bad])
            verified = verified.replaced(bad[fits], again.take(np.flatnonzero(fits)))
            good[bad[fits]] = True
        run.take(frames, assigned, verified, good)
        tight_px = np.interp(np.arange(len(run.blobs)), frames, tight)
        usual_px = np.interp(np.arange(len(run.blobs)), frames, np.maximum(usual, _LEAST_USUAL_PX))
        _leave_twins(run, tight_px)
        limit_rad = _mend_lurches(run, tight_px)
        run.refuse(frames[~good])
        _identify_again(run, tight_px, limit_rad)
        if (run.found.blob_of_led == before).all():
            break
    return usual_px


def _leave_twins(run: RunIdentities, tight_px: FloatArray) -> None:
    """Take the other pose of frames in a twin: LEDs nearly in one plane have two, which fit alike."""
    R, t_mm = run.found.R_camera_brick, run.found.t_camera_brick_mm
    turn, _ = run.turns()
    calm = np.flatnonzero(turn <= 2 * _LEAST_TURN_RAD)
    frames = np.flatnonzero(turn > _MOST_TURN_RAD / 2)
    if calm.size == 0 or frames.size == 0:
        return
    nearest = calm[np.abs(calm[None] - frames[:, None]).argmin(axis=1)]
    lights = run.lights_of(frames)
    verified = run.verify(
        lights,
        (R[nearest], t_mm[nearest]),
        motion=unknown_motion(lights.uv_px, run.ray_model),
        gate_px=tight_px[frames],
    )
    before, after = turn_between(R[frames], R[nearest]), turn_between(_attitudes(verified), R[nearest])
    fits = is_whole(verified, lights) & (scatter_px(verified) <= tight_px[frames])
    run.take(frames, run.found.blob_of_led[frames], verified, fits & (after < 0.5 * before))


def _mend_lurches(run: RunIdentities, tight_px: FloatArray) -> FloatArray:
    """Leave out the one LED without which a frame does not turn away from its neighbours.

    Some LEDs decide the attitude nearly alone: a false light in one's place turns the pose, and fits.
    Where the frame turns without any of them as well, it is the brick that did.
    Returns the turns that are usual, rad, shape (n,).
    """
    R, t_mm = run.found.R_camera_brick, run.found.t_camera_brick_mm
    turn, between = run.turns()
    limit = _usual_turn(turn)
    turn = np.nan_to_num(turn)
    frames = np.flatnonzero(turn > limit)
    if frames.size == 0:
        return limit
    row, led = np.nonzero(run.found.blob_of_led[frames] >= 0)
    tried = run.found.blob_of_led[frames[row]]
    tried[np.arange(len(row)), led] = -1
    at = frames[row]
    lights = run.lights.of_leds(at, tried)
    known_R = np.where(np.isfinite(between), between, R)
    worst = turn >= maximum_filter(turn, 5, mode="nearest")
    rest = np.where((worst & (turn > limit))[:, None, None], np.nan, R)
    verified = run.verify(
        lights,
        (known_R[at], t_mm[at]),
        weighed=True,
        motion=motion_of(run.motion(rest).within, at),
        gate_px=tight_px[at],
        n_lights=run.lights.count[at],
    )
    left = turn_between(_attitudes(verified), between[at])
    enough = verified.kept.sum(axis=1) >= MIN_INLIERS
    left = np.where(is_whole(verified, lights) & enough, left, np.nan)
    calm = np.nan_to_num(left, nan=np.inf) <= limit[at]
    best = np.full(frames.size, -1)
    for i in np.unique(row[calm]):
        mine = np.flatnonzero((row == i) & calm)
        best[i] = mine[verified.log_evidence[mine].argmax()]
    # A frame that is off turns its neighbours' cubics too, by less.
    mendable = np.zeros(len(R))
    mendable[frames] = np.where(best >= 0, turn[frames], 0.0)
    first = (best >= 0) & (turn[frames] >= maximum_filter(mendable, 5, mode="nearest")[frames])
    mended = best[first]
    run.take(at[mended], tried[mended], verified.take(mended))
    least = np.full(frames.size, np.inf)
    np.fmin.at(least, row, left)
    doubtful = (run.n_found[frames] <= MIN_INLIERS) | ~(least > _SAME_TURN * turn[frames]) | np.isinf(least)
    # In a run that turns smoothly; one that jumps from frame to frame tells nothing by its neighbours.
    doubtful |= (turn[frames] > _MOST_TURN_RAD) & (limit[frames] < _MOST_TURN_RAD)
    run.refuse(frames[doubtful & worst[frames] & (best < 0)])
    return limit


def _usual_turn(turn_rad: FloatArray) -> FloatArray:
    """Return the turns off their neighbours up to which frames are believed, by those near them, (n,)."""
    judged = np.flatnonzero(np.isfinite(turn_rad))
    if judged.size == 0:
        return np.full(len(turn_rad), _LEAST_TURN_RAD)
    usual = np.interp(np.arange(len(turn_rad)), judged, median_filter(turn_rad[judged], _NEAR_TURNS))
    return np.clip(SUSPECT * usual, _LEAST_TURN_RAD, _MOST_TURN_RAD)


def _identify_again(run: RunIdentities, tight_px: FloatArray, limit_rad: FloatArray) -> None:
    """Identify frames without an identity, and LEDs without a light, from where the run shows them."""
    motion = run.motion()
    n_found = run.n_found
    known = all_finite(motion.R_camera_brick, 2) & (run.lights.count >= MIN_INLIERS)
    frames = np.flatnonzero(known & (n_found < run.brick_model.n_leds))
    if frames.size == 0:
        return
    places = places_px(motion, frames, run.ray_model, run.brick_model, collar_mm=run.collar_mm)
    new = np.full((frames.size, run.brick_model.n_leds), -1, dtype=np.int64)
    for row, i in enumerate(frames):
        begin, end = run.lights.first[i : i + 2]
        new[row] = assign_predicted(
            run.lights.uv_px[begin:end],
            places[row],
            gate_px=0.7 * run.radius_px if n_found[i] == 0 else run.gate_px,
            shift_limit_px=4 * run.radius_px if n_found[i] == 0 else run.gate_px,
        )
    changed = (new != run.found.blob_of_led[frames]).any(axis=1) & ((new >= 0).sum(axis=1) >= MIN_INLIERS)
    frames, new = frames[changed], new[changed]
    if frames.size == 0:
        return
    lights = run.lights.of_leds(frames, new)
    verified = _verify_known(run, frames, lights, motion, tight_px, intruders=True)
    better = _is_better(frames, verified, motion, n_found, limit_rad)
    rest = np.flatnonzero(~better)
    if rest.size:
        some = lights.take(rest)
        unknown = unknown_motion(some.uv_px, run.ray_model)
        again = _verify_known(run, frames[rest], some, motion, tight_px, within=unknown, intruders=True)
        more = _is_better(frames[rest], again, motion, n_found, limit_rad)
        verified = verified.replaced(rest[more], again.take(np.flatnonzero(more)))
        better[rest[more]] = True
    run.take(frames, new, verified, better)
    run.found.is_ambiguous[frames[better]] = False


def _is_better(
    frames: IntArray, verified: Verified, motion: RunMotion, n_found: IntArray, limit_rad: FloatArray
) -> BoolArray:
    """Tell which frames have more LEDs than were found, without a turn."""
    turn = turn_between(_attitudes(verified), motion.R_camera_brick[frames])
    calm = np.nan_to_num(turn, nan=np.inf) <= np.maximum(limit_rad[frames], 3 * _LEAST_TURN_RAD)
    return np.asarray(calm & (verified.kept.sum(axis=1) > n_found[frames]))


def _verify_known(
    run: RunIdentities,
    frames: IntArray,
    lights: LedLights,
    motion: RunMotion,
    gate_px: FloatArray,
    *,
    within: LedMotion | None = None,
    intruders: bool = False,
) -> Verified:
    """Verify assignments of frames from the run's poses; they move as the run does, or as ``within`` says."""
    return run.verify(
        lights,
        (motion.R_camera_brick[frames], motion.t_camera_brick_mm[frames]),
        intruders=intruders,
        motion=motion_of(motion.within, frames) if within is None else within,
        gate_px=gate_px[frames],
        n_lights=run.lights.count[frames],
    )


def _attitudes(verified: Verified) -> FloatArray:
    return verified.poses.R_camera_brick
