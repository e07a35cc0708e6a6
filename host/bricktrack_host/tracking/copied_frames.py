"""Frames whose picture is that of the frame before once more, and so of no instant of their own.

Programs that record at a constant rate fill the place of a picture that came late with a copy of the last
one, under a stamp of its own. A pose of it is that of the frame before: whole millimetres off while the brick
moves, and as sure as any.
"""

from dataclasses import replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_host.quality import LedFlag, PoseFlag
from bricktrack_host.tracks import LedObservations

_SAME_PX = 0.1  # what encoding a picture twice changes of where an LED's light is: 0.03 px at a low bit rate
_MOVING_PX = 2.0  # on both sides: more than a motion that only slows down leaves at its slowest
_MIN_LEDS = 3
_ONWARDS = 0.5  # cosine: before and after, LEDs go the same way; where a motion turns back it stands still


def with_copied_frames_left_out(observations: LedObservations) -> tuple[LedObservations, list[str]]:
    """Return observations without LEDs in frames that are copies, and what to say of it."""
    copied = copied_frames(observations.uv_px)
    if not copied.any():
        return observations, []
    out = copied[:, None]
    left = replace(
        observations,
        uv_px=np.where(out[..., None], np.nan, observations.uv_px),
        led_flags=observations.led_flags | np.where(out, int(LedFlag.MISSING), 0),
        frame_flags=observations.frame_flags | np.where(copied, int(PoseFlag.FRAME_LOST), 0),
    )
    frames = np.flatnonzero(copied)
    named = ", ".join(str(i) for i in frames[:5]) + (", ..." if len(frames) > 5 else "")
    what = "picture is a copy" if len(frames) == 1 else "pictures are copies"
    return left, [
        f"{len(frames)} {what} of the one before while the brick moves (frame {named}), and left out: the "
        "recording was filled up to a constant rate"
    ]


def copied_frames(uv_px: FloatArray) -> BoolArray:
    """Return which frames show all LEDs where the frame before did, between two that show them moving on.

    Parameters
    ----------
    uv_px : ndarray, shape (n_frames, n_leds, 2), px
        NaN where an LED was not found.
    """
    copied = np.zeros(len(uv_px), dtype=np.bool_)
    step = np.diff(uv_px, axis=0)
    seen = np.asarray(np.isfinite(step).all(axis=2))
    farthest = np.where(seen, np.linalg.norm(step, axis=2), 0.0).max(axis=1, initial=0.0)
    same = (seen.sum(axis=1) >= _MIN_LEDS) & (farthest < _SAME_PX)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(np.int8), [0]])))
    for first, end in edges.reshape(-1, 2).tolist():
        if first == 0 or end == len(step):
            continue
        both = np.asarray(seen[first - 1] & seen[end])
        before, after = step[first - 1, both], step[end, both]
        sizes = np.sqrt((before**2).sum()), np.sqrt((after**2).sum())
        is_moving = both.sum() >= _MIN_LEDS and min(sizes) > _MOVING_PX * np.sqrt(both.sum())
        if is_moving and (before * after).sum() > _ONWARDS * sizes[0] * sizes[1]:
            copied[first + 1 : end + 1] = True
    return copied
