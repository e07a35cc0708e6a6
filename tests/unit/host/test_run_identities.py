import numpy as np
import pytest

from bricktrack_common.rotations import matrix_from_rvec

from .test_identity_newcomers import known_run


def turn_a_frame(found):
    found.R_camera_brick[7] = found.R_camera_brick[7] @ matrix_from_rvec(np.array([0.0, 0.01, 0.0]))


def shift_a_frame(found):
    found.t_camera_brick_mm[7, 0] += 0.5


def lose_a_frame(found):
    found.R_camera_brick[7], found.t_camera_brick_mm[7] = np.nan, np.nan


def drop_a_light(found):
    found.blob_of_led[7, 3] = -1


@pytest.mark.parametrize("change", [turn_a_frame, shift_a_frame, lose_a_frame, drop_a_light])
def test_a_runs_motion_is_that_of_what_is_found_now(change):
    run, _, _ = known_run()
    at_first = run.motion()
    assert run.motion() is at_first
    change(run.found)
    now = run.motion()
    untouched, _, _ = known_run()
    change(untouched.found)
    expected = untouched.motion()
    np.testing.assert_array_equal(now.R_camera_brick, expected.R_camera_brick)
    np.testing.assert_array_equal(now.within.shift_camera_mm, expected.within.shift_camera_mm)
    np.testing.assert_array_equal(now.within.dt_s, expected.within.dt_s)
    assert now is not at_first


def test_attitudes_given_for_those_found_make_a_motion_of_their_own():
    run, R, _ = known_run()
    found = run.motion()
    turned = R @ matrix_from_rvec(np.array([0.0, 0.1, 0.0]))
    given = run.motion(turned)
    np.testing.assert_array_equal(given.R_camera_brick, turned)
    np.testing.assert_array_equal(run.motion().R_camera_brick, found.R_camera_brick)
