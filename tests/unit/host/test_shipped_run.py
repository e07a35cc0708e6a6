"""A run sent away and its results put in place; what processes it is replaced by invented results, at once."""

from dataclasses import replace

import msgspec
import pytest
from small_lab import example

from bricktrack_common.errors import ConfigError, StorageError, TrackingError, TransferError
from bricktrack_common.run_manifest import MANIFEST_NAME, file_entry, read_manifest, write_manifest
from bricktrack_host.many_runs import shipped_run
from bricktrack_host.many_runs.processing_record import read_record
from bricktrack_host.many_runs.run_job import RunJob, is_processed
from bricktrack_host.many_runs.shipped_run import NotThere, pack, process_parcel, publish
from bricktrack_host.pipeline import ProcessedRun, ProcessSettings
from bricktrack_host.results.result_store import earlier_results, read_result, write_results
from bricktrack_host.stages.camera_sensor import CameraSensor


@pytest.fixture
def job(tmp_path):
    run = tmp_path / "runs" / "b7-1_0001_shake"
    run.mkdir(parents=True)
    (run / "video.h264").write_bytes(b"pictures")
    manifest = msgspec.structs.replace(
        example.example_result().manifest, run_id=run.name, files=[file_entry(run / "video.h264")]
    )
    write_manifest(run / MANIFEST_NAME, manifest)
    (tmp_path / "b7.json").write_text("rays")
    (tmp_path / "brick.toml").write_text("leds")
    return RunJob(run, tmp_path / "b7.json", tmp_path / "brick.toml", ProcessSettings())


@pytest.fixture
def processing(monkeypatch):
    """Replace the pipeline; return the folders that it was given."""
    seen = []

    def process_run(run, *, calibration, layout, output, settings, truth, progress):
        seen.append(run)
        assert (run / "video.h264").read_bytes() == b"pictures"
        assert (calibration.read_text(), layout.read_text()) == ("rays", "leds")
        result = replace(example.example_result(), manifest=read_manifest(run / MANIFEST_NAME))
        write_results(result, output)
        (output / "report.html").write_text("page")
        return ProcessedRun(result, output, output / "report.html", None)

    monkeypatch.setattr(shipped_run, "process_run", process_run)
    return seen


class Quiet:
    def stage(self, name, total): ...

    def advance_to(self, done): ...


def sent(job, *, as_bytes, key="k" * 64):
    return publish(job, key, process_parcel(pack(job, as_bytes=as_bytes), Quiet()))


def test_path_and_bytes_give_the_same_results_and_leave_nothing_behind(job, processing):
    summary = sent(job, as_bytes=False)
    assert processing[-1] == job.run
    assert summary.folder == job.run / "results"
    assert summary.report.read_text() == "page"
    stable = {p.name: p.read_bytes() for p in summary.folder.iterdir() if p.suffix in (".parquet", ".csv")}
    assert read_result(summary.folder).manifest.run_id == job.run.name
    sent(job, as_bytes=True)
    assert processing[-1] != job.run
    assert not processing[-1].exists()
    assert {name: (summary.folder / name).read_bytes() for name in stable} == stable
    assert earlier_results(summary.folder) == []


def test_what_is_noted_tells_whether_results_stand(job, processing):
    key = job.input_sha256()
    assert not is_processed(job, key)
    sent(job, as_bytes=True, key=key)
    assert is_processed(job, key)
    took = read_record(job.results).took
    assert took.wall_s >= 0
    assert took.peak_memory_mb > 10
    for change in (
        lambda: job.layout.write_text("other leds"),
        lambda: (job.run / "video.h264").write_bytes(b"cut"),
        lambda: (job.run / "truth.npz").write_bytes(b"how it moved"),
    ):
        change()
        assert job.input_sha256() != key
        key = job.input_sha256()
    other = replace(job, settings=ProcessSettings(use_imu=False))
    assert other.input_sha256() != key
    (job.results / "processing.json").write_text("{")
    assert not is_processed(job, key)


@pytest.mark.parametrize("what", ["calibration", "layout"])
def test_a_file_that_is_missing_is_named_with_what_it_is_for(job, what):
    path = getattr(job, what)
    path.unlink()
    with pytest.raises(
        StorageError, match=rf"{path}: No such file.*the run's {what}; .*--{what} or in fleet"
    ):
        job.input_sha256()


def test_a_worker_without_the_path_says_so(job, processing):
    parcel = pack(job, as_bytes=False)
    elsewhere = replace(parcel, run=job.run.with_name("not-here"))
    assert process_parcel(elsewhere, Quiet()) == NotThere()
    other_run = replace(parcel, known_by={MANIFEST_NAME: "0" * 64})
    assert process_parcel(other_run, Quiet()) == NotThere()
    assert processing == []


def test_what_feels_a_moving_camera_is_sent_along(job, tmp_path, processing, monkeypatch):
    other = tmp_path / "runs" / "b7-2_0001_shake"
    other.mkdir()
    (other / "imu_brick.msgpack").write_bytes(b"samples")
    (other / "video.h264").write_bytes(b"other pictures")
    files = [file_entry(other / "imu_brick.msgpack"), file_entry(other / "video.h264")]
    write_manifest(
        other / MANIFEST_NAME, msgspec.structs.replace(example.example_result().manifest, files=files)
    )
    table = tmp_path / "table.csv"
    table.write_text("a,b,c")
    turned = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    original = shipped_run.process_run

    def looks_beside(run, *, settings, **options):
        source = run / settings.camera_sensor.source
        if settings.camera_sensor.kind == "table":
            assert source.read_text() == "a,b,c"
        else:
            assert (source / "imu_brick.msgpack").read_bytes() == b"samples"
            assert (source / MANIFEST_NAME).read_bytes() == (other / MANIFEST_NAME).read_bytes()
        return original(run, settings=settings, **options)

    monkeypatch.setattr(shipped_run, "process_run", looks_beside)
    for sensor in (
        CameraSensor(kind="table", source="../../table.csv", rotation=turned),
        CameraSensor(kind="imu", source="../b7-2_0001_shake", imu="brick", rotation=turned),
    ):
        moving = replace(job, settings=ProcessSettings(camera=sensor.kind, camera_sensor=sensor))
        assert sent(moving, as_bytes=True).run_id == job.run.name
        assert job.run not in processing
        parcel = pack(moving, as_bytes=False)
        assert len(parcel.known_by) == 2
        without = replace(parcel, known_by=dict.fromkeys(parcel.known_by, "0" * 64))
        assert process_parcel(without, Quiet()) == NotThere()


def test_errors_name_the_run_where_it_is_here(job, monkeypatch):
    def process_run(run, **options):
        raise TrackingError(f"{run}/video.h264: no poses")

    monkeypatch.setattr(shipped_run, "process_run", process_run)
    with pytest.raises(TrackingError) as raised:
        process_parcel(pack(job, as_bytes=True), Quiet())
    assert str(raised.value) == f"{job.run}/video.h264: no poses"


def test_other_software_processes_nothing(job, processing):
    parcel = pack(job, as_bytes=True)
    other = replace(parcel, software=parcel.software | {"numpy": "1.0"})
    with pytest.raises(ConfigError, match="numpy .*, here 1.0"):
        process_parcel(other, Quiet())
    assert processing == []


def test_results_damaged_on_the_way_are_refused(job, processing):
    returned = process_parcel(pack(job, as_bytes=True), Quiet())
    damaged = replace(returned, files=returned.files | {"fused.csv": b"0"})
    with pytest.raises(TransferError, match="damaged on the way"):
        publish(job, "k" * 64, damaged)
    assert not job.results.exists()
