"""The one way in which loops are compiled: once a machine, without the interpreter's lock.

Numba keeps the code of each function under the time stamp of its own file, and would go on using it after a
change in another file that the function calls into. So the code is kept in a folder named after what the
function's module holds, and all modules of ours that it imports from, and so on: a change compiles anew what
it can reach, once, and nothing else. Of several processes that need the same code one compiles it; the others
wait, and load it.
"""

import hashlib
import logging
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any, ParamSpec, TextIO, TypeVar, cast

import numba
from numba import njit
from numba.core.compiler_lock import global_compiler_lock

import bricktrack_common

try:
    import fcntl
except ImportError:  # not on Windows, where each process compiles for itself
    fcntl = None  # type: ignore[assignment]

logger = logging.getLogger(__name__)
_P = ParamSpec("_P")
_R = TypeVar("_R")
COMPILED_ROOT = Path(os.environ.get("NUMBA_CACHE_DIR") or Path.home() / ".cache" / "bricktrack" / "compiled")
QUICK_WITH = ("0.68.1",)
"""Versions of numba that `compiled_cache` was tested with: it rests on parts of it that may change any time.
With others numba's own cache is used as it is."""
_NAMING = Lock()
"""Numba takes a function's folder from a setting of the whole process; modules may be imported by threads."""
PATIENCE_S = 600.0
"""Another process that compiles for longer has been stopped: its code is compiled here too."""
_POLL_S = 0.1
_IN_ANY_ORDER = {"contract", "reassoc", "arcp", "nsz"}
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
    return _kept(function)


def compiled_in_place(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function compiled as by `compiled`, which makes no arrays: it fills those that it is given.

    They then need no counts of who holds them, whose atomic changes cost small kernels a third of their
    time.
    """
    return _kept(function, _nrt=False)


def compiled_sums(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function compiled as by `compiled_in_place`, whose products may be rounded with their sums.

    One rounding instead of two: faster, and not less exact. NaN and infinity stay what they are.
    """
    return _kept(function, _nrt=False, fastmath={"contract"})


def compiled_fast(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function compiled as by `compiled_sums`, whose sums may also be taken in another order.

    For formulas that do not rest on the order of their operations. NaN and infinity stay what they are.
    """
    return _kept(function, _nrt=False, fastmath=_IN_ANY_ORDER)


def compiled_inline(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function compiled as by `compiled_fast`, whose code is put where it is called.

    An array is passed as a dozen numbers: for a short function with several arrays that costs more than what
    it does.
    """
    return _kept(function, _nrt=False, forceinline=True, fastmath=_IN_ANY_ORDER)


def compiled_callback(signature: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return what compiles a function for callers outside Python; they call the result's ``address``."""

    def kept(function: Callable[..., Any]) -> Any:
        with _NAMING:
            numba.config.CACHE_DIR = str(_folder(function.__code__.co_filename))  # type: ignore[attr-defined]
            return numba.cfunc(signature, cache=True)(function)

    return kept


def _kept(function: Callable[_P, _R], **options: bool | set[str]) -> Callable[_P, _R]:
    folder = _folder(function.__code__.co_filename)
    dispatcher: Any = njit(nogil=True, error_model="numpy", **options)(function)  # type: ignore[call-overload]
    with _NAMING:
        numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]
        if numba.__version__ in QUICK_WITH:
            from bricktrack_host.compiled_cache import QuickCache

            dispatcher._cache = QuickCache(function)  # type: ignore[no-untyped-call]
        else:
            dispatcher.enable_caching()
    dispatcher.compile = _one_at_a_time(dispatcher.compile, folder, function.__qualname__)
    return cast(Callable[_P, _R], dispatcher)


def _one_at_a_time(compile_for: Callable[[Any], Any], folder: Path, name: str) -> Callable[[Any], Any]:
    """Return a dispatcher's compilation, of which there is one at a time among processes.

    The lock of the process is taken before that between processes, by everyone, and a function's before those
    of the functions that it calls: nobody waits in a circle.
    """

    def compile_or_load(signature: Any) -> Any:
        with global_compiler_lock:
            if not any(folder.rglob("*.nbi")):  # what numba calls its lists of what it keeps
                _say_once()
            with _lock_between_processes(folder / f"{name}.lock"):
                return compile_for(signature)

    return compile_or_load


@cache
def _say_once() -> None:
    logger.warning(
        "compiling the numerical loops for this machine, some minutes in all; kept in %s, so only once",
        COMPILED_ROOT,
    )


@contextmanager
def _lock_between_processes(path: Path) -> Iterator[None]:
    """Hold a lock on a file while the block runs; where there can be none, go on without."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("w")
    except OSError:
        yield
        return
    with file:
        if fcntl is not None:
            _wait_for(file, path)
        yield


def _wait_for(file: TextIO, path: Path) -> None:
    """Take the lock of a file, which its closing gives back, or go on without after `PATIENCE_S`."""
    until_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < until_s:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(_POLL_S)
        except OSError:  # some network file systems have no locks
            return
        else:
            return
    logger.warning("%s: another process holds it for %.0f s; compiling without", path, PATIENCE_S)


@cache
def _folder(filename: str) -> Path:
    held = hashlib.sha256(numba.__version__.encode())  # versions do not keep the same
    for source in sorted(sources_behind(Path(filename))):
        held.update(source.name.encode() + _read(source))
    return COMPILED_ROOT / held.hexdigest()[:16]


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
