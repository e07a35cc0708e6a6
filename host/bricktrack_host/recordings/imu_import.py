"""Inertial samples from elsewhere, as the register records that a run's stream holds."""

import errno
import struct
from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.errors import ConfigError, RunFormatError
from bricktrack_common.imu_records import (
    FIRST_REGISTER,
    N_DATA_BYTES,
    STANDARD_GRAVITY_MPS2,
    ImuDescription,
    ImuFlag,
    ImuRecord,
    decode_imu,
)
from bricktrack_host.recordings.loose_files import LooseImu

_OPR_MODE_AMG = 0x07
_ACC_LSB_PER_MPS2 = 100.0  # BNO055 data sheet, table 3-17
_GYRO_LSB_PER_DPS = 16.0  # table 3-22
_INT16_MAX = 32767
_ON_GRID_LSB = 1e-3  # how far from a whole register value a number may be and still count as one
_NO_TEMPERATURE_DEGC = -128  # no chip reads this: better than a believable 0


@dataclass(frozen=True, slots=True)
class ImportedImu:
    """One sensor's stream, ready to write.

    Attributes
    ----------
    notes : list of str
        What became of the resolution and the timing, in words.
    n_missing : int
        Slots without a sample.
    n_repeats, n_clipped : int
        As `decode_imu` flags them.
    """

    description: ImuDescription
    records: list[ImuRecord]
    notes: list[str]
    n_missing: int
    n_repeats: int
    n_clipped: int


def import_imu(
    imu: LooseImu, *, name: str, acc_range_g: float = 16.0, gyro_range_dps: float = 2000.0
) -> ImportedImu:
    """Return samples as register records on the grid that fits their times best.

    A BNO055's own steps, 0.01 m/s^2 and 1/16 deg/s, are kept exactly; finer data get the finest scale that
    16 bits allow, and the notes say what it is.

    Raises
    ------
    RunFormatError
        If the samples are too irregular for a grid.
    ConfigError
        If values go beyond the stated range.
    """
    period_ns, t0_ns, slots, worst_ns = _fit_grid(imu.t_ns)
    acc_lsb, acc_words, acc_note = _to_words(
        imu.acc_mps2, _ACC_LSB_PER_MPS2, acc_range_g * STANDARD_GRAVITY_MPS2, "accelerometer", "m/s²",
        f"give its range with --imu-acc-range-g (it is {acc_range_g:g} now)",
    )  # fmt: skip
    gyro_lsb, gyro_words, gyro_note = _to_words(
        imu.gyro_dps, _GYRO_LSB_PER_DPS, gyro_range_dps, "gyroscope", "deg/s",
        f"give its range with --imu-gyro-range-dps (it is {gyro_range_dps:g} now)",
    )  # fmt: skip
    description = ImuDescription(
        name=name, chip_id="", bus="import", address=0, opr_mode=_OPR_MODE_AMG, fusion=False,
        acc_lsb_per_mps2=acc_lsb, gyro_lsb_per_dps=gyro_lsb, acc_range_g=acc_range_g,
        gyro_range_dps=gyro_range_dps, period_ns=period_ns, t0_ns=t0_ns,
    )  # fmt: skip
    present = [bool(row.all()) for row in np.isfinite(imu.acc_mps2)]
    records = [
        ImuRecord(slot, t, t, _registers(acc, gyro), 0, None)
        if ok
        else ImuRecord(slot, t, t, None, errno.ENODATA, None)
        for slot, t, acc, gyro, ok in zip(
            slots.tolist(), imu.t_ns.tolist(), acc_words.tolist(), gyro_words.tolist(), present, strict=True,
        )
    ]  # fmt: skip
    samples = decode_imu(description, records)
    counts = {f: int(np.count_nonzero(samples.flags & int(f))) for f in ImuFlag}
    notes = [
        f"{len(records)} samples every {period_ns / 1e6:.4f} ms, within {worst_ns / 1e3:.0f} µs of that grid",
        acc_note,
        gyro_note,
    ]
    if counts[ImuFlag.GAP]:
        notes.append(f"{counts[ImuFlag.GAP]} samples are missing")
    if counts[ImuFlag.STUCK]:
        notes.append(f"{counts[ImuFlag.STUCK]} samples repeat at least ten times: taken as a stuck sensor")
    if counts[ImuFlag.JUMP]:
        notes.append(f"{counts[ImuFlag.JUMP]} samples jump and come back as no brick does: not used")
    return ImportedImu(
        description, records, notes, counts[ImuFlag.GAP], counts[ImuFlag.REPEAT],
        int(np.count_nonzero(samples.flags & int(ImuFlag.ACC_CLIPPED | ImuFlag.GYRO_CLIPPED))),
    )  # fmt: skip


