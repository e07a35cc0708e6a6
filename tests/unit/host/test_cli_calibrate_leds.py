"""``bricktrack calibrate leds`` from observations to the layout file; the pictures are another test's."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from led_scenes import random_poses
from page_commands import type_all
from pinhole import PinholeCamera

from bricktrack_common.brick_model import ProfileEntry, load_brick_model
from bricktrack_common.errors import ConfigError
from bricktrack_host import pipeline
from bricktrack_host.calibration import calibration_file
from bricktrack_host.cli.calibrate_leds import leds
from bricktrack_host.tracking.led_model.led_profile import predict_brick
from bricktrack_host.tracks import LedObservations

CAMERA = PinholeCamera()
LAYOUT = Path(__file__).resolve().parents[2] / "data" / "path-traced" / "layout.toml"


@pytest.fixture
def sweep(monkeypatch):
    """Thirty places of a brick whose collars are 0.8 mm long and whose m5 sits 0.3 mm too low.

    Called with pixels, (7, 2), they are added in every frame.
    """
    brick = load_brick_model(LAYOUT)
    places = brick.led_positions_mm.copy()
    places[5, 1] += 0.3
    built = replace(brick, led_positions_mm=places, led_profile=ProfileEntry(collar_mm=0.8, source="test"))
    R, t = random_poses(30, seed=1)
    prediction, _ = predict_brick(R, t, CAMERA, built, collar_mm=0.8)
    seen = LedObservations(
        sensor_timestamp_ns=np.arange(30) * 33_000_000,
        exposure_ns=np.full(30, 4_000_000),
        uv_px=prediction.uv_px + np.random.default_rng(2).normal(0, 0.02, (30, 7, 2)),
        cov_px2=np.broadcast_to(0.06**2 * np.eye(2), (30, 7, 2, 2)).copy(),
        area_px2=np.full((30, 7), 3500.0),
        led_flags=np.zeros((30, 7), dtype=np.int64),
        frame_flags=np.zeros(30, dtype=np.int64),
    )
    manifest = SimpleNamespace(camera=None, simulated=True, run_id="b2_sweep")
    monkeypatch.setattr(
        "bricktrack_common.run_folder.read_run", lambda *_, **__: SimpleNamespace(manifest=manifest)
    )
    monkeypatch.setattr(calibration_file, "load_calibration", lambda _: SimpleNamespace(ray_model=CAMERA))
    monkeypatch.setattr(pipeline, "observe_run", lambda *_, **__: (seen, []))
    return seen


def without_profile(tmp_path):
    """Write the layout without its profile."""
    text = LAYOUT.read_text(encoding="utf-8")
    path = tmp_path / "layout.toml"
    path.write_text(text.split("[led_profile]")[0], encoding="utf-8")
    return path


def test_a_profile_and_positions_go_into_a_copy_of_the_layout(sweep, tmp_path, capsys):
    layout, output = without_profile(tmp_path), tmp_path / "refined.toml"
    before = load_brick_model(LAYOUT)
    leds(tmp_path, tmp_path / "c.json", layout, output, positions=True)
    after = load_brick_model(output)
    said = capsys.readouterr().out
    assert "simulated" in said
    assert "neither turn nor size" in said
    # Seen within 20 degrees of one view, a longer collar looks like LEDs that sit deeper; the sd says so.
    sd_mm = float(re.search(r"sd ([\d.]+) mm", after.led_profile.source).group(1))
    assert after.led_profile.collar_mm == pytest.approx(0.8, abs=3 * sd_mm)
    assert 0.02 < sd_mm < 0.2
    # By the formula of the shift a collar of 1 mm moves the middle of the light, from afar and at 50 degrees,
    # by 0.4 mm per sine: what the collar is unsure by, LEDs of 3 mm are.
    assert after.led_profile.shift_sd_per_radius == pytest.approx(0.4 * sd_mm / 3.0, rel=0.4)
    assert "b2_sweep" in after.led_profile.source
    moved = after.led_positions_mm - before.led_positions_mm
    # It does not count in the gauge, so that it moves alone.
    assert moved[5, 1] == pytest.approx(0.3, abs=0.02)
    assert "LED m5: not where the layout has it" in " ".join(said.split())
    np.testing.assert_array_equal(after.led_positions_mm[0], 0.0)
    np.testing.assert_array_equal(after.led_axes, before.led_axes)
    if before.imu_lever_arm_mm is not None:
        np.testing.assert_array_equal(after.imu_lever_arm_mm, before.imu_lever_arm_mm)
    with pytest.raises(ConfigError, match="has a .led_profile. already"):
        leds(tmp_path, tmp_path / "c.json", output, tmp_path / "again.toml")


def test_a_dirty_led_is_named_and_left_out(sweep, tmp_path, capsys):
    # m5 sits beside its place in this sweep, and m2 is dirty besides: five others are left.
    sweep.uv_px[:, 2] += [1.5, 0.0]
    output = tmp_path / "out.toml"
    leds(tmp_path, tmp_path / "c.json", without_profile(tmp_path), output)
    said = " ".join(capsys.readouterr().out.split())
    assert re.search(
        r"left out: LED m2 \(\d\.\d+ px\), m5 \(\d\.\d+ px\): elsewhere than all the others say", said
    )
    profile = load_brick_model(output).led_profile
    assert profile.collar_mm == pytest.approx(0.8, abs=0.05)
    assert "without m2, m5" in profile.source


def test_the_how_to_pages_commands_write_what_they_say(sweep, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = LAYOUT.read_text(encoding="utf-8")
    if load_brick_model(LAYOUT).led_profile is not None:
        text = text[: text.index("[led_profile]")]
    (tmp_path / "brick.toml").write_text(text, encoding="utf-8")
    (tmp_path / "runs" / "b2_sweep").mkdir(parents=True)
    (tmp_path / "b2.json").touch()
    type_all("calibrate-leds.md")
    fitted = load_brick_model(tmp_path / "brick-with-leds.toml").led_profile
    assert fitted is not None and fitted.collar_mm == pytest.approx(0.8, abs=0.05)
    moved = load_brick_model(tmp_path / "brick-refined.toml").led_positions_mm
    assert np.abs(moved - load_brick_model(LAYOUT).led_positions_mm).max() > 0.2
