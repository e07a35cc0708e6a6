import numpy as np
from pinhole import PinholeCamera
from scipy.spatial.transform import Rotation

from bricktrack_host.tracking.pose.p3p import ray_centre_mm, rays_of, solve_p3p


def test_one_of_the_poses_is_the_true_one():
    rng = np.random.default_rng(1)
    n = 2000
    points = rng.uniform(-30, 30, (n, 3, 3))
    R = Rotation.random(n, random_state=2).as_matrix()
    t = np.column_stack([rng.uniform(-20, 20, (n, 2)), rng.uniform(100, 180, n)])
    X = np.einsum("nij,nkj->nki", R, points) + t[:, None]
    found_R, found_t, valid = solve_p3p(X / np.linalg.norm(X, axis=-1, keepdims=True), points)
    error = np.linalg.norm(found_t - t[:, None], axis=-1) + 50 * np.linalg.norm(
        found_R - R[:, None], axis=(-2, -1)
    )
    best = np.where(valid, error, np.inf).min(axis=1)
    # Slim triangles and double roots lose digits; those within 0.1 mm are starts as good as any.
    assert (best < 0.1).mean() > 0.99
    assert np.median(best) < 1e-7


def test_every_pose_brings_the_points_onto_the_rays():
    rng = np.random.default_rng(3)
    points = rng.uniform(-30, 30, (200, 3, 3))
    X = points + np.array([0.0, 0.0, 140.0])
    bearing = X / np.linalg.norm(X, axis=-1, keepdims=True)
    R, t, valid = solve_p3p(bearing, points)
    Y = np.einsum("nkij,nlj->nkli", R, points) + t[:, :, None]
    off = np.linalg.norm(np.cross(Y, bearing[:, None]), axis=-1).max(axis=-1)
    assert np.median(off[valid]) < 1e-8
    assert valid.any(axis=1).all()


def test_points_in_a_line_give_nothing():
    points = np.array([[[0.0, 0, 0], [0, 10, 0], [0, 25, 0]]])
    X = points + np.array([3.0, -9.0, 140.0])
    assert not solve_p3p(X / np.linalg.norm(X, axis=-1, keepdims=True), points)[2].any()


def test_no_triples_give_no_poses():
    assert solve_p3p(np.empty((0, 3, 3)), np.empty((0, 3, 3)))[2].shape == (0, 4)


def test_the_rays_of_a_pinhole_meet_in_its_pupil():
    camera = PinholeCamera()
    np.testing.assert_allclose(ray_centre_mm(camera), 0.0, atol=1e-6)
    points, directions = rays_of(camera, np.array([[100.0, 200.0], [959.5, 539.5]]))
    assert points[:, 2].tolist() == [camera.plane_a_mm] * 2
    np.testing.assert_allclose(np.cross(points, directions), 0.0, atol=1e-6)
