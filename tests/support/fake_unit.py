"""A brick unit in a thread, serving run folders over the real protocol, and misbehaving when told to."""

import shutil
import threading
from collections.abc import Callable
from pathlib import Path

import zmq

from bricktrack_common.checksums import crc32
from bricktrack_common.clocks import read_clock_triplet
from bricktrack_common.run_manifest import MANIFEST_NAME, file_entry, read_manifest
from bricktrack_common.wire_codec import decode_request, encode_message
from bricktrack_common.wire_messages import (
    Arm,
    Armed,
    Chunk,
    Configure,
    Configured,
    Confirm,
    Confirmed,
    Deleted,
    DeleteRun,
    DescribeRun,
    Disarm,
    Disarmed,
    FileSummary,
    GetStatus,
    HealthItem,
    Hello,
    HelloReply,
    ListRuns,
    Read,
    Refusal,
    RunDescription,
    RunList,
    RunSummary,
    StatusReply,
    StillImage,
    TakeStill,
)
from bricktrack_host.transfer.software import own_software

Message = list[bytes]
Misbehaviour = Callable[[object, list[Message]], list[Message]]
"""Gets a request and the messages that would answer it; returns what is sent instead."""


class FakeUnit:
    """Serves every run folder below ``runs``; ``misbehave`` may alter each answer."""

    def __init__(
        self, runs: Path, *, name: str = "fake", misbehave: Misbehaviour | None = None, port: int = 0
    ) -> None:
        self.name = name
        self.runs = runs
        self.misbehave = misbehave or (lambda request, messages: messages)
        self.requests: list[object] = []
        self.confirmed: set[str] = set()
        self.state = "idle"
        self.software = own_software()
        self.auto_arm = False
        self.run_id = ""
        self.reason = ""
        self.last_error = ""
        self.health: list[HealthItem] = []
        self.picture = b""
        self.camera_mode = "full"
        self.settings: dict[str, object] = {"camera.exposure_us": 2000, "recording.label": ""}
        self.changed: set[str] = set()
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self.port = port or self._socket.bind_to_random_port("tcp://127.0.0.1")
        if port:
            self._socket.bind(f"tcp://127.0.0.1:{port}")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="fake-unit")

    @property
    def address(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    def __enter__(self) -> "FakeUnit":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()
        self._socket.close()
        self._context.term()

    def reads(self) -> list[Read]:
        return [r for r in self.requests if isinstance(r, Read)]

    def _serve(self) -> None:
        while not self._stop.is_set():
            if not self._socket.poll(20):
                continue
            identity, header = self._socket.recv_multipart()
            request_id, request = decode_request(header)
            self.requests.append(request)
            reply, data = self._answer(request)
            message = [encode_message(request_id, reply), *data]
            for altered in self.misbehave(request, [message]):
                self._socket.send_multipart([identity, *altered])

    def _answer(self, request: object) -> tuple[object, list[bytes]]:
        match request:
            case Hello():
                return HelloReply(unit=self.name, software=self.software, simulated=True), []
            case GetStatus():
                return self._status(), []
            case Arm(label=label):
                self.state = "armed"
                return Armed(run_id=f"{self.name}_0001_{label}", missing=["imu base: no answer"]), []
            case Disarm():
                self.state = "idle"
                return Disarmed(), []
            case ListRuns():
                return RunList(runs=[self._summary(f) for f in self._folders()]), []
            case DescribeRun(run_id=run_id):
                return RunDescription(run_id=run_id, files=self._files(run_id)), []
            case Read():
                path = self.runs / request.run_id / self._files(request.run_id)[request.file_index].name
                with path.open("rb") as file:
                    file.seek(request.offset)
                    data = file.read(request.length)
                return (
                    Chunk(run_id=request.run_id, file_index=request.file_index, offset=request.offset,
                          n_bytes=len(data), crc32=crc32(data)),
                    [data],
                )  # fmt: skip
            case Confirm(run_id=run_id, sha256=sha256):
                if sha256 != [f.sha256 for f in self._files(run_id)]:
                    return Refusal(code="hash-mismatch", message="other hashes"), []
                self.confirmed.add(run_id)
                return Confirmed(run_id=run_id), []
            case DeleteRun(run_id=run_id, force=force):
                if run_id not in self.confirmed and not force:
                    return Refusal(code="not-confirmed", message=f"no host has run {run_id}"), []
                n_bytes = sum(f.n_bytes for f in self._files(run_id))
                shutil.rmtree(self.runs / run_id)
                return Deleted(run_id=run_id, n_bytes=n_bytes), []
            case TakeStill():
                head = StillImage(
                    encoding="png", width_px=0, height_px=0, n_bytes=len(self.picture), model="fake",
                    crc32=crc32(self.picture), mode=self.camera_mode, exposure_us=2000, analogue_gain=1.0,
                    colour_gains=(1.0, 1.0), lit=None, taken_ns=1, simulated=True,
                )  # fmt: skip
                return head, [self.picture]
            case Configure(values=values):
                unknown = [key for key in values if key not in self.settings]
                if unknown:
                    return Refusal(code="bad-value", message=f"{unknown[0]}: cannot be configured"), []
                self.changed |= {key for key, value in values.items() if value is not None}
                self.changed -= {key for key, value in values.items() if value is None}
                self.settings |= values
                return Configured(values=self.settings, changed=sorted(self.changed)), []
        raise AssertionError(request)

    def _folders(self) -> list[Path]:
        return sorted(p for p in self.runs.iterdir() if p.is_dir())

    def _files(self, run_id: str) -> list[FileSummary]:
        folder = self.runs / run_id
        entries = [file_entry(folder / MANIFEST_NAME), *read_manifest(folder / MANIFEST_NAME).files]
        return [FileSummary(name=e.name, n_bytes=e.n_bytes, sha256=e.sha256) for e in entries]

    def _summary(self, folder: Path) -> RunSummary:
        return RunSummary(
            run_id=folder.name, state="complete", n_bytes=sum(f.n_bytes for f in self._files(folder.name)),
            confirmed=folder.name in self.confirmed,
        )  # fmt: skip

    def _status(self) -> StatusReply:
        return StatusReply(
            unit=self.name, state=self.state, runs=len(self._folders()), disk_free_bytes=10**10,
            disk_needed_bytes=10**8, frames=0, imus=[], edges=0, health=self.health, auto_arm=self.auto_arm,
            last_error=self.last_error, run_id=self.run_id, reason=self.reason,
            runs_unconfirmed=len(self._folders()) - len(self.confirmed),
            clocks=read_clock_triplet(),
        )  # fmt: skip
