"""Blocks of memory in a mapped file, handed out and taken back: compiled, as NumPy calls it for its arrays.

A block is one of its size class that was given back, or comes from behind all that is used of the file. The
file system is asked to hold it first: that a disk is full is found out here, and not when the block is
written to. Small arrays, and those that the file has no place for, come from the C library as ever.

NumPy calls all of this with the interpreter's lock held, one call at a time.
"""

from typing import Any

import numpy as np
from numba import carray, types  # type: ignore[attr-defined]

from bricktrack_common.arrays import IntArray
from bricktrack_host.compiled import compiled, compiled_callback

BASE, SIZE, USED, FILE, LEAST, TOUCHED, MOST_TOUCHED = range(7)
"""Of the allocator's numbers: where the file is mapped, and how many bytes of it; how many of them are used;
the file's descriptor; from how many bytes on arrays lie in it; how many were handed out since the file's
pages were last given back to the system, and after how many they are."""
_STACKS = 8  # where the stacks of free blocks begin, one for each size class
_PAGE_BITS = 12
_N_CLASSES = 4 * (48 - _PAGE_BITS)  # four between a power of two and the next
_DEPTH = 128  # a stack's count, and the blocks that it can hold; what is beyond stays unused
N_NUMBERS = _STACKS + _N_CLASSES * _DEPTH
_MADV_DONTNEED = 4  # of a mapped file: forget the pages, which stay with the file
_FALLOC_WHOLE = 0
_SPACE, _ZERO = ord(" "), ord("0")

_address: Any = types.intp
_bytes: Any = types.intp
_int: Any = types.int32
_nothing: Any = types.void
_numbers: Any = types.CPointer(types.int64)  # type: ignore[no-untyped-call]


def _of_c(name: str, signature: Any) -> Any:
    """Return a function of the C library, for compiled code."""
    return types.ExternalFunction(name, signature)


_malloc = _of_c("malloc", _address(_bytes))
_calloc = _of_c("calloc", _address(_bytes, _bytes))
_realloc = _of_c("realloc", _address(_address, _bytes))
_free = _of_c("free", _nothing(_address))
_memset = _of_c("memset", _address(_address, _int, _bytes))
_memcpy = _of_c("memcpy", _address(_address, _address, _bytes))
_usleep = _of_c("usleep", _int(_int))
_pread = _of_c("pread", _bytes(_int, _address, _bytes, _bytes))
_madvise = _of_c("madvise", _int(_address, _bytes, _int))
_fallocate = _of_c("fallocate", _int(_int, _int, _bytes, _bytes))


@compiled
def _size_class(n_bytes: int) -> tuple[int, int]:
    """Return the bytes of a block that holds so many, a quarter more at most, and the place of its stack."""
    bits = _PAGE_BITS + 2
    while (n_bytes - 1) >> (bits + 1):
        bits += 1
    quarter = 1 << (bits - 2)
    quarters = max((n_bytes + quarter - 1) // quarter, 1)  # 5 to 8; fewer of the smallest
    return quarters * quarter, _STACKS + (4 * (bits - _PAGE_BITS - 2) + quarters - 1) * _DEPTH


@compiled
def give_back(numbers: IntArray) -> None:
    """Give the file's pages back to the system; what they hold stays with the file."""
    numbers[TOUCHED] = 0
    _madvise(numbers[BASE], numbers[USED], _MADV_DONTNEED)


@compiled
def watch(numbers: IntArray, statm: int, text: Any, look_us: int, most_pages: int, ends: Any) -> None:
    """Give pages back whenever so many more than at best are in memory.

    Parameters
    ----------
    numbers : ndarray of int64, shape (N_NUMBERS,)
    statm : int
        Descriptor of ``/proc/self/statm``, whose third number tells how many pages of mapped files are.
    text : ndarray of uint8, shape (m,)
        Room to read it.
    look_us : int
        From one look to the next.
    most_pages : int
    ends : ndarray of bool, shape (1,)
        Set by another thread when it is to end.
    """
    least = _file_pages(statm, text)
    while not ends[0]:
        _usleep(look_us)
        if _file_pages(statm, text) - least > most_pages:
            give_back(numbers)
            least = _file_pages(statm, text)  # libraries are mapped files too


@compiled
def _file_pages(statm: int, text: Any) -> int:
    n, column, pages = _pread(statm, text.ctypes.data, len(text), 0), 0, 0
    for i in range(n):
        if text[i] == _SPACE:
            column += 1
        elif column == 2:
            pages = 10 * pages + text[i] - _ZERO
    return pages


@compiled
def _take(numbers: IntArray, n_bytes: int) -> int:
    """Return the address of a block in the file, or 0."""
    if n_bytes < numbers[LEAST]:
        return 0
    size, stack = _size_class(n_bytes)
    numbers[TOUCHED] += size
    if numbers[TOUCHED] > numbers[MOST_TOUCHED]:
        give_back(numbers)
    if numbers[stack]:
        at = numbers[stack + numbers[stack]]
        numbers[stack] -= 1
        return int(numbers[BASE] + at)
    at = numbers[USED]
    if at + size > numbers[SIZE] or _fallocate(numbers[FILE], _FALLOC_WHOLE, at, size) != 0:
        return 0
    numbers[USED] += size
    return int(numbers[BASE] + at)


@compiled
def _is_ours(numbers: IntArray, address: int) -> bool:
    return bool(0 <= address - numbers[BASE] < numbers[SIZE])


@compiled_callback(_address(_numbers, _bytes))
def allocate(kept: Any, n_bytes: int) -> Any:
    """Return the address of a new block, 0 if there is no memory."""
    address = _take(carray(kept, N_NUMBERS), n_bytes)
    return address if address else _malloc(n_bytes)


@compiled_callback(_address(_numbers, _bytes, _bytes))
def allocate_zeros(kept: Any, n: int, n_bytes: int) -> Any:
    """Return the address of a new block of zeros for n elements, 0 if there is no memory."""
    if n and n_bytes > np.iinfo(np.int64).max // n:
        return 0
    address = _take(carray(kept, N_NUMBERS), n * n_bytes)
    return _memset(address, 0, n * n_bytes) if address else _calloc(n, n_bytes)


@compiled_callback(_address(_numbers, _address, _bytes))
def reallocate(kept: Any, address: int, n_bytes: int) -> Any:
    """Return the address of a block of another size with the same content, 0 if there is no memory.

    How many bytes there were, NumPy does not say: as many as wanted are copied, which the file always has.
    """
    numbers = carray(kept, N_NUMBERS)
    if not _is_ours(numbers, address):
        return _realloc(address, n_bytes)
    new = _take(numbers, n_bytes)
    if new == 0:
        new = _malloc(n_bytes)
    if new != 0:
        _memcpy(new, address, min(n_bytes, numbers[USED] - (address - numbers[BASE])))
    return new


@compiled_callback(_nothing(_numbers, _address, _bytes))
def release(kept: Any, address: int, n_bytes: int) -> None:
    """Take a block back."""
    numbers = carray(kept, N_NUMBERS)
    if not _is_ours(numbers, address):
        _free(address)
        return
    _, stack = _size_class(n_bytes)
    if numbers[stack] < _DEPTH - 1:
        numbers[stack] += 1
        numbers[stack + numbers[stack]] = address - numbers[BASE]
