"""The film of a run: marks are where the LEDs are, frames keep their times, and nothing half-written stays."""

from dataclasses import replace

import numpy as np
import pytest
from example_report import example_result

from bricktrack_common.errors import ConfigError
from bricktrack_host.cli.overlay import overlay
from bricktrack_host.viewing import overlay as drawing
from bricktrack_host.viewing.overlay import STRIP_ROWS, UNUSED, USED, OverlayArtist

WIDTH, HEIGHT = 1920, 1080
BLACK = np.full((HEIGHT, WIDTH), 16, dtype=np.uint8)


@pytest.fixture(scope="module")
def result():
    return example_result()


@pytest.fixture(scope="module")
def artist(result):
    return OverlayArtist.of(result, WIDTH, HEIGHT)


def coloured(picture, colour):
    """Return (u, v) of the pixels of about a colour, in the picture above the strip."""
    near = np.abs(picture[:HEIGHT].astype(int) - colour).max(axis=2) < 12
    rows, columns = np.nonzero(near)
    return np.stack([columns, rows], axis=1)


def test_every_used_led_gets_a_ring_around_its_centroid(result, artist):
    index = 50
    picture = artist.draw(index, BLACK)
    assert picture.shape == (HEIGHT + STRIP_ROWS, WIDTH, 3)
    ring = coloured(picture, USED)
    checked = 0
    for uv, area in zip(result.observations.uv_px[index], result.observations.area_px2[index], strict=True):
        distance = np.linalg.norm(ring - uv, axis=1)
        radius = np.sqrt(area / np.pi) + 6
        if np.min([uv - radius, [WIDTH, HEIGHT] - uv - radius]) < 3:
            continue  # the picture's border cuts this ring
        checked += 1
        around = np.abs(distance - radius) < 2.5
        # A ring two pixels wide has at least its circumference in pixels; its label touches none of it.
        assert around.sum() > 0.8 * 2 * np.pi * radius
        mean = ring[around].mean(axis=0)
        assert np.abs(mean - uv).max() < 1.5
    assert checked >= 5


def test_an_led_that_is_not_used_has_another_colour(result, artist):
    covered = np.flatnonzero(
        np.isnan(result.optical.residual_px[:, 0, 0]) & np.isfinite(result.observations.uv_px[:, 0, 0])
    )
    picture = artist.draw(int(covered[0]), BLACK)
    uv = result.observations.uv_px[covered[0], 0]
    distance = np.linalg.norm(coloured(picture, UNUSED) - uv, axis=1)
    assert (distance < 60).sum() > 100


def test_a_lost_picture_is_grey_and_says_so(artist):
    picture = artist.draw(5, None)
    assert (picture[HEIGHT // 2, WIDTH // 2] == 60).all()


def test_the_cursor_moves_with_time_not_with_the_frames_number(result, artist):
    t_ns = result.optical.t_ns
    columns = [int(artist._cursor[i]) for i in (0, 120, 121, len(t_ns) - 1)]
    # Two frames are missing after 120: the cursor steps over three periods there.
    assert columns[2] - columns[1] == pytest.approx(3 * (columns[1] - columns[0]) / 120, abs=1.5)


def words_of(artist, index, picture, monkeypatch):
    words = []
    monkeypatch.setattr(drawing, "_write", lambda picture, text, at, colour: words.append(text))
    artist.draw(index, picture)
    return words


def test_a_dropout_shows_what_is_known_without_the_camera(result, artist, monkeypatch):
    hidden = int(np.flatnonzero(np.isnan(result.optical.t_camera_brick_mm[:, 0]))[3])
    words = words_of(artist, hidden, BLACK, monkeypatch)
    assert "camera alone   no pose" in words
    fused = next(text for text in words if text.startswith("fused"))
    x_mm = float(fused.split("x ")[1].split()[0])
    moved = result.rest.relative(
        result.fused["frame"].R_camera_brick[[hidden]], result.fused["frame"].t_camera_brick_mm[[hidden]]
    )
    assert x_mm == pytest.approx(moved.t_mm[0, 0], abs=6e-4)  # three decimals


def test_the_strip_of_chosen_frames_spans_them_alone(result):
    artist = OverlayArtist.of(result, WIDTH, HEIGHT, frames=(200, 260))
    assert (artist._cursor[200], artist._cursor[259]) == (90, WIDTH - 30)
    assert np.ptp(artist._cursor[:200]) == 0
    # Drawn to the scale of these frames: a curve comes near the upper or the lower end.
    plot = artist._strip[drawing._WORDS_ROWS + 34 : -30].astype(int)
    rows = np.concatenate([np.nonzero(np.abs(plot - ink).max(axis=2) < 12)[0] for ink in drawing.AXES])
    assert min(rows.min(), len(plot) - 1 - rows.max()) < 12


def test_the_line_goes_on_where_the_camera_saw_nothing(result, artist):
    hidden = np.flatnonzero(np.isnan(result.optical.t_camera_brick_mm[:, 0]))
    columns = np.arange(artist._cursor[hidden[2]], artist._cursor[hidden[-3]])
    plot = artist._strip[drawing._WORDS_ROWS + 34 :, columns].astype(int)
    assert len(columns) > 10
    inked = [(np.abs(plot - ink).max(axis=2) < 60).any(axis=0) for ink in drawing.AXES]
    assert inked[2].all()  # drawn last; it hides the others where they cross
    assert min(np.mean(columns) for columns in inked) > 0.5


def test_no_rest_is_said(result, monkeypatch):
    words = words_of(OverlayArtist.of(replace(result, rest=None), WIDTH, HEIGHT), 3, BLACK, monkeypatch)
    assert any("from the camera" in text for text in words)
    assert any("SIMULATED" in text for text in words)


@pytest.mark.parametrize("name", ["film.txt", "film.avi", "film", "mp4"])
def test_a_name_that_is_no_films_is_refused_before_anything_is_read(tmp_path, name):
    with pytest.raises(ConfigError, match=r"the film is an MP4; name it film\.mp4|name it mp4\.mp4"):
        overlay(tmp_path / "no_run", output=tmp_path / name)
