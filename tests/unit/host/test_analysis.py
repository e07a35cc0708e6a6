"""What a notebook calls: arrays that equal the tables, and joins that hold sample for sample."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_lab import example

from bricktrack_common.errors import RunFormatError
from bricktrack_host import analysis
from bricktrack_host.results.spectra import SpectrumError, amplitude_spectrum


@pytest.fixture(scope="module")
def run(lab):
    return analysis.load_run(lab / "b7-1")


def columns(table, *names):
    return np.stack([table.column(name).to_numpy() for name in names], axis=1)


def test_a_run_is_found_by_its_folder_or_its_results(lab, run):
    assert analysis.load_run(str(lab / "b7-1" / "results")).run_id == run.run_id == "b7-1_0001_shake"
    assert run.simulated
    assert "2 frames were dropped by the camera" in run.problems
    with pytest.raises(RunFormatError, match="Name one of them"):
        analysis.load_run(lab)
    with pytest.raises(RunFormatError, match="Process the run first"):
        analysis.load_run(lab / "b7-1" / "nowhere")


def test_motion_at_edges_is_that_of_the_table(run):
    motion, table = run.motion("edges"), run.table("samples")
    np.testing.assert_array_equal(motion.sample, table.column("edge_index").to_numpy())
    np.testing.assert_allclose(motion.displacement_mm, columns(table, "dx_mm", "dy_mm", "dz_mm"), atol=1e-9)
    rotation_rad = columns(table, "drvec_x_rad", "drvec_y_rad", "drvec_z_rad")
    np.testing.assert_allclose(np.deg2rad(motion.rotation_deg), rotation_rad, atol=1e-12)
    np.testing.assert_allclose(motion.t_s, table.column("t_s").to_numpy(), atol=1e-12)
    # The table's deviations leave the rest pose out, which is a mean of many frames.
    sd_mm = columns(table, "sd_dx_mm", "sd_dy_mm", "sd_dz_mm")
    assert (motion.displacement_sd_mm >= sd_mm - 1e-12).all()
    np.testing.assert_allclose(motion.displacement_sd_mm, sd_mm, rtol=0.2)


def test_every_kind_of_instant_has_its_rows(run):
    kinds = run.table("fused").column("kind").to_pylist()
    for at, kind in (("slots", "imu"), ("frames", "frame"), ("edges", "edge")):
        assert len(run.motion(at).t_s) == kinds.count(kind) > 0
    assert len(run.motion("optical").t_s) == run.table("optical").num_rows
    with pytest.raises(analysis.HistoryError, match="there is motion at slots, frames, edges, optical"):
        run.motion("samples")


def test_another_point_moves_as_a_rigid_body_does(run):
    p_mm = np.array([54.0, -20.0, 10.0])
    led, other = run.motion("slots"), run.motion("slots", point_mm=p_mm)
    R = Rotation.from_rotvec(led.rotation_deg, degrees=True)
    np.testing.assert_allclose(other.displacement_mm, led.displacement_mm + R.apply(p_mm) - p_mm, atol=1e-9)
    # 58 mm from the LED the rotation's deviation, here about 0.05 degrees, adds some 0.05 mm.
    assert np.median(other.displacement_sd_mm) > np.median(led.displacement_sd_mm)


def test_what_is_missing_is_said(run):
    without = replace(run.result, rest=None)
    with pytest.raises(analysis.HistoryError, match="no rest pose"):
        analysis.Run(run.folder, without).motion()
    with pytest.raises(analysis.HistoryError, match="no fused motion at 'edge' instants; there are: none"):
        analysis.Run(run.folder, replace(run.result, fused={})).motion("edges")


def test_the_spectrum_holds_the_variance_and_peaks_where_the_motion_was_put(run):
    t_s = np.arange(2048) / 100
    wave = 2.0 * np.sin(2 * np.pi * 6.25 * t_s)
    spectrum = amplitude_spectrum(t_s, wave[:, None])
    # Parseval: half the squared amplitude; the window's ends are worth less than one percent here.
    assert np.sum(spectrum.density**2) * spectrum.f_hz[0] == pytest.approx(2.0, rel=0.01)
    # The example sways at 3.1 Hz along z; bins are 0.2 Hz apart.
    shaken = analysis.spectrum(run.motion("slots"))
    assert shaken.density.shape[1] == 6
    assert shaken.f_hz[np.argmax(shaken.density[:, 2])] == pytest.approx(3.1, abs=0.2)
    with pytest.raises(SpectrumError, match="at least 64"):
        amplitude_spectrum(t_s[:50], wave[:50, None])
    with pytest.raises(SpectrumError, match="must rise"):
        amplitude_spectrum(np.zeros(100), np.zeros((100, 1)))


def test_components_are_those_of_the_test(lab, run):
    test = analysis.load_test(lab / "shake-12")
    assert test.assemblies == ["brick-7"]
    assert test.problems == []
    components = test.components("brick-7")
    assert list(components) == ["B", "C"]
    # B is seen by b7-1 alone: the same rotation; the point is the brick's origin.
    np.testing.assert_allclose(components["B"].rotation_deg, run.motion("edges").rotation_deg, atol=1e-9)
    expected = run.motion("edges", point_mm=(-10.0, -20.0, -30.0))
    np.testing.assert_allclose(components["B"].displacement_mm, expected.displacement_mm, atol=1e-9)
    np.testing.assert_allclose(components["B"].displacement_sd_mm, expected.displacement_sd_mm, rtol=1e-6)
    with pytest.raises(RunFormatError, match="no assembly 'brick-8'; there are brick-7"):
        test.components("brick-8")


def test_the_laboratorys_rows_get_the_motion_of_their_sample(lab, run, tmp_path):
    daq = tmp_path / "daq.csv"
    daq.write_text("Sample,Force [kN]\n1012,1.5\n999,2.5\n1000,3.5\n")
    motion = run.motion("edges")
    joined = analysis.join_daq(motion, daq, sample_column="Sample", first_sample=1000).to_pydict()
    assert joined["sample"] == [12, -1, 0]
    assert joined["Force [kN]"] == [1.5, 2.5, 3.5]
    assert joined["dx_mm"] == [motion.displacement_mm[12, 0], None, motion.displacement_mm[0, 0]]
    assert joined["sd_drot_z_deg"][2] == motion.rotation_sd_deg[0, 2]
    both = analysis.load_test(lab / "shake-12").components("brick-7")
    joined = analysis.join_daq(both, daq, sample_column="Sample", first_sample=1000).to_pydict()
    assert joined["C_dx_mm"][0] == both["C"].displacement_mm[list(both["C"].sample).index(12), 0]
    assert joined["B_flags"][2] == both["B"].flags[list(both["B"].sample).index(0)]
    with pytest.raises(analysis.HistoryError, match=r"take motion\('edges'\)"):
        analysis.join_daq(run.motion("slots"), daq, sample_column="Sample")


def test_the_invented_dropout_is_flagged_between_its_times(run):
    motion = run.motion("slots")
    inside = motion.flagged(analysis.PoseFlag.DROPOUT)
    first, last = example.DROPOUT_S
    flagged_s = motion.t_s[inside]
    np.testing.assert_allclose([flagged_s.min(), flagged_s.max()], [first, last], atol=0.011)
    assert "dropout" in analysis.flag_names(motion.flags[inside][:1])[0]
