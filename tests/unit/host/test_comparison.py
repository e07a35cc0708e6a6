"""What another processing changed: differences of known size are found, in their units, and the worst come first."""

import csv
import json
import shutil
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from small_lab import BRICK, UNITS, invented_run
from typer.testing import CliRunner

from bricktrack_common.errors import ConfigError, RunFormatError
from bricktrack_common.rotations import matrix_from_rvec
from bricktrack_host.assemblies.combined_test import combine_test
from bricktrack_host.cli.main import app
from bricktrack_host.datasets.comparison import changes, compare_runs, worst_first
from bricktrack_host.datasets.comparison_pairs import compare
from bricktrack_host.reporting.comparison_report import render_comparison, verdict
from bricktrack_host.results.result_store import read_result, write_results

EXTRAPOLATED = 2048


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    return invented_run(tmp_path_factory.mktemp("lab") / "b7-1", "b7-1")


def moved(result, *, shift_mm=(0.0, 0.0, 0.0), turn_rad=(0.0, 0.0, 0.0), kinds=("edge", "frame", "imu")):
    """Return the result with its fused motion shifted in the camera frame and turned in the brick's own axes."""
    fused = dict(result.fused)
    for kind in kinds:
        track = fused[kind]
        fused[kind] = replace(
            track,
            t_camera_brick_mm=track.t_camera_brick_mm + np.array(shift_mm),
            R_camera_brick=track.R_camera_brick @ matrix_from_rvec(np.array(turn_rad)),
        )
    return replace(result, fused=fused)


def test_the_same_results_differ_by_nothing(result):
    pair = compare_runs(result, result)
    assert pair.is_same
    assert pair.n == np.count_nonzero(result.fused["edge"].flags & EXTRAPOLATED == 0)
    assert pair.largest.tolist() == pair.in_sd.tolist() == [0.0] * 6
    assert (pair.share_beyond, pair.appeared, pair.disappeared, pair.changes) == (0.0, 0, 0, ())


def test_a_shift_and_a_turn_are_found_in_their_size_and_axes(result):
    shift_mm = result.rest.R_camera_rest @ np.array([0.05, -0.02, 0.0])
    pair = compare_runs(result, moved(result, shift_mm=shift_mm, turn_rad=(0.0, 0.0, np.deg2rad(0.3))))
    assert pair.at == "edge"
    np.testing.assert_allclose(pair.largest, [0.05, 0.02, 0.0, 0.0, 0.0, 0.3], atol=1e-9)
    np.testing.assert_allclose(pair.rms, pair.largest, atol=1e-9)
    later = moved(result)
    later.fused["edge"].t_camera_brick_mm[700] += 0.01  # at 200 Hz
    assert compare_runs(result, later).worst_s == pytest.approx(3.5, abs=1e-3)
    # In standard deviations: those that the histories state, the smallest of them where the shift is constant.
    known = np.isfinite(pair.difference).all(axis=1)
    assert pair.in_sd[0] == pytest.approx(0.05 / pair.sd[known, 0].min(), rel=1e-9)
    assert pair.share_beyond == pytest.approx(np.mean(
        (1.96 * pair.sd[known, 0] < 0.05) | (1.96 * pair.sd[known, 1] < 0.02) | (1.96 * pair.sd[known, 5] < 0.3)
    ))  # fmt: skip


def test_samples_that_come_and_go_are_counted_and_not_compared(result):
    flags = result.fused["edge"].flags.copy()
    gone, come = np.flatnonzero(flags & EXTRAPOLATED == 0)[:7], np.flatnonzero(flags & EXTRAPOLATED)[:2]
    flags[gone] |= EXTRAPOLATED
    flags[come] = 0
    after = replace(result, fused=result.fused | {"edge": replace(result.fused["edge"], flags=flags)})
    pair = compare_runs(result, after)
    assert (pair.disappeared, pair.appeared) == (7, 2)
    assert pair.n == compare_runs(result, result).n - 7
    assert not pair.is_same
    fewer = replace(
        result,
        edge_index=result.edge_index[5:],
        fused=result.fused
        | {
            "edge": replace(
                result.fused["edge"],
                **{
                    name: getattr(result.fused["edge"], name)[5:]
                    for name in (
                        "t_ns",
                        "R_camera_brick",
                        "t_camera_brick_mm",
                        "omega_brick_radps",
                        "v_camera_mmps",
                        "covariance",
                        "flags",
                    )
                },
            )
        },
    )
    pair = compare_runs(result, fewer)
    assert (pair.disappeared, pair.largest.max()) == (5, 0.0)


