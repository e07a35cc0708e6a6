"""Inertial records in memory that two processes share: one writes, the other looks back over seconds.

Every record has a fixed size and carries its own CRC-32, so that one caught half-written is told from a
whole one on any processor; the count of records is a single aligned word.
"""

import struct
import zlib
from multiprocessing.shared_memory import SharedMemory
from typing import cast

from bricktrack_common.imu_records import N_DATA_BYTES, ImuRecord

_HEADER_BYTES = 64
_RECORD = struct.Struct(f"<qqqiBB3s{N_DATA_BYTES}sx")
_CRC = struct.Struct("<I")
RECORD_BYTES = _RECORD.size + _CRC.size
_NO_DATA = bytes(N_DATA_BYTES)
_NO_STATUS = bytes(3)


class SampleBuffer:
    """A ring of `ImuRecord` in shared memory.

    The process that made it (``name=None``) reads and finally unlinks it; one other process writes.

    Parameters
    ----------
    capacity : int
        Records kept; older ones are overwritten.
    name : str or None
        Of an existing buffer, in the writer's process.
    """

    def __init__(self, capacity: int, name: str | None = None) -> None:
        size = _HEADER_BYTES + capacity * RECORD_BYTES
        self._shared = SharedMemory(name=name, create=name is None, size=size)
        self._is_owner = name is None
        self.capacity = capacity
        self._view = cast("memoryview[int]", self._shared.buf)[:size]
        self._words = self._view[:_HEADER_BYTES].cast("I")
        if self._is_owner:
            for i in range(3):
                self._words[i] = 0

    @property
    def name(self) -> str:
        """By this the writer's process finds the buffer."""
        return self._shared.name

    @property
    def count(self) -> int:
        """Records written so far."""
        return self._words[0]

    @property
    def n_failed(self) -> int:
        """Records without data among them."""
        return self._words[2]

    @property
    def stop_asked(self) -> bool:
        """Whether the reader told the writer to end."""
        return self._words[1] != 0

    def ask_stop(self) -> None:
        """Tell the writer to end."""
        self._words[1] = 1

    def append(self, record: ImuRecord) -> None:
        """Write one record; only the writer's process may."""
        count = self._words[0]
        packed = _RECORD.pack(
            record.slot,
            record.t_before_ns,
            record.t_after_ns,
            record.errno,
            record.data is not None,
            record.status is not None,
            record.status or _NO_STATUS,
            record.data or _NO_DATA,
        )
        at = _HEADER_BYTES + (count % self.capacity) * RECORD_BYTES
        self._view[at : at + RECORD_BYTES] = packed + _CRC.pack(zlib.crc32(packed))
        self._words[2] += record.data is None
        self._words[0] = count + 1

    def records(self, *, newest: int | None = None) -> list[ImuRecord]:
        """Return the whole records that are held, oldest first; at most the ``newest`` ones."""
        count = self.count
        first = max(0, count - self.capacity)
        if newest is not None:
            first = max(first, count - newest)
        raw = []
        for i in range(first, count):
            at = _HEADER_BYTES + (i % self.capacity) * RECORD_BYTES
            raw.append((i, bytes(self._view[at : at + RECORD_BYTES])))
        oldest_untouched = self.count - self.capacity + 1  # the writer may be at work on the one before
        unpacked = (_unpack(data) for i, data in raw if i >= oldest_untouched)
        return [record for record in unpacked if record is not None]

    def close(self) -> None:
        """Let go of the memory; the owner also gives it back to the system."""
        self._words.release()
        self._view.release()
        self._shared.close()
        if self._is_owner:
            self._shared.unlink()


def _unpack(data: bytes) -> ImuRecord | None:
    body, crc = data[: _RECORD.size], data[_RECORD.size :]
    if _CRC.unpack(crc)[0] != zlib.crc32(body):
        return None
    slot, t_before, t_after, error, has_data, has_status, status, registers = _RECORD.unpack(body)
    return ImuRecord(
        slot=slot,
        t_before_ns=t_before,
        t_after_ns=t_after,
        data=registers if has_data else None,
        errno=error,
        status=status if has_status else None,
    )
