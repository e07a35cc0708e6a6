"""Large arrays in a file, so that the memory that processing takes does not grow with the recording.

Processing wants everything of the whole recording: each pass of the smoother goes through all its instants,
forth and back. So NumPy is told to put its larger arrays into a file beside the results, which is mapped into
memory, by its own interface for such things (NEP 49, "Data allocation strategies"); and pages of the file
that were touched are given back to the system again and again. Nothing else knows of it, and no number
changes. The system keeps in memory what it has room for, and writes the rest to the disk. The file has no
name: it is gone with the process, however that ends.

Large arrays lie in memory as ever where that cannot be: on systems other than Linux, with NumPy before 2, on
file systems that cannot set blocks aside, and when half of what was free on the disk is used.
"""

import ctypes
import errno
import logging
import mmap
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

logger = logging.getLogger(__name__)

_LEAST_BYTES = 1 << 18
"""Smaller arrays are more trouble to the system than they take memory."""
_RESIDENT_BYTES = 32 << 20
"""Of the file, before its pages are given back: a tenth of what processing takes anyway."""
_LOOK_S = 0.002  # memory is read at 10 GB/s and more: another 20 MB
_MOST_BYTES = 1 << 40  # what is mapped takes address space, of which there are 100 TB
_SET_HANDLER = 304
"""Its place in the table of NumPy's C interface, which stays what it is as long as NumPy 2 does."""
_HANDLER_VERSION = 1


class _Allocator(ctypes.Structure):
    """``PyDataMemAllocator`` of NumPy."""

    _fields_ = (
        ("ctx", ctypes.c_void_p), ("malloc", ctypes.c_void_p), ("calloc", ctypes.c_void_p),
        ("realloc", ctypes.c_void_p), ("free", ctypes.c_void_p),
    )  # fmt: skip


class _Handler(ctypes.Structure):
    """``PyDataMem_Handler`` of NumPy."""

    _fields_ = (("name", ctypes.c_char * 127), ("version", ctypes.c_uint8), ("allocator", _Allocator))


@contextmanager
def large_arrays_on_disk(folder: Path) -> Iterator[None]:
    """Put large arrays made within the block, by this thread, into a file without a name in a folder.

    A process has one such file on a disk, for all such blocks. Arrays may outlive the block. Processes that
    are forked have no part in the file: they must not touch what lies in it.
    """
    try:
        scratch = _scratch(folder)
    except (OSError, ImportError) as e:
        logger.info("large arrays lie in memory, which grows with the recording: %s", e)
        yield
        return
    with scratch.used():
        yield


class _Scratch:
    """The file, mapped, and what NumPy calls for its blocks.

    It is never taken down: arrays are in it, and give their blocks back when the process ends.
    """

    def __init__(self, folder: Path) -> None:
        if sys.platform != "linux":
            raise ImportError(f"{sys.platform} is not Linux")
        from bricktrack_host import scratch_kernel as kernel

        self._set_handler = _numpy_set_handler()
        n_bytes = min(shutil.disk_usage(folder).free // 2, _MOST_BYTES) // mmap.PAGESIZE * mmap.PAGESIZE
        if n_bytes == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))
        self._file = tempfile.TemporaryFile(prefix=".bricktrack-", dir=folder)  # noqa: SIM115 - for good
        self._file.truncate(n_bytes)
        self._mapped = mmap.mmap(self._file.fileno(), n_bytes)
        self._mapped.madvise(mmap.MADV_DONTFORK)  # or both processes would hand out the same blocks
        self._kernel = kernel
        self.numbers = np.zeros(kernel.N_NUMBERS, dtype=np.int64)
        self.numbers[kernel.BASE] = ctypes.addressof(ctypes.c_char.from_buffer(self._mapped))
        self.numbers[kernel.SIZE], self.numbers[kernel.FILE] = n_bytes, self._file.fileno()
        self.numbers[kernel.LEAST], self.numbers[kernel.MOST_TOUCHED] = _LEAST_BYTES, _RESIDENT_BYTES // 2
        self._callbacks = kernel.allocate, kernel.allocate_zeros, kernel.reallocate, kernel.release
        addresses = (callback.address for callback in self._callbacks)
        allocator = _Allocator(self.numbers.ctypes.data, *addresses)
        self._handler = _Handler(b"bricktrack_scratch", _HANDLER_VERSION, allocator)
        self._capsule = _new_capsule(ctypes.addressof(self._handler), b"mem_handler", None)
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(self))  # some arrays go later than all modules do

    @contextmanager
    def used(self) -> Iterator[None]:
        """Let NumPy put large arrays of this thread here."""
        before = self._set_handler(self._capsule)
        try:
            with self._watched():
                yield
        finally:
            self._set_handler(before)

    @contextmanager
    def _watched(self) -> Iterator[None]:
        """Give the file's pages back to the system whenever too many are in memory, and at the end."""
        kernel, text, ends = self._kernel, np.zeros(256, dtype=np.uint8), np.zeros(1, dtype=np.bool_)
        with Path("/proc/self/statm").open("rb") as statm:
            limits = int(_LOOK_S * 1e6), _RESIDENT_BYTES // mmap.PAGESIZE
            args = self.numbers, statm.fileno(), text, *limits, ends
            watch = threading.Thread(target=kernel.watch, args=args, name="scratch")
            watch.start()
            try:
                yield
            finally:
                ends[0] = True
                watch.join()
                kernel.give_back(self.numbers)


_OF_DISK: dict[int, _Scratch] = {}


def _scratch(folder: Path) -> _Scratch:
    disk = folder.stat().st_dev
    if disk not in _OF_DISK:
        _OF_DISK[disk] = _Scratch(folder)
    return _OF_DISK[disk]


_new_capsule = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p)(
    ("PyCapsule_New", ctypes.pythonapi)
)
_capsule_pointer = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
    ("PyCapsule_GetPointer", ctypes.pythonapi)
)


def _numpy_set_handler() -> Any:
    """Return ``PyDataMem_SetHandler`` of NumPy's C interface."""
    interface = import_module("numpy._core._multiarray_umath")._ARRAY_API
    table = ctypes.cast(_capsule_pointer(interface, None), ctypes.POINTER(ctypes.c_void_p))
    return ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.py_object)(table[_SET_HANDLER])