def test_without_samples_pictures_are_matched_by_their_stamps(result):
    without = {k: v for k, v in result.fused.items() if k != "edge"}
    later = replace(
        without["frame"], t_ns=without["frame"].t_ns + 200_000
    )  # another calibration's centre row
    pair = compare_runs(replace(result, fused=without), replace(result, fused=without | {"frame": later}))
    assert pair.at == "frame"
    assert pair.is_same
    pair = compare_runs(replace(result, fused={}), moved(result, shift_mm=(1.0, 1.0, 1.0)))
    assert pair.at == "optical"
    assert pair.is_same, "the optical poses were not moved"


def test_no_rest_pose_any_more_means_that_all_went(result):
    pair = compare_runs(result, replace(result, rest=None))
    assert pair.n == 0
    assert pair.disappeared == compare_runs(result, result).n
    assert np.isnan(pair.largest).all()
    assert ("rest pose", "known", "none") in [(c.what, c.before, c.after) for c in pair.changes]


def test_what_else_changed_is_named(result):
    other = replace(
        result,
        provenance=msgspec.structs.replace(
            result.provenance,
            calibration_sha256="a" * 64,
            software_version="0.2.0",
            settings=result.provenance.settings | {"rolling_shutter": False},
        ),
        problems=("a new one",),
    )
    found = {(c.what, c.before, c.after) for c in changes(result, other)}
    assert ("software", "0.1.0", "0.2.0") in found
    assert ("calibration, SHA-256", "111111111111…", "aaaaaaaaaaaa…") in found
    assert ("setting rolling_shutter", "true", "false") in found
    assert ("problem", "–", "a new one") in found
    assert ("problem", "2 frames were dropped by the camera", "–") in found


def test_two_recordings_are_not_compared(result):
    other = replace(result, provenance=msgspec.structs.replace(result.provenance, manifest_sha256="f" * 64))
    with pytest.raises(RunFormatError, match="different recordings"):
        compare_runs(result, other)


def test_the_worst_come_first(result):
    small = compare_runs(result, moved(result, shift_mm=(0.001, 0, 0)), name="small")
    large = compare_runs(result, moved(result, shift_mm=(0.5, 0, 0)), name="large")
    none = compare_runs(result, replace(result, rest=None), name="none left")
    assert [p.name for p in worst_first([small, none, large])] == ["none left", "large", "small"]


# Folders, the page and the command.


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """Two runs; the second one processed again, 0.2 mm off, with another calibration; and tests of both states."""
    folder = tmp_path_factory.mktemp("lab")
    results = {unit: folder / unit / "results" for unit in UNITS}
    for unit in UNITS:
        invented_run(folder / unit, unit)
    combine_test("shake-12", results, [BRICK], folder / "first")
    result = read_result(results["b7-2"])
    shift_mm = result.rest.R_camera_rest @ np.array([0.2, 0.0, 0.0])
    other = msgspec.structs.replace(result.provenance, calibration_sha256="a" * 64)
    write_results(replace(moved(result, shift_mm=shift_mm), provenance=other), results["b7-2"])
    combine_test("shake-12", results, [BRICK], folder / "second")
    shutil.copytree(folder / "first", folder / "shake-12")
    combine_test("shake-12", results, [BRICK], folder / "shake-12")
    return folder


