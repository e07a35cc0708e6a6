"""``bricktrack calibrate fit`` on the simulated pictures that the repository carries, and on wrong input."""

import csv
import hashlib
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from bricktrack_common.errors import BricktrackError, CalibrationError, ConfigError
from bricktrack_host.calibration.calibration_file import load_calibration
from bricktrack_host.cli.calibrate import app

SAMPLE = Path(__file__).resolve().parents[2] / "data" / "path-traced"


def fit(*arguments):
    """Run the command; errors raised on purpose come out as they are."""
    result = CliRunner().invoke(app, ["fit", *map(str, arguments)], env={"COLUMNS": "140", "NO_COLOR": "1"})
    if isinstance(result.exception, BricktrackError):
        raise result.exception
    return result


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    path = tmp_path_factory.mktemp("calibration") / "sample.json"
    result = fit(
        "--rig",
        SAMPLE / "rig.toml",
        "--target",
        "32x18",
        "--unit",
        "sample",
        "--focus-note",
        "f/2",
        "--layout",
        SAMPLE / "layout.toml",
        "--figures",
        path.parent / "figures",
        "-o",
        path,
    )
    assert result.exit_code == 0, result.output
    return path, result.output


def test_the_sample_is_calibrated_and_reported(fitted):
    path, output = fitted
    calibration = load_calibration(path)
    assert (calibration.unit, calibration.focus_note) == ("sample", "f/2")
    assert calibration.simulated
    assert "simulated" in output
    # The sample's README: 490 whole dots at A (some 40 more have their centre in the picture); 576 at B.
    assert 485 <= calibration.images[0].n_dots_found <= 530
    assert calibration.images[1].n_dots_found == 576
    assert (
        calibration.images[0].sha256
        == hashlib.sha256((SAMPLE / "calib_A_32x18.png").read_bytes()).hexdigest()
    )
    assert calibration.sensor_mode.line_time_ns == pytest.approx(18903.5)
    # Dots are measured to about 0.02 px of 100 um at plane B.
    assert calibration.residuals[1].mean_um < 3.0
    for words in ("plane A: calib_A_32x18.png", "mean residual, µm", "Model: central", "of the picture"):
        assert words in output


def test_the_page_stands_alone_and_says_simulated(fitted):
    path, output = fitted
    page = path.with_suffix(".html").read_text()
    assert "Report written to" in output
    assert "SIMULATED" in page and "Calibration of sample" in page
    assert "http" not in page.replace("http://www.w3.org", "")  # nothing is fetched
    assert page.count("data:image/svg+xml") == 6
    for words in (
        "Residuals on the planes",
        "Coverage",
        "Uncertainty of the rays",
        "of the places where the",
    ):
        assert words in page
    pictures = {p.stem: cv2.imread(str(p)) for p in (path.parent / "figures").glob("*.png")}
    assert set(pictures) == {
        *("residual-contours", "residual-surfaces", "residual-arrows", "left-out-errors"),
        *("coverage", "uncertainty"),
    }
    assert all(p is not None and p.std() > 10 for p in pictures.values())  # none is blank


def test_an_earlier_calibration_of_another_unit_is_refused_before_the_work(fitted, tmp_path):
    with pytest.raises(CalibrationError, match="of unit 'sample', the recording of unit 'other'"):
        fit(
            "--rig", SAMPLE / "rig.toml", "--target", "32x18", "--unit", "other", "-o", tmp_path / "o.json",
            "--earlier", fitted[0],
        )  # fmt: skip
    assert not (tmp_path / "o.json").exists()


@pytest.mark.parametrize("order", ["0", "16", "five", "-1"])
def test_an_order_that_is_none_is_refused(tmp_path, order):
    with pytest.raises(
        ConfigError, match="expected a whole number from 1 to 15, 'held' or 'cross-validated'"
    ):
        fit(
            "--rig", SAMPLE / "rig.toml", "--target", "32x18", "--unit", "s", "-o", tmp_path / "o.json",
            f"--order={order}",
        )  # fmt: skip


