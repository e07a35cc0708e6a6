"""The recording for the viewer: what is in the file is what the run and its results say, at the same instants."""

import io
import sys
from dataclasses import replace

import av
import msgspec
import numpy as np
import pytest
from pinhole import PinholeCamera
from small_lab import example, invented_run
from small_videos import write_video
from typer.testing import CliRunner

from bricktrack_common.brick_model import BrickModel
from bricktrack_common.errors import ConfigError, RunFormatError, StorageError
from bricktrack_common.frame_times import FrameRecord, write_frames
from bricktrack_common.run_folder import read_run
from bricktrack_common.run_manifest import FRAMES_NAME, MANIFEST_NAME, VIDEO_NAME, file_entry, write_manifest
from bricktrack_host.assemblies.motion_history import run_history
from bricktrack_host.cli.main import app
from bricktrack_host.recordings.annex_b import NAL_SPS, iter_nal_units, split_access_units
from bricktrack_host.viewing.run_scene import encoded_pictures, nearest_pinhole

rr = pytest.importorskip("rerun")
from bricktrack_host.viewing.rerun_output import save_recording, show_recording  # noqa: E402
from bricktrack_host.viewing.rerun_recording import Belongings  # noqa: E402

FOCAL_PX, CENTRE_PX = 2714.0, np.array([959.5, 539.5])  # of scripts/example_report.py
TIME = "since trigger"


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A run with a small video of as many frames as its invented (simulated) results have."""
    folder = tmp_path_factory.mktemp("lab") / "b7-1"
    result = invented_run(folder, "b7-1")
    stamps = result.observations.sensor_timestamp_ns
    write_video(folder / VIDEO_NAME, len(stamps), options={"preset": "ultrafast"})
    units = split_access_units((folder / VIDEO_NAME).read_bytes())
    with (folder / FRAMES_NAME).open("wb") as file:
        write_frames(
            file,
            [
                FrameRecord(
                    int(t - stamps[0]) // 1000, int(t), 4000, 1.0, u.keyframe, u.byte_offset, u.n_bytes, 0
                )
                for t, u in zip(stamps, units, strict=True)
            ],
        )
    files = [file_entry(folder / name) for name in (VIDEO_NAME, FRAMES_NAME)]
    write_manifest(folder / MANIFEST_NAME, msgspec.structs.replace(result.manifest, files=files))
    return folder, result


@pytest.fixture(scope="module")
def belongings():
    brick = BrickModel(
        name="", led_names=example.BRICK.led_names, led_positions_mm=example.BRICK.led_positions_mm,
        led_axes=np.tile([0.0, 0.0, -1.0], (7, 1)), led_radii_mm=np.full(7, 3.0),
        imu_lever_arm_mm=None, R_brick_imu=None, led_profile=None,
    )  # fmt: skip
    camera = PinholeCamera(f_px=FOCAL_PX, k1=0.0, k2=0.0, p1=0.0, p2=0.0)
    return Belongings(camera, brick)


class Saved:
    """An .rrd file, read back by Rerun's own reader."""

    def __init__(self, path):
        self.reader = rr.chunk.RrdReader(path)
        self.chunks = list(self.reader.stream().to_chunks())

    def column(self, entity, component):
        """Return the instants, ns on the viewer's timeline, and the values of one component, one list each."""
        found = []
        for chunk in self.chunks:
            if chunk.entity_path != f"/{entity}" or chunk.is_static:
                continue
            batch = chunk.to_record_batch()
            times = batch.column(TIME).cast("int64").to_pylist()
            found += zip(times, batch.column(component).to_pylist(), strict=True)
        found.sort(key=lambda row: row[0])
        return np.array([t for t, _ in found]), [np.array(v) for _, v in found]

    def static(self, entity, component):
        for chunk in self.chunks:
            if chunk.entity_path == f"/{entity}" and chunk.is_static:
                return chunk.to_record_batch().column(component).to_pylist()[0]
        raise AssertionError(entity)


