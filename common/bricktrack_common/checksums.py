"""Hashes of files and chunks."""

import hashlib
import zlib
from pathlib import Path


def sha256_file(path: Path) -> str:
    """Return the SHA-256 of a file as 64 hex digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sha256_bytes(data: bytes) -> str:
    """Return the SHA-256 of bytes as 64 hex digits.

    Examples
    --------
    >>> sha256_bytes(b"")[:16]
    'e3b0c44298fc1c14'
    """
    return hashlib.sha256(data).hexdigest()


def crc32(data: bytes) -> int:
    """Return the CRC-32 of a chunk; a quick check before the whole file's SHA-256."""
    return zlib.crc32(data)
