"""The wire protocol's messages, as types that are checked before anything believes them.

`bricktrack_common.wire_codec` makes them bytes; `docs/wire-protocol.md` describes each message, and what may
change within a version.
"""

from typing import Annotated, Literal

import msgspec

from bricktrack_common.clocks import ClockTriplet
from bricktrack_common.run_manifest import FILE_NAME_PATTERN, RUN_ID_PATTERN

PROTOCOL_VERSION = 2
"""Both ends must speak the same; it changes when an older reader would misunderstand a newer writer."""
PROTOCOL_MINOR = 0
"""Counts what was added since: optional fields and new requests."""
MAX_HEADER_BYTES = 64 * 1024
MAX_CHUNK_BYTES = 1024 * 1024
"""The longest raw frame; longer data, a still's, are cut into several."""
MAX_STILL_BYTES = 16 * 1024 * 1024
DEFAULT_PORT = 41733
LABEL_PATTERN = r"^[A-Za-z0-9_-]{0,32}$"
"""What the end of a run's id may be."""

_RunId = Annotated[str, msgspec.Meta(pattern=RUN_ID_PATTERN)]
_Label = Annotated[str, msgspec.Meta(pattern=LABEL_PATTERN)]
_Count = Annotated[int, msgspec.Meta(ge=0, le=2**53)]
_Words = Annotated[str, msgspec.Meta(max_length=2000)]
_Sha256 = Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{64}$")]

DaemonState = Literal["idle", "armed", "recording", "saving", "fault"]
HealthLevel = Literal["ok", "warn", "fail"]
ErrorCode = Literal[
    "bad-message", "bad-version", "busy", "no-such-run", "no-such-file", "out-of-range", "hash-mismatch",
    "no-space", "not-ready", "wrong-state", "internal", "bad-value", "not-confirmed", "too-many",
]  # fmt: skip
StillEncoding = Literal["png", "jpeg"]
ConfigValue = bool | int | float | str | list[float] | None
"""One value of a unit's configuration; `None` stands for what the unit's own file says."""
ConfigValues = Annotated[
    dict[Annotated[str, msgspec.Meta(max_length=64)], ConfigValue], msgspec.Meta(max_length=64)
]


class _Body(
    msgspec.Struct,
    frozen=True,
    kw_only=True,
    forbid_unknown_fields=True,
    omit_defaults=True,
    tag_field="type",
    tag=str.lower,
):
    """Base of all bodies. What is at its default stays out: an older reader need not know the field."""


# Requests, host to unit.


class Hello(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="hello"):
    """Ask who is there."""

    software: _Words


class GetStatus(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="status"):
    """Ask how the unit is."""


class Arm(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="arm"):
    """Get ready to record at the next first edge; answered when the unit *is* ready.

    ``label`` becomes part of the run id; ``duration_s`` overrides the unit's configuration.
    """

    label: _Label = ""
    duration_s: Annotated[float, msgspec.Meta(gt=0, le=600)] | None = None


class Disarm(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="disarm"):
    """Go back to idle without a run; also clears a fault."""


class ListRuns(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="list"):
    """Ask for the runs on the card."""


class DescribeRun(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="describe"):
    """Ask for one run's files, with sizes and hashes; the manifest itself is file 0."""

    run_id: _RunId


class Read(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="read"):
    """Ask for a chunk of a file, by the run's id and the file's index; never by a path."""

    run_id: _RunId
    file_index: _Count
    offset: _Count
    length: Annotated[int, msgspec.Meta(ge=1, le=MAX_CHUNK_BYTES)]


class Confirm(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="confirm"):
    """Tell the unit that the host holds these files, verified and synced to its disk."""

    run_id: _RunId
    sha256: Annotated[list[_Sha256], msgspec.Meta(max_length=64)]


class DeleteRun(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="delete"):
    """Remove a run from the unit's card: one that a host has confirmed, or any with ``force``."""

    run_id: _RunId
    force: bool = False


class TakeStill(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="still"):
    """Take a picture for aiming, focus and calibration, while the unit is idle.

    ``png`` is the luma plane as the camera gave it, grey, without loss; ``jpeg`` is smaller and in colour.
    ``lit`` switches the LEDs on for it, where they hang on the unit's pins.
    """

    encoding: StillEncoding = "png"
    lit: bool = True


class Configure(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="configure"):
    """Change values of the unit's configuration, for good; without values only ask what they are.

    Keys are dotted, ``camera.exposure_us``; `None` goes back to what the unit's own file says.
    """

    values: ConfigValues = {}


Request = (
    Hello | GetStatus | Arm | Disarm | ListRuns | DescribeRun | Read | Confirm | DeleteRun | TakeStill
    | Configure
)  # fmt: skip


