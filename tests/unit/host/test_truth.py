"""Comparison with the truth: against errors put in by hand, and the samples' own truth files."""

import io
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import Rotation

from bricktrack_common.arrays import rows_of
from bricktrack_common.errors import RunFormatError, TrackingError
from bricktrack_host.results.true_motion import read_true_motion
from bricktrack_host.results.truth import compare_with_truth, comparison_table, groups_to_show

from .test_results import example


@pytest.fixture(scope="module")
def result():
    return example.example_result()


@pytest.fixture(scope="module")
def truth():
    return example.true_motion()


def group(comparison, source, name, of="groups"):
    return next(g for g in getattr(comparison, of) if g.source == source and g.group == name)


def shifted(track, *, mm, rad):
    """Return a track with a constant error put on the true motion."""
    R, t_mm, _, _ = example.true_motion_at(track.t_ns)
    R_off = Rotation.from_rotvec(rad).as_matrix()
    return replace(track, R_camera_brick=R @ R_off, t_camera_brick_mm=t_mm + np.asarray(mm))


def test_a_constant_error_is_told_exactly_and_vanishes_from_rest(result, truth):
    mm, rad = [0.3, -0.2, 0.5], [0.002, 0.0, -0.001]
    optical = shifted(result.optical, mm=mm, rad=rad)
    fused = {k: shifted(t, mm=mm, rad=rad) for k, t in result.fused.items()}
    rest = example.tare(optical)
    comparison = compare_with_truth(replace(result, optical=optical, fused=fused, rest=rest), truth)
    for source in ("optical", "fused"):
        g = group(comparison, source, "at frames")
        # Truth every millisecond, cubic between: 1e-6 mm here.
        np.testing.assert_allclose(g.mean, [*mm, *np.rad2deg(rad)], atol=2e-5)
        np.testing.assert_allclose(g.rms, np.abs([*mm, *np.rad2deg(rad)]), atol=2e-5)
        zeroed = group(comparison, source, "at frames", of="from_rest")
        # A turn of 0.002 rad about m0 leaves 0.002 x 4 mm of path, not the 0.5 mm put in.
        assert max(zeroed.rms[:3]) < 0.01
    assert max(group(comparison, "fused", "between frames").largest[:3]) == pytest.approx(0.5, abs=1e-3)


def test_groups_hold_each_instant_once(result, truth):
    comparison = compare_with_truth(result, truth)
    parts = ("at frames", "between frames", "during dropouts", "near impacts")
    total = sum(g.n + g.n_without for g in comparison.groups if g.source == "fused" and g.group in parts)
    everything = group(comparison, "fused", "all")
    assert total == everything.n + everything.n_without
    outside = group(comparison, "fused", "extrapolated")
    n_rows = sum(len(t.t_ns) for t in result.fused.values())
    assert total + outside.n + outside.n_without == n_rows
    # Hidden for 0.35 s: 10 or 11 frames without a pose.
    assert group(comparison, "optical", "during dropouts").n_without in (10, 11)
    assert len(comparison.impacts_ns) == 1
    assert abs(comparison.impacts_ns[0] - example.T0_NS - example.IMPACT_S * 1e9) < 2e6


def test_all_is_not_shown_beside_the_one_group_that_it_is_of(result, truth):
    shown = {(g.source, g.group) for g in groups_to_show(compare_with_truth(result, truth).groups)}
    assert {("optical", "all"), ("fused", "all"), ("optical", "during dropouts")} <= shown
    calm = np.isfinite(result.optical.t_camera_brick_mm[:, 0]) & (
        result.optical.t_ns < example.T0_NS + (example.IMPACT_S - 1.0) * 1e9
    )
    before_all = rows_of(result.optical, np.flatnonzero(calm)[:20])
    groups = compare_with_truth(replace(result, optical=before_all), truth).groups
    shown = [g.group for g in groups_to_show(groups) if g.source == "optical"]
    assert shown == ["at frames"] and ("optical", "all") in {(g.source, g.group) for g in groups}


def test_honest_covariances_give_unit_nees_and_small_ones_are_found_out(result, truth):
    n = np.count_nonzero(np.isfinite(result.optical.t_camera_brick_mm[:, 0]))
    g = group(compare_with_truth(result, truth), "optical", "all")
    # Mean of n chi-square(6)/6: deviation sqrt(2 / 6 / n); share within 95 %: binomial. Four of each.
    assert g.nees_mean == pytest.approx(1, abs=4 * np.sqrt(2 / 6 / n))
    assert g.nees_within_95 == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / n))
    boastful = replace(result, optical=replace(result.optical, covariance=result.optical.covariance / 4))
    g = group(compare_with_truth(boastful, truth), "optical", "all")
    assert g.nees_mean == pytest.approx(4, abs=16 * np.sqrt(2 / 6 / n))
    assert g.nees_within_95 < 0.6


