"""A run under way on disk: whatever order its chunks come in, and whatever was left of it before."""

import hashlib
import json
import os
import random
import zlib

import pytest

from bricktrack_common.wire_messages import FileSummary, RunDescription
from bricktrack_host.transfer import part_folder
from bricktrack_host.transfer.chunk_reads import VerifiedChunk
from bricktrack_host.transfer.part_folder import JOURNAL_NAME, PartFolder

DATA = random.Random(2).randbytes(1_000_003)
CHUNK = 64 * 1024
CHUNKS = [(o, min(CHUNK, len(DATA) - o)) for o in range(0, len(DATA), CHUNK)]


def describe(data=DATA):
    summary = FileSummary(name="video.h264", n_bytes=len(data), sha256=hashlib.sha256(data).hexdigest())
    return RunDescription(run_id="b1_0001", files=[summary])


@pytest.fixture
def path(tmp_path):
    return tmp_path / "b1_0001.part"


def fail(text):
    raise AssertionError(text)


def fill(part, chunks):
    for offset, n_bytes in chunks:
        data = DATA[offset : offset + n_bytes]
        part.write("video.h264", VerifiedChunk(offset, data, zlib.crc32(data)))


@pytest.mark.parametrize("hash_bytes", [1, 200_000, 10**9])
def test_chunks_in_any_order_make_the_file_and_its_hash(path, monkeypatch, hash_bytes):
    """The hash is worked out behind the writing, up to the first hole, however often that is done."""
    monkeypatch.setattr(part_folder, "_HASH_BYTES", hash_bytes)
    shuffled = random.Random(3).sample(CHUNKS, len(CHUNKS))
    with PartFolder.open(path, describe(), note=fail) as part:
        fill(part, shuffled)
        assert part.n_bytes_missing == 0
        assert part.sha256("video.h264") == hashlib.sha256(DATA).hexdigest()
    assert (path / "video.h264").read_bytes() == DATA


def test_what_is_noted_is_not_asked_for_again(path):
    with PartFolder.open(path, describe(), note=fail) as part:
        fill(part, CHUNKS[3:6])
    with PartFolder.open(path, describe(), note=fail) as part:
        assert part.n_bytes_verified == 3 * CHUNK
        assert list(part.missing_chunks("video.h264", CHUNK)) == [*CHUNKS[:3], *CHUNKS[6:]]
        fill(part, [*CHUNKS[:3], *CHUNKS[6:]])
        assert part.sha256("video.h264") == hashlib.sha256(DATA).hexdigest()


def test_a_range_noted_twice_or_over_another_counts_once(path):
    with PartFolder.open(path, describe(), note=fail) as part:
        fill(part, CHUNKS[:2])
    journal = path / JOURNAL_NAME
    lines = journal.read_bytes().split(b"\n")
    journal.write_bytes(b"\n".join([*lines[:-1], lines[1], b""]))
    notes = []
    with PartFolder.open(path, describe(), note=notes.append) as part:
        assert part.n_bytes_verified == 2 * CHUNK
    assert len(notes) == 1


def test_bytes_that_a_power_cut_lost_are_asked_for_again(path):
    with PartFolder.open(path, describe(), note=fail) as part:
        fill(part, CHUNKS)
    with (path / "video.h264").open("rb+") as file:  # the journal came to the disk, these bytes did not
        file.seek(5 * CHUNK)
        file.write(bytes(CHUNK))
    notes = []
    with PartFolder.open(path, describe(), note=notes.append) as part:
        assert list(part.missing_chunks("video.h264", CHUNK)) == [CHUNKS[5]]
    assert notes == ["b1_0001.part: 1 ranges noted earlier are not as noted; they are fetched again"]


def test_a_file_shortened_behind_our_back_has_another_hash(path):
    with PartFolder.open(path, describe(), note=fail) as part:
        fill(part, CHUNKS)
        os.truncate(path / "video.h264", 1000)
        assert part.sha256("video.h264") == hashlib.sha256(DATA[:1000]).hexdigest()


def test_the_chunks_of_a_vast_file_are_not_all_made(path):
    vast = FileSummary(name="video.h264", n_bytes=2**53, sha256="0" * 64)
    with PartFolder.open(path, RunDescription(run_id="b1_0001", files=[vast]), note=fail) as part:
        chunks = part.missing_chunks("video.h264", CHUNK)
        assert [next(chunks), next(chunks)] == [(0, CHUNK), (CHUNK, CHUNK)]


def test_the_journal_is_lines_of_json(path):
    with PartFolder.open(path, describe(), note=fail) as part:
        fill(part, CHUNKS[:1])
        head, first = [json.loads(line) for line in (path / JOURNAL_NAME).read_bytes().splitlines()]
    assert head["journal"] == 1
    assert (first["file"], first["offset"], first["n_bytes"]) == ("video.h264", 0, CHUNK)
