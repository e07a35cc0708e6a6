"""Loose files become a run that says the same; what does not fit together is refused."""

import csv
import os
from pathlib import Path

import numpy as np
import pytest
from small_videos import HEIGHT, PERIOD_US, WIDTH, grey_of, write_video

from bricktrack_common.errors import ConfigError, RunFormatError, StorageError, VideoError
from bricktrack_common.frame_times import FrameFlag
from bricktrack_common.imu_records import ImuFlag
from bricktrack_common.run_folder import read_run
from bricktrack_host.recordings.import_recording import Recording, import_recording
from bricktrack_host.recordings.imu_import import import_imu
from bricktrack_host.recordings.loose_files import LooseImu, LooseRig, read_rig, sensor_mode
from bricktrack_host.recordings.video_frames import decode_run_video

N = 24
T0_NS = 5_118_442_907_613
RIG = LooseRig(sensor_mode(width=WIDTH, height=HEIGHT, line_time_us=18.9), 4000, T0_NS, True, 200.0)


def stamps(n=N, dropped=()):
    return [i * PERIOD_US for i in range(n + len(dropped)) if i not in dropped]


def recording(folder, *, stamps_us=None, n=N, suffix=".h264", video_stamps=None, **changes):
    stamps_us = stamps() if stamps_us is None else stamps_us
    video, times = folder / f"v{suffix}", folder / "pts.txt"
    if not video.exists():
        write_video(video, n, stamps_us=video_stamps)
    times.write_text("".join(f"{s}\n" for s in stamps_us))
    return Recording(
        **{"video": video, "timestamps": times, "rig": RIG, "unit": "b1", "label": "s", "simulated": True}
        | changes
    )


def imported(folder, **options):
    return read_run(
        import_recording(recording(folder, **options), folder / "runs").folder, verify_hashes=True
    )


def assert_pictures_are_their_own(run, first=0):
    frames = list(decode_run_video(run.video, run.frames))
    assert all(f.picture is not None for f in frames)
    # CRF 18 errs by less than one grey level in the mean; neighbours differ by 37.
    assert [abs(float(f.picture.luma.mean()) - grey_of(f.index + first)) < 3 for f in frames] == [True] * len(
        frames
    )


@pytest.mark.parametrize("suffix", [".h264", ".mp4", ".mkv"])
def test_every_kind_of_file_gives_the_same_run(tmp_path, suffix):
    run = imported(tmp_path, suffix=suffix)
    assert run.frames.n_frames == N
    assert run.frames.pts_us.tolist() == stamps()
    assert run.frames.sensor_timestamp_ns.tolist() == [T0_NS + 1000 * s for s in stamps()]
    assert set(run.frames.exposure_us.tolist()) == {4000}
    assert run.frames.keyframe.tolist() == [i % 10 == 0 for i in range(N)]
    assert_pictures_are_their_own(run)
    assert run.manifest.simulated
    assert run.manifest.origin == "import"
    assert run.manifest.run_id == "b1_s"
    assert run.manifest.camera.mode.line_time_ns == pytest.approx(18900)
    assert run.problems == [
        "no edges of the square wave: there is no t = 0 and no laboratory clock", "no inertial samples",
    ]  # fmt: skip


def test_exposures_that_vary_are_each_pictures_own(tmp_path):
    times_us = [2000 + 50 * i for i in range(N)]
    (tmp_path / "exposures.txt").write_text("# us\n" + "".join(f"{t}.0\n" for t in times_us))
    run = imported(tmp_path, exposures=tmp_path / "exposures.txt")
    assert run.frames.exposure_us.tolist() == times_us
    assert run.manifest.camera.exposure_us == 2575  # the median


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("4000\n" * (N - 1), f"{N - 1} exposures for {N} stamps"),
        ("4000\n" * (N - 1) + "-3\n", f"line {N}: '-3'"),
    ],
)
def test_exposures_that_cannot_be_right_are_refused(tmp_path, text, words):
    (tmp_path / "exposures.txt").write_text(text)
    with pytest.raises(VideoError, match=words):
        imported(tmp_path, exposures=tmp_path / "exposures.txt")


