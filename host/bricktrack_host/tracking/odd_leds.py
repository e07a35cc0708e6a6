"""LEDs that are elsewhere than all the others say, in every frame alike: set beside their place, or dirty.

One such LED pulls all poses of a run the same way, by a good part of its own error, and widens what is taken
for the noise of all. Which one it is shows where the others, without it, agree far better with each other.
"""

from dataclasses import replace

import numpy as np
from scipy.special import fdtrc

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_host.quality import LedFlag
from bricktrack_host.tracking.centroid_noise import measure_noise
from bricktrack_host.tracking.frame_errors import MIN_LEDS, FrameErrors
from bricktrack_host.tracking.led_tracker import NOT_USED
from bricktrack_host.tracks import LedObservations

_CHANCE = 1e-4
_LEAST_PX = 0.15  # what a profile's or a ray's own error may be
_IDLE_SHARE = 0.05  # of the frames; an LED hidden for most of a shake is of use in more
_WHY_UNUSED = {
    LedFlag.MISSING: "not found",
    LedFlag.PARTLY_COVERED: "partly covered",
    LedFlag.MERGED: "run together with another light",
    LedFlag.BORDER: "cut by the picture's border",
}


def with_odd_leds_doubted(
    observations: LedObservations, errors: FrameErrors
) -> tuple[LedObservations, FrameErrors]:
    """Return observations in which LEDs that contradict all the others throughout are doubted by as much.

    Parameters
    ----------
    observations : LedObservations
        With covariances as the segmentation states them.
    errors : FrameErrors
        Of the same observations.

    Returns
    -------
    LedObservations, FrameErrors
        Odd LEDs have `LedFlag.OUTLIER`, and the variance that their distance from the others' word is.
    """
    off_px = odd_leds_px(errors)
    odd = off_px > 0
    doubt_px2 = (off_px**2)[:, None, None] * np.eye(2)
    flags = np.where(odd & np.isfinite(observations.uv_px[..., 0]), int(LedFlag.OUTLIER), 0)
    doubted = replace(
        observations, cov_px2=observations.cov_px2 + doubt_px2, led_flags=observations.led_flags | flags
    )
    return doubted, replace(errors, own_px2=errors.own_px2 + doubt_px2)


def words_on_odd_leds(observations: LedObservations, brick_model: BrickModel) -> list[str]:
    """Return a line on the odd LEDs of `with_odd_leds_doubted`, if there are any."""
    odd = ((observations.led_flags & int(LedFlag.OUTLIER)) != 0).any(axis=0)
    if not odd.any():
        return []
    names = ", ".join(np.array(brick_model.led_names)[odd])
    return [
        f"LED {names}: elsewhere than all the other LEDs say, in every frame alike, and doubted by as much. "
        "Check its place in the layout, and whether it is clean"
    ]


def words_on_unused_leds(observations: LedObservations, brick_model: BrickModel) -> list[str]:
    """Return a line on LEDs that hardly any frame could use while it used others, if there are any."""
    used = (observations.led_flags & int(NOT_USED)) == 0
    used = used[used.any(axis=1)]
    if not len(used):
        return []
    idle = np.flatnonzero(used.mean(axis=0) < _IDLE_SHARE)
    if not idle.size:
        return []
    named = []
    for k in idle:
        flags = observations.led_flags[:, k]
        why = [(int(((flags & int(flag)) != 0).sum()), words) for flag, words in _WHY_UNUSED.items()]
        told = ", ".join(f"{words} in {n}" for n, words in sorted(why, reverse=True) if n)
        named.append(
            f"{brick_model.led_names[k]}, used in {int(used[:, k].sum())} of {len(used)} frames ({told})"
        )
    return [
        f"LEDs that were hardly used: {'; '.join(named)}. They are dark or faint beside the others, covered, "
        "or not where the layout has them. The others hold the poses, less surely"
    ]


def odd_leds_px(errors: FrameErrors) -> FloatArray:
    """Return how far each LED is from where the others put it, (n_leds,), px; 0 where that may be chance.

    Notes
    -----
    With P the weights of what no pose explains, ``(P e)_k`` and ``P_kk`` give an LED's distance from where
    the others put it, and its covariance. Its square beside the noise of the others follows F. All frames
    count as one: the error stands. The worst first, while five others remain.
    """
    off_px = np.zeros(errors.seen.shape[1])
    leds = errors.seen.copy()
    while (odd := oddest_led(errors, leds)) is not None:
        k, off_px[k] = odd
        leds[:, k] = False
    return off_px


def oddest_led(errors: FrameErrors, leds: BoolArray) -> tuple[int, float] | None:
    """Return the LED that is oddest beside some of each frame's, (n, n_leds), and how far off it is, px.

    None where that of every LED may be chance. See `odd_leds_px`.
    """
    found = [(k, *_beside_the_others(errors, leds, k)) for k in np.flatnonzero(leds.any(axis=0)).tolist()]
    odd = [(px / noise_px, k, px) for k, px, noise_px, chance in found if chance < _CHANCE and px > _LEAST_PX]
    return max(odd)[1:] if odd else None


def _beside_the_others(errors: FrameErrors, leds: BoolArray, k: int) -> tuple[float, float, float]:
    """Return an LED's distance from where the others put it, their noise, px, and the chance of as much."""
    others = leds.copy()
    others[:, k] = False
    noise = measure_noise(errors, others)
    frames = np.flatnonzero(leds[:, k] & (others.sum(axis=1) >= MIN_LEDS))
    if frames.size == 0 or noise.n_frames == 0:
        return 0.0, noise.sd_px, 1.0
    squares, distances, weights = [], [], []
    for pattern in np.unique(leds[frames], axis=0):
        rows = frames[(leds[frames] == pattern).all(axis=1)]
        e, A, D = errors.of_leds(rows, pattern)
        W = np.linalg.inv(D + noise.sd_px**2 * np.eye(D.shape[-1]))
        WA = W @ A
        P = W - WA @ np.linalg.solve(np.swapaxes(A, 1, 2) @ WA, np.swapaxes(WA, 1, 2))
        own = slice(2 * int(pattern[:k].sum()), 2 * int(pattern[:k].sum()) + 2)
        Pe = np.einsum("nij,nj->ni", P[:, own], e)
        d = np.linalg.solve(P[:, own, own], Pe[..., None])[..., 0]
        squares.append(np.sum(d * Pe, axis=1))
        distances.append(np.sum(d**2, axis=1) / 2)
        weights.append(np.trace(P[:, own, own], axis1=1, axis2=2))
    statistic = max(float(np.mean(np.concatenate(squares))) / 2, 0.0)
    chance = float(fdtrc(2.0, max(noise.dof, 1.0), statistic))
    off_px = np.sqrt(np.average(np.concatenate(distances), weights=np.concatenate(weights)))
    return float(off_px), noise.sd_px, chance
