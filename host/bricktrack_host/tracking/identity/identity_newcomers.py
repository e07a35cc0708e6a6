"""LEDs that a frame shows and a frame beside it does not: they came, or another light is in their place.

An LED in sight from frame to frame is where it was; one that was hidden may still be, and any light near its
place pass for it. Some LEDs decide the attitude nearly alone: a false light in such a one's place turns the
pose, and fits. So newcomers are judged by where all else shows the LED: the frame's other LEDs, the
neighbouring frames, and how the run moves within the frame.
"""

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.tracking.identity.assigned_lights import MIN_INLIERS
from bricktrack_host.tracking.identity.evidence import log_area_ratio
from bricktrack_host.tracking.identity.identity_prediction import shown_by_the_rest
from bricktrack_host.tracking.identity.run_identities import RunIdentities
from bricktrack_host.tracking.identity.verification import motion_of

_SURE = 5.0  # log odds that an LED be believed: 150 to one
_FLEETING = 10.0  # more for one that neither the frame before nor the one after shows
_AT_END = 3.0  # more in a run's first and last frame, with neighbours on one side
_STILL = 5.0  # more if the brick must be taken not to move within the frame, though its run does
_ROUNDS = 3  # false lights in one frame, the worst first


def leave_out_fleeting(run: RunIdentities) -> None:
    """Leave out what one frame alone shows, before the run's motion is known: what is true comes again."""
    known, came, gone, _ = _neighbours(run)
    row, led = np.nonzero(came & gone)
    for k in np.unique(led):
        _leave_out(run, known[row[led == k]], np.full(1, k))


def leave_out_newcomers(run: RunIdentities, usual_px: FloatArray) -> None:
    """Leave out the newcomers that may be other lights; frames of too few LEDs without them are refused.

    Parameters
    ----------
    usual_px : ndarray, shape (n,)
        What residuals usually scatter by about each frame.
    """
    for _ in range(_ROUNDS if run.known_frames().size else 0):
        frames, leds, needed = _newcomers(run)
        for still in (False, True):
            if frames.size == 0:
                return
            missing = needed + still * _STILL - log_odds(run, frames, leds, usual_px, still=still)
            doubtful = missing > 0
            frames, leds = frames[doubtful], leds[doubtful]
            needed, missing = needed[doubtful], missing[doubtful]
        if frames.size == 0:
            return
        order = np.lexsort((-missing, frames))
        worst = order[np.unique(frames[order], return_index=True)[1]]
        _leave_out(run, frames[worst], leds[worst])


def _newcomers(run: RunIdentities) -> tuple[IntArray, IntArray, FloatArray]:
    """Return frames and LEDs whose lights are to be judged, and the log odds that they need."""
    known, came, gone, lost = _neighbours(run)
    whole = run.lights_of(known).is_whole  # what is cut is flagged, and used for no pose
    needed = np.where((came & gone) | lost.any(axis=1, keepdims=True), _SURE + _FLEETING, _SURE)
    needed[[0, -1]] += np.where((came | gone)[[0, -1]], _AT_END, 0.0)
    row, led = np.nonzero(whole & (came | gone))
    return known[row], led, needed[row, led]


def _neighbours(run: RunIdentities) -> tuple[IntArray, BoolArray, BoolArray, BoolArray]:
    """Return the known frames, and which LEDs came, are gone in the next, and are lost from one frame alone.

    What came into a frame that lost another LED may have driven it out.
    """
    known = run.known_frames()
    has = run.found.blob_of_led[known] >= 0
    before, after = has.copy(), has.copy()
    before[1:], after[:-1] = has[:-1], has[1:]
    return known, has & ~before, has & ~after, before & after & ~has


def _leave_out(run: RunIdentities, frames: IntArray, leds: IntArray) -> None:
    """Fit frames, each once, without one LED."""
    tried = run.found.blob_of_led[frames]
    tried[np.arange(frames.size), leds] = -1
    motion = run.motion()
    start = (motion.R_camera_brick[frames], motion.t_camera_brick_mm[frames])
    within = motion_of(motion.within, frames)
    verified = run.verify(run.lights.of_leds(frames, tried), start, motion=within)
    enough = verified.kept.sum(axis=1) >= MIN_INLIERS
    run.take(frames, tried, verified, enough)
    run.refuse(frames[~enough])


def log_odds(
    run: RunIdentities, frames: IntArray, leds: IntArray, usual_px: FloatArray, *, still: bool
) -> FloatArray:
    """Return how much likelier the lights of LEDs are theirs than lights that fell anywhere, as logarithms.

    Parameters
    ----------
    frames, leds : ndarray of int64, shape (m,)
        LEDs that have lights in these frames.
    usual_px : ndarray, shape (n,)
        See `leave_out_newcomers`.
    still : bool
        The brick is taken not to move within the frames, whose other LEDs must bear it out.
    """
    shown = shown_by_the_rest(run, frames, leds, usual_px, still=still)
    r, S = shown.residual_px, shown.covariance_px2
    det = S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] * S[:, 1, 0]
    chi2 = (S[:, 1, 1] * r[:, 0] ** 2 - 2 * S[:, 0, 1] * r[:, 0] * r[:, 1] + S[:, 0, 0] * r[:, 1] ** 2) / det
    log_density = -0.5 * (chi2 + np.log(det)) - np.log(2 * np.pi)
    mode = run.ray_model.sensor_mode
    n_free = run.lights.count[frames] - run.n_found[frames] + 1
    log_anywhere = np.log(n_free / (mode.width * mode.height))
    odds = log_density - log_anywhere + log_area_ratio(shown.log_area_ratio)
    # An LED that faces away is not shown at all.
    return np.where(np.isfinite(odds) & (shown.others_fit | (not still)), odds, -np.inf)
