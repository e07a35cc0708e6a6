"""The one way in which loops are compiled: once a machine, without the interpreter's lock.

Numba keeps the code of each function under the time stamp of its own file, and would go on using it after a
change in another file that the function calls into. So the code is kept in a folder named after what all
modules hold that compile: when one changes, everything is compiled anew, once.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar, cast

import numba
from numba import njit

_P = ParamSpec("_P")
_R = TypeVar("_R")


def _folder() -> Path:
    root = Path(os.environ.get("NUMBA_CACHE_DIR") or Path.home() / ".cache" / "bricktrack" / "compiled")
    held = hashlib.sha256()
    for source in sorted(Path(__file__).parent.rglob("*.py")):
        text = source.read_bytes()
        if b"import compiled" in text:
            held.update(text)
    return root / held.hexdigest()[:16]


numba.config.CACHE_DIR = str(_folder())  # type: ignore[attr-defined]


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function compiled by numba; threads can run it side by side.

    Division by zero gives infinity or NaN, as in numpy. The first call on a machine compiles; the code is
    kept in the user's cache folder, or in ``NUMBA_CACHE_DIR``.
    """
    return cast(Callable[_P, _R], njit(cache=True, nogil=True, error_model="numpy")(function))
