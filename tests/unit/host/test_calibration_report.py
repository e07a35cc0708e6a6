"""The page of a calibration: says what there is to say, for each kind of model, and stands alone."""

import re

import msgspec
import numpy as np
import pytest
from lens_boards import A_MM, B_MM, Board, brown, see, two_planes

from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_common.errors import StorageError
from bricktrack_host.calibration.calibration_file import Target, TargetImage, make_calibration
from bricktrack_host.calibration.rays.ray_calibration import calibrate_rays
from bricktrack_host.calibration.rays.rig_tolerance import RigTolerance
from bricktrack_host.reporting.calibration_report import (
    gathered_evidence,
    verdict,
    write_calibration_report,
)


def calibrated(planes, **options):
    fitted = calibrate_rays(planes, sensor_mode=IMX219_1080P, dot_diameter_mm=1e-3, **options)
    made = make_calibration(
        fitted,
        unit="b<1>",
        target=Target(columns=32, rows=18, pitch_mm=4.0, dot_diameter_mm=2.0),
        images=tuple(
            TargetImage(name=f"{z}.png", sha256="ab" * 32, z_mm=z, n_dots_found=500, n_dots_left_out=0)
            for z in (A_MM, B_MM)
        ),
        simulated=True,
    )
    return fitted, made


def turned_far_board():
    rng = np.random.default_rng(9)
    return [(A_MM, see(brown, A_MM, rng)),
            (B_MM, see(brown, B_MM, rng, board=Board(turn_deg=(0.08, 0.0, 0.0))))]  # fmt: skip


@pytest.fixture(scope="module")
def plain():
    return calibrated(two_planes(brown, 3), model="central")


@pytest.fixture(scope="module")
def turned():
    return calibrated(turned_far_board(), model="central")


def test_a_page_against_an_earlier_calibration(plain, tmp_path):
    fitted, made = plain
    _, earlier = calibrated(two_planes(brown, 4), model="two-plane")
    page = tmp_path / "page.html"
    write_calibration_report(page, fitted, made, earlier=earlier, pictures_dir=tmp_path / "png")
    html = page.read_text()
    assert "Calibration of b&lt;1&gt;" in html and "SIMULATED" in html
    assert "Against the earlier calibration" in html
    assert (tmp_path / "png" / "earlier.png").stat().st_size > 10_000
    assert "ab" * 32 in html  # where the pictures' hashes are
    for r in made.residuals:
        assert f"{r.mean_um:.2f}" in html and f"{r.max_um:.2f}" in html
    assert "http" not in html.replace("http://www.w3.org", "")


def test_a_page_with_a_walking_pupil_says_what_looks_alike(tmp_path):
    planes = two_planes(lambda p: brown(p, walk_mm=3.0), 5)
    fitted, made = calibrated(planes, model="walking-pupil")
    write_calibration_report(tmp_path / "p.html", fitted, made)
    html = (tmp_path / "p.html").read_text()
    assert "The pupil walks by" in html and "would look the same" in html


def test_a_page_lists_what_was_found_of_the_rig(tmp_path):
    fitted, made = calibrated(
        turned_far_board(), model="central", tolerance=RigTolerance(shift_mm=0.05, turn_rad=0.01)
    )
    write_calibration_report(tmp_path / "p.html", fitted, made)
    html = (tmp_path / "p.html").read_text()
    assert "plane 2: turn about x" in html and "no: the tolerance stands" in html


def test_the_verdict_warns_of_a_rig_that_the_pictures_contradict(turned):
    fitted, made = turned
    line, problems = verdict(gathered_evidence(fitted, made))
    assert "µm from the rays on average" in line
    assert any(re.search(r"plane 2: turn about x by 0\.0[78]\d ± 0\.00\d", p) for p in problems)


def test_the_verdict_warns_of_a_small_target():
    fitted, made = calibrated(two_planes(brown, 2, board=Board(columns=20, rows=12)), model="central")
    _, problems = verdict(gathered_evidence(fitted, made))
    assert any("Dots surround only" in p for p in problems)


def test_a_lens_that_changed_is_told(plain):
    fitted, made = calibrated(
        two_planes(lambda p: (brown(p) - [960, 540]) * 1.003 + [960, 540], 8), model="central"
    )
    _, problems = verdict(gathered_evidence(fitted, made, earlier=plain[1]))
    assert any("The lens is not what it was" in p for p in problems)
    same = msgspec.structs.replace(made, focus_note="again")
    assert not verdict(gathered_evidence(fitted, made, earlier=same))[1]


def test_a_folder_that_is_not_there_is_named(plain, tmp_path):
    fitted, made = plain
    with pytest.raises(StorageError, match=r"nowhere/p\.html: the report cannot be written"):
        write_calibration_report(tmp_path / "nowhere" / "p.html", fitted, made)
