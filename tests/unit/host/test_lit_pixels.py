"""Lights in windows against OpenCV's components and dilation: alone, beside others, with holes, at the rim."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from bricktrack_host.tracking.pictures.centroids import flat_bytes
from bricktrack_host.tracking.pictures.lit_pixels import LIT, OWN, light_near, near_others, widened

CUT = np.uint8(100)
Picture = NDArray[np.uint8]


def picture_of(*discs: tuple[float, float, float], size: tuple[int, int] = (70, 90)) -> Picture:
    """Return a picture, rows x columns, with discs of centre u, v and radius, wider in memory than it is."""
    v, u = np.mgrid[: size[0], : size[1]]
    picture = np.full((size[0], size[1] + 6), 250, dtype=np.uint8)[:, : size[1]]
    picture[:] = 20
    for at_u, at_v, radius in discs:
        picture[np.hypot(u - at_u, v - at_v) <= radius] = 200
    return picture


def found_near(picture: Picture, u: float, v: float) -> tuple[tuple[int, ...], NDArray[np.bool_], Picture]:
    """Return box and pixels of the light near a point, its pixels taken from rows' first to last, and the mask."""
    luma, stride = flat_bytes(picture)
    x, y, w, h, n, first, last, mask = light_near(
        luma, stride, 0, 0, picture.shape[1], picture.shape[0], CUT, u, v
    )
    column = np.arange(picture.shape[1])
    spanned = (column >= first[:, None]) & (column <= last[:, None])
    return (x, y, w, h, n), spanned, mask


def component_at(picture: Picture, u: int, v: int) -> tuple[tuple[int, ...], NDArray[np.bool_]]:
    _, labels, stats, _ = cv2.connectedComponentsWithStats((picture >= CUT).astype(np.uint8), connectivity=8)
    label = labels[v, u]
    assert label > 0
    return tuple(stats[label].tolist()), labels == label


@pytest.mark.parametrize("discs", [
    [(40.0, 30.0, 12.0)],
    [(40.0, 30.0, 0.0)],  # one pixel
    [(0.0, 0.0, 9.0)],  # in the corner
    [(40.0, 30.0, 12.0), (70.0, 30.0, 8.0)],
    [(40.0, 30.0, 12.0), (40.0, 55.0, 8.0)],  # one below the other: each row holds one run
    [(40.0, 30.0, 12.0), (49.0, 39.0, 6.0)],  # run together
])  # fmt: skip
def test_a_light_is_the_component_that_opencv_finds(discs: list[tuple[float, float, float]]) -> None:
    picture = picture_of(*discs)
    u, v = int(discs[0][0]), int(discs[0][1])
    box, pixels = component_at(picture, u, v)
    found, spanned, mask = found_near(picture, u, v)
    assert found == box
    assert mask.size or not ((picture >= CUT) & ~pixels).any()
    rows, columns = pixels.any(axis=1), np.arange(pixels.shape[1])
    first = np.where(pixels, columns, 1000).min(axis=1)
    last = np.where(pixels, columns, -1).max(axis=1)
    np.testing.assert_array_equal(spanned.any(axis=1), rows)
    np.testing.assert_array_equal(spanned, (columns >= first[:, None]) & (columns <= last[:, None]))
    if mask.size:
        np.testing.assert_array_equal(mask == OWN, pixels)
        np.testing.assert_array_equal(mask == LIT, (picture >= CUT) & ~pixels)


def test_lights_with_holes_and_runs_that_touch_by_corners_alone_are_whole() -> None:
    rng = np.random.default_rng(3)
    for _ in range(40):
        picture = picture_of()
        part = picture[20:50, 30:70]
        part[rng.random(part.shape) < rng.uniform(0.2, 0.95)] = 180
        picture[33:36, 48:51] = 180  # so that the middle's neighbours are lit, and it is taken itself
        assert found_near(picture, 49.0, 34.0)[0] == component_at(picture, 49, 34)[0]


def test_a_staircase_of_runs_is_one_light_and_a_broken_one_is_two() -> None:
    picture = picture_of()
    for j in range(5):
        picture[30 + j, 40 + 3 * j : 43 + 3 * j] = 200
    assert found_near(picture, 41.0, 30.0)[0] == (40, 30, 15, 5, 15)
    picture[32] = 20
    (_, y, _, h, n), _, mask = found_near(picture, 41.0, 30.0)
    assert (y, h, n) == (30, 2, 6)
    assert mask.size > 0


def test_a_disc_alone_needs_no_mask() -> None:
    assert found_near(picture_of((40.0, 30.0, 12.0)), 40.0, 30.0)[2].size == 0


def test_nothing_lit_is_no_light() -> None:
    assert found_near(picture_of(), 40.0, 30.0)[0][4] == 0


def test_what_lies_near_others_is_opencvs_dilation_but_for_the_light_itself() -> None:
    rng = np.random.default_rng(5)
    for reach in (1, 3, 6):
        mask = rng.choice(np.array([0, 1, 2], dtype=np.uint8), size=(31, 44), p=[0.94, 0.03, 0.03])
        square = np.ones((2 * reach + 1, 2 * reach + 1), dtype=np.uint8)
        expected = (cv2.dilate((mask == LIT).astype(np.uint8), square) > 0) & (mask != OWN)
        np.testing.assert_array_equal(near_others(mask, reach) > 0, expected)
    assert near_others(np.full((5, 5), OWN, dtype=np.uint8), 2).size == 0


def test_spans_are_widened_as_a_square_dilates_them() -> None:
    first, last = np.array([9, 4, 6, 9, 9]), np.array([-1, 5, 6, -1, -1])
    spans = np.zeros((5, 9), dtype=np.uint8)
    spans[1, 4:6] = spans[2, 6] = 1
    wide = cv2.dilate(spans, np.ones((3, 3), dtype=np.uint8))
    wide_first, wide_last = widened(first, last, 1, 0, 9)
    for j in range(5):
        lit = np.flatnonzero(wide[j])
        assert (
            (wide_first[j] > wide_last[j])
            if not lit.size
            else (wide_first[j], wide_last[j]) == (lit[0], lit[-1])
        )
    inside = widened(first, last, 3, 2, 8)
    assert inside[0].min() == 2
    assert inside[1].max() == 7
