"""CURVE keys: the pair that a unit or a host proves itself with, and the files that hold them.

The files are those of the ZeroMQ world, ``NAME.key`` with a public key and ``NAME.key_secret`` with both. A
key is 32 bytes, written as 40 characters of Z85. A secret file belongs to its user alone, mode 0600: one that
others could have read is refused, not mended, because it may have been read.
"""

import hashlib
import os
import re
import stat
import struct
from dataclasses import dataclass, field
from pathlib import Path

import zmq
import zmq.auth
from zmq.utils import z85

from bricktrack_common.errors import ConfigError, StorageError

PUBLIC_SUFFIX = ".key"
SECRET_SUFFIX = ".key_secret"
_KEY_PATTERN = re.compile(r"[0-9A-Za-z.:+=^!/*?&<>()\[\]{}@%$#-]{40}")
_MAX_FILE_BYTES = 4096


@dataclass(frozen=True, slots=True)
class KeyPair:
    """Both halves of a CURVE key, as Z85 text; the secret one stays out of what is printed."""

    public: str
    secret: str = field(repr=False)


def make_key_pair() -> KeyPair:
    """Return a new pair, whose public key can be typed as an argument: it does not begin with a hyphen."""
    while True:
        public, secret = zmq.curve_keypair()
        if not public.startswith(b"-"):
            return KeyPair(public.decode("ascii"), secret.decode("ascii"))


def check_public_key(text: str, *, where: str) -> str:
    """Return a public key, checked.

    Raises
    ------
    ConfigError
        If it is not 40 characters of Z85, or stands for more than 32 bytes.
    """
    try:
        good = _KEY_PATTERN.fullmatch(text) is not None and len(z85.decode(text.encode("ascii"))) == 32
    except (ValueError, struct.error):
        good = False
    if not good:
        raise ConfigError(
            f"{where}: {text!r:.60} is no key; expected 40 characters, as 'bricktrack keys show' and "
            "'bricktrackd keys show' print them"
        )
    return text


def fingerprint(public: str) -> str:
    """Return a short name of a public key, for people to compare: 16 hex digits of its SHA-256.

    Examples
    --------
    >>> fingerprint("Yne@$w-vo<fVvi]a<NY6T1ed:M$fCG*[IaLV{hID")
    'ebb3-af4d-d99c-eff3'
    """
    digits = hashlib.sha256(z85.decode(public.encode("ascii"))).hexdigest()[:16]
    return "-".join(digits[i : i + 4] for i in range(0, 16, 4))


def write_secret_key(path: Path, pair: KeyPair, *, what: str) -> None:
    """Write both halves, for this user alone, durably and never over another file.

    Parameters
    ----------
    what : str
        Whose key it is, for people who open the file.

    Raises
    ------
    StorageError
        If the file exists already or cannot be written.
    """
    text = (
        f"# CURVE key of {what}. Secret: it stays on this machine, with mode 0600.\n"
        f'metadata\ncurve\n    public-key = "{pair.public}"\n    secret-key = "{pair.secret}"\n'
    )
    _write_new(path, text, mode=0o600)


def write_public_key(path: Path, public: str, *, what: str) -> None:
    """Write a public key that others may read; see `write_secret_key`."""
    text = f'# CURVE public key of {what}.\nmetadata\ncurve\n    public-key = "{public}"\n'
    _write_new(path, text, mode=0o644)


def read_secret_key(path: Path) -> KeyPair:
    """Return both halves of a key.

    Raises
    ------
    ConfigError
        If there is no such file, others may read or write it, or it holds no pair that belongs together.
    """
    text_public, text_secret = _read(path, is_secret=True)
    if text_secret is None:
        raise ConfigError(f"{path}: holds no secret key; expected a file ending in {SECRET_SUFFIX}")
    public = check_public_key(text_public, where=str(path))
    check_public_key(text_secret, where=f"{path}: secret-key")
    if zmq.curve_public(text_secret.encode("ascii")).decode("ascii") != public:
        raise ConfigError(f"{path}: its two halves do not belong together; make a new key")
    return KeyPair(public, text_secret)


def read_public_key(path: Path) -> str:
    """Return the public half of either kind of file; raise `ConfigError` as `read_secret_key` does."""
    public, secret = _read(path, is_secret=False)
    if secret is not None and path.suffix == PUBLIC_SUFFIX:
        raise ConfigError(
            f"{path}: holds a secret key, which has no business here. Delete the file, make a new key pair, "
            f"and put its {PUBLIC_SUFFIX} file here"
        )
    return check_public_key(public, where=str(path))


def _read(path: Path, *, is_secret: bool) -> tuple[str, str | None]:
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode) or status.st_size > _MAX_FILE_BYTES:
            raise ConfigError(f"{path}: no key file; expected a file of {_MAX_FILE_BYTES} bytes at most")
        if is_secret:
            _check_private(path, status)
        public, secret = zmq.auth.load_certificate(path)
        return public.decode("ascii"), None if secret is None else secret.decode("ascii")
    except OSError as e:
        raise ConfigError(f"{path}: the key cannot be read: {e.strerror or e}") from e
    except (ValueError, IndexError) as e:
        if isinstance(e, ConfigError):
            raise
        raise ConfigError(f"{path}: no key file: {e}") from e


def _check_private(path: Path, status: os.stat_result) -> None:
    mode = stat.S_IMODE(status.st_mode)
    if mode & 0o077:
        raise ConfigError(
            f"{path}: mode {mode:04o}: others on this machine may have read this secret key; expected 0600. "
            f"If nobody has: chmod 600 {path}. Otherwise make a new key"
        )
    if status.st_uid not in (os.geteuid(), 0):
        raise ConfigError(
            f"{path}: belongs to user {status.st_uid}; expected user {os.geteuid()}, who reads it: chown it"
        )


def _write_new(path: Path, text: str, *, mode: int) -> None:
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with os.fdopen(descriptor, "w", encoding="ascii") as file:
            os.fchmod(file.fileno(), mode)  # whatever the umask
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
    except FileExistsError as e:
        raise StorageError(f"{path}: exists already; a key is never written over") from e
    except OSError as e:
        raise StorageError(f"{path}: cannot be written: {e.strerror or e}") from e