@pytest.fixture(scope="module")
def saved(lab, belongings, tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "run.rrd"
    save_recording(path, read_run(lab[0]), lab[1], belongings)
    assert [p.name for p in path.parent.iterdir()] == ["run.rrd"], "nothing half-written stays"
    return Saved(path)


def test_the_video_is_the_recorded_bytes_at_the_poses_instants(lab, saved):
    folder, result = lab
    t_ns, samples = saved.column("world/camera/video", "VideoStream:sample")
    np.testing.assert_array_equal(t_ns, result.optical.t_ns - result.t0_ns)
    stream = b"".join(bytes(np.asarray(sample, dtype=np.uint8).ravel()) for sample in samples)
    assert stream == (folder / VIDEO_NAME).read_bytes()
    with av.open(io.BytesIO(stream), format="h264") as container:
        assert sum(1 for _ in container.decode(video=0)) == len(t_ns)


def test_leds_are_drawn_where_they_were_seen_and_residuals_end_there(lab, saved):
    result = lab[1]
    _, points = saved.column("world/camera/leds/used", "Points2D:positions")
    _, predicted = saved.column("world/camera/leds/predicted", "Points2D:positions")
    _, tails = saved.column("world/camera/leds/residuals_x100", "Arrows2D:origins")
    _, ways = saved.column("world/camera/leds/residuals_x100", "Arrows2D:vectors")
    used = np.isfinite(result.optical.residual_px).all(axis=2)
    for i in (0, 50, 300):
        uv, residual = result.observations.uv_px[i, used[i]], result.optical.residual_px[i, used[i]]
        # Single precision at a thousand pixels: 6e-5. Rerun counts pixels from their corner.
        np.testing.assert_allclose(points[i] - 0.5, uv, atol=1e-4)
        np.testing.assert_allclose(predicted[i] - 0.5, uv - residual, atol=1e-4)
        np.testing.assert_allclose(ways[i], 100 * residual, atol=1e-5)
        np.testing.assert_allclose(tails[i] + ways[i], points[i], atol=1e-3)
    assert [len(p) for p in points] == used.sum(axis=1).tolist()
    seen = np.isfinite(result.observations.uv_px).all(axis=2)
    _, labels = saved.column("world/camera/leds/names", "Points2D:labels")
    assert [list(row) for row in labels[300:302]] == [list(example.BRICK.led_names)] * 2
    assert [len(row) for row in labels] == seen.sum(axis=1).tolist()


def test_the_brick_stands_where_the_pose_puts_it_and_nowhere_without_one(lab, saved):
    result = lab[1]
    t_ns, leds = saved.column("world/optical/leds", "Points3D:positions")
    np.testing.assert_array_equal(t_ns, result.optical.t_ns - result.t0_ns)
    R, t_mm = result.optical.R_camera_brick[77], result.optical.t_camera_brick_mm[77]
    np.testing.assert_allclose(leds[77], example.BRICK.led_positions_mm @ R.T + t_mm, atol=2e-5)
    known = np.isfinite(result.optical.t_camera_brick_mm).all(axis=1)
    assert not known.all()
    _, boxes = saved.column("world/optical/box", "LineStrips3D:strips")
    assert [len(box) for box in boxes] == known.astype(int).tolist()
    corners = (boxes[77][0] - t_mm) @ R
    np.testing.assert_allclose(corners.min(axis=0), example.BRICK.led_positions_mm.min(axis=0) - 6, atol=1e-4)
    np.testing.assert_allclose(corners.max(axis=0), example.BRICK.led_positions_mm.max(axis=0) + 6, atol=1e-4)
    # Twelve edges, each along one axis: fifteen steps of one line, three of them twice.
    steps = np.abs(np.diff(corners, axis=0)) > 1e-3
    assert steps.sum(axis=1).tolist() == [1] * 15
    assert len({frozenset(map(tuple, np.round(corners[i : i + 2], 2))) for i in range(15)}) == 12
    _, vectors = saved.column("world/fused/axes", "Arrows3D:vectors")
    track = result.fused["imu"]
    np.testing.assert_allclose(vectors[500].T, 20 * track.R_camera_brick[500], atol=1e-5)
    extrapolated = track.flags & 2048 != 0
    assert extrapolated.any()
    assert all(len(v) == (0 if e else 3) for v, e in zip(vectors, extrapolated, strict=True))


def test_rays_run_from_the_camera_through_the_centroids_to_the_leds_depth(lab, saved):
    result = lab[1]
    _, rays = saved.column("world/rays", "LineStrips3D:strips")
    used = np.isfinite(result.optical.residual_px[77]).all(axis=1)
    ends = rays[77][:, 1]
    np.testing.assert_allclose(rays[77][:, 0], 0.0, atol=1e-5)
    seen = ends[:, :2] / ends[:, 2:] * FOCAL_PX + CENTRE_PX
    np.testing.assert_allclose(seen, result.observations.uv_px[77, used], atol=1e-3)
    placed = (
        example.BRICK.led_positions_mm @ result.optical.R_camera_brick[77].T
        + result.optical.t_camera_brick_mm[77]
    )
    np.testing.assert_allclose(ends[:, 2], placed[used, 2], atol=1e-4)


def test_curves_are_those_of_the_results(lab, saved):
    result = lab[1]
    t_ns, values = saved.column("motion/displacement_mm/y/fused", "Scalars:scalars")
    history = run_history(result, "imu")
    np.testing.assert_array_equal(t_ns, result.fused["imu"].t_ns - result.t0_ns)
    expected = np.where(history.measured, history.displacement_mm[:, 1], np.nan)
    np.testing.assert_array_equal(np.concatenate(values), expected)
    t_ns, values = saved.column("motion/rotation_deg/z/optical", "Scalars:scalars")
    np.testing.assert_array_equal(np.concatenate(values), run_history(result).rotation_deg[:, 2])
    t_ns, values = saved.column("imu/angular_rate", "Scalars:scalars")
    # On the camera's time: the invented alignment says that the sensor's stamps are 0.21 ms late.
    np.testing.assert_array_equal(t_ns, result.imu.t_ns - 210_000 - result.t0_ns)
    np.testing.assert_allclose(np.stack(values), np.rad2deg(result.imu.gyro_radps), rtol=1e-15)
    _, values = saved.column("residuals", "Scalars:scalars")
    np.testing.assert_array_equal(np.stack(values), np.linalg.norm(result.optical.residual_px, axis=2))


def test_words_say_what_to_mind(lab, saved):
    text = saved.static("about", "TextDocument:text")[0]
    assert "SIMULATED" in text
    assert "2 frames were dropped by the camera" in text
    t_ns, words = saved.column("events", "TextLog:text")
    spoken = [str(w[0]) for w in words]
    assert "impact" in spoken
    # The dropout begins between 8.4 s and the next sample of the sensor; see scripts/example_report.py.
    assert 8.4 <= t_ns[spoken.index("dropout")] / 1e9 <= 8.412
    assert len(saved.reader.blueprints()) == 1


def test_a_camera_is_drawn_as_the_pinhole_nearest_to_its_rays(saved, belongings):
    pinhole = nearest_pinhole(belongings.rays)
    assert pinhole.focal_px == pytest.approx((FOCAL_PX, FOCAL_PX), rel=1e-9)
    assert pinhole.principal_px == pytest.approx(tuple(CENTRE_PX), abs=1e-6)
    distorted = nearest_pinhole(PinholeCamera())
    # k1 r^2 with r = 135 px / 1560 px: 0.05 %.
    assert distorted.focal_px == pytest.approx((1560, 1560), rel=2e-3)
    matrix = np.array(saved.static("world/camera", "Pinhole:image_from_camera")[0]).reshape(3, 3).T
    np.testing.assert_allclose(matrix, [[FOCAL_PX, 0, 960.0], [0, FOCAL_PX, 540.0], [0, 0, 1]], rtol=1e-6)


def test_without_calibration_layout_or_rest_there_is_less_and_nothing_wrong(lab, tmp_path):
    folder, result = lab
    save_recording(
        tmp_path / "a.rrd", read_run(folder), replace(result, rest=None), Belongings(), with_video=False
    )
    less = Saved(tmp_path / "a.rrd")
    there = {chunk.entity_path for chunk in less.chunks}
    assert "/world/optical/axes" in there
    assert (
        not {"/world/rays", "/world/camera", "/world/camera/video", "/motion/displacement_mm/x/fused"} & there
    )
    _, leds = less.column("world/optical/leds", "Points3D:positions")
    assert {len(points) for points in leds} == {0}


def test_every_keyframe_can_come_first(lab):
    folder, _ = lab
    run = read_run(folder)
    keyframes = np.flatnonzero(run.frames.keyframe)
    data = run.video.read_bytes()
    second = int(run.frames.byte_offset[keyframes[1]])
    end = second + int(run.frames.n_bytes[keyframes[1]])
    # Take the parameter sets away from the second keyframe, as some recordings have them at the beginning only.
    picture = data[second:end]
    slices = next(u.offset for u in iter_nal_units(picture) if u.nal_type == 5)
    filled = data[:second] + b"\0" * slices + picture[slices:] + data[end:]
    (folder / "bare.h264").write_bytes(filled)
    pictures = encoded_pictures(folder / "bare.h264", run.frames)
    assert any(u.nal_type == NAL_SPS for u in iter_nal_units(pictures[keyframes[1]]))
    assert pictures[1] == encoded_pictures(run.video, run.frames)[1]
    (folder / "bare.h264").write_bytes(data[: end - 1])  # a video that is cut short
    assert len(encoded_pictures(folder / "bare.h264", run.frames)) == keyframes[1]


# What goes wrong, in words.


def test_results_of_another_run_are_refused(lab, belongings, tmp_path):
    folder, result = lab
    other = replace(result, manifest=msgspec.structs.replace(result.manifest, run_id="b9_1_0001_x"))
    with pytest.raises(RunFormatError, match="results of b9_1_0001_x, not of this run"):
        save_recording(tmp_path / "a.rrd", read_run(folder), other, belongings)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="--save"):
        save_recording(tmp_path / "file" / "a.rrd", read_run(folder), result, belongings)


def test_without_a_screen_a_file_is_advised(lab, belongings, monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(ConfigError, match=r"no screen here .* --save run\.rrd"):
        show_recording(read_run(lab[0]), lab[1], belongings)


def test_the_command_says_what_is_missing(lab, tmp_path, monkeypatch):
    def invoke(*words):
        return CliRunner().invoke(app, ["view", *(str(w) for w in words)], env={"COLUMNS": "200"})

    monkeypatch.chdir(tmp_path)
    done = invoke(lab[0], "--save", "a.rrd", "--no-video")
    assert done.exit_code == 0, done.output
    assert "no calibration: no rays" in done.output
    assert "MB: a.rrd (open it with: rerun a.rrd)" in done.output
    (tmp_path / "other.toml").write_text("version = 1\n")
    refused = invoke(lab[0], "--save", "b.rrd", "--layout", "other.toml")
    assert refused.exit_code == 1
    assert (
        "other.toml is not the layout that these results were made with (SHA-256 222222222222…)"
        in refused.output
    )
    for name in [name for name in sys.modules if name.startswith("bricktrack_host.viewing.rerun")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rerun", None)
    refused = invoke(lab[0])
    assert refused.exit_code == 1
    assert "pip install 'bricktrack[view]'" in refused.output
