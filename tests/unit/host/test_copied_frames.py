"""Copies of a picture are told from a brick that turns back or rests."""

import numpy as np
import pytest

from bricktrack_host.tracking.copied_frames import copied_frames

FRAME_S = 1 / 30
LEDS_PX = np.random.default_rng(1).uniform(200, 900, (7, 2))


def seen(position_px, noise_px=0.03, seed=2):
    """Return LEDs that go along u and less along v, shape (n, 7, 2)."""
    position_px = np.asarray(position_px, dtype=np.float64)
    way = position_px[:, None, None] * np.array([1.0, 0.4])
    return LEDS_PX + way + np.random.default_rng(seed).normal(0, noise_px / 3, (len(position_px), 7, 2))


def swing(n, hz=3.0, phase=0.0):
    return 60.0 * np.sin(2 * np.pi * hz * np.arange(n) * FRAME_S + phase)


def filled_up(uv, *frames):
    uv = uv.copy()
    for k in frames:
        uv[k] = uv[k - 1] + np.random.default_rng(k).normal(0, 0.01, (7, 2))  # encoded once more
    return uv


@pytest.mark.parametrize("copies", [(31,), (31, 32), (10, 31, 45)])
def test_copies_in_the_middle_of_a_motion_are_found(copies):
    uv = filled_up(seen(swing(60, phase=0.4)), *copies)
    assert np.flatnonzero(copied_frames(uv)).tolist() == list(copies)


def test_a_copy_is_found_with_leds_hidden():
    uv = filled_up(seen(swing(60, phase=0.4)), 31)
    uv[30, :3], uv[32, 5] = np.nan, np.nan
    assert np.flatnonzero(copied_frames(uv)).tolist() == [31]


def test_no_copy_is_seen_where_a_motion_turns_back():
    # Two frames as far before the turning point as after it show the same picture.
    for hz in (1.0, 2.0, 3.0, 5.0):
        phase = np.pi / 2 - 2 * np.pi * hz * 30.5 * FRAME_S
        uv = seen(swing(60, hz, phase))
        assert np.abs(np.diff(uv, axis=0)).max(axis=(1, 2)).min() < 0.1
        assert not copied_frames(uv).any()


def test_no_copy_is_seen_in_drawn_motions_and_at_rest():
    # Two of a brick's six degrees of freedom, up to 10 Hz, in 90 000 frames. Along one line alone, some 30 of
    # as many frames do stand where the one before did.
    rng = np.random.default_rng(5)
    for seed in range(200):
        along = [a * swing(450, f, p) for a, f, p in rng.uniform([0, 1, 0], [1, 10, 6.3], (3, 3))]
        across = [a * swing(450, f, p) for a, f, p in rng.uniform([0, 1, 0], [0.3, 10, 6.3], (2, 3))]
        uv = seen(np.sum(along, axis=0), seed=seed)
        uv[..., 1] += np.sum(across, axis=0)[:, None]
        assert not copied_frames(uv).any()
    assert not copied_frames(seen(np.zeros(90))).any()
    starts = seen(np.concatenate([np.zeros(20), 10.0 * np.arange(20), np.full(20, 190.0)]))
    assert not copied_frames(starts).any()
