"""The report's section on the two ways to fuse: what it says and draws is what it was given."""

from dataclasses import replace

import numpy as np
import pytest

from bricktrack_host.reporting.fusion_check import TwoFusions, fusion_check_chart, fusion_check_words
from bricktrack_host.reporting.report import ReportExtras, render_report
from bricktrack_host.results.run_summary import key_figures, main_track

from .test_results import example

FOUND = {
    "pose_level_agrees": True,
    "pose_level_apart_rms_mm": 0.0123,
    "pose_level_apart_max_mm": 0.0456,
    "pose_level_apart_max_deg": 0.021,
    "pose_level_share_beyond": 0.004,
}


@pytest.fixture(scope="module")
def result():
    blank = example.example_result()
    return replace(blank, alignment=dict(blank.alignment) | FOUND)


def two_fusions(result):
    track = main_track(result)
    shift = np.zeros_like(track.t_camera_brick_mm)
    shift[:, 1] = 0.02
    return TwoFusions.of(replace(track, t_camera_brick_mm=track.t_camera_brick_mm + shift), track)


def test_figures_stand_in_words_and_not_in_the_table_of_the_clocks(result):
    page = render_report(result, ReportExtras(fusions=two_fusions(result)))
    assert "Fused in two ways" in page
    assert "They agree: 0.012 mm apart rms, 0.046 mm and 0.021 deg at most" in page
    assert "in 0.4 % of the instants" in page
    assert "pose level" not in page


def test_a_disagreement_is_called_one(result):
    assert "do not agree" in fusion_check_words(dict(result.alignment) | {"pose_level_agrees": False})[0]


def test_runs_fused_otherwise_have_no_such_section():
    page = render_report(example.example_result())
    assert "Fused in two ways" not in page


def test_the_chart_draws_the_difference(result):
    chart = fusion_check_chart(result, key_figures(result), two_fusions(result))
    (above,), (below,) = chart.panels
    lines = [mark for mark in above.marks if getattr(mark, "label", "") == "y"]
    assert np.nanmax(np.abs(lines[0].y - 0.02)) < 1e-9
    assert above.y_limits[1] >= 0.02
    assert below.y_label == "apart, deg"
