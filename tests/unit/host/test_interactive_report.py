"""The interactive pages: one file, nothing fetched, every sample in it, and no band where nothing was seen."""

import base64
import gzip
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_lab import example
from typer.testing import CliRunner

from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.cli.main import app
from bricktrack_host.quality import PoseFlag
from bricktrack_host.reporting.combined_interactive import render_interactive_test
from bricktrack_host.reporting.combined_report import read_combined_test
from bricktrack_host.reporting.interactive_panels import MAX_SAMPLES, samples
from bricktrack_host.reporting.interactive_report import banded, render_interactive_report
from bricktrack_host.reporting.plots import half_frame_rate_hz
from bricktrack_host.results.run_summary import key_figures

from .test_report import changed


@pytest.fixture(scope="module")
def result():
    return example.example_result()


@pytest.fixture(scope="module")
def html(result):
    return render_interactive_report(result)


def models(html):
    """Return every model of the page's document that has attributes, by type."""
    [text] = re.findall(r"const docs_json = '(.*?)';\n", html, re.S)
    found = {}

    def walk(value):
        if isinstance(value, dict):
            if value.get("type") == "object" and "attributes" in value:
                found.setdefault(value["name"], []).append(value["attributes"])
            for inner in value.values():
                walk(inner)
        elif isinstance(value, list):
            for inner in value:
                walk(inner)

    walk(json.loads(text.encode().decode("unicode_escape")))
    return found


def sources(html):
    """Return the columns of every source of the page, as arrays."""
    out = []
    for attributes in models(html)["ColumnDataSource"]:
        columns = {}
        for name, value in attributes["data"]["entries"]:
            if isinstance(value, dict) and value.get("type") == "ndarray":
                raw = gzip.decompress(base64.b64decode(value["array"]["data"]))
                columns[name] = np.frombuffer(raw, value["dtype"]).reshape(value["shape"])
            else:
                columns[name] = value
        out.append(columns)
    return out


def test_the_page_is_one_file_that_fetches_nothing(html):
    outside_scripts = re.sub(r"<script.*?</script>", "", html, flags=re.S)
    assert not re.search(r'(src|href)="(?!#)', outside_scripts)
    assert not re.search(r"<script[^>]* src=", html)
    assert "<link" not in outside_scripts
    assert "SIMULATED" in outside_scripts
    assert len(html) < 3_000_000  # 1.3 MB of it are the library


def test_sections_stand_in_order_with_problems_first(html):
    words = re.sub(r"<script.*?</script>", "", html, flags=re.S)
    titles = re.findall(r"<h2>(.*?)</h2>", words)
    assert titles == [
        "Motion", "Inertial sensor", "Residuals of the LEDs", "Camera and inertial sensor", "Timing", "Spectra",
    ]  # fmt: skip
    assert words.index("2 frames were dropped by the camera") < words.index("<h2>Motion")


def test_the_page_holds_the_motion_put_in(html, result):
    fused = next(s for s in sources(html) if "said" in s and "frame" not in s)
    track = result.fused["imu"]
    measured = track.flags & int(PoseFlag.EXTRAPOLATED | PoseFlag.NO_POSE) == 0
    moved = result.rest.relative(track.R_camera_brick, track.t_camera_brick_mm)
    assert len(fused["t"]) == len(track.t_ns)
    # Single precision has 24 bits: millionths of the largest value.
    np.testing.assert_allclose(fused["y0"][measured], moved.t_mm[measured, 0], atol=2e-6)
    turned_deg = np.rad2deg(rvec_from_matrix(moved.R))
    np.testing.assert_allclose(fused["y5"][measured], turned_deg[measured, 2], atol=2e-6)
    assert np.isnan(fused["y0"][~measured]).all()
    assert (fused["high0"][measured] > fused["low0"][measured]).all()
    optical = next(s for s in sources(html) if "leds" in s)
    assert len(optical["t"]) == key_figures(result).n_poses
    assert np.isin(optical["leds"], np.arange(3, 8)).all()


def test_dropouts_and_impacts_are_marked_in_every_panel_over_time(html, result):
    figures = key_figures(result)
    found = models(html)
    panels = [f for f in found["Figure"] if f.get("name") == "over time"]
    assert len(panels) == 6 + 6 + 2 + 3 + 3
    strips = [r for r in found["GlyphRenderer"] if r.get("name") == "dropouts"]
    assert len(strips) == len(panels)
    # An impact after the video would flatten the curves of the time that is shown.
    assert {p["window_axis"] for p in panels} == {"x"}
    shaded = [s for s in sources(html) if set(s) == {"x0", "x1"}]
    assert len(shaded) == len(panels)
    expected_s = (figures.dropouts_ns - result.t0_ns) / 1e9
    for strip in shaded:
        np.testing.assert_allclose(np.stack([strip["x0"], strip["x1"]], axis=1), expected_s)
    assert len([r for r in found["GlyphRenderer"] if r.get("name") == "impacts"]) == len(panels)


