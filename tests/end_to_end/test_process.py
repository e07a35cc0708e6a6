"""From a run folder to results on the shortened path-traced sample, and what happens when it is harmed."""

import json
import re
import shutil
import sys
from pathlib import Path

import av
import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest
from path_traced import SAMPLE, import_motion
from typer.testing import CliRunner

from bricktrack_common.camera_model import SensorMode
from bricktrack_common.errors import CalibrationError, ConfigError, RunFormatError, TrackingError, VideoError
from bricktrack_common.run_manifest import MANIFEST_NAME, read_manifest, write_manifest
from bricktrack_host import pipeline, scratch_arrays, scratch_kernel
from bricktrack_host.calibration.calibration_file import load_calibration, save_calibration
from bricktrack_host.cli import calibrate
from bricktrack_host.cli.main import app
from bricktrack_host.pipeline import ProcessSettings, process_run
from bricktrack_host.quality import PoseFlag
from bricktrack_host.results.result_store import results_id
from bricktrack_host.viewing.overlay_video import write_overlay

LAYOUT = SAMPLE / "layout.toml"
HIDDEN_FROM, HIDDEN_TO = 35, 42  # frames in which a bar hides m0 wholly (the sample's README)


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A folder with the imported run and the calibration."""
    folder = tmp_path_factory.mktemp("bench")
    import_motion(folder / "runs")
    calibrate.fit(
        folder / "calibration.json", "sample", rig=SAMPLE / "rig.toml", target="32x18", images_dir=SAMPLE
    )
    return folder


@pytest.fixture(scope="module")
def processed(bench):
    return process_run(
        bench / "runs" / "sample_motion",
        calibration=bench / "calibration.json",
        layout=LAYOUT,
        truth=SAMPLE / "truth",
    )


@pytest.fixture
def copy(bench, tmp_path):
    """A copy of the run that a test may harm."""
    return Path(shutil.copytree(bench / "runs" / "sample_motion", tmp_path / "sample_motion"))


def process(bench, run, **options):
    return process_run(run, calibration=bench / "calibration.json", layout=LAYOUT, **options)


def amend(run, **changes):
    path = run / MANIFEST_NAME
    write_manifest(path, msgspec.structs.replace(read_manifest(path), **changes))


def test_every_frame_has_a_pose_the_origin_led_hidden_or_not(processed):
    optical = processed.result.optical
    assert np.isfinite(optical.t_camera_brick_mm).all()
    hidden = slice(HIDDEN_FROM, HIDDEN_TO + 1)
    assert (optical.flags[hidden] & PoseFlag.LED_MISSING != 0).all()
    assert np.isnan(processed.result.observations.uv_px[hidden, 0]).all()


def test_errors_against_truth_are_what_the_picture_allows(processed):
    # With the true lens, thresholded centroids and no model of the dome, a least-squares pose reaches 0.040 / 0.023 /
    # 0.183 mm and 0.27 deg (the sample's README, "motion, none, yes"); fused ones must do no worse.
    groups = {(g.source, g.group): g for g in processed.truth.groups}
    for source in ("optical", "fused"):
        rms = groups[source, "at frames"].rms
        assert rms[0] < 0.040 and rms[1] < 0.023 and rms[2] < 0.183
        assert np.linalg.norm(rms[3:]) < 0.27
    assert groups["fused", "between frames"].n > 300


def test_the_clocks_of_camera_and_imu_are_aligned(processed):
    model = json.loads('{"t_imu_minus_t_cam_ns": -61374200}')  # truth/model.json of the sample
    offset_ms = processed.result.alignment["smoothed_offset_ms"]
    assert offset_ms == pytest.approx(
        model["t_imu_minus_t_cam_ns"] / 1e6, abs=0.2
    )  # DESIGN 8: 0.2 ms or better


def test_results_are_on_the_laboratory_samples(processed):
    table = pq.read_table(processed.folder / "fused.parquet").to_pylist()
    edges = [row for row in table if row["kind"] == "edge"]
    index = [row["edge_index"] for row in edges]
    assert index == list(range(index[0], index[-1] + 1))
    steps = np.diff([row["t_ns"] for row in edges])
    assert (
        np.abs(steps - 5_000_100).max() <= 60
    )  # the wave's period on the unit's clock, 20 ppm long; rounding


def test_processing_again_gives_the_same_bytes(processed, bench):
    before = {p.name: p.read_bytes() for p in processed.folder.iterdir() if p.suffix in (".parquet", ".csv")}
    summary = (processed.folder / "summary.json").read_bytes()
    process(bench, bench / "runs" / "sample_motion", truth=SAMPLE / "truth")
    assert {name: (processed.folder / name).read_bytes() for name in before} == before
    assert (processed.folder / "summary.json").read_bytes() == summary


@pytest.mark.skipif(sys.platform != "linux", reason="arrays lie on the disk on Linux only")
def test_a_recording_called_long_gives_the_same_bytes_with_its_arrays_on_the_disk(
    processed, bench, tmp_path, monkeypatch
):
    monkeypatch.setattr(pipeline, "_LONG_FRAMES", 1)
    monkeypatch.setattr(scratch_arrays, "_OF_DISK", {})
    monkeypatch.setattr(scratch_arrays, "_LEAST_BYTES", 2000)
    monkeypatch.setattr(scratch_arrays, "_RESIDENT_BYTES", 1 << 18)
    process(bench, bench / "runs" / "sample_motion", truth=SAMPLE / "truth", output=tmp_path / "results")
    (scratch,) = scratch_arrays._OF_DISK.values()
    assert scratch.numbers[scratch_kernel.USED] > 1 << 20
    assert results_id(tmp_path / "results") == results_id(processed.folder)


def test_the_report_stands_alone(processed):
    page = processed.report.read_text(encoding="utf-8")
    assert "simulated" in page.lower()
    assert 'src="http' not in page and 'href="http' not in page


def test_the_paper_way_gives_poses_too(bench, copy):
    processed = process(
        bench, copy, settings=ProcessSettings(segmentation="paper", prsoi_form="printed", use_imu=False)
    )
    flags = processed.result.fused["frame"].flags
    assert (flags & PoseFlag.OPTICAL_ONLY != 0).all()
    n = np.isfinite(processed.result.optical.t_camera_brick_mm).all(axis=1).sum()
    assert n >= 30  # its rules need all seven LEDs; prediction carries some frames more


def test_a_video_cut_in_the_middle_loses_frames_and_says_so(bench, copy):
    video = copy / "video.h264"
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    processed = process(bench, copy)
    lost = processed.result.optical.flags & PoseFlag.FRAME_LOST != 0
    assert 10 < lost.sum() < 40
    assert np.isnan(processed.result.optical.t_camera_brick_mm[lost]).all()
    assert any("video.h264 has" in p for p in processed.result.problems)
    assert any("frames lost" in p for p in processed.result.problems)


def test_an_altered_video_is_refused(bench, copy):
    video = copy / "video.h264"
    data = bytearray(video.read_bytes())
    data[len(data) // 2] ^= 0x40
    video.write_bytes(bytes(data))
    with pytest.raises(RunFormatError, match=r"video\.h264: its SHA-256 is not the manifest's"):
        process(bench, copy)


def test_frame_times_cut_short_leave_the_other_frames_right(bench, copy, processed):
    frames = copy / "frames.msgpack"
    frames.write_bytes(frames.read_bytes()[:-5])
    result = process(bench, copy).result
    assert len(result.optical.t_ns) == len(processed.result.optical.t_ns) - 1
    np.testing.assert_array_equal(result.optical.t_ns, processed.result.optical.t_ns[:-1])
    assert any("frames.msgpack is cut" in p for p in result.problems)


def test_a_run_without_imu_is_smoothed_from_optics_alone(bench, copy):
    (copy / "imu_brick.msgpack").unlink()
    processed = process(bench, copy)
    assert (processed.result.fused["frame"].flags & PoseFlag.OPTICAL_ONLY != 0).all()
    assert any("no inertial samples" in p for p in processed.result.problems)


def test_a_run_without_video_is_refused(bench, copy):
    (copy / "video.h264").unlink()
    with pytest.raises(VideoError, match="no video"):
        process(bench, copy)


def test_a_calibration_of_another_sensor_mode_is_refused(bench, copy, tmp_path):
    full_field = SensorMode(
        name="imx219-full", width=1920, height=1080, crop_width=3280, crop_height=1845, line_time_ns=18903.5
    )
    wrong = tmp_path / "wrong.json"
    save_calibration(
        wrong, msgspec.structs.replace(load_calibration(bench / "calibration.json"), sensor_mode=full_field)
    )
    with pytest.raises(
        CalibrationError, match=r"imx219-full.*recording was\s+made in.*imx219-1920x1080-crop"
    ):
        process_run(copy, calibration=wrong, layout=LAYOUT)


def test_a_calibration_of_another_unit_is_refused(bench, copy):
    amend(copy, unit="other")
    with pytest.raises(CalibrationError, match=r"of unit 'sample', the recording of unit 'other'"):
        process(bench, copy)


def _stretched(line: re.Match[str]) -> str:
    x, y, z = (float(n) for n in re.findall(r"-?\d+\.\d+", line[0]))
    return f"position_mm = [{1.5 * x}, {0.7 * y}, {-2 * z}]"


def test_a_layout_of_another_brick_gives_no_pose_but_words(bench, copy, tmp_path):
    layout = tmp_path / "layout.toml"
    layout.write_text(re.sub(r"position_mm = .*", _stretched, LAYOUT.read_text()))
    with pytest.raises(TrackingError, match=r"none of 48 frames (gave a pose|do five)"):
        process_run(copy, calibration=bench / "calibration.json", layout=layout)


def test_an_imu_that_the_run_does_not_have_is_named(bench, copy):
    with pytest.raises(ConfigError, match="no IMU 'other'; it has: brick"):
        process(bench, copy, settings=ProcessSettings(imu="other"))


def test_a_film_of_the_run_keeps_its_frames_times(processed, bench, tmp_path):
    film = tmp_path / "film.mp4"
    n = write_overlay(
        bench / "runs" / "sample_motion", processed.folder, film, slow=4.0, scale=0.25, frames=(30, 40)
    )
    assert n == 10
    with av.open(str(film)) as container:
        frames = list(container.decode(video=0))
    # The picture; below it words and the motion.
    assert [(f.width, f.height) for f in frames] == [(480, 270 + 90)] * 10
    stamps = processed.result.observations.sensor_timestamp_ns[30:40]
    expected = (stamps - stamps[0]) / 1e9 * 4.0
    assert [f.time for f in frames] == pytest.approx(expected.tolist(), abs=1e-4)
    assert list(tmp_path.iterdir()) == [film]


def test_a_film_of_another_runs_results_is_refused(processed, bench, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(bench / "runs" / "sample_motion", other)
    path = other / MANIFEST_NAME
    write_manifest(path, msgspec.structs.replace(read_manifest(path), run_id="sample_other"))
    with pytest.raises(RunFormatError, match="not of this run"):
        write_overlay(other, processed.folder, tmp_path / "film.mp4")
    assert not (tmp_path / "film.mp4").exists()


@pytest.mark.parametrize("camera", ["imu", "table"])
def test_a_moving_camera_is_not_fused_as_if_it_stood_still(bench, tmp_path, camera):
    moving = process_run(
        bench / "runs" / "sample_motion",
        calibration=bench / "calibration.json",
        layout=LAYOUT,
        output=tmp_path / "moving",
        settings=ProcessSettings(camera=camera),
    )
    assert any("the position is not observable" in problem for problem in moving.result.problems)
    for track in moving.result.fused.values():
        assert (track.flags & PoseFlag.OPTICAL_ONLY).all()


def test_the_fleet_file_says_what_the_camera_moves_with(bench, tmp_path):
    (tmp_path / "fleet.toml").write_text(
        f'[[unit]]\nname = "sample"\naddress = "tcp://127.0.0.1:9"\ncamera = "table"\nlayout = "{LAYOUT}"\n'
        f'calibration = "{bench / "calibration.json"}"\n'
    )
    run = bench / "runs" / "sample_motion"
    done = CliRunner().invoke(
        app, ["process", str(run), "--fleet", str(tmp_path / "fleet.toml"), "-o", str(tmp_path / "out")]
    )
    assert done.exit_code == 0, done.output
    assert "the position is not observable" in " ".join(done.output.split())


@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.parametrize("send", ["path", "bytes"])
def test_a_cluster_gives_the_same_bytes_and_its_work_stands(processed, bench, tmp_path, send):
    distributed = pytest.importorskip("distributed")
    run, out = str(bench / "runs" / "sample_motion"), tmp_path / "out"
    arguments = ["process", run, "-c", str(bench / "calibration.json"), "-l", str(LAYOUT), "-o", str(out)]
    truth = ["--truth", str(SAMPLE / "truth")]
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0"
    ) as cluster:
        there = ["--scheduler", cluster.scheduler.address, "--send", send]
        done = CliRunner().invoke(app, [*arguments, *truth, *there], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    for path in processed.folder.iterdir():
        if path.suffix in (".parquet", ".csv") or path.name == "summary.json":
            assert (out / path.name).read_bytes() == path.read_bytes(), path.name
    done = CliRunner().invoke(app, [*arguments, *truth], catch_exceptions=False)
    assert "processed already, of the same input" in done.output
    done = CliRunner().invoke(app, [*arguments, *truth, "--no-imu"], catch_exceptions=False)
    assert "processed already" not in done.output
    assert f"earlier: {out}_1" in done.output.replace("\n", "")
