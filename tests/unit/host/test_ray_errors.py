"""What noisy dots do to poses of noiseless LEDs, over many calibrations of one camera; all simulated."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from tests.support.led_scenes import seven_leds
from tests.support.lens_boards import Board, brown, two_planes

from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_common.poses import Pose
from bricktrack_host.calibration.rays.central_rays import fit_central_rays
from bricktrack_host.calibration.rays.irt import fit_two_plane_irt
from bricktrack_host.results.ray_errors import ray_errors
from bricktrack_host.results.rest_pose import RestPose

LAYOUT = seven_leds()
LEDS_MM = LAYOUT.led_positions_mm
REST = Pose(Rotation.from_rotvec([0.05, -0.1, 0.02]).as_matrix(), np.array([-24.0, -22.0, 130.0]))
MOVED = Pose(
    REST.R @ Rotation.from_rotvec([0.03, -0.02, 0.04]).as_matrix(), REST.t_mm + np.array([2.5, -2.0, 3.0])
)
BOARD = Board(columns=13, rows=8, pitch_mm=9.0)
N_CALIBRATIONS = 16
OF_CHANCE = 3 * np.sqrt(2 / (6 * N_CALIBRATIONS))
"""Three deviations of the mean of chi squared of 6 over 6, over the calibrations."""
FITS = {
    "central": lambda planes: fit_central_rays(planes, sensor_mode=IMX219_1080P, order=5),
    "two planes": lambda planes: fit_two_plane_irt(planes, sensor_mode=IMX219_1080P, order=5),
}


def posed(rays, true_pose):
    """The pose at which LEDs lie where a lens shows those of the true one, by pixels."""
    uv = brown(true_pose.apply(LEDS_MM))

    def moved(x):
        return Pose(true_pose.R @ Rotation.from_rotvec(x[:3]).as_matrix(), true_pose.t_mm + 100 * x[3:])

    found = least_squares(lambda x: (rays.project(moved(x).apply(LEDS_MM)).uv_px - uv).ravel(), np.zeros(6))
    return moved(found.x)


def off(pose, true_pose):
    """``[dtheta, dt]`` that takes a pose to the true one."""
    turn = Rotation.from_matrix(pose.R.T @ true_pose.R).as_rotvec()
    return np.concatenate([turn, true_pose.t_mm - pose.t_mm])


@pytest.fixture(scope="module", params=list(FITS))
def calibrations(request):
    """Rays, and the poses that they lead to of a brick at rest and away from it."""
    found = []
    for seed in range(N_CALIBRATIONS):
        rays = FITS[request.param](two_planes(brown, seed, board=BOARD, noise_px=0.1))
        found.append((rays, posed(rays, REST), posed(rays, MOVED)))
    return found


def test_leds_that_show_elsewhere_put_poses_as_far_off_as_stated():
    rays = FITS["central"](two_planes(brown, 0, board=BOARD, noise_px=0.02))
    sd_px = np.array([2.0, 1.0, 3.0, 0.0, 2.0, 2.0, 1.0])
    covariance = ray_errors(rays, LAYOUT, REST, led_sd_px=sd_px).covariance(REST.R[None], REST.t_mm[None])[0]
    seen, rng, normalised = rays.project(REST.apply(LEDS_MM)).uv_px, np.random.default_rng(3), []
    for _ in range(40):
        uv = seen + rng.normal(size=(7, 2)) * sd_px[:, None]

        def moved(x):
            return Pose(REST.R @ Rotation.from_rotvec(x[:3]).as_matrix(), REST.t_mm + 100 * x[3:])

        found = least_squares(
            lambda x, uv=uv: (rays.project(moved(x).apply(LEDS_MM)).uv_px - uv).ravel(), np.zeros(6)
        )
        e = off(moved(found.x), REST)
        normalised.append(e @ np.linalg.solve(covariance, e))
    # Three deviations of the mean of chi squared of 6 over 6.
    assert np.mean(normalised) / 6 == pytest.approx(1, abs=3 * np.sqrt(2 / (6 * 40)))


def test_poses_are_as_far_off_as_stated(calibrations):
    normalised = []
    for rays, *poses in calibrations:
        errors = ray_errors(rays, LAYOUT, poses[0])
        for pose, truth in zip(poses, (REST, MOVED), strict=True):
            covariance = errors.covariance(pose.R[None], pose.t_mm[None])[0]
            e = off(pose, truth)
            normalised.append(e @ np.linalg.solve(covariance, e))
    assert np.mean(normalised) / 6 == pytest.approx(1, abs=OF_CHANCE)


def test_displacements_are_as_far_off_as_stated(calibrations):
    true = REST.inverse() @ MOVED
    normalised, ratio = [], []
    for rays, at_rest, pose in calibrations:
        errors = ray_errors(rays, LAYOUT, at_rest)
        rest = RestPose(
            at_rest.R, at_rest.t_mm, (0, 1), 4, np.full(3, 1e-7), np.full(3, 1e-9), np.zeros((6, 6)), "given",
            errors,
        )  # fmt: skip
        R, t_mm = pose.R[None], pose.t_mm[None]
        absolute = errors.covariance(R, t_mm)
        covariance = rest.relative_covariance(R, t_mm, absolute)[0]
        moved = rest.relative(R, t_mm)
        e = off(Pose(moved.R[0], moved.t_mm[0]), true)
        normalised.append(e @ np.linalg.solve(covariance, e))
        ratio.append(np.sqrt(np.diagonal(covariance) / np.diagonal(absolute[0])))
    assert np.mean(normalised) / 6 == pytest.approx(1, abs=OF_CHANCE)
    # Moved by 4 mm and turned by 3 degrees, with rays of few, noisy dots.
    assert (np.mean(ratio, axis=0) < 0.6).all()


def test_nothing_is_told_of_a_brick_that_hardly_shows(calibrations):
    rays, _, _ = calibrations[0]
    assert ray_errors(rays, LAYOUT, Pose(REST.R, REST.t_mm + np.array([150.0, 0, 0]))) is None