def test_no_band_is_drawn_where_the_motion_is_not_known():
    y = np.array([[1.0], [2.0], [np.nan], [np.nan], [5.0]])
    columns = banded(y, np.full_like(y, 0.5))
    np.testing.assert_array_equal(columns["low0"], [0.5, 1.5, 3.0, 4.0, 4.5])
    np.testing.assert_array_equal(columns["high0"], [1.5, 2.5, 3.0, 4.0, 5.5])
    nothing = banded(np.full((3, 1), np.nan), np.ones((3, 1)))
    np.testing.assert_array_equal(nothing["low0"], nothing["high0"])


def test_long_recordings_are_thinned_but_keep_their_extremes():
    t = np.arange(3 * MAX_SAMPLES) / 1000
    y = np.sin(t)
    y[123_457] = 40.0
    source = samples(t, {"y": y}, flags=np.zeros(len(t), dtype=np.int64))
    assert len(source.data["t"]) < MAX_SAMPLES / 5
    assert source.data["y"].max() == 40.0
    assert t[123_457] in source.data["t"]
    assert set(source.data["said"]) == {"none"}


def test_runs_with_less_in_them_still_make_a_page(result):
    optical = result.optical
    nothing = replace(
        result,
        optical=replace(optical, R_camera_brick=np.full_like(optical.R_camera_brick, np.nan),
                        t_camera_brick_mm=np.full_like(optical.t_camera_brick_mm, np.nan),
                        flags=np.full_like(optical.flags, int(PoseFlag.NO_POSE))),
        fused={}, edge_fit=None, imu=None, rest=None, problems=(),
    )  # fmt: skip
    assert re.findall(r"<h2>(.*?)</h2>", render_interactive_report(nothing)) == ["Timing"]
    camera_only = replace(result, fused={}, imu=None, rest=None)
    page = render_interactive_report(camera_only)
    assert "No rest pose" in page
    untriggered = changed(result.manifest, trigger=type(result.manifest.trigger)(pin="x", t0_ns=None))
    assert "time since the first frame" in render_interactive_report(
        replace(camera_only, manifest=untriggered)
    )


def test_a_tests_page_holds_every_component(lab):
    test = read_combined_test(lab / "shake-12")
    html = render_interactive_test(test)
    curves = [s for s in sources(html) if "sample" in s]
    assert len(curves) == 2
    for source, history in zip(curves, test.motions["brick-7"].values(), strict=True):
        rows = history.measured
        np.testing.assert_allclose(source["y1"][rows], history.displacement_mm[rows, 1], atol=5e-6)
        np.testing.assert_array_equal(source["sample"], history.sample)
    labels = {item["label"]["value"] for item in models(html)["LegendItem"]}
    assert labels == {"B", "C"}


@pytest.mark.slow
def test_the_command_writes_each_page_where_it_says(lab, tmp_path):
    lab = Path(shutil.copytree(lab, tmp_path / "lab"))

    def report(*words):
        done = CliRunner().invoke(app, ["report", *map(str, words)], env={"COLUMNS": "200"})
        return done.exit_code, done.output

    code, said = report(lab / "b7-1", "--interactive")
    assert code == 0, said
    assert f"report: {lab / 'b7-1' / 'results' / 'interactive.html'}" in said
    assert "2 frames were dropped by the camera" in said
    code, said = report(lab / "shake-12")
    assert code == 0, said
    assert (lab / "shake-12" / "report.html").is_file()
    code, said = report(lab / "shake-12", "-i", "-o", tmp_path / "page.html")
    assert code == 0, said
    assert (tmp_path / "page.html").stat().st_size > 1_000_000
    code, said = report(lab / "shake-12", "--truth", lab)
    assert code == 1
    assert "--truth is for runs" in said
    empty = tmp_path / "empty"
    empty.mkdir()
    assert report(empty)[0] == 1


def test_half_the_frame_rate_is_that_of_the_frames_there_are(result):
    seen = result.observations
    stamps_ns = np.arange(0, 9_000_000_000, 25_000_000, dtype=np.int64)  # 40 Hz
    kept_ns = np.delete(stamps_ns, np.arange(3, len(stamps_ns) - 1, 4))  # every fourth dropped
    for stamps, half_hz in ((stamps_ns, 20.0), (kept_ns, 15.0)):
        given = replace(result, observations=replace(seen, sensor_timestamp_ns=stamps))
        assert half_frame_rate_hz(given) == pytest.approx(half_hz, rel=0.01)  # ends count by one frame
    assert (
        half_frame_rate_hz(replace(result, observations=replace(seen, sensor_timestamp_ns=stamps_ns[:1])))
        is None
    )