# Replies, unit to host.


class HelloReply(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="hello-reply"):
    """Who is there."""

    unit: _RunId
    software: _Words
    simulated: bool


class ImuStatus(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How one inertial sensor is."""

    name: str
    samples: _Count
    gaps: _Count
    calibration: Annotated[int, msgspec.Meta(ge=0, le=255)] | None = None
    problem: _Words = ""


class HealthItem(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How one part of a unit is: ``warn`` makes runs worse, with ``fail`` it cannot work."""

    name: Annotated[str, msgspec.Meta(max_length=64)]
    level: HealthLevel
    words: _Words
    remedy: _Words = ""


class CameraStatus(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the camera is set."""

    mode: Annotated[str, msgspec.Meta(max_length=64)]
    exposure_us: _Count
    analogue_gain: float
    frame_rate_hz: float


class StatusReply(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="status-reply"):
    """How the unit is."""

    unit: _RunId
    state: DaemonState
    reason: _Words = ""
    run_id: str = ""
    runs: _Count
    disk_free_bytes: _Count
    disk_needed_bytes: _Count
    frames: _Count
    frame_age_ms: float | None = None
    imus: list[ImuStatus]
    edges: _Count
    line_is_high: bool | None = None
    temperature_degc: float | None = None
    last_error: _Words = ""
    health: Annotated[list[HealthItem], msgspec.Meta(max_length=64)] = []
    health_age_s: Annotated[float, msgspec.Meta(ge=0)] | None = None
    clocks: ClockTriplet
    runs_unconfirmed: _Count | None = None
    auto_arm: bool = False
    camera: CameraStatus | None = None


class Armed(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="armed"):
    """The unit is ready; the run will have this id."""

    run_id: _RunId
    missing: list[_Words]


class Disarmed(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="disarmed"):
    """The unit is idle."""


class RunSummary(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One run on the card."""

    run_id: _RunId
    state: Literal["complete", "interrupted"]
    n_bytes: _Count
    confirmed: bool


class RunList(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="run-list"):
    """The runs on the card, oldest first."""

    runs: Annotated[list[RunSummary], msgspec.Meta(max_length=10_000)]


class FileSummary(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One file of a run; its place in the list is its index."""

    name: Annotated[str, msgspec.Meta(pattern=FILE_NAME_PATTERN)]
    n_bytes: _Count
    sha256: _Sha256


class RunDescription(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="run-description"):
    """The files of a run; index 0 is the manifest."""

    run_id: _RunId
    files: Annotated[list[FileSummary], msgspec.Meta(min_length=1, max_length=64)]


class Chunk(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="chunk"):
    """A chunk of a file; its bytes are the next frame of the message."""

    run_id: _RunId
    file_index: _Count
    offset: _Count
    n_bytes: _Count
    crc32: Annotated[int, msgspec.Meta(ge=0, le=0xFFFFFFFF)]


class Confirmed(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="confirmed"):
    """The unit has noted that the host holds the run."""

    run_id: _RunId


class Deleted(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="deleted"):
    """The run is gone from the card, and this much room came free."""

    run_id: _RunId
    n_bytes: _Count


class StillImage(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="still-image"):
    """A picture; its bytes are the next frames of the message, together ``n_bytes`` long.

    ``lit`` tells whether the LEDs were switched on for it, `None` where they hang on no pins. ``taken_ns`` is
    CLOCK_MONOTONIC when the picture was asked of the camera.
    """

    encoding: StillEncoding
    width_px: _Count
    height_px: _Count
    n_bytes: Annotated[int, msgspec.Meta(ge=1, le=MAX_STILL_BYTES)]
    crc32: Annotated[int, msgspec.Meta(ge=0, le=0xFFFFFFFF)]
    model: _Words
    mode: Annotated[str, msgspec.Meta(max_length=64)]
    exposure_us: _Count
    analogue_gain: float
    colour_gains: tuple[float, float]
    lit: bool | None
    taken_ns: _Count
    simulated: bool


class Configured(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="configured"):
    """What can be configured from here, as it is now; ``changed`` are the keys that a host has set."""

    values: ConfigValues
    changed: Annotated[list[Annotated[str, msgspec.Meta(max_length=64)]], msgspec.Meta(max_length=64)] = []


class Refusal(_Body, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="refusal"):
    """The unit does not do what was asked, and says why."""

    code: ErrorCode
    message: _Words


Reply = (
    HelloReply | StatusReply | Armed | Disarmed | RunList | RunDescription | Chunk | Confirmed | Deleted
    | StillImage | Configured | Refusal
)  # fmt: skip
