"""The whole path-traced sample, made by none of our code: a profile fitted on one video, used on another."""

import os
from pathlib import Path

import numpy as np
import pytest
from path_traced import import_motion, import_static

from bricktrack_common.brick_model import load_brick_model
from bricktrack_host.cli import calibrate
from bricktrack_host.cli.calibrate_leds import leds
from bricktrack_host.pipeline import process_run

SAMPLES = os.environ.get("BRICKTRACK_SAMPLES")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(SAMPLES is None, reason="BRICKTRACK_SAMPLES does not name the samples' folder"),
]


@pytest.fixture(scope="module")
def processed(tmp_path_factory):
    sample = Path(SAMPLES or "") / "path-traced"
    folder = tmp_path_factory.mktemp("sample")
    import_static(folder, sample)
    import_motion(folder, sample)
    calibration, layout = folder / "calibration.json", folder / "layout.toml"
    calibrate.fit(calibration, "sample", rig=sample / "rig.toml", target="32x18", images_dir=sample)
    leds(folder / "sample_static", calibration, sample / "layout.toml", layout)
    moved, rested = (
        process_run(
            folder / f"sample_{name}",
            calibration=calibration,
            layout=layout,
            truth=sample / "truth" / truth,
        )
        for name, truth in (("motion", "motion_dense.csv"), ("static", "static_poses.csv"))
    )
    return layout, moved, rested


def test_the_fitted_collar_is_near_the_drawn_one(processed):
    profile = load_brick_model(processed[0]).led_profile
    assert profile is not None
    assert profile.collar_mm == pytest.approx(0.7, abs=0.1)  # the README's; limb and lens shift it somewhat
    assert "simulated" in profile.source


def test_every_frame_has_a_pose(processed):
    # 68 of 75 frames show all seven LEDs, the others six (truth/motion_leds.csv)
    assert np.isfinite(processed[1].result.optical.t_camera_brick_mm).all()


def test_errors_are_below_what_plain_centroids_reach(processed):
    # "motion, 50 ms about the impact left out, + collar, rows": 0.017 / 0.006 / 0.142 mm and 0.12 deg (README)
    groups = {(g.source, g.group): g.rms for g in processed[1].truth.groups if g.n}
    for group in (("optical", "at frames"), ("fused", "at frames"), ("fused", "between frames")):
        x, y, z, *rotation = groups[group]
        assert x < 0.017 and y < 0.006 and z < 0.142
        assert np.linalg.norm(rotation) < 0.12


def test_pictures_whose_rows_are_of_one_instant_are_solved_alone(processed):
    # "static", the frames' poses 6 mm apart: "+ collar", video, the better of both sweeps (README)
    group = next(g for g in processed[2].truth.groups if (g.source, g.group) == ("optical", "all"))
    assert group.n == 20
    assert (np.array(group.rms[:3]) < [0.013, 0.002, 0.100]).all()
    assert np.linalg.norm(group.rms[3:]) < 0.06
