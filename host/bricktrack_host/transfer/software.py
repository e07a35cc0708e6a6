"""Which bricktrack this is, in the words that hosts and units use for it."""

from functools import cache
from importlib import metadata


@cache
def own_software() -> str:
    """Return the software of this machine, as ``bricktrack 1.2.3``."""
    return f"bricktrack {metadata.version('bricktrack')}"
