"""From a printed target to rays, by the commands: capture from a unit at two depths, fit, check.

The unit is a fake one that serves drawn (simulated) pictures over the real protocol.
"""

import re

import cv2
import numpy as np
import pytest
from board_pictures import BoardPose, Faults, camera_of, picture_of_board
from fake_unit import FakeUnit
from typer.testing import CliRunner

from bricktrack_host.calibration.calibration_file import load_calibration
from bricktrack_host.calibration.capture_file import load_capture
from bricktrack_host.calibration.target.printed_target import DotTarget, target_toml
from bricktrack_host.cli import app

pytestmark = pytest.mark.slow  # some 20 s together, drawing included

TARGET = DotTarget(columns=48, rows=30, pitch_mm=4.0, diameter_mm=2.0)
CAMERA = camera_of()
MODE = """name = "full"
width = 960
height = 540
crop_width = 1920
crop_height = 1080
binning = 2
line_time_ns = 18903.5
"""


def run(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments], env={"COLUMNS": "160", "NO_COLOR": "1"})


def png(pose, *, seed=1, **faults):
    picture = picture_of_board(TARGET, CAMERA, pose, faults=Faults(seed=seed, **faults))
    return cv2.imencode(".png", picture.grey)[1].tobytes()


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    folder = tmp_path_factory.mktemp("desk")
    (folder / "runs").mkdir()
    (folder / "target.toml").write_text(target_toml(TARGET))
    (folder / "mode.toml").write_text(MODE)
    with FakeUnit(folder / "runs", name="b1") as unit:
        yield folder, unit


@pytest.fixture(scope="module")
def captured(desk):
    """The board hangs upside down, a little turned."""
    folder, unit = desk
    outputs = []
    for z_mm in (101.117, 161.111):
        unit.picture = png(BoardPose((0.3, -0.2, z_mm), 181.0))
        outputs.append(
            run(
                "calibrate",
                "capture",
                folder / "cal",
                "-a",
                unit.address,
                "--at-mm",
                z_mm,
                "--average",
                3,
                "--board",
                folder / "target.toml",
                "--sensor-mode",
                folder / "mode.toml",
            )
        )
    return folder / "cal", outputs


def test_pictures_are_taken_checked_and_kept(captured):
    folder, outputs = captured
    for result in outputs:
        assert result.exit_code == 0, result.output
        assert "Target at" in result.output
        assert "(simulated)" in result.output
        assert "Good to calibrate from" in result.output
        assert "Warning" not in result.output
    assert "a second depth is wanted" in outputs[0].output
    assert "can begin" in outputs[1].output
    capture = load_capture(folder)
    assert [p.z_mm for p in capture.picture] == [101.117, 161.111]
    assert (capture.unit, capture.simulated, capture.target) == ("b1", True, TARGET)
    assert capture.sensor_mode.name == "full"
    for p in capture.picture:
        assert (p.n_averaged, p.white_grey, p.exposure_us) == (3, 235.0, 2000)
        assert cv2.imread(str(folder / p.file), cv2.IMREAD_UNCHANGED).dtype == np.uint16
        seen = cv2.imread(str(folder / p.file.replace(".png", "_seen.png")))
        assert seen.shape == (540, 960, 3)
        # Something is drawn in colour.
        assert np.count_nonzero(np.ptp(seen.astype(int), axis=2) > 60) > 1000
    assert sorted(p.suffix for p in folder.iterdir()) == [".png"] * 4 + [".toml"]


@pytest.fixture(scope="module")
def calibration(captured, tmp_path_factory):
    path = tmp_path_factory.mktemp("fit") / "b1.json"
    result = run("calibrate", "fit", "--captured", captured[0], "-o", path)
    assert result.exit_code == 0, result.output
    return path


def test_the_captured_pictures_give_true_rays(calibration):
    stored = load_calibration(calibration)
    assert (stored.unit, stored.simulated) == ("b1", True)
    model = stored.ray_model
    u, v = np.meshgrid(np.linspace(30, 930, 20), np.linspace(30, 510, 12))
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    # Board axes: half a turn from the camera's, and a degree; the origin 0.3, -0.2 mm off.
    c, s = np.cos(np.deg2rad(1.0)), np.sin(np.deg2rad(1.0))
    for z_mm in (101.117, 130.0, 161.111):
        true = (CAMERA.points_on_plane(uv, z_mm) - [0.3, -0.2]) @ np.array([[c, -s], [s, c]])
        error_um = 1e3 * np.hypot(*(model.points_on_plane(uv, z_mm) - true).T)
        # 0.01 px of drawing and noise are 1.5 um at 130 mm, less for 300 dots together.
        assert np.median(error_um) < 2.0
        assert error_um.max() < 20.0