def test_stamps_that_do_not_begin_at_zero_keep_their_instants(tmp_path):
    late = [s + 5 * PERIOD_US for s in stamps()]
    run = imported(tmp_path, stamps_us=late)
    assert run.frames.pts_us.tolist() == stamps()
    assert run.frames.sensor_timestamp_ns.tolist() == [T0_NS + 1000 * s for s in late]


def test_a_dropped_frame_is_flagged_and_counted(tmp_path):
    run = imported(tmp_path, stamps_us=stamps(dropped=(7,)))
    assert np.flatnonzero(run.frames.flags & FrameFlag.GAP_BEFORE).tolist() == [7]
    assert run.manifest.quality.frames_dropped == 1


@pytest.mark.parametrize("n_stamps", [N - 1, N + 1])
def test_a_count_that_differs_is_refused_with_both_counts(tmp_path, n_stamps):
    with pytest.raises(VideoError, match=f"holds {N} pictures and .* {n_stamps} stamps.*--allow-shorter"):
        imported(tmp_path, stamps_us=stamps(n_stamps))
    assert not list((tmp_path / "runs").glob("*")) if (tmp_path / "runs").exists() else True


def test_a_surplus_at_the_end_may_be_allowed_and_is_said(tmp_path):
    run = imported(tmp_path, stamps_us=stamps(N - 1), allow_shorter=True)
    assert run.frames.n_frames == N - 1
    assert "1 pictures at the end have no stamp and were left out" in run.problems
    assert_pictures_are_their_own(run)
    other = tmp_path / "other"
    other.mkdir()
    run = imported(other, stamps_us=stamps(N + 3), allow_shorter=True)
    assert run.frames.n_frames == N
    assert "3 stamps at the end have no picture: the video was cut, those frames are lost" in run.problems


@pytest.mark.parametrize(
    ("stamps_us", "words"),
    [
        (stamps()[1:], "the first stamp is 33327 µs, not 0"),
        (stamps(N - 1, dropped=(9,)), "leave out a frame after line 9"),
    ],
    ids=["first line missing", "a line in the middle missing"],
)
def test_a_surplus_that_may_be_elsewhere_is_refused_even_when_allowed(tmp_path, stamps_us, words):
    with pytest.raises(VideoError, match=words):
        imported(tmp_path, stamps_us=stamps_us, allow_shorter=True)


