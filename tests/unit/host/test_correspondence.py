from dataclasses import replace

import numpy as np
import pytest
from led_scenes import leds_in_camera, lit_outline, polygon_centroid, random_poses, seven_leds
from pinhole import PinholeCamera

from bricktrack_common.brick_model import LayoutFile, LedEntry, brick_model_from_file
from bricktrack_host.tracking.identity.correspondence import search_correspondence
from bricktrack_host.tracking.identity.paper_rules import (
    identify_by_paper,
    is_paper_layout,
    paper_correspondence,
)
from bricktrack_host.tracking.pictures.segment import Blobs

CAMERA = PinholeCamera()
BRICK = seven_leds()
COLLAR = 0.7
FITTED = seven_leds(collar_mm=COLLAR)
RADIUS_PX = 34.0


def blobs_at(uv, area=np.pi * RADIUS_PX**2 * 0.8):
    n = len(uv)
    return Blobs(
        uv_px=np.asarray(uv, dtype=float),
        cov_px2=np.broadcast_to(0.0036 * np.eye(2), (n, 2, 2)),
        area_px2=np.full(n, area),
        eccentricity=np.full(n, 0.3),
        fill=np.full(n, 1.0),
        flags=np.zeros(n, dtype=np.int64),
    )


def picture(R, t, *, seed, hidden=(), n_false=0, brick=BRICK):
    """Shuffled blobs of one pose, with their LEDs' numbers, -1 for false ones."""
    rng = np.random.default_rng(seed)
    uv = CAMERA.project(leds_in_camera(R[None], t[None], brick)).uv_px[0]
    led = np.array([i for i in range(brick.n_leds) if i not in hidden])
    points = np.vstack(
        [uv[led] + rng.normal(0, 0.3, (len(led), 2)), rng.uniform([60, 60], [1860, 1020], (n_false, 2))]
    )
    led = np.append(led, np.full(n_false, -1))
    order = rng.permutation(len(led))
    return blobs_at(points[order]), led[order]


def picture_of_domes(R, t, *, seed, hidden=(), n_false=0):
    """The same of lit domes, by their outlines; centroids and areas as of usual pictures."""
    rng = np.random.default_rng(seed)
    led = np.array([i for i in range(7) if i not in hidden])
    centres, axes = leds_in_camera(R[None], t[None], FITTED)[0, led], FITTED.led_axes[led] @ R.T
    outlines = [
        lit_outline(c, a, radius=3.0, collar=COLLAR, camera=CAMERA)
        for c, a in zip(centres, axes, strict=True)
    ]
    uv, area = zip(*(polygon_centroid(x) for x in outlines), strict=True)
    points = np.vstack(
        [uv + rng.normal(0, 0.06, (len(led), 2)), rng.uniform([60, 60], [1860, 1020], (n_false, 2))]
    )
    areas = np.append(area * np.exp(rng.normal(0, 0.05, len(led))), rng.uniform(900, 6000, n_false))
    led = np.append(led, np.full(n_false, -1))
    order = rng.permutation(len(led))
    return replace(blobs_at(points[order]), area_px2=areas[order]), led[order]


def check(found, led, *, at_least):
    for k, blob in enumerate(found.blob_of_led):
        assert blob == -1 or led[blob] == k, (found, led)
    assert found.n_found >= at_least


@pytest.mark.parametrize(
    ("hidden", "n_false"), [((), 0), ((), 4), ((0,), 3), ((1,), 0), ((2,), 3), ((0, 5), 2)]
)
@pytest.mark.parametrize("collar", [COLLAR, None])
def test_leds_are_identified_from_nothing(hidden, n_false, collar):
    R, t = random_poses(4, seed=hash((hidden, n_false)) % 1000, tilt_deg=30.0)
    for i in range(4):
        blobs, led = picture_of_domes(R[i], t[i], seed=i, hidden=hidden, n_false=n_false)
        brick = BRICK if collar is None else FITTED
        check(search_correspondence(blobs, CAMERA, brick, collar_mm=collar), led, at_least=7 - len(hidden))


@pytest.mark.parametrize(("hidden", "n_false"), [((), 0), ((), 4), ((0,), 3), ((0, 5), 2)])
def test_five_leds_at_least_are_identified_where_their_profile_is_like_no_guess(hidden, n_false):
    """A profile unlike any guess, points, leaves the sixth and seventh to less than 20,000 to one."""
    R, t = random_poses(4, seed=hash((hidden, n_false)) % 1000, tilt_deg=30.0)
    for i in range(4):
        blobs, led = picture(R[i], t[i], seed=i, hidden=hidden, n_false=n_false)
        check(search_correspondence(blobs, CAMERA, BRICK, collar_mm=None), led, at_least=5)