def test_a_run_is_compared_with_what_its_last_processing_replaced(lab):
    found = compare(lab / "b7-2")
    assert found.title == "b7-2_0001_shake"
    assert found.simulated
    np.testing.assert_allclose(found.pairs[0].largest, [0.2, 0, 0, 0, 0, 0], atol=1e-9)
    back = compare(lab / "b7-2" / "results", lab / "b7-2" / "results_1")
    np.testing.assert_array_equal(back.pairs[0].after, found.pairs[0].before)
    with pytest.raises(ConfigError, match="no earlier results are kept"):
        compare(lab / "b7-1")
    with pytest.raises(RunFormatError, match="no such folder"):
        compare(lab / "nothing")


def test_a_test_brings_its_components_too(lab):
    found = compare(lab / "first", lab / "second")
    by_name = {pair.name: pair for pair in found.pairs}
    assert by_name["b7-1"].is_same
    assert not by_name["b7-2"].is_same, "each test is of the results that it was combined of"
    assert by_name["brick-7: B"].is_same
    # C is seen by b7-2 from B, which turns by a few degrees: the shift is turned with it.
    length = np.linalg.norm(by_name["brick-7: C"].difference[:, :3], axis=1)
    np.testing.assert_allclose(length[np.isfinite(length)], 0.2, atol=1e-9)
    assert compare(lab / "second").only_after == ["b7-1"]
    assert (lab / "shake-12_1" / "test.json").read_bytes() == (lab / "first" / "test.json").read_bytes()
    kept = {pair.name: pair for pair in compare(lab / "shake-12").pairs}
    assert kept.keys() == by_name.keys()
    np.testing.assert_array_equal(kept["brick-7: C"].difference, by_name["brick-7: C"].difference)


def test_folders_of_runs_are_matched_by_name(lab, tmp_path):
    (tmp_path / "b7-2").symlink_to(lab / "b7-2" / "results_1")
    (tmp_path / "b7-9").symlink_to(lab / "b7-1" / "results")
    found = compare(tmp_path, lab)
    assert [pair.name for pair in found.pairs] == ["b7-2"]
    assert found.only_before == ["b7-9"]
    assert "b7-1" in found.only_after


def test_the_page_names_the_worst_and_holds_everything(lab):
    page = render_comparison(compare(lab / "first", lab / "second"))
    assert page.index("brick-7: C") < page.index("b7-1</td>")
    assert "SIMULATED" in page
    assert "111111111111…" in page
    assert page.count('<img src="data:image/svg+xml') == 4  # differences and motion of the two that differ
    assert "http" not in page.replace("http://www.w3.org", "")
    assert verdict(compare(lab / "first", lab / "first")) == ("No number differs in 4 motions.", "good")
    words, mood = verdict(compare(lab / "b7-2"))
    assert (mood, words.startswith("The motion differs, at most by ")) == ("bad", True)


def test_the_command_prints_a_table_and_writes_page_and_csv(lab, tmp_path):
    def invoke(*words):
        return CliRunner().invoke(app, [str(w) for w in words], env={"COLUMNS": "200"})

    page, table = tmp_path / "page.html", tmp_path / "changes.csv"
    done = invoke("compare", lab / "first", lab / "second", "-o", page, "--csv", table)
    assert done.exit_code == 0, done.output
    assert "(simulated): 2 of 4 motions differ" in done.output
    assert page.read_text().startswith("<!DOCTYPE html>")
    with table.open() as file:
        rows = {row["motion"]: row for row in csv.DictReader(file)}
    assert float(rows["b7-2"]["max_dx_mm"]) == pytest.approx(0.2, abs=1e-9)
    assert float(rows["b7-1"]["share_beyond"]) == 0.0
    said = json.loads(invoke("compare", lab / "b7-2", "-o", page, "--json").output)
    assert said["motions"][0]["max_dx_mm"] == pytest.approx(0.2, abs=1e-9)
    refused = invoke("compare", lab / "b7-1", "-o", page)
    assert refused.exit_code == 1
    assert "Name two to compare" in refused.output
    in_the_way = invoke("compare", lab / "b7-2", "-o", table / "page.html")
    assert in_the_way.exit_code == 1
    assert "Choose another --output" in " ".join(in_the_way.output.split())
