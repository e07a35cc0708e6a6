"""The stream of inertial samples: raw BNO055 registers as read, and what they mean in units."""

import math
from array import array
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import IntFlag
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.errors import RunFormatError
from bricktrack_common.streams import Field, StreamSchema, pass_records, write_stream
from bricktrack_common.typed_data import convert

FIRST_REGISTER = 0x08
LAST_REGISTER = 0x35
N_DATA_BYTES = LAST_REGISTER - FIRST_REGISTER + 1
"""One burst: accelerometer to calibration status, 46 bytes (BNO055 data sheet, register map page 0)."""

STANDARD_GRAVITY_MPS2 = 9.80665
_MAX_ACC_STEP_MPS2 = 300.0  # between samples 10 ms apart; 30 g is the worst impact expected on a table
_MAX_GYRO_STEP_RADPS = 40.0
_LATE_NS = 2_000_000
_LONGEST_READ_NS = 10_000_000  # a burst at 100 kHz takes 5 ms, and the chip stretches the clock

IMU_SCHEMA = StreamSchema(
    "bricktrack.imu",
    2,
    (
        Field("slot", "int", "number of the 10 ms grid point since the grid's start"),
        Field("t_before_ns", "int", "ns, CLOCK_MONOTONIC, before the bus transaction"),
        Field("t_after_ns", "int", "ns, CLOCK_MONOTONIC, after it"),
        Field("data", "bytes?", "registers 0x08..0x35, or nil where the read failed"),
        Field("errno", "int", "error number of a failed read, else 0"),
        Field("status", "bytes?", "SYS_STATUS, SYS_ERR, OPR_MODE where they were read"),
    ),
)


class ImuFlag(IntFlag):
    """What is wrong with one inertial sample; derived from the raw record by `decode_imu`."""

    NONE = 0
    GAP = 1
    """No data: the read failed, the slot was skipped because the one before ran over, or the read took longer
    than a slot and than 10 ms, as on a bus that hung and came free: nobody knows when the chip was asked."""
    LATE = 2
    """The read began more than 2 ms after its slot; the stamp is right, the spacing is not."""
    REPEAT = 4
    """All channels equal the sample before: the sensor had nothing new (its clock beats with ours)."""
    STUCK = 8
    """Ten samples or more are equal, with or without gaps: the sensor no longer measures. Values are NaN."""
    BLANK = 16
    """All registers 0x00 or 0xFF: a sensor in reset or off the bus. Values are NaN."""
    ACC_CLIPPED = 32
    """An accelerometer axis is at its range limit."""
    GYRO_CLIPPED = 64
    """A gyroscope axis is at its range limit."""
    JUMP = 128
    """A step that no brick makes, and back: corrupted bytes. Values are NaN."""
    BAD_QUATERNION = 256
    """The chip's quaternion is not of unit length: a torn or corrupted read. Values are NaN."""
    MODE_CHANGED = 512
    """The operation mode is not the one set: the sensor was reset. Values are NaN until it is right again."""


UNUSABLE = (
    ImuFlag.GAP | ImuFlag.STUCK | ImuFlag.BLANK | ImuFlag.JUMP | ImuFlag.BAD_QUATERNION | ImuFlag.MODE_CHANGED
)

_Positive = Annotated[float, msgspec.Meta(gt=0)]

AxisMap = Literal["P0", "P1", "P2", "P3", "P4", "P5", "P6", "P7"]
"""How the chip lies on its board, by the names of the data sheet's section 3.4; P1 turns nothing."""


