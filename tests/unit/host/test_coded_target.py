"""Coded targets in every way that a picture can be bad: each dot gets its own place, or the board is refused."""

import dataclasses

import numpy as np
import pytest
from board_pictures import BoardPose, Faults, camera_of, picture_of_board, wrong_and_right

from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dots.dot_detection import detect_dots
from bricktrack_host.calibration.dots.dot_grid import GridOrigin, assign_coded_grid, assign_grid
from bricktrack_host.calibration.dots.dot_observations import board_turn_deg, in_picture_axes
from bricktrack_host.calibration.dots.grid_code import find_code
from bricktrack_host.calibration.target.printed_target import DotTarget

TARGET = DotTarget(columns=32, rows=20, pitch_mm=4.0, diameter_mm=2.0)
CAMERA = camera_of()


def slanting(u, v):
    return (0.3 + 0.9 * u) * (1.1 - 0.6 * v)


HARD = [
    pytest.param(BoardPose((0, 0, 101)), Faults(), id="square-on, cut on all sides"),
    pytest.param(BoardPose((8, -5, 130), 93.0), Faults(hidden_share=0.3), id="turned by 93, 30 % hidden"),
    pytest.param(
        BoardPose((40, 22, 120), -37.0), Faults(hidden_share=0.2), id="a corner of it, turned by -37"
    ),
    pytest.param(
        BoardPose((0, 0, 140), 180.0, 20, -15), Faults(light=slanting, glare=0.3), id="upside down, tilted"
    ),
    pytest.param(
        BoardPose((-9, 4, 125), 45.0), Faults(n_reflections=8, hidden_share=0.1), id="at 45, 8 reflections"
    ),
    pytest.param(BoardPose((3, 3, 110), -135.0), Faults(blur_px=2.5, noise=0.02), id="out of focus, noisy"),
]


@pytest.mark.parametrize(("pose", "faults"), HARD)
def test_every_dot_placed_has_its_own_place(pose, faults):
    picture = picture_of_board(TARGET, CAMERA, pose, faults=faults)
    dots = assign_coded_grid(detect_dots(picture.grey), TARGET)
    wrong, right = wrong_and_right(dots, picture, within_px=2.0)
    assert wrong == 0
    # Dots under a reflection are lost, and those whose blurred rim reaches the border; no more.
    assert right > 0.85 * np.count_nonzero(picture.whole)
    # ... large and small alike.
    large = TARGET.large_dots()[dots.column_row[:, 1], dots.column_row[:, 0]]
    assert 0.18 < large.mean() < 0.32
    # A board tilted to the optical axis looks turned by a little more or less.
    assert abs((board_turn_deg(dots) - pose.turn_deg + 180) % 360 - 180) < 4.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_boards_with_every_fault_at_once_are_read_right_or_refused(seed):
    rng = np.random.default_rng([seed, 77])
    pose = BoardPose(
        (rng.uniform(-25, 25), rng.uniform(-15, 15), rng.uniform(90, 160)),
        rng.uniform(-180, 180), rng.uniform(-15, 15), rng.uniform(-15, 15),
    )  # fmt: skip
    a, b = rng.uniform(0.25, 1.1, 2)
    faults = Faults(
        hidden_share=0.3,
        light=lambda u, v: (a * (1 - u) + b * u) * (1 - 0.3 * v),
        blur_px=rng.uniform(0.3, 2),
        noise=rng.uniform(0.003, 0.02),
        n_reflections=int(rng.integers(0, 8)),
        glare=rng.uniform(0, 0.3),
        seed=seed,
    )
    picture = picture_of_board(TARGET, camera_of(k1=rng.uniform(-0.3, 0.1)), pose, faults=faults, samples=2)
    try:
        dots = assign_coded_grid(detect_dots(picture.grey), TARGET)
    except CalibrationError:
        return
    wrong, right = wrong_and_right(dots, picture, within_px=3.0)
    assert wrong == 0
    assert right > 0.7 * np.count_nonzero(picture.whole)


def test_the_pixel_noise_of_a_clean_picture_is_what_the_covariance_says():
    small = DotTarget(columns=17, rows=11, pitch_mm=4.0, diameter_mm=2.0)
    picture = picture_of_board(
        small, camera_of(640, 360), BoardPose((0, 0, 80), 20.0),
        size=(640, 360), faults=Faults(noise=0.02), samples=8,
    )  # fmt: skip
    dots = assign_coded_grid(detect_dots(picture.grey), small)
    index = {tuple(c): k for k, c in enumerate(picture.column_row)}
    true = picture.centroid_px[[index[tuple(c)] for c in dots.column_row]]
    error = dots.uv_px - true
    normalised = np.einsum("ni,nij,nj->n", error, np.linalg.inv(dots.cov_px2), error) / 2
    # The median of chi-square with two degrees of freedom, by two: 0.69; with 180 dots it scatters by 11 %.
    assert 0.5 < np.median(normalised) < 1.0


def test_black_dots_and_16_bit_means_are_read_alike():
    target = DotTarget(columns=20, rows=14, pitch_mm=4.0, diameter_mm=2.0, polarity="black-on-white")
    pose = BoardPose((2, 1, 120), 70.0)
    eight, sixteen = (
        picture_of_board(target, CAMERA, pose, faults=Faults(noise=0), bits=bits) for bits in (8, 16)
    )
    a, b = (assign_coded_grid(detect_dots(p.grey), target) for p in (eight, sixteen))
    wrong, right = wrong_and_right(a, eight, within_px=1.0)
    assert wrong == 0
    assert right >= np.count_nonzero(eight.whole)
    order = [np.lexsort(d.column_row.T) for d in (a, b)]
    # Rounding to 1/255 on a step of 163 grey levels over some 30 rim pixels: 0.001 px.
    np.testing.assert_allclose(a.uv_px[order[0]], b.uv_px[order[1]], atol=0.006)


