"""What is saved comes back and projects alike; what is damaged, newer or of another camera is refused."""

import json
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import numpy as np
import pytest

from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.calibration_file import (
    Target,
    TargetImage,
    load_calibration,
    make_calibration,
    rays_of_recording,
    require_match,
    save_calibration,
)
from bricktrack_host.calibration.dots.dot_observations import DotObservations
from bricktrack_host.calibration.rays.ray_calibration import calibrate_rays

PLANES_MM = (101.117, 161.111)
DATA = Path(__file__).resolve().parents[2] / "data" / "calibrations"


def see(z_mm):
    """Dots through a pinhole of 1600 px with some barrel distortion."""
    i, j = np.meshgrid(np.arange(-15.5, 16), np.arange(-8.5, 9))
    xy = 4.0 * np.stack([i.ravel(), j.ravel()], axis=1)
    slope = xy / z_mm
    uv = 1600.0 * slope * (1 - 0.1 * (slope**2).sum(axis=1, keepdims=True)) + [959.5, 539.5]
    uv += np.random.default_rng(int(z_mm)).normal(0, 0.02, uv.shape)
    keep = np.all((uv > 16) & (uv < [1904, 1064]), axis=1)
    n = int(keep.sum())
    cov = np.broadcast_to(4e-4 * np.eye(2), (n, 2, 2))
    return DotObservations(uv[keep], xy[keep], cov, np.full(n, 800.0), np.zeros((n, 2), dtype=np.int64))


@pytest.fixture(scope="module", params=["central", "walking-pupil", "two-plane"])
def calibration(request):
    fitted = calibrate_rays(
        [(z, see(z)) for z in PLANES_MM], sensor_mode=IMX219_1080P, model=request.param, dot_diameter_mm=2.0
    )
    return make_calibration(
        fitted,
        unit="brick-1",
        target=Target(columns=32, rows=18, pitch_mm=4.0, dot_diameter_mm=2.0),
        images=tuple(
            TargetImage(name=f"{z}.png", sha256="0" * 64, z_mm=z, n_dots_found=500, n_dots_left_out=0)
            for z in PLANES_MM
        ),
        focus_note="ring at 126 mm, locked with varnish",
        created_utc=datetime(2026, 11, 22, 12, 0, tzinfo=UTC),
    )


@pytest.fixture
def path(calibration, tmp_path):
    save_calibration(tmp_path / "calibration.json", calibration)
    return tmp_path / "calibration.json"


def rewritten(path, change):
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    return path


def test_a_saved_calibration_comes_back_to_the_last_bit(calibration, path):
    loaded = load_calibration(path)
    assert loaded == calibration
    assert loaded.created_utc == datetime(2026, 11, 22, 12, 0, tzinfo=UTC)
    points = np.random.default_rng(0).uniform([-40, -20, 100], [40, 20, 160], (50, 3))
    before, after = calibration.ray_model.project(points), loaded.ray_model.project(points)
    np.testing.assert_array_equal(after.uv_px, before.uv_px)
    np.testing.assert_array_equal(after.J_px_per_mm, before.J_px_per_mm)
    uv = before.uv_px
    np.testing.assert_array_equal(loaded.ray_model.is_covered(uv), calibration.ray_model.is_covered(uv))
    np.testing.assert_array_equal(
        loaded.ray_model.point_sd_mm(uv, 130.0), calibration.ray_model.point_sd_mm(uv, 130.0)
    )
    assert loaded.ray_model is loaded.ray_model  # made once


def test_the_model_made_for_the_file_is_the_fitted_one():
    fitted = calibrate_rays([(z, see(z)) for z in PLANES_MM], sensor_mode=IMX219_1080P, dot_diameter_mm=2.0)
    made = make_calibration(
        fitted,
        unit="u",
        target=Target(columns=32, rows=18, pitch_mm=4.0, dot_diameter_mm=2.0),
        images=(),
    )
    uv = np.array([[300.0, 200.0], [1500.0, 900.0]])
    np.testing.assert_array_equal(
        made.ray_model.points_on_plane(uv, 140.0), fitted.model.points_on_plane(uv, 140.0)
    )
    np.testing.assert_allclose(made.ray_model.point_sd_mm(uv, 140.0), fitted.model.point_sd_mm(uv, 140.0))
    assert made.created_utc.utcoffset().total_seconds() == 0
    assert "central rays" in made.method


@pytest.mark.parametrize(
    ("kind", "xy_mm", "sd_mm"),
    [
        (
            "central",
            [[-59.06771583, -30.41138477], [48.14134474, 32.11448124], [-87.95637481, -49.23713795]],
            [0.00351378, 0.00304257, 0.0118645],
        ),
        (
            "two-plane",
            [[-59.03181929, -30.38924319], [48.12769656, 32.09680651], [-87.79302623, -49.14012076]],
            [0.00741151, 0.0059829, 0.03128622],
        ),
    ],
)
def test_files_of_version_1_are_still_read(kind, xy_mm, sd_mm):
    """Written, and their points and standard deviations printed, by the code of that time."""
    calibration = load_calibration(DATA / f"version-1-{kind}.json")
    assert (calibration.unit, calibration.choice.order) == ("brick-1", 3)
    assert not calibration.choice.held
    uv = np.array([[300.0, 200.0], [1500.0, 900.0], [5.0, 5.0]])
    model = calibration.ray_model
    np.testing.assert_allclose(model.points_on_plane(uv, 140.0), xy_mm, atol=1e-8)
    np.testing.assert_allclose(model.point_sd_mm(uv, 140.0), sd_mm, rtol=1e-5)


