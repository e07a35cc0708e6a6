"""One finished recording in memory; `saving` makes a run folder of it."""

from dataclasses import dataclass, field
from typing import BinaryIO, Literal

import msgspec
import numpy as np

from bricktrack_common.arrays import IntArray
from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.imu_records import ImuDescription, ImuFlag, ImuRecord, decode_imu
from bricktrack_common.run_manifest import CameraSection, ClocksSection, WaveSection
from bricktrack_device.capture.ring import VideoCut
from bricktrack_device.capture.trigger import EdgeTrain


class RunLog:
    """The daemon's own events during a run; becomes ``log.jsonl``."""

    def __init__(self) -> None:
        self._events: list[dict[str, str | int | float | None]] = []

    def add(self, event: str, **facts: str | int | float | None) -> None:
        """Note an event, stamped now."""
        self._events.append({"t_ns": monotonic_ns(), "event": event, **facts})

    def write(self, file: BinaryIO) -> None:
        """Write one JSON object a line."""
        for event in self._events:
            file.write(msgspec.json.encode(event) + b"\n")


_USELESS = {
    ImuFlag.STUCK: "repeat the one before, ten in a row or more: the sensor no longer measured",
    ImuFlag.BLANK: "are all zero or all ones: the sensor was in reset or off the bus",
    ImuFlag.MODE_CHANGED: "came in another mode than the one set: the sensor had reset itself",
    ImuFlag.BAD_QUATERNION: "have a quaternion that is none: torn or corrupted reads",
}


@dataclass(frozen=True, slots=True, eq=False)
class ImuRecording:
    """One sensor's part of a run.

    ``n_slots`` is how many slots were due in the window; ``flags`` are those of `decode_imu`.
    """

    description: ImuDescription
    records: list[ImuRecord]
    n_slots: int
    flags: IntArray = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "flags", decode_imu(self.description, self.records).flags)

    def problems(self) -> list[str]:
        """Return in words what makes samples useless, beyond the gaps that are counted anyway."""
        name, words = self.description.name, []
        for flag, what in _USELESS.items():
            n = int(np.count_nonzero(self.flags & flag))
            if n:
                words.append(f"imu {name}: {n} of {self.n_slots} samples {what}")
        return words


@dataclass(frozen=True, slots=True)
class Recording:
    """Everything of one run, before it is written."""

    run_id: str
    unit: str
    label: str
    state: Literal["complete", "interrupted"]
    simulated: bool
    hardware: dict[str, str]
    camera: CameraSection | None
    video: VideoCut | None
    imus: list[ImuRecording]
    trigger_pin: str
    nominal_hz: float | None
    edges: EdgeTrain
    wave: WaveSection
    clocks: ClocksSection
    window_ns: tuple[int, int]
    missing: list[str]
    log: RunLog = field(repr=False)

    @property
    def truth_window_ns(self) -> tuple[int, int]:
        """What the true motion beside a simulated run must cover: the window and every picture in it."""
        start_ns, end_ns = self.window_ns
        if self.video and self.video.records:
            start_ns = min(start_ns, self.video.records[0].sensor_timestamp_ns)
        return start_ns, end_ns

    @property
    def n_bytes(self) -> int:
        """Roughly what the run takes on the card."""
        return (self.video.n_bytes if self.video else 0) + sum(100 * len(i.records) for i in self.imus)