def test_truth_between_samples_is_exact_to_micrometres_and_nan_outside(truth):
    t_ns = np.random.default_rng(1).integers(truth.t_ns[0], truth.t_ns[-1], 2000)
    R, t_mm = truth.at(t_ns)
    R_true, t_true, _, _ = example.true_motion_at(t_ns)
    # Where the formula has a kink in its speed, the cubic over that millisecond rounds it off.
    kinks_s = np.array([1.0, 1.5, example.IMPACT_S, 13.0, 14.0])
    calm = np.abs((t_ns[:, None] - example.T0_NS) / 1e9 - kinks_s).min(axis=1) > 2e-3
    assert np.abs(t_mm - t_true).max() < 0.03  # the impact: 110 mm/s at once, a quarter of it over 1 ms
    assert np.abs(t_mm - t_true)[calm].max() < 1e-5
    off = Rotation.from_matrix(np.swapaxes(R, -1, -2)[calm] @ R_true[calm]).magnitude()
    assert off.max() < 1e-7
    R, t_mm = truth.at(np.array([truth.t_ns[0] - 1, truth.t_ns[-1] + 1]))
    assert np.isnan(t_mm).all()
    assert np.isnan(R).all()


def test_npz_comes_back_with_every_nanosecond(truth, tmp_path):
    q = Rotation.from_matrix(truth.R_camera_brick).as_quat()[:, [3, 0, 1, 2]]
    np.savez(
        tmp_path / "truth.npz", t_ns=truth.t_ns, q_wxyz_camera_brick=q,
        t_camera_brick_mm=truth.t_camera_brick_mm, omega_brick_radps=truth.omega_brick_radps,
        v_camera_mmps=truth.v_camera_mmps, dropouts_ns=truth.dropouts_ns,
    )  # fmt: skip
    back = read_true_motion(tmp_path / "truth.npz")
    np.testing.assert_array_equal(back.t_ns, truth.t_ns)
    np.testing.assert_array_equal(back.dropouts_ns, truth.dropouts_ns)
    np.testing.assert_allclose(back.R_camera_brick, truth.R_camera_brick, atol=1e-12)
    assert back.is_continuous


def test_files_that_are_no_truth_are_refused_in_words(tmp_path):
    np.savez(tmp_path / "truth.npz", t_ns=np.arange(3.0), other=1)
    with pytest.raises(RunFormatError, match="no 'q_wxyz_camera_brick'"):
        read_true_motion(tmp_path / "truth.npz")
    (tmp_path / "bad.npz").write_bytes(b"PK not")
    with pytest.raises(RunFormatError, match="not a readable"):
        read_true_motion(tmp_path / "bad.npz")
    (tmp_path / "poses.csv").write_text("t_us,x_mm\n0,1\n")
    with pytest.raises(RunFormatError, match="missing"):
        read_true_motion(tmp_path / "poses.csv")


def test_anothers_truth_is_refused(result, truth):
    with pytest.raises(TrackingError, match="another run"):
        compare_with_truth(result, replace(truth, t_ns=truth.t_ns + 10**13))


def test_figures_go_to_json_and_to_the_terminal(result, truth):
    comparison = compare_with_truth(result, truth)
    data = json.loads(comparison.to_json())
    assert data["simulated"] is True
    assert data["camera_frame"][0]["rms"][2] == pytest.approx(0.09, rel=0.15)  # the noise put in
    empty = next(g for g in data["camera_frame"] if g["n"] == 0)
    assert empty["rms"] == [None] * 6
    console = Console(width=220, record=True, file=io.StringIO())
    console.print(comparison_table(comparison))
    text = console.export_text()
    assert "simulated" in text
    assert "during dropouts" in text


def sample_truth() -> Path:
    folder = os.environ.get("BRICKTRACK_SAMPLES")
    if not folder:
        pytest.skip("BRICKTRACK_SAMPLES does not name the samples' folder")
    return Path(folder) / "path-traced" / "truth"


def test_dense_truth_of_the_sample_agrees_with_its_truth_at_frames():
    dense = read_true_motion(sample_truth() / "motion_dense.csv")
    frames = read_true_motion(sample_truth() / "motion_poses.csv")
    assert dense.is_continuous
    assert not frames.is_continuous
    R, t_mm = dense.at(frames.t_ns)
    # The file gives 1e-6 mm and 1e-9 of a quaternion; at the impact 1 ms of cubic misses 0.003 mm.
    assert np.median(np.abs(t_mm - frames.t_camera_brick_mm)) < 2e-6
    assert np.abs(t_mm - frames.t_camera_brick_mm).max() < 0.005
    off = Rotation.from_matrix(np.swapaxes(R, -1, -2) @ frames.R_camera_brick).magnitude()
    assert np.rad2deg(off).max() < 0.005


def test_truth_of_single_frames_is_given_at_their_instants_only():
    static = read_true_motion(sample_truth() / "static_poses.csv")
    assert static.is_relative
    _, t_mm = static.at(np.array([static.t_ns[3], static.t_ns[3] + 1000, static.t_ns[3] + 10_000_000]))
    np.testing.assert_array_equal(t_mm[0], static.t_camera_brick_mm[3])
    np.testing.assert_array_equal(t_mm[1], static.t_camera_brick_mm[3])
    assert np.isnan(t_mm[2]).all()


def test_a_truth_file_with_semicolons_is_told_so(tmp_path):
    file = tmp_path / "truth.csv"
    file.write_text("t_us;x_mm;y_mm\n0;1,5;2\n")
    with pytest.raises(RunFormatError, match="parted by semicolons"):
        read_true_motion(file)


def test_a_truth_file_with_decimal_commas_is_told_so(tmp_path):
    file = tmp_path / "truth.csv"
    file.write_text("t_us,x_mm,y_mm,z_mm,qw,qx,qy,qz\n0,1,2,3,1,0,0,0\n1,1,5,2,3,1,0,0,0\n")
    with pytest.raises(RunFormatError, match="row 2 has more fields"):
        read_true_motion(file)