def test_a_damaged_file_of_version_1_is_refused(tmp_path):
    data = json.loads((DATA / "version-1-central.json").read_text())
    data["rays"]["covariance_lower"].pop()
    path = tmp_path / "old.json"
    path.write_text(json.dumps(data))
    with pytest.raises(
        CalibrationError, match=r"old\.json: a covariance of 275 numbers; expected 276 for 23"
    ):
        load_calibration(path)
    data["rays"]["order"] = -1
    path.write_text(json.dumps(data))
    with pytest.raises(CalibrationError, match=r"old\.json: rays\.order is -1"):
        load_calibration(path)


def test_the_file_says_what_it_is_in_plain_text(path):
    data = json.loads(path.read_text())
    assert data["format"] == "bricktrack-calibration"
    assert data["version"] == 2
    assert data["sensor_mode"]["name"] == IMX219_1080P.name
    assert data["focus_note"].startswith("ring at")
    assert data["software"].startswith("bricktrack ")
    assert [len(i["sha256"]) for i in data["images"]] == [64, 64]
    assert data["choice"]["candidates"][0]["rms_um"] > 0
    assert data["residuals"][0]["mean_um"] < data["residuals"][0]["max_um"]
    assert data["tolerance"] == {"shift_mm": 0.0, "turn_rad": 0.0, "bend_mm": 0.0}
    assert len(data["noise"]) == 2


def test_a_newer_version_is_refused_by_name(path):
    rewritten(path, lambda d: d.update(version=3, more="than we know"))
    with pytest.raises(CalibrationError, match=r"calibration\.json: calibration version 3 is newer than 2"):
        load_calibration(path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.update(format="something"), "format is 'something'"),
        (lambda d: d.update(version="1"), "version is '1'"),
        (lambda d: d.pop("unit"), "unit"),
        (lambda d: d.update(extra=1), "extra"),
        (lambda d: d["rays"].update(order=4), "expected 15|expected 33"),
        (lambda d: d["rays"].update(model="magic"), "magic"),
        (lambda d: d.update(plane_a_mm=200.0), "expected 0 < a < b"),
        (lambda d: d["sensor_mode"].update(width=0), "sensor_mode.width"),
        (lambda d: d["images"][0].update(sha256="beef"), "sha256"),
    ],
)
def test_a_file_that_contradicts_itself_is_refused(path, change, words):
    rewritten(path, change)
    with pytest.raises(CalibrationError, match=words):
        load_calibration(path)


def test_damaged_coefficients_are_refused(path):
    def flatten(data):
        for name, values in data["rays"].items():
            if isinstance(values, list) and ("coefficients" in name or "_mm" in name):
                data["rays"][name] = [0.0] * len(values)

    rewritten(path, flatten)
    with pytest.raises(CalibrationError, match="calibration.json"):
        load_calibration(path)


def test_a_missing_or_broken_file_is_named(tmp_path):
    with pytest.raises(CalibrationError, match="nowhere.json: No such file"):
        load_calibration(tmp_path / "nowhere.json")
    (tmp_path / "cut.json").write_text('{"format": "bricktrack-cal')
    with pytest.raises(CalibrationError, match=r"cut\.json: not valid JSON"):
        load_calibration(tmp_path / "cut.json")
    (tmp_path / "list.json").write_text("[1, 2]")
    with pytest.raises(CalibrationError, match=r"list\.json"):
        load_calibration(tmp_path / "list.json")


def test_a_calibration_of_another_unit_or_mode_is_refused(calibration):
    require_match(calibration, unit="brick-1", sensor_mode=IMX219_1080P)
    require_match(calibration, unit=None, sensor_mode=IMX219_1080P)
    with pytest.raises(CalibrationError, match="unit 'brick-1', the recording of unit 'brick-2'"):
        require_match(calibration, unit="brick-2", sensor_mode=IMX219_1080P)
    binned = msgspec.structs.replace(
        IMX219_1080P, name="binned", width=1640, height=1232, crop_x=0, crop_y=0, binning=2
    )
    with pytest.raises(CalibrationError, match="imx219-1920x1080-crop.*'binned'"):
        require_match(calibration, unit=None, sensor_mode=binned)


@pytest.mark.parametrize("line_time_ns", [0.0, 25_000.0])
def test_rows_are_read_as_fast_as_the_recording_says(calibration, line_time_ns):
    mode = msgspec.structs.replace(IMX219_1080P, line_time_ns=line_time_ns)
    rays = rays_of_recording(calibration, unit="brick-1", sensor_mode=mode)
    assert rays.sensor_mode.row_delay_ns(100.0) == 100 * line_time_ns
    points = np.array([[3.0, -2.0, 130.0], [-20.0, 15.0, 110.0]])
    np.testing.assert_array_equal(rays.project(points).uv_px, calibration.ray_model.project(points).uv_px)
    with pytest.raises(CalibrationError, match="brick-2"):
        rays_of_recording(calibration, unit="brick-2", sensor_mode=mode)


def test_a_folder_that_is_not_there_is_named(calibration, tmp_path):
    with pytest.raises(CalibrationError, match="No such file"):
        save_calibration(tmp_path / "no" / "where.json", calibration)