def _fit_grid(t_ns: IntArray) -> tuple[int, int, IntArray, int]:
    """Return period, start, the slot of each sample and the farthest distance of one from its slot."""
    if len(t_ns) < 2:
        raise RunFormatError(f"{len(t_ns)} inertial samples; at least two are needed to know their rate")
    t = (t_ns - t_ns[0]).astype(np.float64)
    median = float(np.median(np.diff(t)))
    slots = np.concatenate([[0], np.cumsum(np.maximum(np.rint(np.diff(t) / median), 0))]).astype(np.int64)
    if slots[-1] == 0:
        raise RunFormatError("inertial samples have no regular rate")
    slope, _ = np.polyfit(slots.astype(np.float64), t, 1)
    period_ns = round(slope)
    start_ns = round(float(np.median(t - slots * period_ns)))
    off = t - (start_ns + slots * period_ns)
    worst = int(np.argmax(np.abs(off)))
    if np.diff(slots).min() < 1 or abs(off[worst]) >= period_ns / 2:
        i = int(np.argmin(np.diff(slots))) + 1 if np.diff(slots).min() < 1 else worst
        raise RunFormatError(
            f"inertial sample {i} at t_ns {t_ns[i]} is not on a regular grid of {period_ns / 1e6:.3f} ms: a "
            "run's stream has one slot a period. Resample the recording to a steady rate first"
        )
    return period_ns, int(t_ns[0]) + start_ns, slots, int(abs(off[worst]))


def _to_words(
    values: FloatArray, usual_lsb: float, limit: float, what: str, unit: str, remedy: str
) -> tuple[float, IntArray, str]:
    """Return the scale, the values as 16-bit register words, and what resolution that keeps."""
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    if largest > limit * 1.01:
        raise ConfigError(f"{what}: {largest:g} {unit} is beyond its range of {limit:g} {unit}; {remedy}")
    scaled = np.where(np.isfinite(values), values, 0.0) * usual_lsb
    if (
        np.abs(scaled - np.rint(scaled)).max(initial=0.0) <= _ON_GRID_LSB
        and largest * usual_lsb <= _INT16_MAX
    ):
        lsb = usual_lsb
        note = f"{what}: kept exactly, in steps of 1/{lsb:g} {unit}"
    else:
        lsb = float(2.0 ** np.floor(np.log2(_INT16_MAX / max(largest, limit / 4096))))
        note = f"{what}: rounded to steps of 1/{lsb:g} {unit}, the finest that 16 bits hold"
    words = np.rint(np.where(np.isfinite(values), values, 0.0) * lsb).astype(np.int64)
    return lsb, words, note


def _registers(acc: list[int], gyro: list[int]) -> bytes:
    """Return one burst, registers 0x08..0x35, with what was not measured left 0."""
    data = bytearray(N_DATA_BYTES)
    struct.pack_into("<3h", data, 0x08 - FIRST_REGISTER, *acc)
    struct.pack_into("<3h", data, 0x14 - FIRST_REGISTER, *gyro)
    struct.pack_into("b", data, 0x34 - FIRST_REGISTER, _NO_TEMPERATURE_DEGC)
    return bytes(data)
