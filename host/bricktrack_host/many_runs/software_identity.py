"""Which software computes: two machines whose identities are equal give the same numbers."""

import functools
import hashlib
import importlib.metadata
import platform
from pathlib import Path

import bricktrack_common
import bricktrack_host

Identity = dict[str, str]
"""Version of each part by its name."""

# What computes, decodes and writes results.
_LIBRARIES = ("av", "msgspec", "numba", "numpy", "opencv-python-headless", "pyarrow", "scipy")


@functools.cache
def code_sha256() -> str:
    """Return a hash over the source files of bricktrack on this machine."""
    held = hashlib.sha256()
    for package in (bricktrack_common, bricktrack_host):
        root = Path(package.__path__[0])
        for source in sorted(root.rglob("*.py")):
            held.update(f"{package.__name__}/{source.relative_to(root).as_posix()}\0".encode())
            held.update(hashlib.sha256(source.read_bytes()).digest())
    return held.hexdigest()


def identity() -> Identity:
    """Return what computes here."""
    versions = {
        "Python": ".".join(platform.python_version_tuple()[:2]),
        "bricktrack": importlib.metadata.version("bricktrack"),
        "bricktrack's code": code_sha256()[:12],
    }
    for name in _LIBRARIES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions


def differences(here: Identity, there: Identity) -> str:
    """Return in words how another machine's software differs from this one's; ``""`` if it does not.

    Examples
    --------
    >>> differences({"numpy": "2.0", "av": "15"}, {"numpy": "1.26", "av": "15"})
    'numpy 1.26, here 2.0'
    """
    return ", ".join(
        f"{name} {there.get(name, 'unknown')}, here {version}"
        for name, version in here.items()
        if there.get(name) != version
    )
