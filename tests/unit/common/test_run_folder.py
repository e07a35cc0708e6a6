import json
from dataclasses import dataclass

import msgspec
import numpy as np
import pytest

from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_common.errors import RunFormatError
from bricktrack_common.frame_times import FrameRecord, write_frames
from bricktrack_common.imu_records import ImuDescription
from bricktrack_common.run_folder import read_run, write_edges
from bricktrack_common.run_manifest import (
    CameraSection,
    ClocksSection,
    QualitySection,
    RunManifest,
    TriggerSection,
    file_entry,
    parse_manifest,
    read_manifest,
    write_manifest,
)


def manifest(files, **changes):
    values = {
        "run_id": "unit-01_ab12cd34_0001",
        "unit": "unit-01",
        "label": "",
        "state": "complete",
        "simulated": True,
        "origin": "bricktrackd",
        "hardware": {"model": "none"},
        "software": {"bricktrack": "0.1.0"},
        "camera": CameraSection(
            model="imx219",
            mode=IMX219_1080P,
            exposure_us=4000,
            analogue_gain=1.0,
            colour_gains=(1.5, 1.5),
            frame_duration_us=33333,
            encoder="libx264",
            encoder_settings={"bitrate": 15_000_000},
        ),
        "imus": [],
        "trigger": TriggerSection(pin="GPIO17", t0_ns=10),
        "clocks": ClocksSection(),
        "window_ns": (0, 10),
        "quality": QualitySection(),
        "missing": [],
        "files": files,
    }
    return RunManifest(**(values | changes))


@dataclass
class Folder:
    path: object

    def manifest(self, **changes):
        files = [file_entry(p) for p in sorted(self.path.iterdir()) if p.name != "manifest.json"]
        write_manifest(self.path / "manifest.json", manifest(files, **changes))


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "video.h264").write_bytes(b"\0\0\0\1" * 25)
    with (tmp_path / "frames.msgpack").open("wb") as file:
        write_frames(file, [FrameRecord(0, 1, 4000, 1.0, True, 0, 100, 0)])
    with (tmp_path / "edges.msgpack").open("wb") as file:
        write_edges(file, np.array([10, 20], dtype=np.int64))
    folder = Folder(tmp_path)
    folder.manifest()
    return folder


def test_a_run_is_read_back(folder):
    run = read_run(folder.path, verify_hashes=True)
    assert run.problems == []
    assert run.manifest == read_manifest(folder.path / "manifest.json")
    assert run.frames.n_frames == 1
    assert run.edges_ns.tolist() == [10, 20]
    assert run.video == folder.path / "video.h264"


def test_what_is_missing_is_said_in_words(folder):
    folder.manifest(missing=["imu led: no answer at 0x28"], state="interrupted")
    (folder.path / "edges.msgpack").unlink()
    frames = folder.path / "frames.msgpack"
    frames.write_bytes(frames.read_bytes()[:-3])
    problems = read_run(folder.path).problems
    assert problems[0] == "imu led: no answer at 0x28"
    assert "interrupted" in problems[1]
    assert problems[2] == "edges.msgpack is missing"
    assert problems[3].startswith("frames.msgpack has ")
    assert problems[4].startswith("frames.msgpack is cut")


@pytest.mark.parametrize("manifest_knows", [False, True])
def test_an_empty_file_counts_as_missing(folder, manifest_knows):
    (folder.path / "imu_led.msgpack").write_bytes(b"\x80")
    sensor = ImuDescription(
        name="led", chip_id="", bus="sim", address=0x28, opr_mode=7, fusion=False, acc_range_g=16.0,
        period_ns=10_000_000, t0_ns=0,
    )  # fmt: skip
    folder.manifest(imus=[sensor])
    names = ["edges.msgpack", "frames.msgpack", "imu_led.msgpack", "video.h264"]
    for name in names:
        (folder.path / name).write_bytes(b"")
    if manifest_knows:
        folder.manifest(imus=[sensor])
    run = read_run(folder.path, verify_hashes=True)
    assert run.problems == [f"{name} is empty and counts as missing" for name in names]
    assert (run.frames, run.imus, run.video) == (None, {}, None)
    assert run.edges_ns.size == 0


def test_an_empty_log_is_no_problem(folder):
    (folder.path / "log.jsonl").write_bytes(b"")
    folder.manifest()
    assert read_run(folder.path, verify_hashes=True).problems == []


def test_an_altered_file_fails_its_hash(folder):
    video = folder.path / "video.h264"
    video.write_bytes(b"\0\0\0\2" * 25)
    read_run(folder.path)
    with pytest.raises(RunFormatError, match=r"video\.h264: its SHA-256 is not the manifest's"):
        read_run(folder.path, verify_hashes=True)


def test_a_folder_without_a_manifest_is_no_run(folder):
    (folder.path / "manifest.json").unlink()
    with pytest.raises(RunFormatError, match="no manifest"):
        read_run(folder.path)
    with pytest.raises(RunFormatError, match="no such folder"):
        read_run(folder.path / "nothing")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 3}, r"bricktrack\.run version 3; this bricktrack reads up to version 2"),
        ({"version": "1"}, "version '1'; expected a positive integer"),
        ({"schema": "other"}, r"not a bricktrack\.run manifest"),
        ({"run_id": "../../etc/passwd"}, "run_id: expected letters, digits"),
        ({"colour": "red"}, "unknown field 'colour'; is it misspelt"),
        ({"camera": {"model": "x"}}, "camera: required field '.*' is missing"),
        (
            {"files": [{"name": "../x", "n_bytes": 1, "sha256": "0" * 64}]},
            r"files\[0\].name: Expected `str` matching",
        ),
        ({"files": [{"name": "a.b", "n_bytes": 1, "sha256": "0" * 64}] * 2}, "a name stands twice"),
    ],
)
def test_a_wrong_manifest_is_refused(change, words):
    data = msgspec.to_builtins(manifest([])) | change
    with pytest.raises(RunFormatError, match=words):
        parse_manifest(json.dumps(data).encode(), where="m")


def test_a_manifest_that_is_no_json_is_refused():
    with pytest.raises(RunFormatError, match="m: not valid JSON"):
        parse_manifest(b"\xff{", where="m")


def test_a_manifest_of_version_1_is_read_with_what_it_did_not_say_yet():
    data = msgspec.to_builtins(manifest([]))
    data["version"] = 1
    del data["trigger"]["wave"]
    for key in ("imu_unusable", "imu_unique_hz"):
        del data["quality"][key]
    read = parse_manifest(json.dumps(data).encode(), where="m")
    assert read.trigger.wave is None and read.quality.imu_unique_hz == {} and read.quality.imu_unusable == 0
