import numpy as np
import pytest

from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.tracking.identity.identity_settling import settle

from .test_identity_newcomers import N, known_run

COVERED = slice(5, 14)


@pytest.mark.parametrize("led", [0, 5, 6])
def test_a_covered_led_taken_for_itself_costs_no_frame_where_six_others_agree(led):
    """What a card leaves of an LED, half its radius off, in more frames than a motion is bridged over."""
    run, _, t_mm = known_run(hidden=led)
    run.found.blob_of_led[COVERED, led] = led
    covered = run.lights.first[np.arange(N)[COVERED]] + led
    run.lights.uv_px[covered] = run.predict(np.arange(N)[COVERED]).uv_px[:, led] + [16.0, 5.0]
    settle(run)
    others = np.delete(np.arange(7), led)
    assert (run.found.blob_of_led[:, others] == others).all()
    assert (run.found.blob_of_led[:, led] == -1).all()
    # A tenth of a millimetre along the view, and some more: centroids good to 0.05 px, motion from splines.
    np.testing.assert_allclose(run.found.t_camera_brick_mm, t_mm, atol=0.5)


@pytest.mark.parametrize("covered", [0, 3, 5])
def test_of_five_leds_one_covered_costs_no_frame_that_moves_as_its_neighbours_do(covered):
    """The outstanding LED and another are hidden throughout; a card leaves a part of a third's light."""
    run, R, _ = known_run(hidden=2)
    run.found.blob_of_led[:, 1] = -1
    run.lights.uv_px[run.lights.first[:N] + 1] = [1800.0, 60.0]
    few = slice(12, 16)
    run.lights.uv_px[run.lights.first[:N][few] + covered] += [12.0, 4.0]
    settle(run)
    others = np.delete(np.arange(7), [1, 2, covered])
    assert (run.found.blob_of_led[:, others] == others).all()
    assert (run.found.blob_of_led[few, covered] == -1).all()
    turn = rvec_from_matrix(np.swapaxes(run.found.R_camera_brick, 1, 2) @ R)
    # Of four LEDs in a plane, moving: frames that turn by more than a degree off their neighbours are refused.
    assert np.degrees(np.linalg.norm(turn, axis=1)).max() < 1.0
