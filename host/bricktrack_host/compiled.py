"""The one way in which loops are compiled: once a machine, without the interpreter's lock."""

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

from numba import njit

_P = ParamSpec("_P")
_R = TypeVar("_R")


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function compiled by numba; threads can run it side by side.

    Division by zero gives infinity or NaN, as in numpy. The first call on a machine compiles, the code is
    kept beside the module (or in ``NUMBA_CACHE_DIR``).
    """
    return cast(Callable[_P, _R], njit(cache=True, nogil=True, error_model="numpy")(function))
