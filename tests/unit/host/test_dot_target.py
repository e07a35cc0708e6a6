"""Dots drawn as outlines through a distorting camera: where they are is known from the outlines alone."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from bricktrack_common.errors import CalibrationError, ShapeError
from bricktrack_host.calibration.dots.dot_detection import detect_dots
from bricktrack_host.calibration.dots.dot_grid import GridOrigin, assign_grid

WIDTH, HEIGHT = 960, 540
FOCAL_PX, K1, K2, P1 = 760.0, -0.18, 0.06, 2e-4
PITCH_MM, DIAMETER_MM = 4.0, 2.0
UPSAMPLING = 8


def camera_px(xyz_mm):
    """Brown-Conrady pinhole, its axis a little off the middle of the picture."""
    x, y = xyz_mm[..., 0] / xyz_mm[..., 2], xyz_mm[..., 1] / xyz_mm[..., 2]
    r2 = x * x + y * y
    radial = 1 + K1 * r2 + K2 * r2**2
    u = FOCAL_PX * (x * radial + P1 * (r2 + 2 * x * x)) + 486.0
    v = FOCAL_PX * (y * radial + 2 * P1 * x * y) + 265.0
    return np.stack([u, v], axis=-1)


@dataclass
class Scene:
    grey: np.ndarray
    centroid_px: np.ndarray
    centre_px: np.ndarray
    xy_mm: np.ndarray
    whole: np.ndarray


def draw(
    *,
    columns=24,
    rows=14,
    z_mm=92.0,
    turn_deg=0.0,
    shift_mm=(0.0, 0.0),
    blur_px=1.0,
    noise=1.5,
    light=None,
    missing=(),
    seed=5,
):
    """Picture of a target whose centre lies at ``shift_mm``; xy_mm are board coordinates."""
    i, j = np.meshgrid(np.arange(columns), np.arange(rows))
    xy = np.stack([i - (columns - 1) / 2, j - (rows - 1) / 2], axis=-1).reshape(-1, 2) * PITCH_MM
    xy = np.delete(xy, list(missing), axis=0)
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))

    def place(board_mm):
        turned = board_mm @ np.array([[c, s], [-s, c]]) + shift_mm
        return camera_px(np.concatenate([turned, np.full((*turned.shape[:-1], 1), z_mm)], axis=-1))

    ring = np.linspace(0, 2 * np.pi, 96, endpoint=False)
    circle = DIAMETER_MM / 2 * np.stack([np.cos(ring), np.sin(ring)], axis=-1)
    outline = place(xy[:, None] + circle)
    a, b = outline, np.roll(outline, -1, axis=1)
    cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    centroid = ((a + b) * cross[..., None]).sum(axis=1) / (3 * cross.sum(axis=1))[:, None]
    inside = (outline > -0.5) & (outline < np.array([WIDTH, HEIGHT]) - 0.5)

    big = np.zeros((HEIGHT * UPSAMPLING, WIDTH * UPSAMPLING), np.uint8)
    near = np.abs(outline - [WIDTH / 2, HEIGHT / 2]).min(axis=1) < [WIDTH, HEIGHT]
    for polygon in outline[near.all(axis=1)]:
        fine = (polygon + 0.5) * UPSAMPLING - 0.5
        cv2.fillPoly(big, [np.round(fine * 16).astype(np.int32)], 255, shift=4)
    grey = cv2.resize(big, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA).astype(float) / 255
    if blur_px:
        grey = cv2.GaussianBlur(grey, (0, 0), blur_px)
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    level = np.ones_like(grey) if light is None else light(u / WIDTH, v / HEIGHT)
    grey = (25 + 160 * grey) * level + np.random.default_rng(seed).normal(0, noise, grey.shape)
    return Scene(
        np.clip(np.round(grey), 0, 255).astype(np.uint8), centroid, place(xy), xy, inside.all((1, 2))
    )


def matched(dots, scene):
    """Index of the true dot nearest to each found one."""
    distance = np.hypot(*np.moveaxis(dots.uv_px[:, None] - scene.centroid_px[None], -1, 0))
    return distance.argmin(axis=1)


@pytest.fixture(scope="module")
def plain():
    return draw()


def test_every_whole_dot_is_found_once_and_no_other(plain):
    dots = detect_dots(plain.grey)
    found = matched(dots, plain)
    assert len(set(found)) == len(found)
    # Dots that end within the blur (two sigma and rounding: 3 px) of the border may go either way.
    outline_reach = 0.5 * np.sqrt(4 * dots.area_px2.max() / np.pi) + 4
    margin = np.minimum(plain.centroid_px, [WIDTH, HEIGHT] - plain.centroid_px).min(axis=1)
    assert set(np.flatnonzero(margin > outline_reach)) <= set(found)
    assert plain.whole[found].all()


def test_centres_err_by_hundredths_of_a_pixel(plain):
    dots = detect_dots(plain.grey)
    error = dots.uv_px - plain.centroid_px[matched(dots, plain)]
    # 1.5 grey levels of noise on a step of 160, radius 8 px: 0.005 px; drawing adds 0.005.
    assert np.sqrt(np.mean(error**2)) < 0.012
    assert np.abs(error).max() < 0.05


@pytest.mark.parametrize("blur_px", [1.0, 2.0])
def test_the_covariance_is_that_of_the_noise(blur_px):
    scene = draw(noise=4.0, blur_px=blur_px)
    dots = detect_dots(scene.grey)
    error = dots.uv_px - scene.centroid_px[matched(dots, scene)]
    normalised = np.einsum("ni,nij,nj->n", error, np.linalg.inv(dots.cov_px2), error) / 2
    # 300 dots make 6 % of scatter in the mean; 0.005 px of drawing on 0.014 of noise adds 13 %.
    assert 0.75 < np.mean(normalised) < 1.4


def test_dark_dots_on_white_are_the_same_dots(plain):
    light = detect_dots(plain.grey)
    dark = detect_dots(255 - plain.grey)
    assert dark.polarity == "black-on-white"
    np.testing.assert_allclose(np.sort(dark.uv_px, axis=0), np.sort(light.uv_px, axis=0), atol=1e-9)


@pytest.mark.parametrize("blur_px", [0.0, 2.5])
def test_uneven_light_does_not_pull_the_centres(blur_px):
    scene = draw(light=lambda u, v: (0.35 + 0.65 * u) * (1 - 0.4 * v), blur_px=blur_px)
    dots = detect_dots(scene.grey)
    assert len(dots) > 0.8 * scene.whole.sum()
    error = dots.uv_px - scene.centroid_px[matched(dots, scene)]
    # Left alone, light that doubles over 500 px pulls a dot of radius 8 by r^2/4 dI/I = 0.03 px.
    assert np.abs(error.mean(axis=0)).max() < 0.005
    assert np.sqrt(np.mean(error**2)) < 0.03


@pytest.fixture(scope="module")
def overfull():
    """A target larger than the picture, and all dots found, cut or not."""
    scene = draw(columns=40, rows=24)
    return scene, detect_dots(scene.grey, keep_cut_dots=True)


def test_cut_dots_are_told_apart_and_kept_only_on_request(overfull):
    scene, every = overfull
    cut = every.touches_border
    assert cut.sum() > 40
    usual = detect_dots(scene.grey)
    np.testing.assert_array_equal(usual.uv_px, every.uv_px[~cut | every.is_completed])
    # None of those believed whole is cut, and the border moved none of them.
    whole = every.select(~cut)
    assert scene.whole[matched(whole, scene)].all()
    assert np.abs(whole.uv_px - scene.centroid_px[matched(whole, scene)]).max() < 0.05


def test_centres_of_cut_dots_are_completed_from_the_visible_rim(overfull):
    scene, every = overfull
    completed = every.select(every.is_completed)
    assert every.touches_border[every.is_completed].all()
    assert len(completed) > 15
    true = matched(completed, scene)
    error = completed.uv_px - scene.centroid_px[true]
    # Radius 8 px. The centroid of what is visible would be off by pixels: see the next lines.
    assert np.sqrt(np.mean(error**2)) < 0.07
    assert np.abs(error).max() < 0.2
    margin = np.minimum(scene.centroid_px[true], [WIDTH - 1, HEIGHT - 1] - scene.centroid_px[true]).min(
        axis=1
    )
    assert margin.min() < 5.0  # some are cut by more than three pixels
    assert margin.min() > 1.0  # none has its centre at the border: too little would be seen of it


def test_a_picture_without_dots_is_refused():
    noise = np.random.default_rng(1).normal(40, 3, (HEIGHT, WIDTH)).astype(np.uint8)
    with pytest.raises(CalibrationError, match="no dots found"):
        detect_dots(noise)
    with pytest.raises(CalibrationError, match="no dots found"):
        detect_dots(np.full((HEIGHT, WIDTH), 255, np.uint8))
    with pytest.raises(ShapeError, match="uint8"):
        detect_dots(noise.astype(float))


@pytest.mark.parametrize("turn_deg", [-43.0, -20.0, 0.0, 12.0, 43.0])
def test_the_grid_is_read_whole_at_any_turn(turn_deg):
    scene = draw(columns=20, rows=20, turn_deg=turn_deg, noise=1.0)
    centre = camera_px(np.array([0.0, 0.0, 92.0]))
    dots = detect_dots(scene.grey)
    placed = assign_grid(
        dots, pitch_mm=PITCH_MM, columns=20, rows=20, origin=GridOrigin((centre[0] + 5, centre[1] - 6))
    )
    assert len(placed) == len(dots)
    np.testing.assert_array_equal(placed.xy_mm, scene.xy_mm[matched(placed, scene)])


def test_a_moved_board_keeps_its_millimetres():
    here, there = draw(columns=12, rows=8), draw(columns=12, rows=8, shift_mm=(9.0, -5.0), turn_deg=8.0)
    placed = []
    for scene, centre_mm in ((here, (0, 0, 92)), (there, (9, -5, 92))):
        u, v = camera_px(np.array(centre_mm, dtype=float))
        placed.append(
            assign_grid(detect_dots(scene.grey), pitch_mm=4.0, columns=12, rows=8, origin=GridOrigin((u, v)))
        )
    assert len(placed[0]) == len(placed[1]) == 96
    order = [np.lexsort(p.xy_mm.T) for p in placed]
    np.testing.assert_array_equal(placed[0].xy_mm[order[0]], placed[1].xy_mm[order[1]])


def test_missing_dots_and_specks_leave_the_rest_in_place():
    scene = draw(columns=16, rows=10, missing=(40, 41, 42, 56, 57, 58, 72, 73, 74, 100))
    for u, v in ((433, 301), (610, 222)):
        cv2.circle(scene.grey, (u, v), 7, 185, -1, lineType=cv2.LINE_AA)
    u, v = camera_px(np.array([0.0, 0.0, 92.0]))
    placed = assign_grid(
        detect_dots(scene.grey), pitch_mm=4.0, columns=16, rows=10, origin=GridOrigin((u, v))
    )
    true = matched(placed, scene)
    on_dot = np.hypot(*(placed.uv_px - scene.centroid_px[true]).T) < 1
    np.testing.assert_array_equal(placed.xy_mm[on_dot], scene.xy_mm[true[on_dot]])
    assert np.count_nonzero(on_dot) >= len(scene.xy_mm) - 2  # a speck may have merged with a dot
    assert np.count_nonzero(~on_dot) == 0


def test_odd_counts_have_a_dot_in_the_centre_and_any_dot_can_be_nominated():
    scene = draw(columns=15, rows=9)
    dots = detect_dots(scene.grey)
    u, v = camera_px(np.array([0.0, 0.0, 92.0]))
    placed = assign_grid(dots, pitch_mm=4.0, columns=15, rows=9, origin=GridOrigin((u + 7, v + 7)))
    np.testing.assert_array_equal(placed.xy_mm, scene.xy_mm[matched(placed, scene)])

    nominated = camera_px(np.array([8.0, -4.0, 92.0]))
    placed = assign_grid(
        dots, pitch_mm=4.0, columns=15, rows=9, origin=GridOrigin(tuple(nominated), at="dot")
    )
    np.testing.assert_array_equal(placed.xy_mm, scene.xy_mm[matched(placed, scene)] - [8.0, -4.0])


def test_what_leaves_a_doubt_is_refused_with_words():
    scene = draw(columns=12, rows=8)
    dots = detect_dots(scene.grey)
    target = {"pitch_mm": 4.0, "columns": 12, "rows": 8}
    centre = camera_px(np.array([0.0, 0.0, 92.0]))

    def placed_at(x_mm, y_mm, **changes):
        u, v = camera_px(np.array([x_mm, y_mm, 92.0]))
        return assign_grid(dots, origin=GridOrigin((u, v)), **(target | changes))

    assert len(placed_at(0.0, 0.0)) == 96
    with pytest.raises(CalibrationError, match="ambiguous"):
        placed_at(2.0, 0.0)
    with pytest.raises(CalibrationError, match=rf"nearest centre that fits is near pixel \({centre[0]:.0f}"):
        placed_at(4.0, 0.0)
    with pytest.raises(CalibrationError, match="12 columns and 8 rows, the target only 10 x 8"):
        placed_at(0.0, 0.0, columns=10)
    with pytest.raises(CalibrationError, match="outside the dots"):
        placed_at(40.0, 0.0)
    with pytest.raises(CalibrationError, match="9 whole dots"):
        assign_grid(dots.select(np.arange(len(dots)) < 9), origin=GridOrigin((480, 270)), **target)
    with pytest.raises(CalibrationError, match="turned by 45 degrees"):
        turned = draw(columns=14, rows=14, turn_deg=45.0)
        assign_grid(
            detect_dots(turned.grey), origin=GridOrigin(tuple(centre)), pitch_mm=4, columns=14, rows=14
        )


def test_a_scatter_of_dots_is_no_grid():
    rng = np.random.default_rng(8)
    grey = np.full((HEIGHT, WIDTH), 30, np.uint8)
    for u, v in rng.uniform([30, 30], [WIDTH - 30, HEIGHT - 30], (60, 2)):
        cv2.circle(grey, (int(u), int(v)), 6, 190, -1, lineType=cv2.LINE_AA)
    with pytest.raises(CalibrationError, match="grid"):
        assign_grid(detect_dots(grey), pitch_mm=4, columns=20, rows=20, origin=GridOrigin((480, 270)))
