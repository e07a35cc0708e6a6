"""Reads ranges of a file from a unit, with several chunks asked for ahead, each verified."""

import logging
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from bricktrack_common.checksums import crc32
from bricktrack_common.errors import TransferError
from bricktrack_common.wire_messages import Chunk, Read
from bricktrack_host.transfer.unit_connection import UnitConnection

logger = logging.getLogger(__name__)

CHUNK_BYTES = 512 * 1024
CREDIT = 5
"""Chunks asked for ahead: the bytes of ten of 256 KiB, and two thirds faster (scripts/bench_transfer.py)."""
_MAX_TRIES_PER_CHUNK = 4


class VerifiedChunk(NamedTuple):
    """Bytes of a file that match their checksum."""

    offset: int
    data: bytes
    crc32: int


@dataclass(slots=True)
class _Asked:
    offset: int
    length: int
    tries: int = 0


def read_chunks(
    connection: UnitConnection,
    run_id: str,
    file_index: int,
    ranges: list[tuple[int, int]],
    *,
    credit: int = CREDIT,
) -> Iterator[VerifiedChunk]:
    """Yield the bytes of some ranges of a file, in the order they arrive.

    Up to ``credit`` chunks are asked for ahead. A chunk that does not match its checksum, and one that
    stays out while others come, is asked for again.

    Parameters
    ----------
    ranges : list of (int, int), bytes
        Offset and length of each chunk, at most `MAX_CHUNK_BYTES` long.

    Raises
    ------
    UnitTimeoutError
        If nothing comes for ``timeout_s``.
    TransferError
        If a chunk comes broken four times.
    UnitError
        If the unit refuses.
    """
    waiting = deque(_Asked(offset, length) for offset, length in ranges)
    asked: dict[int, _Asked] = {}
    heard_s = time.monotonic()
    while waiting or asked:
        while waiting and len(asked) < credit:
            chunk = waiting.popleft()
            chunk.tries += 1
            read = Read(run_id=run_id, file_index=file_index, offset=chunk.offset, length=chunk.length)
            asked[connection.send(read, heard_s + connection.timeout_s)] = chunk
        what = f"{len(asked)} chunks of file {file_index} of {run_id}"
        request_id, reply, data = connection.receive(heard_s + connection.timeout_s, what)
        if request_id not in asked:
            connection.counts.stray_replies += 1
            continue
        chunk = asked.pop(request_id)
        heard_s = time.monotonic()
        what = f"bytes from {chunk.offset} of file {file_index} of {run_id}"
        header = connection.expect(reply, Chunk, what)
        problem = _chunk_problem(header, data, run_id, file_index, chunk)
        if problem:
            _ask_again(connection, chunk, waiting, problem)
        else:
            yield VerifiedChunk(chunk.offset, data, header.crc32)
            heard_s = time.monotonic()  # a slow disk on this side is not the unit's silence
        for overdue in [i for i in asked if i < request_id - 2 * credit]:
            lost = asked.pop(overdue)
            _ask_again(connection, lost, waiting, f"the chunk at byte {lost.offset} did not come")


def _ask_again(connection: UnitConnection, chunk: _Asked, waiting: deque[_Asked], problem: str) -> None:
    if chunk.tries >= _MAX_TRIES_PER_CHUNK:
        raise TransferError(
            f"{connection.address}: {problem}, {chunk.tries} times. Check the network and the unit's card"
        )
    logger.warning("%s: %s; asked for again", connection.address, problem)
    connection.counts.repeated_chunks += 1
    waiting.appendleft(chunk)


def _chunk_problem(reply: Chunk, data: bytes, run_id: str, file_index: int, chunk: _Asked) -> str:
    """Return in words why a chunk is not the one that was asked for, or is broken; else ``""``."""
    where = f"the chunk at byte {chunk.offset} of file {file_index} of {run_id}"
    if (reply.run_id, reply.file_index, reply.offset) != (run_id, file_index, chunk.offset):
        return f"{where} came as byte {reply.offset} of file {reply.file_index} of {reply.run_id}"
    if len(data) != chunk.length or reply.n_bytes != chunk.length:
        return f"{where} has {len(data)} bytes instead of {chunk.length}"
    if crc32(data) != reply.crc32:
        return f"{where} does not match its checksum"
    return ""
