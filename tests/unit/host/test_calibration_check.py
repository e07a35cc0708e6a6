"""A check's figures against dots made by projection through a known camera, with known noise."""

from dataclasses import dataclass

import numpy as np
import pytest
from board_pictures import BoardPose
from pinhole import PinholeCamera

from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.calibration_check import check_board
from bricktrack_host.calibration.dots.disc_bias import disc_bias_px
from bricktrack_host.calibration.dots.dot_observations import DotObservations

SD_PX = 0.05


@dataclass(frozen=True)
class StatedCamera(PinholeCamera):
    """A camera whose rays are stated to be exact to ``sd_mm``."""

    sd_mm: float = 0.0

    def point_covariance_mm2(self, uv_px, z_mm):
        return np.broadcast_to(self.sd_mm**2 * np.eye(2), (*np.shape(uv_px)[:-1], 2, 2))


def dots_at(pose, camera, *, seed=3, sd_px=SD_PX, diameter_mm=1e-3):
    i, j = np.meshgrid(np.arange(24), np.arange(14))
    xy = (np.stack([i, j], axis=-1).reshape(-1, 2) - [11.5, 6.5]) * 4.0
    p = pose.points(xy)
    rng = np.random.default_rng(seed)
    uv = camera.project(p).uv_px + rng.normal(0, sd_px, xy.shape)
    uv = uv + disc_bias_px(camera, p[:, :2], z_mm=p[:, 2], diameter_mm=diameter_mm, axes=pose.rotation[:, :2])
    n = len(xy)
    cov = np.tile(sd_px**2 * np.eye(2), (n, 1, 1))
    return DotObservations(uv, xy, cov, np.full(n, 400.0), np.stack([i, j], axis=-1).reshape(-1, 2))


@pytest.mark.parametrize(
    "pose",
    [BoardPose((0, 0, 101)), BoardPose((7, -4, 140), 100, 0, 0), BoardPose((3, 2, 150), -30, 18, -11)],
)
def test_right_rays_leave_what_the_dots_are_stated_to_have(pose):
    found = check_board(StatedCamera(), dots_at(pose, PinholeCamera()), dot_diameter_mm=1e-3)
    # 336 dots, 666 degrees of freedom: the ratio scatters by 2.7 %.
    assert found.ratio == pytest.approx(1, abs=0.08)
    assert found.n_outliers == 0
    normal = pose.rotation[:, 2]
    depth = normal @ np.array(pose.at_mm) / normal[2]
    assert abs(found.depth_mm - depth) < 4 * found.depth_sd_mm
    assert found.depth_sd_mm < 0.05
    assert found.tilt_deg == pytest.approx(np.rad2deg(np.arccos(normal[2])), abs=0.1)
    # 0.05 px at 1560 px and this depth, each coordinate; a slanting board more along its slope.
    expected_um = 1e3 * np.sqrt(2) * SD_PX * depth / 1560
    assert found.rms_um == pytest.approx(expected_um, rel=0.25)
    assert found.stated_um == pytest.approx(found.rms_um, rel=0.1)


def test_wrong_rays_leave_more():
    dots = dots_at(BoardPose((0, 0, 120)), PinholeCamera(k1=0.09), sd_px=0.02)
    assert check_board(StatedCamera(), dots, dot_diameter_mm=1e-3).ratio > 3
    # ... unless board or rays are stated to be as bad.
    assert check_board(StatedCamera(), dots, dot_diameter_mm=1e-3, board_um=200).ratio < 1
    assert check_board(StatedCamera(sd_mm=0.2), dots, dot_diameter_mm=1e-3).ratio < 1
    assert check_board(StatedCamera(), dots, dot_diameter_mm=1e-3, added_px=2.0).ratio < 1


def test_the_discs_bias_is_taken_out():
    camera = PinholeCamera(k1=-0.3, k2=0.1)
    dots = dots_at(BoardPose((0, 0, 101)), camera, sd_px=0.002, diameter_mm=2.0)
    stated = StatedCamera(k1=-0.3, k2=0.1)
    right = check_board(stated, dots, dot_diameter_mm=2.0)
    assert right.ratio == pytest.approx(1, abs=0.1)
    assert right.depth_mm == pytest.approx(101, abs=4 * right.depth_sd_mm + 1e-4)
    # Left in, it looks mostly like a board farther away.
    assert check_board(stated, dots, dot_diameter_mm=1e-3).depth_mm > 101.005


def test_a_slanting_disc_is_seen_off_its_centre():
    camera = PinholeCamera(k1=0, k2=0, p1=0, p2=0)
    pose = BoardPose((0, 0, 100.0), 0, 30.0, 0)
    bias = disc_bias_px(camera, np.zeros((1, 2)), z_mm=100.0, diameter_mm=4.0, axes=pose.rotation[:, :2])[0]
    # The exact centroid of the ellipse that a pinhole sees: the outline's own middle.
    ring = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    outline = camera.project(pose.points(2.0 * np.stack([np.cos(ring), np.sin(ring)], axis=-1))).uv_px
    exact = (outline.max(axis=0) + outline.min(axis=0)) / 2 - [camera.u0_px, camera.v0_px]
    np.testing.assert_allclose(bias, exact, atol=2e-4)
    assert abs(bias[1]) > 0.1


def test_dirty_dots_are_left_out_and_hopeless_ones_refused():
    dots = dots_at(BoardPose((0, 0, 120)), PinholeCamera())
    smeared = dots.uv_px.copy()
    smeared[[5, 100, 200]] += [1.5, -2.0]
    found = check_board(StatedCamera(), dots.moved_to(smeared), dot_diameter_mm=1e-3)
    assert found.n_outliers == 3
    assert found.ratio == pytest.approx(1, abs=0.08)
    with pytest.raises(CalibrationError, match="10 dots; a check needs at least 20"):
        check_board(StatedCamera(), dots.select(np.arange(len(dots)) < 10), dot_diameter_mm=1e-3)
    shrunk = DotObservations(dots.uv_px, dots.xy_mm / 100, dots.cov_px2, dots.area_px2, dots.column_row)
    with pytest.raises(CalibrationError, match="is the pitch of the target's file the true one"):
        check_board(StatedCamera(), shrunk, dot_diameter_mm=1e-3)