def test_a_bad_picture_is_told_and_a_wrong_one_refused(desk, captured, tmp_path):
    folder, unit = desk
    shared = ("--board", folder / "target.toml", "--sensor-mode", folder / "mode.toml", "--average", 1)
    unit.picture = png(
        BoardPose((65, 10, 130), 8.0, 2.5, 0),
        blur_px=3.2,
        light=lambda u, v: 0.1 + 0.95 * u * u,
    )
    result = run("calibrate", "capture", tmp_path / "bad", "-a", unit.address, "--at-mm", 130, *shared)
    assert result.exit_code == 0, result.output
    assert "px at the left without dots" in result.output
    assert "out of focus" in result.output
    assert "tilted by 2.5 degrees: its bottom is farther away" in result.output
    assert "turned by 8.0 degrees" in result.output
    assert "uneven light" in result.output

    before = load_capture(captured[0])
    unit.picture = cv2.imencode(".png", np.full((540, 960), 30, np.uint8))[1].tobytes()
    result = run("calibrate", "capture", captured[0], "-a", unit.address, "--at-mm", 161.111, "--average", 1)
    assert result.exit_code == 1
    assert "refused_z161.111mm.png: no dots found" in result.output
    assert load_capture(captured[0]) == before

    unit.picture = cv2.imencode(".png", np.full((480, 640), 30, np.uint8))[1].tobytes()
    result = run("calibrate", "capture", captured[0], "-a", unit.address, "--at-mm", 161.111, "--average", 1)
    assert "pictures of 640 x 480 px in mode 'full'" in result.output
    result = run("calibrate", "capture", tmp_path / "new", "-a", unit.address, "--at-mm", 161.111)
    assert "no pictures yet; say with --board" in result.output


def test_files_serve_as_well_and_movement_between_them_is_told(desk, tmp_path):
    folder, _ = desk
    for k, x_mm in enumerate((0.0, 0.01, 0.05)):
        (tmp_path / f"{k}.png").write_bytes(png(BoardPose((x_mm, 0, 120)), seed=k))
    shared = ("--board", folder / "target.toml", "--sensor-mode", folder / "mode.toml", "--at-mm", 120)
    images = [a for k in range(3) for a in ("--image", tmp_path / f"{k}.png")]
    result = run("calibrate", "capture", tmp_path / "cal", "--unit", "b1", *images, *shared)
    assert result.exit_code == 0, result.output
    # 0.05 mm at 120 mm and 850 px: 0.35 px.
    assert 0.3 < float(re.search(r"moved by ([0-9.]+) px", result.output)[1]) < 0.4
    assert load_capture(tmp_path / "cal").picture[0].source == "0.png, 1.png, 2.png"
    (tmp_path / "shifted.png").write_bytes(png(BoardPose((12, -6, 120), 90)))
    result = run(
        "calibrate", "capture", tmp_path / "cal", "--image", tmp_path / "shifted.png", "--add", "--at-mm", 120
    )
    assert result.exit_code == 0, result.output
    assert [p.file for p in load_capture(tmp_path / "cal").picture] == ["z120mm.png", "z120mm_2.png"]


def test_a_calibration_is_checked_with_pictures_taken_anyhow(desk, captured, calibration, tmp_path):
    folder, _ = desk
    result = run("calibrate", "check", calibration, "--captured", captured[0])
    assert result.exit_code == 0, result.output
    assert "The calibration holds." in result.output
    assert "simulated" in result.output

    board = ("--board", folder / "target.toml", "--picture")
    (tmp_path / "by-hand.png").write_bytes(png(BoardPose((5, -3, 137), -70, 12, 7), seed=5))
    result = run("calibrate", "check", calibration, *board, tmp_path / "by-hand.png")
    assert result.exit_code == 0, result.output
    assert "cannot be told" in result.output
    result = run("calibrate", "check", calibration, *board, f"101.117={tmp_path / 'by-hand.png'}")
    assert result.exit_code == 3
    assert "the board seems to be at 13" in result.output


@pytest.mark.parametrize(
    ("lens", "words"),
    [
        # Focused nearer: all rays 0.8 % narrower. With the board square that is another depth: 129 mm.
        ({"f_px": 0.885 * 960 * 1.008}, "the board seems to be at 128.9"),
        # Another lens: 1 % of k1 moves the corners by 0.3 px.
        ({"k1": -0.14}, "times what is stated"),
    ],
)
def test_a_lens_that_was_changed_is_found_out(desk, calibration, tmp_path, lens, words):
    folder, _ = desk
    changed = picture_of_board(TARGET, camera_of(**lens), BoardPose((0, 0, 130), 180))
    cv2.imwrite(str(tmp_path / "now.png"), changed.grey)
    result = run(
        "calibrate",
        "check",
        calibration,
        "--board",
        folder / "target.toml",
        "--picture",
        f"130={tmp_path / 'now.png'}",
        "--board-um",
        1,
    )
    assert result.exit_code == 3, result.output
    assert words in " ".join(result.output.split())
    assert "does not hold: calibrate again" in result.output


def test_a_check_names_what_is_missing(desk, captured, calibration, tmp_path):
    folder, _ = desk
    assert "give either --captured" in run("calibrate", "check", calibration).output
    assert (
        "--picture not given"
        in run("calibrate", "check", calibration, "--board", folder / "target.toml").output
    )
    result = run("calibrate", "check", tmp_path / "none.json", "--captured", captured[0])
    assert result.exit_code == 1
    assert "No such file" in result.output