def test_four_leds_alone_are_identified_or_called_ambiguous_but_never_mistaken():
    R, t = random_poses(12, seed=21, tilt_deg=25.0)
    n_found = 0
    for i in range(12):
        blobs, led = picture(R[i], t[i], seed=i, hidden=(0, 4, 5))
        found = search_correspondence(blobs, CAMERA, BRICK, collar_mm=None)
        check(found, led, at_least=0)
        n_found += found.n_found == 4
    assert n_found >= 4


def test_a_layout_that_looks_the_same_turned_round_is_ambiguous():
    square = [(0.0, 0.0, 0.0), (40.0, 0.0, 0.0), (40.0, 40.0, 0.0), (0.0, 40.0, 0.0), (20.0, 20.0, -15.0)]
    leds = [
        LedEntry(name=f"s{i}", position_mm=p, axis=(0.0, 0.0, -1.0), radius_mm=3.0)
        for i, p in enumerate(square)
    ]
    brick = brick_model_from_file(LayoutFile(led=leds), where="test")
    blobs, _ = picture(np.eye(3), np.array([-20.0, -20.0, 140.0]), seed=1, brick=brick)
    found = search_correspondence(blobs, CAMERA, brick, collar_mm=None)
    assert found.is_ambiguous
    assert found.n_found == 0
    assert "equally well" in found.reason


def test_reflections_alone_are_no_brick():
    rng = np.random.default_rng(5)
    found = search_correspondence(
        blobs_at(rng.uniform([60, 60], [1860, 1020], (6, 2))), CAMERA, BRICK, collar_mm=None
    )
    # Four points can pass by chance for a brick far aside; six do not.
    assert found.n_found <= 4
    few = search_correspondence(blobs_at(np.array([[5.0, 5.0]])), CAMERA, BRICK, collar_mm=None)
    assert few.n_found == 0 and "four are needed" in few.reason


def test_the_likeliest_of_many_blobs_are_searched():
    R, t = random_poses(1, seed=31)
    blobs, led = picture_of_domes(R[0], t[0], seed=2, n_false=18)
    odd = led < 0
    blobs = replace(blobs, area_px2=np.where(odd, 300.0, blobs.area_px2), fill=np.where(odd, 0.7, 1.0))
    check(search_correspondence(blobs, CAMERA, FITTED, collar_mm=COLLAR), led, at_least=7)


def test_the_papers_rules_identify_its_layout():
    R, t = random_poses(60, seed=51, tilt_deg=20.0)
    right = 0
    for i in range(60):
        blobs, led = picture(R[i], t[i], seed=i)
        # Exact points: the blobs' noise of 0.3 px bends a column of 15 mm by a tenth of a degree.
        answer = paper_correspondence(CAMERA.points_on_plane(blobs.uv_px, 130.0))
        right += answer is not None and (led[answer] == np.arange(7)).all()
    assert right >= 57


def test_distortion_bends_the_column_out_of_the_papers_limit_in_raw_pixels():
    camera = PinholeCamera(k1=-0.35, k2=0.1)
    t = np.array([[-45.0, -24.0, 120.0]])
    uv = camera.project(leds_in_camera(np.eye(3)[None], t, BRICK)).uv_px[0]
    assert paper_correspondence(uv) is None
    calibrated = paper_correspondence(camera.points_on_plane(uv, 130.0))
    assert calibrated is not None
    assert calibrated.tolist() == list(range(7))


def test_the_papers_rules_are_believed_only_after_reprojection():
    R, t = random_poses(1, seed=61)
    blobs, led = picture(R[0], t[0], seed=3, n_false=2)
    found = identify_by_paper(blobs, CAMERA, BRICK, collar_mm=None, gate_px=12.0)
    check(found, led, at_least=7)
    broken = replace(blobs, uv_px=blobs.uv_px + np.where((led == 6)[:, None], 90.0, 0.0))
    assert identify_by_paper(broken, CAMERA, BRICK, collar_mm=None, gate_px=12.0).n_found == 0


def test_the_papers_layout_is_recognised():
    assert is_paper_layout(BRICK)
    bent = replace(BRICK, led_positions_mm=BRICK.led_positions_mm + np.eye(7)[3][:, None] * [3.0, 0, 0])
    assert not is_paper_layout(bent)
