"""The LEDs of a run burn from arming until it is saved, and at no other time."""

import queue
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from device_fakes import FakeCamera, FakeRig

from bricktrack_common.errors import HardwareError
from bricktrack_common.run_folder import read_run
from bricktrack_common.wire_messages import Armed, Disarmed, Refusal, Reply
from bricktrack_device.capture.recorder import Recorder
from bricktrack_device.capture.run_light import RunLight
from bricktrack_device.config import (
    CameraTable,
    DeviceConfig,
    LedsTable,
    RecordingTable,
    StorageTable,
    UnitTable,
)
from bricktrack_device.storage.run_store import RunStore

PINS = LedsTable(pins=["GPIO22", "GPIO27"])


class Watching(FakeRig):
    """Notes whether the LEDs are lit when the truth is written, in the middle of saving."""

    def __init__(self, camera: FakeCamera | None = None) -> None:
        super().__init__(camera=camera)
        self.lit_while_saving: list[bool] = []

    def write_truth(self, folder: Path, *, start_ns: int, end_ns: int) -> Path | None:
        self.lit_while_saving.append(self.lit)
        return super().write_truth(folder, start_ns=start_ns, end_ns=end_ns)

    @property
    def lit(self) -> bool:
        states = {self.factory.pin(name).state for name in PINS.pins}
        assert len(states) == 1
        return states == {1}


class Bench:
    def __init__(self, folder: Path, rig: Watching, **camera: bool) -> None:
        config = DeviceConfig(
            unit=UnitTable(name="u"), storage=StorageTable(folder=str(folder), margin_mb=1), leds=PINS,
            recording=RecordingTable(duration_s=0.2, pre_roll_s=0.05, post_roll_s=0.05), imu=[],
            camera=CameraTable(**camera),  # type: ignore[arg-type]
        )  # fmt: skip
        self.rig = rig
        self.store = RunStore(config.storage_folder, "u")
        self.recorder = Recorder(config, rig, self.store)
        self.recorder.start()

    def ask(self, what: str, *args: object) -> Reply:
        answers: queue.Queue[Reply] = queue.Queue()
        getattr(self.recorder, what)(*args, answers.put)
        return answers.get(timeout=60)

    def wait_for(self, state: str) -> None:
        deadline = time.monotonic() + 60
        while self.recorder.state != state:
            assert time.monotonic() < deadline
            time.sleep(0.005)
        # The state changes just before the light does.
        while self.rig.lit != (state in ("armed", "recording", "saving")):
            assert time.monotonic() < deadline
            time.sleep(0.005)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    made: list[Bench] = []

    def make(rig: Watching | None = None, **camera: bool) -> Bench:
        made.append(Bench(tmp_path, rig or Watching(), **camera))
        return made[-1]

    yield make
    for b in made:
        b.recorder.stop()


def test_they_burn_from_arming_to_saving_and_the_manifest_says_so(
    bench: Callable[..., Bench], tmp_path: Path
) -> None:
    b = bench()
    assert not b.rig.lit
    armed = b.ask("arm", "", None)
    assert isinstance(armed, Armed) and b.rig.lit
    b.rig.pulse()
    b.wait_for("recording")
    b.wait_for("idle")
    assert b.rig.lit_while_saving == [True]
    run = read_run(tmp_path / "runs" / armed.run_id)
    assert run.manifest.hardware["leds"] == "lit on GPIO22, GPIO27 from arming to saving"
    assert '"leds lit"' in (tmp_path / "runs" / armed.run_id / "log.jsonl").read_text()


def test_disarming_and_stopping_put_them_out(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.ask("arm", "", None)
    assert isinstance(b.ask("disarm"), Disarmed)
    b.wait_for("idle")
    b.ask("arm", "", None)
    b.recorder.stop()
    assert not b.rig.lit


def test_a_failed_arming_and_a_failed_saving_put_them_out(bench: Callable[..., Bench]) -> None:
    b = bench(Watching(camera=FakeCamera(fail="no ribbon cable")))
    assert isinstance(b.ask("arm", "", None), Refusal)
    assert not b.rig.lit
    b.rig.camera.fail = ""
    b.rig.truth_error = OSError(28, "No space left on device")
    b.ask("arm", "", None)
    b.rig.pulse()
    b.wait_for("fault")
    assert not b.rig.lit


def test_a_pin_that_is_taken_refuses_the_run_or_is_told_where_no_camera_is_needed(
    bench: Callable[..., Bench],
) -> None:
    rig = Watching()
    other = rig.leds(["GPIO27"])
    b = bench(rig)
    refused = b.ask("arm", "", None)
    assert isinstance(refused, Refusal) and "leds: LED pins GPIO22, GPIO27" in refused.message
    b.recorder.stop()
    free = bench(rig, required=False)
    armed = free.ask("arm", "", None)
    assert isinstance(armed, Armed) and any(m.startswith("leds:") for m in armed.missing)
    other.close()


def test_what_a_killed_daemon_left_lit_is_put_out_at_the_next_start(bench: Callable[..., Bench]) -> None:
    rig = Watching()
    for name in PINS.pins:
        pin = rig.factory.pin(name)
        pin.function = "output"
        pin.state = True
    assert rig.lit
    bench(rig).wait_for("idle")
    assert not rig.lit


def test_without_pins_nothing_is_touched() -> None:
    class NoLeds(FakeRig):
        def leds(self, pins: object, *, active_high: bool = True) -> None:  # type: ignore[override]
            raise AssertionError("no pins were named")

    light = RunLight(LedsTable(), NoLeds())
    light.put_out_leftovers()
    light.light()
    assert light.words == ""
    light.put_out()


def test_a_pin_that_cannot_be_had_is_an_error_with_its_name() -> None:
    with pytest.raises(HardwareError, match="GPIO99"):
        RunLight(LedsTable(pins=["GPIO99"]), FakeRig()).light()
