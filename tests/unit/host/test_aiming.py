"""A still's LEDs are counted, their edges measured against blur that is known, and their room to the border."""

import cv2
import numpy as np
import pytest

from bricktrack_common.errors import VideoError
from bricktrack_host.aiming import decode_grey, draw, look_at

ROWS, COLUMNS = 540, 960
LEDS = [(200.0, 150.0), (420.0, 300.0), (700.0, 400.0)]
RADIUS = 30.0


def still(leds=LEDS, *, blur_px=0.0, radius=RADIUS, level=200, background=30, more=()):
    """Draw discs eight times as large, so that edges are right to an eighth of a pixel, and blur them."""
    big = np.full((ROWS * 8, COLUMNS * 8), background, np.uint8)
    for u, v, r in [*((u, v, radius) for u, v in leds), *more]:
        cv2.circle(big, (round((u + 0.5) * 8), round((v + 0.5) * 8)), round(r * 8), level, -1)
    picture = cv2.resize(big, (COLUMNS, ROWS), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(picture, (0, 0), blur_px) if blur_px else picture


def test_leds_are_counted_from_left_to_right_and_reflections_are_not():
    aim = look_at(still(more=[(600.0, 100.0, 9.0)]))
    assert aim.n_found == 3
    assert len(aim.others) == 1
    assert aim.leds.uv_px == pytest.approx(
        np.array(LEDS), abs=0.1
    )  # the drawing's grid is an eighth of a pixel


@pytest.mark.parametrize("sd_px", [1.0, 2.0, 4.0])
def test_the_edges_width_is_that_of_the_blur(sd_px):
    """A straight edge behind a Gaussian goes from 20 % to 80 % within 2 * 0.8416 standard deviations."""
    aim = look_at(still(blur_px=sd_px))
    # Resampling adds some 0.3 px in square; a disc's edge is not quite straight.
    assert aim.focus_px == pytest.approx(2 * 0.8416 * sd_px, abs=0.35)


def test_margins_are_from_the_leds_outlines_to_the_borders():
    aim = look_at(still())
    left, top, right, bottom = aim.margins_px
    assert (left, top) == pytest.approx((200.5 - 30, 150.5 - 30), abs=0.5)
    assert (right, bottom) == pytest.approx((COLUMNS - 700.5 - 30, ROWS - 400.5 - 30), abs=0.5)


def test_an_led_over_the_border_has_no_room_and_no_width():
    aim = look_at(still([(10.0, 200.0), *LEDS]))
    assert aim.n_found == 4
    assert aim.margins_px[0] == 0.0
    assert np.isnan(aim.edge_width_px[0])
    assert np.isfinite(aim.focus_px)


def test_full_level_is_told():
    assert (look_at(still(level=235)).saturated > 0.99).all()
    assert (look_at(still(level=200)).saturated == 0).all()


def test_a_dark_picture_has_no_leds_and_is_still_drawn():
    luma = np.full((ROWS, COLUMNS), 18, np.uint8)
    aim = look_at(luma)
    assert (aim.n_found, aim.margins_px) == (0, None)
    assert np.isnan(aim.focus_px)
    assert draw(luma, aim, title="dark").shape == (ROWS, COLUMNS, 3)


def test_marks_are_drawn_around_leds_and_leave_their_middles():
    luma = still()
    picture = draw(luma, look_at(luma), title="")
    grey = round((200 - 16) * 255 / 219)
    assert picture[150, 200].tolist() == [grey] * 3
    around = picture[150, 200 + 30 : 200 + 40].astype(int)
    assert (around[:, 1] - around[:, 2]).max() > 80  # green


def test_bytes_that_are_no_grey_picture_are_refused():
    with pytest.raises(VideoError, match="no picture"):
        decode_grey(b"nonsense", source="b1")
    colour = cv2.imencode(".png", np.zeros((4, 4, 3), np.uint8))[1].tobytes()
    with pytest.raises(VideoError, match="shape"):
        decode_grey(colour, source="b1")
