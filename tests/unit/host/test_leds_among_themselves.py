"""What LEDs say among themselves of their offsets, against drawn pictures of a brick that sways."""

from dataclasses import replace

import numpy as np
import pytest
from daemon_runs import simulate_run

from bricktrack_common.brick_model import ProfileEntry
from bricktrack_host.fusion.led_by_led import leds_among_themselves
from bricktrack_host.fusion.led_by_led.led_measurements import SeenLeds, picture
from bricktrack_host.fusion.led_by_led.leds_among_themselves import AmongThemselves
from bricktrack_host.fusion.smoothing.observation_kernel import LedArrays
from bricktrack_host.tracking.optical_track import solve_poses

SIZES_PX = np.geomspace(0.005, 1.0, 30)


@pytest.fixture(scope="module")
def run():
    whole = simulate_run(33, duration_s=3.0)
    return replace(
        whole, brick=replace(whole.brick, led_profile=ProfileEntry(collar_mm=0.7, source="simulated"))
    )


def measured(run, residual_px, *, is_used=None, by_view=None):
    """Return what is measured of the run's arrays, of which only these are looked at, with such residuals.

    ``by_view``: gives what each sight has of an LED's errors, shape (m, V), from LEDs; one of them all if None.
    """
    leds = SeenLeds.of(run.observations, run.camera)
    track = solve_poses(run.observations, run.camera, run.brick)
    R, t_mm = track.R_camera_brick[leds.frame], track.t_camera_brick_mm[leds.frame]
    pictured = picture(leds, np.repeat(R[None], 3, 0), np.repeat(t_mm[None], 3, 0), run.camera, run.brick)
    m = len(leds.t_ns)
    fields = dict.fromkeys(LedArrays._fields, np.zeros(m)) | {
        "use": np.ones(m, dtype=np.bool_) if is_used is None else is_used(leds),
        "J": pictured.J_px,
        "cov_px2": np.broadcast_to(0.05**2 * np.eye(2), (m, 2, 2)),
        "residual_px": residual_px(leds, pictured),
    }
    views = np.ones((m, 1)) if by_view is None else by_view(leds)
    return AmongThemselves.of(LedArrays(**fields), leds, np.zeros((m, 2, 0)), views, 7)


def size_px(found):
    """Return the root of the mean square size of offsets that are alike in all LEDs."""
    belief = found.belief(SIZES_PX[:, None, None] ** 2 * np.eye(14), np.zeros(14))
    weight = np.exp(belief - belief.max())
    return np.sqrt((weight * SIZES_PX**2).sum() / weight.sum())


def test_poses_that_change_from_frame_to_frame_are_no_offsets(run):
    rng = np.random.default_rng(1)

    def moved(leds, pictured):
        step = rng.normal(size=(leds.frame.max() + 1, 6)) * np.repeat(
            [0.01, 0.5], 3
        )  # rad, mm: 5 px and more
        noise_px = rng.normal(0, 0.05, (len(leds.led), 2))
        return np.einsum("mik,mk->mi", pictured.J_px, step[leds.frame]) + noise_px

    assert size_px(measured(run, moved)) < 0.02


def test_offsets_are_measured_as_large_as_they_are(run):
    rng = np.random.default_rng(2)
    true_px = rng.normal(0, 0.2, (7, 2))

    def off(leds, _):
        return true_px[leds.led] + rng.normal(0, 0.05, (len(leds.led), 2))

    found = measured(run, off)
    assert len(found.value) == 8  # of 14 numbers a pose hides six
    z = (found.value - found.by_error @ true_px.ravel()) / found.noise_sd
    assert np.abs(z).max() < 4  # eight, of noise as it was drawn
    assert 0.1 < size_px(found) < 0.4  # eight draws of 0.2 px


def test_what_all_poses_hide_says_nothing_of_the_size(run):
    # A pixel, the way one and the same pose would move the LEDs: such as a wrong inertial sample asks for.
    step = np.array([2e-3, -1e-3, 1e-3, 0.05, -0.05, 0.4])  # rad, mm

    def as_by_a_pose(leds, pictured):
        mean = [pictured.J_px[leds.led == led].mean(axis=0) @ step for led in range(7)]
        return np.array(mean)[leds.led]

    moved_px = measured(run, as_by_a_pose)
    assert size_px(moved_px) < 0.02


def test_a_run_without_four_leds_in_a_frame_says_nothing(run):
    none = measured(run, lambda leds, _: np.ones((len(leds.led), 2)), is_used=lambda leds: leds.led < 3)
    assert not len(none.value)
    np.testing.assert_array_equal(none.belief(np.ones((3, 1, 1)) * np.eye(14), np.zeros(14)), np.zeros(3))


def test_changes_with_the_view_are_measured_beside_what_stays(run):
    rng = np.random.default_rng(3)
    stays_px, change_px = rng.normal(0, 0.1, (7, 2)), rng.normal(0, 0.3, (7, 2))

    def views(leds):
        return np.stack([np.ones(len(leds.led)), np.sin(0.7 * leds.frame)], axis=1)

    def off(leds, _):
        changed = views(leds)[:, 1, None] * change_px[leds.led]
        return stays_px[leds.led] + changed + rng.normal(0, 0.05, (len(leds.led), 2))

    found = measured(run, off, by_view=views)
    true_px = np.concatenate([stays_px.ravel(), change_px.ravel()])
    assert len(found.value) == 16  # eight each: one pose of all frames, and one that changes so, are hidden
    z = (found.value - found.by_error @ true_px) / found.noise_sd
    assert np.abs(z).max() < 4  # sixteen, of noise as it was drawn
    assert np.abs(found.value / found.noise_sd).max() > 30  # and there was something to find


def test_frames_beyond_what_is_summed_at_once_count_as_well(run, monkeypatch):
    def off(leds, _):
        return np.random.default_rng(4).normal(0, 0.2, (len(leds.led), 2))

    whole = measured(run, off)
    monkeypatch.setattr(leds_among_themselves, "_FRAMES_AT_ONCE", 13)
    parts = measured(run, off)
    prior = SIZES_PX[:, None, None] ** 2 * np.eye(14)
    np.testing.assert_allclose(
        parts.belief(prior, np.zeros(14)), whole.belief(prior, np.zeros(14)), atol=1e-8
    )
