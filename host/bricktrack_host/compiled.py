"""The one way in which loops are compiled: once a machine, without the interpreter's lock.

Numba keeps the code of each function under the time stamp of its own file, and would go on using it after a
change in another file that the function calls into. So the code is kept in a folder named after what the
function's module holds, and all modules of ours that it imports from, and so on: a change compiles anew what
it can reach, once, and nothing else.
"""

import hashlib
import os
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import ParamSpec, TypeVar, cast

import numba
from numba import njit

import bricktrack_common

_P = ParamSpec("_P")
_R = TypeVar("_R")
_ROOT = Path(os.environ.get("NUMBA_CACHE_DIR") or Path.home() / ".cache" / "bricktrack" / "compiled")
_OURS = {
    "bricktrack_host": Path(__file__).parent,
    "bricktrack_common": Path(bricktrack_common.__file__).parent,
}
_IMPORT = re.compile(r"^\s*from (bricktrack_\w+)([\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function compiled by numba; threads can run it side by side.

    Division by zero gives infinity or NaN, as in numpy. The first call on a machine compiles; the code is
    kept in the user's cache folder, or in ``NUMBA_CACHE_DIR``.
    """
    numba.config.CACHE_DIR = str(_folder(function.__code__.co_filename))  # type: ignore[attr-defined]
    return cast(Callable[_P, _R], njit(cache=True, nogil=True, error_model="numpy")(function))


def compiled_in_place(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function compiled as by `compiled`, which makes no arrays: it fills those that it is given.

    They then need no counts of who holds them, whose atomic changes cost small kernels a third of their
    time.
    """
    numba.config.CACHE_DIR = str(_folder(function.__code__.co_filename))  # type: ignore[attr-defined]
    made = njit(cache=True, nogil=True, error_model="numpy", _nrt=False)  # type: ignore[call-overload]
    return cast(Callable[_P, _R], made(function))


def _folder(filename: str) -> Path:
    held = hashlib.sha256()
    for source in sorted(sources_behind(Path(filename))):
        held.update(source.name.encode() + _read(source))
    return _ROOT / held.hexdigest()[:16]


def sources_behind(source: Path) -> set[Path]:
    """Return a module's file and those of our modules that it imports from, however indirectly."""
    reached: set[Path] = set()
    open_: list[Path] = [source]
    while open_:
        at = open_.pop()
        if at not in reached:
            reached.add(at)
            open_ += _imported(at)
    return reached


@cache
def _imported(source: Path) -> tuple[Path, ...]:
    found = []
    for package, inner, names in _IMPORT.findall(_read(source).decode()):
        if package in _OURS:
            base = _OURS[package].joinpath(*inner.split("."))
            tried = [base.with_suffix(".py"), base / "__init__.py"]
            tried += [base / f"{name}.py" for name in re.findall(r"\w+", names)]
            found += [path for path in tried if path.is_file()]
    return tuple(found)


@cache
def _read(source: Path) -> bytes:
    return source.read_bytes()
