import numpy as np
import pytest
from led_scenes import draw_disc, picture_of_light

from bricktrack_common.errors import ShapeError
from bricktrack_host.quality import LedFlag
from bricktrack_host.tracking.pictures.segment import PaperLimits, Picture, find_blobs, paper_filter

CENTRES = np.array([[300.3, 250.8], [700.6, 300.1], [1200.2, 700.7], [1700.9, 900.4]])


def scene(level=0.85, wall=0.03):
    light = np.full((1080, 1920), wall * level)
    for centre in CENTRES:
        draw_disc(light, centre, (34.0, 34.0), level=level)
    return light


def nearest(blobs, centre):
    distance = np.hypot(*(blobs.uv_px - centre).T)
    return int(distance.argmin()), float(distance.min())


@pytest.mark.parametrize("level", [1.0, 0.3, 0.08])
def test_all_leds_are_found_at_any_exposure(level):
    blobs = find_blobs(picture_of_light(scene(level)), radius_px=36.0)
    assert len(blobs) == len(CENTRES)
    for centre in CENTRES:
        assert nearest(blobs, centre)[1] < 0.02
    assert (blobs.flags == 0).all()


def test_the_papers_limits_need_the_right_exposure():
    assert len(paper_filter(picture_of_light(scene(0.85)))) == len(CENTRES)
    assert len(paper_filter(picture_of_light(scene(0.3)))) == 0  # grey 135: below its 200


def test_a_lamp_that_outshines_the_leds_does_not_hide_them():
    light = scene(0.25)
    light[40:100, 1500:1800] = 1.0
    blobs = find_blobs(picture_of_light(light), radius_px=36.0)
    for centre in CENTRES:
        assert nearest(blobs, centre)[1] < 0.02


def test_leds_of_different_brightness_are_all_found():
    light = np.full((1080, 1920), 0.01)
    for centre, level in zip(CENTRES, (1.0, 0.6, 0.35, 0.2), strict=True):
        draw_disc(light, centre, (34.0, 34.0), level=level)
    blobs = find_blobs(picture_of_light(light), radius_px=36.0)
    for centre in CENTRES:
        assert nearest(blobs, centre)[1] < 0.02


def test_small_leds_are_searched_with_a_finer_step():
    light = np.full((480, 640), 0.01)
    draw_disc(light, (201.3, 77.7), (6.0, 6.0), level=0.8)
    blobs = find_blobs(picture_of_light(light), radius_px=6.0)
    assert nearest(blobs, (201.3, 77.7))[1] < 0.05


def test_a_light_at_the_border_is_flagged_by_ours_and_dropped_by_the_paper():
    light = scene()
    light[500:560, :30] = 0.85
    blobs = find_blobs(picture_of_light(light), radius_px=36.0)
    i, distance = nearest(blobs, (15, 530))
    assert distance < 3
    assert blobs.flags[i] & LedFlag.BORDER
    assert nearest(paper_filter(picture_of_light(light)), (15, 530))[1] > 100


def test_two_lights_run_together_are_flagged():
    light = scene()
    draw_disc(light, CENTRES[0] + [52, 0], (34, 34), level=0.85)
    blobs = find_blobs(picture_of_light(light), radius_px=36.0)
    i, _ = nearest(blobs, CENTRES[0] + [26, 0])
    assert blobs.flags[i] & LedFlag.MERGED


def test_a_dark_picture_has_no_candidates():
    assert len(find_blobs(picture_of_light(np.full((480, 640), 0.001)))) == 0


def test_the_papers_centroid_is_the_plain_mean_of_the_pixels_that_pass():
    light = np.full((200, 200), 0.01)
    light[80:120, 90:131] = 0.9
    blobs = paper_filter(picture_of_light(light))
    np.testing.assert_allclose(blobs.uv_px, [[110.0, 99.5]])
    assert blobs.area_px2.tolist() == [40 * 41]


def test_the_papers_colour_limit_rejects_a_channel_below_100():
    light = np.full((200, 200), 0.01)
    draw_disc(light, (100, 100), (30, 30), level=0.85)
    picture = picture_of_light(light)
    yellow = Picture(picture.luma, np.full_like(picture.chroma_u, 50), picture.chroma_v)
    assert len(paper_filter(picture)) == 1
    # Luma 205 and Cb 50: blue = 1.164 * 189 + 2.017 * (50 - 128) = 63, grey still above 200.
    assert len(paper_filter(yellow)) == 0


def test_the_papers_limits_reject_by_eccentricity_and_size():
    light = np.full((300, 600), 0.01)
    draw_disc(light, (150, 150), (60, 20), level=0.9)
    draw_disc(light, (350, 150), (35, 35), level=0.9)
    draw_disc(light, (500, 150), (10, 10), level=0.9)
    blobs = paper_filter(picture_of_light(light), limits=PaperLimits.for_radius(36.0))
    assert len(blobs) == 1
    np.testing.assert_allclose(blobs.uv_px, [[350, 150]], atol=0.05)


def test_planes_that_do_not_belong_together_are_refused():
    with pytest.raises(ShapeError, match="twice half"):
        Picture(np.zeros((10, 10), np.uint8), np.zeros((5, 5), np.uint8), np.zeros((10, 10), np.uint8))


def test_read_only_views_with_a_stride_are_accepted():
    picture = picture_of_light(scene())
    padded = np.zeros((1080, 2048), np.uint8)
    padded[:, :1920] = picture.luma
    view = padded[:, :1920]
    view.flags.writeable = False
    blobs = find_blobs(Picture(view, picture.chroma_u, picture.chroma_v), radius_px=36.0)
    assert len(blobs) == len(CENTRES)