class ImuDescription(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a stream's header and the manifest say of one sensor.

    Attributes
    ----------
    name : str
        As in the file name, ``imu_<name>.msgpack``.
    chip_id : str
        The sensor's unique id (page 1, 0x50..0x5F) as hex, or ``""`` where it could not be read.
    opr_mode : int
        Operation mode register, as 0x07 (AMG) or 0x0C (NDOF).
    fusion : bool
        Whether the chip's own orientation outputs run in this mode.
    acc_lsb_per_mps2, gyro_lsb_per_dps : float
        Scales of the registers.
    acc_range_g, gyro_range_dps : float
        Where the channels clip.
    period_ns, t0_ns : int, ns
        The grid: slot n is due at ``t0_ns + n * period_ns``, CLOCK_MONOTONIC.
    latency_ns : int, ns
        Added to the middle of the transaction to give the sample time; negative for a filter's lag.
    axis_map : str
        The axis remap that the chip applied; the data are in the axes after it.
    calibration_restored : bool
        Whether a saved calibration was written into the chip; only fusion modes use one.
    """

    name: Annotated[str, msgspec.Meta(pattern=r"^[a-z0-9_-]{1,16}$")]
    chip_id: str
    bus: str
    address: int
    opr_mode: int
    fusion: bool
    acc_lsb_per_mps2: _Positive = 100.0
    gyro_lsb_per_dps: _Positive = 16.0
    acc_range_g: _Positive
    gyro_range_dps: _Positive = 2000.0
    period_ns: Annotated[int, msgspec.Meta(gt=0)]
    t0_ns: int
    latency_ns: int = 0
    axis_map: AxisMap = "P1"
    calibration_restored: bool = False


@dataclass(frozen=True, slots=True)
class ImuRecord:
    """One slot as read; the fields are those of `IMU_SCHEMA`."""

    slot: int
    t_before_ns: int
    t_after_ns: int
    data: bytes | None
    errno: int
    status: bytes | None


@dataclass(frozen=True, slots=True, eq=False)
class ImuSamples:
    """Inertial samples in units and in the sensor's axes, one row for every slot of the grid.

    Attributes
    ----------
    t_ns : ndarray of int64, shape (n,)
        Middle of the transaction plus latency; the due time where the slot is a gap.
    acc_mps2, gyro_radps : ndarray, shape (n, 3)
        NaN where `flags` says that the sample is not usable.
    q_wxyz : ndarray, shape (n, 4)
        The chip's own orientation; NaN unless a fusion mode runs.
    temperature_degc : ndarray, shape (n,)
    calibration : ndarray of uint8, shape (n,)
        CALIB_STAT: system, gyroscope, accelerometer, magnetometer, two bits each.
    flags : ndarray of int64, shape (n,), `ImuFlag`
    """

    t_ns: IntArray
    acc_mps2: FloatArray
    gyro_radps: FloatArray
    q_wxyz: FloatArray
    temperature_degc: FloatArray
    calibration: NDArray[np.uint8]
    flags: IntArray


def write_imu(file: BinaryIO, description: ImuDescription, records: Iterable[ImuRecord]) -> int:
    """Write one sensor's stream to an open file; return the number of records."""
    rows = ((r.slot, r.t_before_ns, r.t_after_ns, r.data, r.errno, r.status) for r in records)
    return write_stream(file, IMU_SCHEMA, rows, meta=msgspec.to_builtins(description))


def read_imu(path: Path) -> tuple[ImuDescription, list[ImuRecord], int]:
    """Return a sensor's description, its records and the bytes left over after the last whole one.

    Raises
    ------
    RunFormatError
        If it is no inertial stream, or slots do not increase.
    """
    records: list[ImuRecord] = []
    description, leftover_bytes = _pass_imu(path, records.append)
    return description, records, leftover_bytes


def read_imu_samples(path: Path) -> tuple[ImuDescription, ImuSamples, int]:
    """Return a sensor's description, its samples (`decode_imu`) and the bytes left over.

    Raises
    ------
    RunFormatError
        As `read_imu`, or if the grid is damaged.
    """
    reads = _Reads()
    description, leftover_bytes = _pass_imu(path, reads.add)
    return description, reads.decoded(description), leftover_bytes


def _pass_imu(path: Path, take: Callable[[ImuRecord], None]) -> tuple[ImuDescription, int]:
    i, last_slot = 0, -math.inf

    def checked(row: list[Any]) -> None:
        nonlocal i, last_slot
        record = ImuRecord(*row)
        if record.slot <= last_slot:
            raise RunFormatError(
                f"{path}: slot {record.slot} of record {i} does not come after the one before"
            )
        if record.data is not None and len(record.data) != N_DATA_BYTES:
            raise RunFormatError(f"{path}: record {i}: {len(record.data)} bytes; expected {N_DATA_BYTES}")
        take(record)
        i, last_slot = i + 1, record.slot

    meta, leftover_bytes = pass_records(path, IMU_SCHEMA, checked)
    return convert(meta, ImuDescription, where=f"{path}: header", error=RunFormatError), leftover_bytes


def decode_imu(description: ImuDescription, records: Iterable[ImuRecord]) -> ImuSamples:
    """Turn raw registers into units, put gaps where slots are missing, and flag what cannot be trusted.

    Raises
    ------
    RunFormatError
        If slots lie far apart, or a number does not fit 64 bits: the grid is damaged.
    """
    reads = _Reads()
    for record in records:
        reads.add(record)
    return reads.decoded(description)


class _Reads:
    """Records as they come, kept as numbers: as objects they would take five times the memory."""

    def __init__(self) -> None:
        self._slot, self._before_ns, self._after_ns = array("q"), array("q"), array("q")
        self._data, self._is_read = bytearray(), bytearray()
        self._modes: list[tuple[int, int]] = []
        """Slot and operation mode, where it was read."""

    def add(self, record: ImuRecord) -> None:
        """Take one record, of a slot after the last."""
        try:
            self._slot.append(record.slot)
            self._before_ns.append(record.t_before_ns)
            self._after_ns.append(record.t_after_ns)
        except OverflowError:
            raise RunFormatError(
                f"inertial record {len(self._is_read)}: a number does not fit 64 bits"
            ) from None
        self._data += record.data or bytes(N_DATA_BYTES)
        self._is_read.append(record.data is not None)
        if record.status is not None and len(record.status) == 3:
            self._modes.append((record.slot, record.status[2]))

    def decoded(self, description: ImuDescription) -> ImuSamples:
        """Return the samples; see `decode_imu`."""
        if not self._slot:
            empty = np.empty((0, 3))
            zero = np.empty(0, dtype=np.int64)
            return ImuSamples(
                zero, empty, empty.copy(), np.empty((0, 4)), np.empty(0), np.empty(0, np.uint8), zero.copy()
            )
        first = self._slot[0]
        n = self._slot[-1] - first + 1
        if n > 50 * len(self._slot) + 100_000:
            raise RunFormatError(
                f"imu {description.name}: {len(self._slot)} records over {n} slots; the grid is damaged"
            )
        before_ns, after_ns = (np.frombuffer(t, dtype=np.int64) for t in (self._before_ns, self._after_ns))
        took_ns = after_ns - before_ns
        longest_ns = max(description.period_ns, _LONGEST_READ_NS)
        known = np.frombuffer(self._is_read, dtype=np.bool_) & (took_ns >= 0) & (took_ns <= longest_ns)
        t_due = description.t0_ns + (first + np.arange(n, dtype=np.int64)) * description.period_ns
        t_ns = t_due.copy()
        raw = np.zeros((n, N_DATA_BYTES), dtype=np.uint8)
        flags = np.full(n, int(ImuFlag.GAP), dtype=np.int64)
        at = np.frombuffer(self._slot, dtype=np.int64)[known] - first
        raw[at] = np.frombuffer(self._data, dtype=np.uint8).reshape(-1, N_DATA_BYTES)[known]
        t_ns[at] = (before_ns + took_ns // 2)[known] + description.latency_ns
        flags[at] = np.where(before_ns[known] - t_due[at] > _LATE_NS, int(ImuFlag.LATE), 0)
        mode_wrong = np.zeros(n, dtype=np.bool_)
        for (slot, mode), (next_slot, _) in pairwise([*self._modes, (first + n, 0)]):
            mode_wrong[slot - first : next_slot - first] = mode != description.opr_mode
        return _in_units(description, t_ns, raw, flags, mode_wrong)


def _in_units(
    description: ImuDescription,
    t_ns: IntArray,
    raw: NDArray[np.uint8],
    flags: IntArray,
    mode_wrong: NDArray[np.bool_],
) -> ImuSamples:
    """Return samples of every slot's registers; ``flags`` holds gaps and late reads, and is filled in."""
    words = raw.view("<i2").astype(np.float64)  # 23 words from register 0x08
    acc = words[:, 0:3] / description.acc_lsb_per_mps2
    gyro_dps = words[:, 6:9] / description.gyro_lsb_per_dps
    q = words[:, 12:16] / 16384.0
    present = flags & ImuFlag.GAP == 0

    flags[present & ((raw[:, :18] == 0).all(axis=1) | (raw == 0xFF).all(axis=1))] |= int(ImuFlag.BLANK)
    # Temperature and calibration status change on their own time: repeats are judged on the measurements.
    # A gap between two makes the later one no newer.
    taken = np.flatnonzero(present)
    same = np.zeros(len(taken), dtype=np.bool_)
    same[1:] = (raw[taken[1:], :44] == raw[taken[:-1], :44]).all(axis=1)
    flags[taken[same]] |= int(ImuFlag.REPEAT)
    flags[taken[_in_runs_of_at_least(same, 9)]] |= int(ImuFlag.STUCK)
    limit = description.acc_range_g * STANDARD_GRAVITY_MPS2 * 0.995
    flags[present & (np.abs(acc) >= limit).any(axis=1)] |= int(ImuFlag.ACC_CLIPPED)
    flags[present & (np.abs(gyro_dps) >= description.gyro_range_dps * 0.998).any(axis=1)] |= int(
        ImuFlag.GYRO_CLIPPED
    )
    gyro = np.deg2rad(gyro_dps)
    flags[_spikes(acc, present, _MAX_ACC_STEP_MPS2) | _spikes(gyro, present, _MAX_GYRO_STEP_RADPS)] |= int(
        ImuFlag.JUMP
    )
    if description.fusion:
        norm = np.linalg.norm(q, axis=1)
        flags[present & (np.abs(norm - 1) > 0.01)] |= int(ImuFlag.BAD_QUATERNION)
    flags[mode_wrong] |= int(ImuFlag.MODE_CHANGED)

    bad = flags & int(UNUSABLE) != 0
    acc[bad], gyro[bad], q[bad] = np.nan, np.nan, np.nan
    if not description.fusion:
        q[:] = np.nan
    temperature = raw[:, 0x34 - FIRST_REGISTER].view(np.int8).astype(np.float64)
    temperature[~present] = np.nan
    return ImuSamples(t_ns, acc, gyro, q, temperature, raw[:, 0x35 - FIRST_REGISTER].copy(), flags)


def _in_runs_of_at_least(mask: NDArray[np.bool_], length: int) -> NDArray[np.bool_]:
    edges = np.diff(np.concatenate([[0], mask.astype(np.int8), [0]]))
    out = np.zeros_like(mask)
    for start, end in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
        if end - start >= length:
            out[start:end] = True
    return out


def _spikes(values: FloatArray, present: NDArray[np.bool_], limit: float) -> NDArray[np.bool_]:
    """Mark single samples that leave both neighbours by more than ``limit`` in the same direction."""
    out = np.zeros(len(values), dtype=np.bool_)
    if len(values) >= 3:
        up, down = values[1:-1] - values[:-2], values[1:-1] - values[2:]
        jump = (np.sign(up) == np.sign(down)) & (np.minimum(np.abs(up), np.abs(down)) > limit)
        out[1:-1] = jump.any(axis=1) & present[1:-1] & present[:-2] & present[2:]
    return out