def test_a_video_cut_in_the_middle_of_a_picture_is_not_one_short_but_still_counted(tmp_path):
    made = recording(tmp_path)
    data = made.video.read_bytes()
    made.video.write_bytes(data[: len(data) * 2 // 3])
    with pytest.raises(VideoError, match=rf"holds \d+ pictures and .* {N} stamps"):
        import_recording(made, tmp_path / "runs")


def test_a_container_that_knows_better_is_believed(tmp_path):
    """As many pictures as stamps, but the container has the gap at another place."""
    with pytest.raises(VideoError, match="by the container picture 5 comes"):
        imported(
            tmp_path, suffix=".mkv", video_stamps=stamps(dropped=(5,)), stamps_us=stamps(dropped=(15,)),
        )  # fmt: skip


def test_a_container_of_invented_constant_rate_is_not_compared(tmp_path):
    made = import_recording(
        recording(tmp_path, suffix=".mp4", stamps_us=stamps(dropped=(5,))), tmp_path / "runs"
    )
    assert any("constant rate" in note for note in made.notes)


@pytest.mark.parametrize(
    ("options", "words"),
    [({"bf": "2", "b_strategy": "0"}, "B picture.*ffmpeg"), ({"x264-params": "interlaced=1"}, "interlaced")],
)
@pytest.mark.parametrize("suffix", [".h264", ".mp4"])
def test_videos_out_of_order_are_refused(tmp_path, suffix, options, words):
    write_video(tmp_path / f"v{suffix}", N, options=options)
    with pytest.raises(VideoError, match=words):
        imported(tmp_path, suffix=suffix)


def test_a_video_without_a_first_keyframe_is_refused(tmp_path):
    made = recording(tmp_path)
    first = import_recording(made, tmp_path / "runs")
    frames = read_run(first.folder).frames
    made.video.write_bytes(made.video.read_bytes()[frames.byte_offset[1] :])
    with pytest.raises(VideoError, match="first picture is no keyframe"):
        imported(tmp_path, stamps_us=stamps(N - 1), label="t")


def test_the_picture_size_must_be_the_rigs(tmp_path):
    with pytest.raises(VideoError, match="160 x 96 px; the rig says 1920 x 1080"):
        imported(tmp_path, rig=LooseRig(sensor_mode(width=1920, height=1080, line_time_us=1), 1, 0))


def test_text_is_no_video(tmp_path):
    (tmp_path / "v.h264").write_text("0\n1\n")
    with pytest.raises(VideoError, match="no video that can be read.*Expected H.264"):
        imported(tmp_path)
    (tmp_path / "v.h264").write_bytes(b"")
    with pytest.raises(VideoError, match="the file is empty"):
        imported(tmp_path)


def test_an_existing_run_is_never_overwritten(tmp_path):
    imported(tmp_path)
    with pytest.raises(StorageError, match="exists already"):
        imported(tmp_path)


def test_a_run_id_with_a_path_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="run id"):
        imported(tmp_path, label="../x")
    with pytest.raises(ConfigError, match="unit and label may hold letters"):
        imported(tmp_path, unit="")  # a manifest without a unit could not be read again


def imu_of(n=300, *, period_ns=10_001_000, acc=None, gyro=None, jitter_ns=40_000, missing=()):
    draw = np.random.default_rng(2)
    t = T0_NS + np.arange(n) * period_ns + draw.integers(-jitter_ns, jitter_ns + 1, n)
    acc = np.round(draw.normal(0, 5, (n, 3)), 2) if acc is None else acc
    gyro = np.round(draw.normal(0, 50, (n, 3)) * 16) / 16 if gyro is None else gyro
    keep = np.setdiff1d(np.arange(n), missing)
    return LooseImu(t[keep].astype(np.int64), acc[keep], gyro[keep])


def decoded(imu, **options):
    from bricktrack_common.imu_records import decode_imu

    made = import_imu(imu, name="brick", **options)
    return made, decode_imu(made.description, made.records)


def test_a_bno055s_steps_are_kept_exactly():
    imu = imu_of()
    made, samples = decoded(imu)
    assert (made.description.acc_lsb_per_mps2, made.description.gyro_lsb_per_dps) == (100, 16)
    # Whole register values divided by 100 and 16: the nearest float to what the file says.
    np.testing.assert_allclose(samples.acc_mps2, imu.acc_mps2, rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.rad2deg(samples.gyro_radps), imu.gyro_dps, rtol=0, atol=1e-12)
    assert samples.t_ns.tolist() == imu.t_ns.tolist()
    assert not samples.flags.any()
    assert made.notes[1] == "accelerometer: kept exactly, in steps of 1/100 m/s²"


def test_finer_data_get_the_finest_scale_that_fits_and_it_is_said():
    draw = np.random.default_rng(3)
    acc, gyro = draw.normal(0, 4, (300, 3)), draw.normal(0, 30, (300, 3))
    made, samples = decoded(imu_of(acc=acc, gyro=gyro))
    # The largest value of these draws is between 8 and 16 m/s^2, between 64 and 128 deg/s.
    assert (made.description.acc_lsb_per_mps2, made.description.gyro_lsb_per_dps) == (2048, 256)
    np.testing.assert_allclose(samples.acc_mps2, acc, rtol=0, atol=0.5 / 2048 * 1.001)
    np.testing.assert_allclose(np.rad2deg(samples.gyro_radps), gyro, rtol=0, atol=0.5 / 256 * 1.001)
    assert "rounded to steps of 1/2048 m/s²" in made.notes[1]


def test_missing_samples_become_gaps_at_their_own_slots():
    imu = imu_of(missing=(50, 51, 52, 120))
    _, samples = decoded(imu)
    assert np.flatnonzero(samples.flags & ImuFlag.GAP).tolist() == [50, 51, 52, 120]


def test_nan_rows_become_gaps():
    imu = imu_of()
    imu.acc_mps2[7] = np.nan
    made, samples = decoded(imu)
    assert np.flatnonzero(samples.flags & ImuFlag.GAP).tolist() == [7]
    assert made.n_missing == 1


def test_a_stuck_sensor_is_said():
    imu = imu_of()
    imu.acc_mps2[100:120] = imu.acc_mps2[100]
    imu.gyro_dps[100:120] = imu.gyro_dps[100]
    made, _ = decoded(imu)
    assert any("taken as a stuck sensor" in note for note in made.notes)


def test_a_long_recording_with_a_slow_clock_keeps_its_grid():
    """300 s at 200 ppm off 10 ms drifts by 60 ms, six slots of a grid of 10 ms sharp."""
    imu = imu_of(30_000, period_ns=10_002_000)
    made, samples = decoded(imu)
    assert made.description.period_ns == pytest.approx(10_002_000, abs=2)
    assert not (samples.flags & int(ImuFlag.GAP | ImuFlag.LATE)).any()


def test_values_beyond_the_range_are_refused():
    with pytest.raises(ConfigError, match=r"accelerometer: 200 .*--imu-acc-range-g"):
        import_imu(imu_of(acc=np.full((300, 3), 200.0)), name="brick")


@pytest.mark.parametrize("jitter_ns", [6_000_000])
def test_samples_without_a_grid_are_refused(jitter_ns):
    with pytest.raises(RunFormatError, match="steady rate"):
        import_imu(imu_of(jitter_ns=jitter_ns, period_ns=20_000_000 // 2), name="brick")


def test_nothing_is_left_behind_by_a_failure(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("bricktrack_host.recordings.import_recording.write_manifest", full)
    with pytest.raises(StorageError, match="no space left"):
        imported(tmp_path)
    assert list((tmp_path / "runs").iterdir()) == []


SAMPLES = os.environ.get("BRICKTRACK_SAMPLES")


@pytest.mark.skipif(not SAMPLES, reason="BRICKTRACK_SAMPLES does not name the folder of samples")
def test_the_sample_comes_out_the_same_from_both_containers(tmp_path):
    source = Path(SAMPLES) / "path-traced"
    runs = []
    for kind in ("h264", "mp4"):
        made = import_recording(
            Recording(
                video=source / f"motion.{kind}", timestamps=source / "motion_pts_us.txt",
                imus={"brick": source / "imu_motion.csv"}, edges=source / "edges_motion.csv",
                rig=read_rig(source / "rig.toml", table="motion"), unit="sample", label=kind, simulated=True,
            ),
            tmp_path,
        )  # fmt: skip
        runs.append(read_run(made.folder, verify_hashes=True))
    bare, boxed = runs
    assert bare.video.read_bytes() == boxed.video.read_bytes()
    assert bare.frames.byte_offset.tolist() == boxed.frames.byte_offset.tolist()
    assert bare.frames.n_frames == 75
    rows = list(csv.DictReader((source / "imu_motion.csv").read_text().splitlines()))
    _, samples = bare.imus["brick"]
    assert samples.t_ns.tolist() == [int(r["t_ns"]) for r in rows]
    written = np.array([[float(r[c]) for c in ("ax_mps2", "ay_mps2", "az_mps2")] for r in rows])
    np.testing.assert_allclose(samples.acc_mps2, written, rtol=0, atol=1e-12)
    assert len(bare.edges_ns) == bare.manifest.quality.edges == 675
    assert bare.manifest.trigger.t0_ns == bare.edges_ns[0]
