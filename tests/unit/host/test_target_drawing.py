"""The printed target: rendered by a PDF reader, every dot lies where and is as large as it should, in mm."""

import numpy as np
import pypdfium2
import pytest
from typer.testing import CliRunner

from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dots.dot_detection import detect_dots
from bricktrack_host.calibration.dots.dot_grid import assign_coded_grid
from bricktrack_host.calibration.target.printed_target import DotTarget, load_target
from bricktrack_host.calibration.target.target_drawing import PAPERS_MM, draw_target, smallest_paper
from bricktrack_host.calibration.target.target_size import field_of_angles, filling_target
from bricktrack_host.cli.main import app

PX_PER_MM = 8.0


def rendered(path):
    """The page as a scanner would see it, grey, and the words on it."""
    page = pypdfium2.PdfDocument(path)[0]
    grey = page.render(scale=PX_PER_MM * 25.4 / 72, grayscale=True).to_numpy()
    return np.ascontiguousarray(grey.reshape(grey.shape[:2])), page.get_textpage().get_text_bounded()


@pytest.mark.parametrize("polarity", ["white-on-black", "black-on-white"])
def test_a_rendered_page_holds_every_dot_at_true_scale(polarity, tmp_path):
    target = DotTarget(columns=24, rows=14, pitch_mm=4.0, diameter_mm=2.0, polarity=polarity)
    assert draw_target(target, tmp_path / "t.pdf") == "A5"
    grey, words = rendered(tmp_path / "t.pdf")
    np.testing.assert_allclose(grey.shape, (1184, 1680), atol=1)  # 148 x 210 mm
    # Letters and rulers are dark on white: dots of another polarity than the white ones.
    dots = assign_coded_grid(detect_dots(grey, polarity=polarity), target)
    assert len(dots) == 24 * 14
    px_per_mm = np.array(grey.shape[::-1]) / [210, 148]  # the reader fills whole pixels
    scale = np.ptp(dots.uv_px, axis=0) / np.ptp(dots.xy_mm, axis=0) / px_per_mm
    # A renderer places edges to some hundredths of a pixel; the board is 736 px wide.
    np.testing.assert_allclose(scale, 1.0, atol=2e-4)
    from_middle = (dots.uv_px - dots.uv_px.mean(axis=0)) / px_per_mm
    np.testing.assert_allclose(from_middle, dots.xy_mm - dots.xy_mm.mean(axis=0), atol=0.01)
    diameter = 2 * np.sqrt(dots.area_px2 / np.pi) / PX_PER_MM
    np.testing.assert_allclose(diameter, target.diameters_mm()[dots.column_row[:, 1], dots.column_row[:, 0]],
                               rtol=0.02)  # fmt: skip
    for said in ("24 x 14 dots", "pitch 4 mm", "diameter 2 mm", "at 100 %", "100"):
        assert said in words


def test_the_rulers_are_true(tmp_path):
    target = DotTarget(columns=24, rows=14, pitch_mm=4.0, diameter_mm=2.0)
    draw_target(target, tmp_path / "t.pdf")
    grey, _ = rendered(tmp_path / "t.pdf")
    wide = np.flatnonzero((grey < 100).sum(axis=1) > 60 * PX_PER_MM)
    ruler, sheet_bottom = wide[-1], wide[wide < wide[-1] - 5 * PX_PER_MM][-1]
    assert (ruler - sheet_bottom) / PX_PER_MM == pytest.approx(17, abs=0.3)
    row = grey[ruler - 1 : ruler + 2].min(axis=0) < 200
    assert np.count_nonzero(row) == pytest.approx(100 * PX_PER_MM, abs=3)


def test_the_same_target_is_the_same_file(tmp_path):
    target = DotTarget(columns=8, rows=6, pitch_mm=4.0, diameter_mm=2.0)
    for name in ("a.pdf", "b.pdf"):
        draw_target(target, tmp_path / name)
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()


def test_what_does_not_fit_is_refused_with_what_would():
    wide = DotTarget(columns=54, rows=32, pitch_mm=4.0, diameter_mm=2.0)
    assert smallest_paper(wide) == "A4"
    with pytest.raises(CalibrationError, match=r"do not fit A5 \(210 x 148 mm\); take A4"):
        draw_target(wide, "unused.pdf", paper="A5")
    with pytest.raises(CalibrationError, match="fit no paper up to A0"):
        draw_target(DotTarget(columns=300, rows=300, pitch_mm=4.0, diameter_mm=2.0), "unused.pdf")
    with pytest.raises(CalibrationError, match="expected one of A5, A4"):
        draw_target(wide, "unused.pdf", paper="foolscap")
    assert PAPERS_MM["A4"] == (297.0, 210.0)


def test_a_filling_target_reaches_beyond_the_picture_at_both_planes():
    for fov in ((38.9, 22.5), (59.0, 35.4), (100.0, 70.0)):
        near, far = (field_of_angles(fov, z_mm=z, width_px=1920) for z in (101.117, 161.111))
        target = filling_target(near, far)
        for field in (near, far):
            assert field.share_filled(target) == 1.0
            assert (target.columns - 1) * target.pitch_mm > field.width_mm * 1.08
            assert (target.rows - 1) * target.pitch_mm > field.height_mm * 1.08
        assert near.dots_seen(target)[0] >= 24
        # ... by little: another two columns less would not do.
        assert (target.columns - 3) * target.pitch_mm < far.width_mm * 1.1


def test_the_command_writes_the_drawing_and_its_description(tmp_path):
    def run(*arguments):
        return CliRunner().invoke(
            app, ["target", *map(str, arguments)], env={"COLUMNS": "140", "NO_COLOR": "1"}
        )

    result = run("-o", tmp_path / "t.pdf", "--fov-deg", 59, 35.4, "--pitch-mm", 4)
    assert result.exit_code == 0, result.output
    target = load_target(tmp_path / "t.toml")
    assert (target.pitch_mm, target.diameter_mm, target.coded) == (4.0, 2.0, True)
    # tan(29.5 degrees) * 2 * 161.111 = 182.3 mm of picture.
    assert target.columns == 52
    assert "182 x 103" in result.output
    assert "100 %" in result.output
    paper = run("-o", tmp_path / "p.pdf", "--plain", "--columns", 32, "--rows", 18, "--pitch-mm", 4)
    assert "Change --pitch-mm" in paper.output  # 1080p crop: dots of 54 px at plane A
    assert not load_target(tmp_path / "p.toml").coded
    wrong = run("-o", tmp_path / "t.ps")
    assert (wrong.exit_code, "ends in .pdf" in wrong.output) == (1, True)
    wrong = run("-o", tmp_path / "t.pdf", "--planes-mm", 160, 100)
    assert (wrong.exit_code, "expected 0 < A < B" in wrong.output) == (1, True)
    wrong = run("-o", tmp_path / "t.pdf", "--fov-deg", 0, 20)
    assert (wrong.exit_code, "angles of view of 0 x 20" in wrong.output) == (1, True)
