import numpy as np
import pytest

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
