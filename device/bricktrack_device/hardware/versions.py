"""Which versions of the libraries are installed, and whether they are new enough to be trusted."""

import re
from collections.abc import Sequence
from importlib import metadata

from bricktrack_common.errors import HardwareError

_RELEASE = re.compile(r"^(\d+(?:\.\d+)*)(?:\.post(\d+))?")


def release(version: str) -> tuple[tuple[int, ...], int]:
    """Return the numbers of a version and of its post-release (-1 without one), to be compared.

    Examples
    --------
    >>> release("2.0.1.post3") > release("2.0.1"), release("0.3.9") < release("0.3.32+rpt1")
    (True, True)

    Raises
    ------
    ValueError
        If it does not start with a number.
    """
    found = _RELEASE.match(version)
    if found is None:
        raise ValueError(f"{version!r} is no version")
    return tuple(int(n) for n in found[1].split(".")), int(found[2] or -1)


def installed(distribution: str) -> str | None:
    """Return the version of an installed Python distribution, or `None`."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def require(distribution: str, minimum: str, *, why: str, remedy: str) -> str:
    """Return the installed version of a distribution, which must not be older than ``minimum``.

    Raises
    ------
    HardwareError
        If it is not installed or too old.
    """
    found = installed(distribution)
    if found is None:
        raise HardwareError(f"{distribution} is not installed; expected {minimum} or newer. {remedy}")
    if release(found) < release(minimum):
        raise HardwareError(
            f"{distribution} {found} is too old; expected {minimum} or newer, because {why}. {remedy}"
        )
    return found


def versions_of(distributions: Sequence[str]) -> dict[str, str]:
    """Return the versions of those distributions that are installed."""
    found = {d: installed(d) for d in distributions}
    return {d: v for d, v in found.items() if v is not None}