def test_planes_are_turned_together_and_by_quarters_only():
    poses = (BoardPose((0, 0, 101), 133.0), BoardPose((0, 0, 140), 136.0))  # 135 lies between two quarters
    planes = [assign_coded_grid(detect_dots(picture_of_board(TARGET, CAMERA, p).grey), TARGET) for p in poses]
    turned = in_picture_axes(planes)
    quarter = {round((board_turn_deg(t) - p.turn_deg) / 90) for t, p in zip(turned, poses, strict=True)}
    assert len(quarter) == 1
    assert max(abs(board_turn_deg(t)) for t in turned) < 47
    elsewhere = picture_of_board(TARGET, CAMERA, BoardPose((0, 0, 140), 40.0))
    other = assign_coded_grid(detect_dots(elsewhere.grey), TARGET)
    with pytest.raises(CalibrationError, match="turned by 13[0-9.]+, 4[0-9.]+ degrees"):
        in_picture_axes([planes[0], other])


def test_what_the_sizes_do_not_tell_is_refused():
    plain = DotTarget(columns=32, rows=20, pitch_mm=4.0, diameter_mm=2.0, coded=False)
    uncoded = detect_dots(picture_of_board(plain, CAMERA, BoardPose((0, 0, 120))).grey)
    with pytest.raises(CalibrationError, match="fit no place on the coded target of 32 x 20"):
        assign_coded_grid(uncoded, TARGET)

    picture = picture_of_board(TARGET, CAMERA, BoardPose((0, 0, 120), 10.0))
    with pytest.raises(CalibrationError, match="the picture is mirrored"):
        assign_coded_grid(detect_dots(np.ascontiguousarray(picture.grey[:, ::-1])), TARGET)

    dots = detect_dots(picture.grey)
    few = dots.select(np.hypot(*(dots.uv_px - [480, 270]).T) < 75)
    with pytest.raises(CalibrationError, match="dots of known size found; a coded target needs at least 30"):
        assign_coded_grid(few, TARGET)


def test_few_dots_that_fit_two_places_are_ambiguous():
    """The code's smallest windows that are all different: six by six, some by one dot only."""
    target = DotTarget(columns=54, rows=32, pitch_mm=4.0, diameter_mm=2.0)
    windows = np.lib.stride_tricks.sliding_window_view(target.large_dots(), (6, 6)).reshape(-1, 36)
    differing = windows.astype(float) @ (~windows).T + (~windows).astype(float) @ windows.T
    np.fill_diagonal(differing, 36)
    closest, farthest = differing.min(axis=1).argmin(), differing.min(axis=1).argmax()
    rows, columns = np.nonzero(np.ones((6, 6)))
    ij = np.stack([columns, rows], axis=1)
    with pytest.raises(CalibrationError, match="which part of the target is seen is ambiguous: 36 dots"):
        find_code(ij, windows[closest].astype(int), ij * 30.0, target)
    place = find_code(ij + np.array([7, -3]), windows[farthest].astype(int), ij * 30.0, target)
    np.testing.assert_array_equal(place.column_row - ij, [[farthest % 49, farthest // 49]] * 36)


def test_a_slipped_part_of_the_grid_is_refused():
    rows, columns = np.nonzero(np.ones((20, 32)))
    ij = np.stack([columns, rows], axis=1)
    seen = TARGET.large_dots()[rows, columns].astype(int)
    place = find_code(ij, seen, ij * 30.0, TARGET)
    np.testing.assert_array_equal(place.column_row, ij)
    assert not place.contradicts.any()
    slipped = ij + np.where((columns > 26) & (rows > 13), 1, 0)[:, None] * [1, 0]
    with pytest.raises(CalibrationError, match="wrong size for their place"):
        find_code(slipped, seen, ij * 30.0, TARGET)
    # Single misread dots are left out, and nothing else is.
    misread = seen.copy()
    misread[[7, 200, 455]] ^= 1
    np.testing.assert_array_equal(
        np.flatnonzero(find_code(ij, misread, ij * 30.0, TARGET).contradicts), [7, 200, 455]
    )


def test_a_grid_torn_across_a_gap_is_refused():
    """Two halves of a board, one of them off by a third of a step: no single grid."""
    picture = picture_of_board(TARGET, CAMERA, BoardPose((0, 0, 130)))
    dots = detect_dots(picture.grey)
    right = dots.uv_px[:, 0] > 500
    step = 25.0
    gap = np.abs(dots.uv_px[:, 0] - 500) < 1.6 * step
    torn = dataclasses.replace(dots, uv_px=dots.uv_px + np.where(right, 0.45 * step, 0.0)[:, None] * [1, 0])
    with pytest.raises(CalibrationError, match="torn|form one grid"):
        assign_grid(
            torn.select(~gap), pitch_mm=4.0, columns=32, rows=20, origin=GridOrigin((300, 270), "dot")
        )


def test_a_plain_target_in_view_whole_needs_no_origin():
    plain = DotTarget(columns=15, rows=11, pitch_mm=4.0, diameter_mm=2.0, coded=False)
    picture = picture_of_board(plain, CAMERA, BoardPose((6, -4, 110), 12.0), faults=Faults(hidden_share=0.1))
    dots = assign_grid(detect_dots(picture.grey), pitch_mm=4.0, columns=15, rows=11)
    assert wrong_and_right(dots, picture, within_px=1.0)[0] == 0
    cut = picture_of_board(plain, CAMERA, BoardPose((48, -4, 110), 12.0))
    with pytest.raises(CalibrationError, match="--origin-near"):
        assign_grid(detect_dots(cut.grey), pitch_mm=4.0, columns=15, rows=11)