def test_the_flags_say_the_same_as_the_rig_file(fitted, tmp_path):
    path = tmp_path / "flags.json"
    result = fit(
        "--plane-a", SAMPLE / "calib_A_32x18.png", "--a-mm", 101.117,
        "--plane-b", SAMPLE / "calib_B_32x18.png", "--b-mm", 161.111,
        "--pitch-mm", 4, "--columns", 32, "--rows", 18, "--origin-near", 960, 540, "--dot-diameter-mm", 2,
        "--unit", "sample", "-o", path, "--no-report",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert load_calibration(path).rays == load_calibration(fitted[0]).rays


def test_two_planes_can_be_asked_for(tmp_path):
    path = tmp_path / "two.json"
    result = fit(
        "--rig",
        SAMPLE / "rig.toml",
        "--target",
        "32x18",
        "--unit",
        "s",
        "-o",
        path,
        "--model",
        "two-plane",
        "--no-report",
    )
    assert result.exit_code == 0, result.output
    assert load_calibration(path).choice.model == "two-plane"
    assert load_calibration(path).choice.order == 5
    assert not path.with_suffix(".html").exists()
    assert "Warning: rays outside are extrapolated" in result.output  # at B dots fill half of the picture


@pytest.mark.skipif(
    "BRICKTRACK_SAMPLES" not in os.environ, reason="BRICKTRACK_SAMPLES names no samples folder"
)
def test_the_rays_are_true_over_the_whole_picture(fitted):
    """Judged at dots of a larger target, which the fit has not seen."""
    model = load_calibration(fitted[0]).ray_model
    with (Path(os.environ["BRICKTRACK_SAMPLES"]) / "path-traced/truth/calib_dots.csv").open() as f:
        truth = [row for row in csv.DictReader(f) if row["target"] == "54x32"]
    for plane, z_mm in (("A", 101.117), ("B", 161.111)):
        rows = np.array(
            [[float(r[k]) for k in ("u_px", "v_px", "x_mm", "y_mm")] for r in truth if r["plane"] == plane]
        )
        rows = rows[np.all((rows[:, :2] >= 0) & (rows[:, :2] <= [1919, 1079]), axis=1)]
        error_um = 1e3 * np.hypot(*(model.points_on_plane(rows[:, :2], z_mm) - rows[:, 2:]).T)
        assert error_um.mean() < 1.5
        assert error_um.max() < 15.0


@pytest.mark.skipif(
    "BRICKTRACK_SAMPLES" not in os.environ, reason="BRICKTRACK_SAMPLES names no samples folder"
)
def test_pictures_of_a_larger_target_confirm_the_calibration(fitted, tmp_path):
    """Dots that the fit has not seen, half of them where plane B's target did not reach."""
    pictures = Path(os.environ["BRICKTRACK_SAMPLES"]) / "path-traced"
    board = tmp_path / "54x32.toml"
    board.write_text("[target]\ncolumns = 54\nrows = 32\npitch_mm = 4.0\ndiameter_mm = 2.0\ncoded = false\n")
    result = CliRunner().invoke(
        app,
        [
            "check", str(fitted[0]), "--board", str(board), "--origin-near", "960", "540", "--board-um", "0",
            "--picture", f"101.117={pictures / 'calib_A_54x32.png'}",
            "--picture", f"161.111={pictures / 'calib_B_54x32.png'}",
        ],
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "The calibration holds" in result.output


def test_wrong_input_is_named(tmp_path):
    rig = ("--rig", SAMPLE / "rig.toml")
    out = ("--unit", "u", "-o", tmp_path / "c.json")
    with pytest.raises(ConfigError, match="54x32"):
        fit(*rig, *out, "--target", "9x9")
    with pytest.raises(CalibrationError, match=r"calib_A_32x18\.png: No such file"):
        fit(*rig, *out, "--target", "32x18", "--images-dir", tmp_path)
    with pytest.raises(ConfigError, match="--a-mm, --plane-b"):
        fit(*out, "--plane-a", "x.png")
    with pytest.raises(ConfigError, match="--a-mm given together with --rig"):
        fit(*rig, *out, "--a-mm", 100)
    (tmp_path / "calib_A_32x18.png").write_text("no picture")
    with pytest.raises(CalibrationError, match=r"calib_A_32x18\.png: not a picture"):
        fit(*rig, *out, "--target", "32x18", "--images-dir", tmp_path)
    cv2.imwrite(str(tmp_path / "calib_A_32x18.png"), np.zeros((480, 640), np.uint8))
    with pytest.raises(CalibrationError, match="640 x 480 px; sensor mode"):
        fit(*rig, *out, "--target", "32x18", "--images-dir", tmp_path)
    cv2.imwrite(str(tmp_path / "calib_A_32x18.png"), np.zeros((1080, 1920), np.uint8))
    with pytest.raises(CalibrationError, match=r"calib_A_32x18\.png: no dots found"):
        fit(*rig, *out, "--target", "32x18", "--images-dir", tmp_path)
    assert not (tmp_path / "c.json").exists()


def test_a_wrong_key_of_the_calibration_table_is_named_and_other_tables_pass(tmp_path):
    text = (SAMPLE / "rig.toml").read_text()
    rig = tmp_path / "rig.toml"
    rig.write_text(text.replace("pitch_mm = 4.0", 'pitch_mm = "4"'))
    out = ("--unit", "u", "-o", tmp_path / "c.json", "--target", "32x18")
    with pytest.raises(ConfigError, match=r"rig\.toml: calibration\.pitch_mm"):
        fit("--rig", rig, *out)
    rig.write_text(text.replace("plane_a_mm", "plane_a_cm"))
    with pytest.raises(ConfigError, match="plane_a_cm|plane_a_mm"):
        fit("--rig", rig, *out)


def test_help_shows_an_example():
    result = CliRunner().invoke(app, ["fit", "--help"], env={"COLUMNS": "120"})
    assert result.exit_code == 0
    assert "--target 32x18" in result.output
